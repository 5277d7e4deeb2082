// Probabilities of the identity rows: softmax over a row's support of estimate plus calibration. Rust twin:
// `Identities::probabilities` of cif-field. Source: methods reference 5.3.

#import constants
#import accumulation

// Its count is that of the rows.
@group(0) @binding(0) var<uniform> accumulation: Accumulation;
@group(0) @binding(1) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(2) var<storage, read> log_estimates: array<f32>;
@group(0) @binding(3) var<storage, read> log_calibrations: array<f32>;
// Dense instance index, bits of its probability.
@group(0) @binding(4) var<storage, read_write> identities: array<vec2u>;

@compute @workgroup_size(64)
fn identity(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    if row >= accumulation.count {
        return;
    }
    let first = row_offsets[row];
    let end = row_offsets[row + 1u];
    if first == end {
        return;
    }
    var largest = log_estimates[first] + log_calibrations[first];
    for (var entry = first + 1u; entry < end; entry++) {
        largest = max(largest, log_estimates[entry] + log_calibrations[entry]);
    }
    var sum = 0.0;
    for (var entry = first; entry < end; entry++) {
        sum += exp(max(log_estimates[entry] + log_calibrations[entry] - largest, -100.0));
    }
    for (var entry = first; entry < end; entry++) {
        let weight = exp(max(log_estimates[entry] + log_calibrations[entry] - largest, -100.0));
        identities[entry].y = bitcast<u32>(weight / sum);
    }
}
