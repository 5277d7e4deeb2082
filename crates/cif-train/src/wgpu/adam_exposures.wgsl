// The optimiser's step of all exposures: cameras that the step saw move against their gradients, which become zero, then
// all give up what they have in common, which is the field's. One workgroup; means are added in a fixed order. Rust
// twin: exposure.rs `Exposures::step`.

#import constants
#import exposure_rates

@group(0) @binding(0) var<uniform> rates: ExposureRates;
// Logarithms of gains and offsets, `[cameras, 6]`; so are gradients and moments.
@group(0) @binding(1) var<storage, read_write> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(3) var<storage, read_write> first_moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> second_moments: array<f32>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(5) var<storage, read_write> faults: array<atomic<u32>>;

#import adam

const INVOCATIONS: u32 = 256u;
#import workgroup

@compute @workgroup_size(256)
fn adam_exposures(
    #paste lane_builtins
) {
    #paste lane
    let waits = atomicLoad(&faults[1]) != 0u;
    var gain_sum = vec4f(0.0);
    var offset_sum = vec4f(0.0);
    for (var camera = local; camera < rates.cameras; camera += 256u) {
        let first = EXPOSURE_FLOATS * camera;
        var is_seen = false;
        for (var k = 0u; k < EXPOSURE_FLOATS; k++) {
            is_seen = is_seen || gradients[first + k] != 0.0;
        }
        for (var k = 0u; k < EXPOSURE_FLOATS; k++) {
            let at = first + k;
            if is_seen && !waits {
                let moved = move_by(
                    values[at], gradients[at], first_moments[at], second_moments[at], rates.rate, rates.second);
                values[at] = moved.parameter;
                first_moments[at] = moved.first;
                second_moments[at] = moved.second;
            }
            gradients[at] = 0.0;
            if k < 3u {
                gain_sum[k] += values[at];
            } else {
                offset_sum[k - 3u] += values[at];
            }
        }
    }
    let mean_gain = sum_of_workgroup(lane, gain_sum) / f32(rates.cameras);
    let mean_offset = sum_of_workgroup(lane, offset_sum) / f32(rates.cameras);
    for (var camera = local; camera < rates.cameras && !waits; camera += 256u) {
        let first = EXPOSURE_FLOATS * camera;
        for (var channel = 0u; channel < 3u; channel++) {
            values[first + channel] -= mean_gain[channel];
            values[first + 3u + channel] -= mean_offset[channel];
        }
    }
}
