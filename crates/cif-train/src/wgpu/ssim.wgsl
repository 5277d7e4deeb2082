// Structural similarity of a view and its gradient, added to that of the colours: the window is separable, so rows and
// columns are blurred in turn, with zeros beyond the border. Rust twin: losses/ssim.rs. Source: Wang et al. 2004;
// gradient from methods reference 1.4.

#import constants
#import loss_settings

@group(0) @binding(0) var<uniform> settings: LossSettings;
@group(0) @binding(1) var<storage, read> colors: array<vec4f>;
@group(0) @binding(2) var<storage, read> targets: array<u32>;
// Blurred along rows: five images, x, y, x^2, y^2 and x y, later D, E and F; `[5, pixels]`.
@group(0) @binding(3) var<storage, read_write> rows: array<vec4f>;
// D, E, F: `[3, pixels]`.
@group(0) @binding(4) var<storage, read_write> maps: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> v_colors: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> partial_sums: array<vec4f>;

const INVOCATIONS: u32 = 256u;
#import workgroup

fn tap(distance: u32) -> f32 {
    return settings.window[distance / 4u][distance % 4u];
}

// Pixel of a folded dispatch.
fn pixel_of(group: vec3u, local: u32) -> u32 {
    return (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
}

// What is blurred along rows first: images of colours and targets.
@compute @workgroup_size(256)
fn blur_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = pixel_of(group, local);
    if pixel >= settings.pixels {
        return;
    }
    let column = pixel % settings.width;
    var sums: array<vec4f, 5>;
    for (var k = 0u; k < 5u; k++) {
        sums[k] = vec4f(0.0);
    }
    for (var k = 0u; k < 11u; k++) {
        let at = column + k;
        if at < 5u || at >= settings.width + 5u {
            continue;
        }
        let other = pixel + k - 5u;
        let weight = tap(u32(abs(i32(k) - 5)));
        let x = vec4f(colors[other].xyz, 0.0);
        let y = vec4f(unpack4x8unorm(targets[other]).xyz, 0.0);
        sums[0] += weight * x;
        sums[1] += weight * y;
        sums[2] += weight * (x * x);
        sums[3] += weight * (y * y);
        sums[4] += weight * (x * y);
    }
    for (var k = 0u; k < 5u; k++) {
        rows[k * settings.pixels + pixel] = sums[k];
    }
}

fn blur_column(image: u32, pixel: u32) -> vec4f {
    let row = pixel / settings.width;
    var sum = vec4f(0.0);
    for (var k = 0u; k < 11u; k++) {
        let at = row + k;
        if at >= 5u && at < settings.height + 5u {
            let other = pixel + k * settings.width - 5u * settings.width;
            sum += tap(u32(abs(i32(k) - 5))) * rows[image * settings.pixels + other];
        }
    }
    return sum;
}

// Similarity of every pixel, and what its gradient is made of.
@compute @workgroup_size(256)
fn compare(
    @builtin(workgroup_id) group: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let workgroup = group.y * MAX_WORKGROUPS + group.x;
    let pixel = workgroup * 256u + local;
    var similarity = vec4f(0.0);
    if pixel < settings.pixels {
        let m1 = blur_column(0u, pixel);
        let m2 = blur_column(1u, pixel);
        let s1 = blur_column(2u, pixel) - m1 * m1;
        let s2 = blur_column(3u, pixel) - m2 * m2;
        let s12 = blur_column(4u, pixel) - m1 * m2;
        let a = 2.0 * m1 * m2 + SSIM_C1;
        let b = 2.0 * s12 + SSIM_C2;
        let c = m1 * m1 + m2 * m2 + SSIM_C1;
        let d = s1 + s2 + SSIM_C2;
        similarity = a * b / (c * d);
        let v = settings.similarity_weight;
        maps[pixel] = v
            * (2.0 * m2 * (b - a) / (c * d) - 2.0 * m1 * similarity / c + 2.0 * m1 * similarity / d);
        maps[settings.pixels + pixel] = v * (-similarity / d);
        maps[2u * settings.pixels + pixel] = v * (2.0 * a / (c * d));
    }
    let sum = sum_of_workgroup(lane, vec4f(similarity.x + similarity.y + similarity.z, 0.0, 0.0, 0.0));
    if local == 0u {
        partial_sums[2u * workgroup + 1u] = sum;
    }
}

// Blurs D, E and F along rows.
@compute @workgroup_size(256)
fn blur_maps(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = pixel_of(group, local);
    if pixel >= settings.pixels {
        return;
    }
    let column = pixel % settings.width;
    for (var image = 0u; image < 3u; image++) {
        var sum = vec4f(0.0);
        for (var k = 0u; k < 11u; k++) {
            let at = column + k;
            if at >= 5u && at < settings.width + 5u {
                sum += tap(u32(abs(i32(k) - 5))) * maps[image * settings.pixels + pixel + k - 5u];
            }
        }
        rows[image * settings.pixels + pixel] = sum;
    }
}

// Blurs them along columns, and adds the gradient.
@compute @workgroup_size(256)
fn add_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = pixel_of(group, local);
    if pixel >= settings.pixels {
        return;
    }
    let x = vec4f(colors[pixel].xyz, 0.0);
    let y = vec4f(unpack4x8unorm(targets[pixel]).xyz, 0.0);
    v_colors[pixel] +=
        blur_column(0u, pixel) + 2.0 * x * blur_column(1u, pixel) + y * blur_column(2u, pixel);
}
