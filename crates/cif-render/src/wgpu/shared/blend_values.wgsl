// Four channels of the values of Gaussians and of pixels, `[rows, C]` each, and the pass that they are blended with.

#import blend_chunk
@group(0) @binding(4) var<uniform> chunk: BlendChunk;
@group(0) @binding(5) var<storage, read> values: array<f32>;

// Values of the staged splats.
var<workgroup> staged_values: array<vec4f, STAGED>;

fn drawn_passes() -> u32 {
    return chunk.passes;
}

fn row_range(row: u32) -> vec2u {
    return vec2u(row * chunk.channels + chunk.first, (row + 1u) * chunk.channels);
}

// Places of four values from `first` on, of which those from `end` on stand in for nothing.
fn places(first: u32, end: u32) -> vec4u {
    return min(vec4u(first) + vec4u(0u, 1u, 2u, 3u), vec4u(end - 1u));
}

// What of four values from `first` on lies before `end`.
fn before(first: u32, end: u32, found: vec4f) -> vec4f {
    return select(vec4f(0.0), found, vec4u(first) + vec4u(0u, 1u, 2u, 3u) < vec4u(end));
}

// Stages the values of the splats.
fn stage_values(count: u32, local: u32) {
    if (local < count) {
        let first = staged[local].row_first;
        let end = staged[local].row_end;
        let at = places(first, end);
        staged_values[local] = before(first, end, vec4f(values[at.x], values[at.y], values[at.z], values[at.w]));
    }
    workgroupBarrier();
}

fn values_of(place: u32, splat: Staged, passes: u32, labels: vec4u) -> vec4f {
    return staged_values[place];
}

// Peak of the blending weight.
fn strength_of(splat: Staged) -> f32 {
    return select(splat.factor.w, splat.color.w, chunk.passes == INSTANCE_PASS);
}

// Place of a pixel, which is counted from the first row that is drawn.
fn position_of(at: vec2u) -> u32 {
    return (at.y - view.first_row * TILE) * view.size.x + at.x;
}
