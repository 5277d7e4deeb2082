// The optimiser's step of the deformation network, whose gradient comes in SPLITS parts, and of the calibrations, which
// stay within their limit. Gradients become zero. Rust twins: adam/mod.rs, trainer/optimiser.rs, trainer/step.rs
// `keep_in_range`. Source: methods reference 1.1 and 5.3.

#import constants
#import group_rates

@group(0) @binding(0) var<uniform> rates: GroupRates;
@group(0) @binding(1) var<storage, read_write> parameters: array<f32>;
// `[rates.parts, rates.floats]`.
@group(0) @binding(2) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(3) var<storage, read_write> first_moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> second_moments: array<f32>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(5) var<storage, read_write> faults: array<atomic<u32>>;

#import adam

@compute @workgroup_size(64)
fn adam_network(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    if at >= rates.floats {
        return;
    }
    var g = 0.0;
    for (var part = 0u; part < rates.parts; part++) {
        g += gradients[part * rates.floats + at];
        gradients[part * rates.floats + at] = 0.0;
    }
    if rates.rate <= 0.0 || atomicLoad(&faults[1]) != 0u {
        return;
    }
    let moved = move_by(parameters[at], g, first_moments[at], second_moments[at], rates.rate, rates.second);
    parameters[at] = clamp(moved.parameter, -rates.limit, rates.limit);
    first_moments[at] = moved.first;
    second_moments[at] = moved.second;
}
