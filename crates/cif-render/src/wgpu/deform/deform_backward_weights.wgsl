// Gradients of weights and biases: products of the columns that deform_backward left, summed over the Gaussians of a
// chunk in SPLITS parts. Each workgroup makes 32 x 32 weights of one layer, each thread 4 x 4. The optimiser adds the
// parts in order. Source: methods reference 2.3; twin: DeformationAtTime::layer_backward in cpu/deform.rs.

#import layers
#import moment
#import faults

@group(0) @binding(0) var<uniform> layers: Layers;
@group(0) @binding(1) var<uniform> moment: Moment;
@group(0) @binding(2) var<storage, read> scratch: array<vec4<f32>>;
// `[SPLITS, MLP_FLOATS]`.
@group(0) @binding(3) var<storage, read_write> partial_sums: array<f32>;
@group(0) @binding(4) var<storage, read_write> faults: array<atomic<u32>>;

// Adds to a part; says whether it is one that no optimiser may take.
fn add(at: u32, value: f32) -> bool {
    let total = partial_sums[at] + value;
    partial_sums[at] = total;
    return is_beyond(total);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var layer = 0u;
    while layer + 1u < LAYERS && group.x >= layers.rows[2u * layer + 3u].z {
        layer++;
    }
    let shape = layers.rows[2u * layer];
    let place = layers.rows[2u * layer + 1u];
    let tile = group.x - place.z;
    let first_output = tile / place.w * 32u + thread / 8u * 4u;
    let first_input = tile % place.w * 32u + thread % 8u * 4u;
    // Columns behind the end repeat the last one and are not written.
    var output_columns: array<u32, 4>;
    var input_columns: array<u32, 4>;
    for (var k = 0u; k < 4u; k++) {
        output_columns[k] = 1u + (shape.x + min(first_output + k, shape.z - 1u)) * ROW_QUADS;
        input_columns[k] = 1u + (shape.y + min(first_input + k, shape.w - 1u)) * ROW_QUADS;
    }
    var sums: array<vec4<f32>, 4>;
    var biases: vec4<f32>;
    let rows = min(moment.gaussians - moment.first, CHUNK_ROWS);
    let blocks = (rows + ROWS - 1u) / ROWS;
    let per_split = (blocks + SPLITS - 1u) / SPLITS;
    let last = min((group.y + 1u) * per_split, blocks);
    for (var block = group.y * per_split; block < last; block++) {
        let base = block * BLOCK_QUADS;
        if scratch[base].x == 0.0 {
            continue;
        }
        for (var quad = 0u; quad < ROW_QUADS; quad++) {
            let a = scratch[base + input_columns[0] + quad];
            let b = scratch[base + input_columns[1] + quad];
            let c = scratch[base + input_columns[2] + quad];
            let d = scratch[base + input_columns[3] + quad];
            for (var k = 0u; k < 4u; k++) {
                let v = scratch[base + output_columns[k] + quad];
                sums[k] += vec4<f32>(dot(v, a), dot(v, b), dot(v, c), dot(v, d));
                biases[k] += dot(v, vec4<f32>(1.0));
            }
        }
    }
    let part = group.y * MLP_FLOATS;
    var beyond = false;
    for (var k = 0u; k < 4u; k++) {
        let output = first_output + k;
        if output < shape.z {
            for (var j = 0u; j < 4u; j++) {
                let input = first_input + j;
                if input < shape.w {
                    beyond = add(part + place.x + output * shape.w + input, sums[k][j]) || beyond;
                }
            }
            if first_input == 0u {
                beyond = add(part + place.y + output, biases[k]) || beyond;
            }
        }
    }
    if beyond {
        atomicOr(&faults[0], MLP_FAULT);
    }
}
