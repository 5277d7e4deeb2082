// Gradient of the calibrations: v_mu_i^k = -(rho_i^k - p_i^k R_i), rho the weighted responsibilities summed over the
// pairs of Gaussian i in the order in which they were emitted. Rust twin: cpu/renderer/backward.rs,
// `calibration_backward`. Source: methods reference 4.2.

#import constants
#import numbers
#import view
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> depth_order: array<u32>;
@group(0) @binding(2) var<storage, read> slot_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(4) var<storage, read> identities: array<vec2u>;
@group(0) @binding(5) var<storage, read> label_mass: array<f32>;
@group(0) @binding(6) var<storage, read> work: array<u32>;
@group(0) @binding(7) var<storage, read_write> v_calibrations: array<f32>;

@compute @workgroup_size(64)
fn identity_backward(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank >= view.gaussians) {
        return;
    }
    let row = depth_order[rank];
    let first = row_offsets[row];
    let width = row_offsets[row + 1u] - first;
    let begin = slot_offsets[rank];
    let end = select(begin, slot_offsets[rank + 1u], work[WORK_PAIRS] > 0u);
    var total = 0.0;
    for (var entry = 0u; entry < width; entry += 1u) {
        var mass = 0.0;
        for (var slot = begin; slot < end; slot += width) {
            mass += label_mass[slot + entry];
        }
        v_calibrations[first + entry] = mass;
        total += mass;
    }
    for (var entry = 0u; entry < width; entry += 1u) {
        let probability = bitcast<f32>(identities[first + entry].y);
        v_calibrations[first + entry] = probability * total - v_calibrations[first + entry];
    }
}
