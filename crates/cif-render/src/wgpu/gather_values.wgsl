// Adds the pairs of every splat, in the order in which they were emitted, to the gradients of its Gaussian's values, and
// with weights to those of the splat, in the form of gather_gradients. Rust twin: cpu/renderer/blend.rs, `gather_pairs`.

#import constants
#import blend_variant
#import numbers
#import view
#import splat
#import blend_chunk
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: BlendChunk;
@group(0) @binding(2) var<storage, read> splats: array<Splat>;
@group(0) @binding(3) var<storage, read> depth_order: array<u32>;
@group(0) @binding(4) var<storage, read> pair_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(6) var<storage, read> pair_sums: array<f32>;
@group(0) @binding(7) var<storage, read> work: array<u32>;
@group(0) @binding(8) var<storage, read_write> v_values: array<f32>;
@group(0) @binding(9) var<storage, read_write> splat_gradients: array<vec4f>;

@compute @workgroup_size(64)
fn gather_values(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank >= view.gaussians) {
        return;
    }
    let row = depth_order[rank];
    var sums: array<f32, GRADIENT_SUMS>;
    for (var k = 0u; k < SUMS; k += 1u) {
        sums[k] = 0.0;
    }
    // Without pairs at all when the lists did not fit.
    let last = select(0u, pair_offsets[rank + 1u], work[WORK_PAIRS] > 0u);
    for (var pair = pair_offsets[rank]; pair < last; pair += 1u) {
        if (pairs[pair].x != NO_SPLAT) {
            for (var k = 0u; k < SUMS; k += 1u) {
                sums[k] += pair_sums[pair * PAIR_SUMS + k];
            }
        }
    }
    let first = row * chunk.channels + chunk.first;
    for (var k = 0u; k < min(BLEND_CHANNELS, chunk.channels - chunk.first); k += 1u) {
        v_values[first + k] += sums[k];
    }
    if (WITH_WEIGHTS) {
        let splat = splats[row];
        let factor = splat.factor;
        let by_color = chunk.passes == COLOR_PASS;
        // v_sigma = -alpha v_alpha, alpha = o P and v_o = P v_alpha.
        let v_opacity = select(0.0, -sums[9] / factor.w, by_color && factor.w > 0.0);
        let q = select(sums[9], 0.0, by_color);
        let v_mean = chunk.mean_geometry * vec2f(factor.x * sums[4], factor.y * sums[4] + factor.z * sums[5]);
        let moments = chunk.full_geometry * vec3f(sums[6], sums[7], sums[8]);
        var earlier: array<vec4f, 3>;
        if (chunk.first > 0u) {
            earlier[0] = splat_gradients[3u * row];
            earlier[1] = splat_gradients[3u * row + 1u];
            earlier[2] = splat_gradients[3u * row + 2u];
        }
        let is_visible = select(0.0, 1.0, splat.radius > 0.0);
        splat_gradients[3u * row] = earlier[0] + vec4f(v_mean, moments.xy);
        splat_gradients[3u * row + 1u] = vec4f(earlier[1].x + moments.z, 0.0, 0.0, 0.0);
        splat_gradients[3u * row + 2u] = vec4f(earlier[2].xy + vec2f(v_opacity, q), is_visible, 0.0);
    }
}
