// Adds the mass of every Gaussian's pairs, in the order in which they were emitted, to its row of counts: the labels of
// the pass, and the mass on all pixels last. Rust twin: cpu/renderer/count.rs. Source: methods reference 5.1.

#import constants
#import numbers
#import view
#import splat
#import label_chunk
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: LabelChunk;
@group(0) @binding(2) var<storage, read> depth_order: array<u32>;
@group(0) @binding(3) var<storage, read> pair_offsets: array<u32>;
@group(0) @binding(4) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(5) var<storage, read> pair_sums: array<f32>;
@group(0) @binding(6) var<storage, read> work: array<u32>;
@group(0) @binding(7) var<storage, read_write> counts: array<f32>;

@compute @workgroup_size(64)
fn gather_counts(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank >= view.gaussians) {
        return;
    }
    var sums: array<f32, PAIR_SUMS>;
    for (var k = 0u; k < PAIR_SUMS; k += 1u) {
        sums[k] = 0.0;
    }
    let last = select(0u, pair_offsets[rank + 1u], work[WORK_PAIRS] > 0u);
    for (var pair = pair_offsets[rank]; pair < last; pair += 1u) {
        if (pairs[pair].x != NO_SPLAT) {
            for (var k = 0u; k < PAIR_SUMS; k += 1u) {
                sums[k] += pair_sums[pair * PAIR_SUMS + k];
            }
        }
    }
    let row = depth_order[rank] * (chunk.instances + 1u);
    for (var k = 0u; k < chunk.count; k += 1u) {
        counts[row + chunk.labels[k / 4u][k % 4u] - 1u] += sums[k];
    }
    if (chunk.adds_total != 0u) {
        counts[row + chunk.instances] += sums[PAIR_SUMS - 1u];
    }
}
