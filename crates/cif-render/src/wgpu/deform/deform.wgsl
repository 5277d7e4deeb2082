// Moves the canonical Gaussians to the time of a view: lookup, trunk and heads in one pass, deltas added to the raw
// parameters. Source: methods reference 2.2 and 2.3; twins: DeformationAtTime::forward in cpu/deform.rs,
// reference/deform.rs.

#import deformation
#import moment

@group(0) @binding(0) var<uniform> deformation: Deformation;
@group(0) @binding(1) var<uniform> moment: Moment;
@group(0) @binding(2) var<storage, read> canonical: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> canonical_sh: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> planes: array<f32>;
@group(0) @binding(5) var<storage, read> lines: array<f32>;
@group(0) @binding(6) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> posed: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> posed_sh: array<vec4<f32>>;

#import hexplane
#import network

// Hidden layers take the place of the features, which the trunk alone reads.
const FEATURE_REGION: u32 = 0u;
const HIDDEN_REGION: u32 = 0u;
const TRUNK_REGION: u32 = FIRST_COLUMNS * ROW_QUADS;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_row = (group.y * groups.x + group.x) * ROWS;
    if first_row >= moment.gaussians {
        return;
    }
    block_features(thread, first_row, FEATURE_REGION);
    workgroupBarrier();
    multiply(thread, FEATURE_REGION, FEATURES, TRUNK_FORWARD, WIDTH_QUADS, START_BIAS, true, TRUNK_REGION);
    workgroupBarrier();
    // Each of the first ROWS threads keeps the geometry of its Gaussian.
    let row = first_row + thread;
    let mine = thread < ROWS && row < moment.gaussians;
    var geometry: array<vec4<f32>, 3>;
    if mine {
        for (var k = 0u; k < 3u; k++) {
            geometry[k] = canonical[row * 3u + k];
        }
    }
    for (var head = 0u; head < HEADS; head++) {
        let at = deformation.heads[head * 2u];
        let output = deformation.heads[head * 2u + 1u].x;
        multiply(thread, TRUNK_REGION, WIDTH, at.z, WIDTH_QUADS, START_BIAS, true, HIDDEN_REGION);
        workgroupBarrier();
        let quads = (at.y + 3u) / 4u;
        for (var item = thread; item < ROWS * quads; item += THREADS) {
            let local = item / quads;
            let column = item % quads;
            var delta = weights[output + WIDTH * quads + column];
            let first = HIDDEN_REGION + local / 4u;
            let from_weight = output + column;
            var k = 0u;
            for (; k + 4u <= WIDTH; k += 4u) {
                let w0 = weights[from_weight + k * quads];
                let w1 = weights[from_weight + (k + 1u) * quads];
                let w2 = weights[from_weight + (k + 2u) * quads];
                let w3 = weights[from_weight + (k + 3u) * quads];
                delta += activations[first + k * ROW_QUADS][local % 4u] * w0;
                delta += activations[first + (k + 1u) * ROW_QUADS][local % 4u] * w1;
                delta += activations[first + (k + 2u) * ROW_QUADS][local % 4u] * w2;
                delta += activations[first + (k + 3u) * ROW_QUADS][local % 4u] * w3;
            }
            for (; k < WIDTH; k++) {
                delta += activations[first + k * ROW_QUADS][local % 4u] * weights[from_weight + k * quads];
            }
            if at.x == SH_COMPONENT {
                let moved = first_row + local;
                if moved < moment.gaussians {
                    let quad = moved * 12u + column;
                    posed_sh[quad] = canonical_sh[quad] + delta;
                }
            } else if at.x == 3u {
                geometry[0].w += delta.x;
            } else if at.x == 8u {
                geometry[2] += delta;
            } else {
                // Three outputs: the fourth is padding, and zero.
                geometry[at.x / 4u] += vec4<f32>(delta.xyz, 0.0);
            }
        }
        workgroupBarrier();
    }
    if mine {
        for (var k = 0u; k < 3u; k++) {
            posed[row * 3u + k] = geometry[k];
        }
    }
}
