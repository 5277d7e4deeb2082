// Colour loss of a view and its gradient, and the value of the instance loss from the pass that drew it. Sums per
// workgroup are added in a fixed order by `total`. Rust twins: losses/mod.rs `color_loss`, cpu/renderer/mod.rs
// `instance_loss`. Source: methods reference 1.4 and 4.3.

#import constants
#import loss_settings

@group(0) @binding(0) var<uniform> settings: LossSettings;
// Colour and transmittance.
@group(0) @binding(1) var<storage, read> colors: array<vec4f>;
// Depth, probability of the label, instance transmittance.
@group(0) @binding(2) var<storage, read> blended: array<vec4f>;
// Red, green and blue bytes from the lowest.
@group(0) @binding(3) var<storage, read> targets: array<u32>;
// Dense instance index + 1, or 0.
@group(0) @binding(4) var<storage, read> labels: array<u32>;
@group(0) @binding(5) var<storage, read_write> v_colors: array<vec4f>;
// Absolute and squared differences, instance loss, unsupported pixels; two per workgroup: the second has the structural
// similarity.
@group(0) @binding(6) var<storage, read_write> partial_sums: array<vec4f>;
// As a workgroup's sums, for the view.
@group(0) @binding(7) var<storage, read_write> results: array<vec4f>;

const INVOCATIONS: u32 = 256u;
#import workgroup

// Sums of a pixel; leaves its gradient.
fn compare(pixel: u32) -> vec4f {
    let difference = colors[pixel].xyz - unpack4x8unorm(targets[pixel]).xyz;
    let absolute = abs(difference);
    // Devices may unpack a byte to a number next to the nearest one: colours that differ by no more are equal.
    let direction = select(sign(difference), vec3f(0.0), absolute <= vec3f(FLOAT_SPACING));
    v_colors[pixel] = vec4f(settings.absolute_weight * direction, 0.0);
    var sums = vec4f(absolute.x + absolute.y + absolute.z, dot(difference, difference), 0.0, 0.0);
    if settings.with_instances != 0u {
        if labels[pixel] != 0u {
            let probability = blended[pixel].y;
            sums.z = -log(max(probability, MIN_LABEL_PROBABILITY));
            if probability < MIN_LABEL_PROBABILITY {
                sums.w = 1.0;
            } else if settings.by_coverage != 0u {
                sums.z += log(1.0 - blended[pixel].z);
            }
        }
    }
    return sums;
}

@compute @workgroup_size(256)
fn losses(
    @builtin(workgroup_id) group: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let workgroup = group.y * MAX_WORKGROUPS + group.x;
    let pixel = workgroup * 256u + local;
    var sums = vec4f(0.0);
    if pixel < settings.pixels {
        sums = compare(pixel);
    }
    let sum = sum_of_workgroup(lane, sums);
    if local == 0u {
        partial_sums[2u * workgroup] = sum;
        partial_sums[2u * workgroup + 1u] = vec4f(0.0);
    }
}

// Adds the workgroups' sums; one workgroup.
@compute @workgroup_size(256)
fn total(
    #paste lane_builtins
) {
    #paste lane
    let workgroups = (settings.pixels + 255u) / 256u;
    for (var part = 0u; part < 2u; part++) {
        var sums = vec4f(0.0);
        for (var k = local; k < workgroups; k += 256u) {
            sums += partial_sums[2u * k + part];
        }
        let sum = sum_of_workgroup(lane, sums);
        if local == 0u {
            results[2u * settings.slot + part] = sum;
        }
    }
}
