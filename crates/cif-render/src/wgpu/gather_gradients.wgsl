// Sums the pairs of every splat, in the order in which they were emitted, and turns first moments into the gradient by
// the mean. Twelve numbers per Gaussian: mean 2, second moments 3, colour 3, opacity, responsibility, whether it is
// visible, 0. Rust twin: cpu/renderer/backward.rs, `project_backward`.

#import constants
#import numbers
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> depth_order: array<u32>;
@group(0) @binding(3) var<storage, read> pair_offsets: array<u32>;
@group(0) @binding(4) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(5) var<storage, read> pair_sums: array<f32>;
@group(0) @binding(6) var<storage, read> work: array<u32>;
@group(0) @binding(7) var<storage, read_write> splat_gradients: array<vec4f>;

@compute @workgroup_size(64)
fn gather_gradients(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank >= view.gaussians) {
        return;
    }
    let row = depth_order[rank];
    var sums: array<f32, GRADIENT_SUMS>;
    for (var k = 0u; k < GRADIENT_SUMS; k += 1u) {
        sums[k] = 0.0;
    }
    // Without pairs at all when the lists did not fit.
    let last = select(0u, pair_offsets[rank + 1u], work[WORK_PAIRS] > 0u);
    for (var pair = pair_offsets[rank]; pair < last; pair += 1u) {
        if (pairs[pair].x != NO_SPLAT) {
            for (var k = 0u; k < GRADIENT_SUMS; k += 1u) {
                sums[k] += pair_sums[pair * PAIR_SUMS + k];
            }
        }
    }
    let splat = splats[row];
    let factor = splat.factor;
    // v_sigma = -alpha v_alpha, alpha = o P and v_o = P v_alpha.
    let v_opacity = select(0.0, -sums[8] / factor.w, factor.w > 0.0);
    splat_gradients[3u * row] =
        vec4f(factor.x * sums[0], factor.y * sums[0] + factor.z * sums[1], sums[2], sums[3]);
    splat_gradients[3u * row + 1u] = vec4f(sums[4], sums[5], sums[6], sums[7]);
    splat_gradients[3u * row + 2u] = vec4f(v_opacity, sums[9], select(0.0, 1.0, splat.radius > 0.0), 0.0);
}
