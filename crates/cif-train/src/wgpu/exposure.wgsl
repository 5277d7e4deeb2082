// What the camera of a view makes of its colours, and the gradients of that: by the rendered colours, and by the
// exposure, whose sums per workgroup are added in a fixed order by `add_gradient`. Rust twin: exposure.rs `Exposure`.

#import constants
#import faults
#import exposure_settings

@group(0) @binding(0) var<uniform> settings: ExposureSettings;
// Logarithms of gains and offsets, `[cameras, 6]`.
@group(0) @binding(1) var<storage, read> values: array<f32>;
// Rendered colour and transmittance.
@group(0) @binding(2) var<storage, read> colors: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> recorded: array<vec4f>;
// By the recorded colours, then by the rendered ones.
@group(0) @binding(4) var<storage, read_write> v_colors: array<vec4f>;
// By the logarithms of gains and by offsets: two per workgroup.
@group(0) @binding(5) var<storage, read_write> partial_sums: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> gradients: array<f32>;
// Bits of the step, and whether steps wait for the host.
@group(0) @binding(7) var<storage, read_write> faults: array<atomic<u32>>;

const INVOCATIONS: u32 = 256u;
#import workgroup

// The transmittance stays.
fn gain() -> vec4f {
    let first = EXPOSURE_FLOATS * settings.camera;
    return vec4f(exp(vec3f(values[first], values[first + 1u], values[first + 2u])), 1.0);
}

fn offset() -> vec4f {
    let first = EXPOSURE_FLOATS * settings.camera + 3u;
    return vec4f(values[first], values[first + 1u], values[first + 2u], 0.0);
}

@compute @workgroup_size(256)
fn expose(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if pixel < settings.pixels {
        recorded[pixel] = gain() * colors[pixel] + offset();
    }
}

@compute @workgroup_size(256)
fn pull_back(
    @builtin(workgroup_id) group: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let workgroup = group.y * MAX_WORKGROUPS + group.x;
    let pixel = workgroup * 256u + local;
    var gain_sum = vec4f(0.0);
    var offset_sum = vec4f(0.0);
    if pixel < settings.pixels {
        offset_sum = v_colors[pixel];
        let v = offset_sum * gain();
        gain_sum = v * colors[pixel];
        v_colors[pixel] = v;
    }
    let by_gain = sum_of_workgroup(lane, gain_sum);
    let by_offset = sum_of_workgroup(lane, offset_sum);
    // The grid is folded, so there may be workgroups without pixels.
    if local == 0u && workgroup * 256u < settings.pixels {
        partial_sums[2u * workgroup] = by_gain;
        partial_sums[2u * workgroup + 1u] = by_offset;
    }
}

// Adds the workgroups' sums to the gradient of the camera; one workgroup.
@compute @workgroup_size(256)
fn add_gradient(
    #paste lane_builtins
) {
    #paste lane
    let workgroups = (settings.pixels + 255u) / 256u;
    var gain_sum = vec4f(0.0);
    var offset_sum = vec4f(0.0);
    for (var k = local; k < workgroups; k += 256u) {
        gain_sum += partial_sums[2u * k];
        offset_sum += partial_sums[2u * k + 1u];
    }
    let by_gain = sum_of_workgroup(lane, gain_sum);
    let by_offset = sum_of_workgroup(lane, offset_sum);
    if local == 0u {
        for (var channel = 0u; channel < 3u; channel++) {
            let at = EXPOSURE_FLOATS * settings.camera + channel;
            let by_log_gain = gradients[at] + by_gain[channel];
            let by_shift = gradients[at + 3u] + by_offset[channel];
            gradients[at] = by_log_gain;
            gradients[at + 3u] = by_shift;
            if is_beyond(by_log_gain) || is_beyond(by_shift) {
                atomicOr(&faults[0], EXPOSURES_FAULT);
            }
        }
    }
}
