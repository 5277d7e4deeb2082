// Rows of identities: (dense instance index, bits of its probability), ascending indices.

fn drawn_passes() -> u32 {
    return COLOR_PASS | select(0u, INSTANCE_PASS, WITH_INSTANCES);
}

fn row_range(row: u32) -> vec2u {
    if (!WITH_INSTANCES) {
        return vec2u(0u);
    }
    return vec2u(row_offsets[row], row_offsets[row + 1u]);
}

// The rows are read where they lie.
fn stage_more(count: u32, local: u32) {}

fn values_of(place: u32, splat: Staged, passes: u32, labels: vec4u) -> vec4f {
    if (!WITH_INSTANCES || (passes & INSTANCE_IN_TILE) == 0u) {
        return vec4f(0.0);
    }
    return probabilities_of(splat.row_first, splat.row_end, labels);
}

// Probabilities of four labels (dense index + 1) in a row; 0 outside its support.
fn probabilities_of(first: u32, end: u32, labels: vec4u) -> vec4f {
    var found = vec4f(0.0);
    if (first < end) {
        var entry = first;
        loop {
            let item = identities[entry];
            found = select(found, vec4f(bitcast<f32>(item.y)), labels == vec4u(item.x + 1u));
            continuing {
                entry += 1u;
                break if entry >= end;
            }
        }
    }
    return found;
}
