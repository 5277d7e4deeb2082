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

// Invocations of a Gaussian, a sum each, and Gaussians of a workgroup.
const LANES: u32 = 16u;
const TOGETHER: u32 = 16u;

var<workgroup> gathered: array<f32, LANES * TOGETHER>;

// A number of a pair, 0 of what stands in for nothing.
fn number_of(pair: u32, lane: u32) -> f32 {
    let value = pair_sums[pair * PAIR_SUMS + lane];
    return select(0.0, value, pairs[pair].x != NO_SPLAT);
}

@compute @workgroup_size(256)
fn gather_gradients(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let lane = local % LANES;
    let place = local / LANES;
    let rank = item_of(workgroup, place, TOGETHER);
    var sum = 0.0;
    if (rank < view.gaussians && lane < GRADIENT_SUMS) {
        // Without pairs at all when the lists did not fit.
        let last = select(0u, pair_offsets[rank + 1u], work[WORK_PAIRS] > 0u);
        var pair = pair_offsets[rank];
        // Four at a time, so that none waits for the memory of the one before.
        for (; pair + 4u <= last; pair += 4u) {
            let a = number_of(pair, lane);
            let b = number_of(pair + 1u, lane);
            let c = number_of(pair + 2u, lane);
            let d = number_of(pair + 3u, lane);
            sum = (((sum + a) + b) + c) + d;
        }
        for (; pair < last; pair += 1u) {
            sum += number_of(pair, lane);
        }
    }
    gathered[local] = sum;
    workgroupBarrier();
    if (rank >= view.gaussians || lane >= 3u) {
        return;
    }
    let row = depth_order[rank];
    let splat = splats[row];
    let factor = splat.factor;
    let own = place * LANES;
    var numbers: vec4f;
    if (lane == 0u) {
        let mean = vec2f(gathered[own], gathered[own + 1u]);
        numbers = vec4f(
            factor.x * mean.x, factor.y * mean.x + factor.z * mean.y, gathered[own + 2u], gathered[own + 3u]);
    } else if (lane == 1u) {
        numbers = vec4f(gathered[own + 4u], gathered[own + 5u], gathered[own + 6u], gathered[own + 7u]);
    } else {
        // v_sigma = -alpha v_alpha, alpha = o P and v_o = P v_alpha.
        let v_opacity = select(0.0, -gathered[own + 8u] / factor.w, factor.w > 0.0);
        numbers = vec4f(v_opacity, gathered[own + 9u], select(0.0, 1.0, splat.radius > 0.0), 0.0);
    }
    splat_gradients[3u * row + lane] = numbers;
}
