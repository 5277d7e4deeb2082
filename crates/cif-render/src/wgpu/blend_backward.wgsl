// Gradient of four channels of values that were blended over a tile, and of their weights where they are asked for; built
// like rasterize_backward. Rust twin: cpu/blend_backward.rs. Source: methods reference 3.2, with the values in place of
// colours and nothing behind them.
//
// A pair's sums: v_value of each channel; then, with u = L d, v_sigma u0, v_sigma u1 (mean); v_sigma u0 u0, u0 u1, u1 u1
// (covariance); v_sigma. What goes through the weights is a sum over channels, so that chunks of them add up.

#import constants
#import blend_variant
@group(0) @binding(6) var<storage, read> v_blended: array<f32>;
// Read where gradients go through the weights.
@group(0) @binding(7) var<storage, read> blended: array<f32>;
@group(0) @binding(8) var<storage, read_write> pair_sums: array<f32>;
#import tile_backward
#import blend_values

struct Pixel {
    centre: vec2f,
    // The pass while it lets light through.
    open: u32,
    // Values that are blended have none.
    label: u32,
    transmittance: f32,
    v_blended: vec4f,
    // Q - E_i.
    remainder: f32,
}

struct Sums {
    values: vec4f,
    // Moments 0, 1, 00, 01.
    first: vec4f,
    // 11, v_sigma.
    second: vec2f,
}

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = pixel_in_quadrant(tile, quadrant, local);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    if (all(at < view.size)) {
        p.open = chunk.passes;
        let row = row_range(position_of(at));
        let i = places(row.x, row.y);
        p.v_blended =
            before(row.x, row.y, vec4f(v_blended[i.x], v_blended[i.y], v_blended[i.z], v_blended[i.w]));
        if (WITH_WEIGHTS) {
            // Beyond the last channel v_blended is 0.
            p.remainder = dot(p.v_blended, vec4f(blended[i.x], blended[i.y], blended[i.z], blended[i.w]));
        }
    }
    return p;
}

// Adds what a splat does to a pixel to its sums, and steps the pixel.
fn add(
    splat: Staged,
    own: vec4f,
    quadrant: u32,
    passes: u32,
    behind: u32,
    p: ptr<function, Pixel>,
    sums: ptr<function, Sums>,
) -> f32 {
    if ((passes & (*p).open) == 0u) {
        return 0.0;
    }
    let u = whitened(splat.factor.xyz, splat.mean - (*p).centre);
    let unclamped = strength_of(splat) * exp(-0.5 * dot(u, u));
    let alpha = min(MAX_ALPHA, unclamped);
    if (alpha < MIN_ALPHA) {
        return 0.0;
    }
    let weight = (*p).transmittance * alpha;
    let next = (*p).transmittance - weight;
    if (next < MIN_TRANSMITTANCE) {
        (*p).open = 0u;
        return 0.0;
    }
    (*sums).values += weight * (*p).v_blended;
    if (WITH_WEIGHTS) {
        let e = dot((*p).v_blended, own);
        (*p).remainder -= weight * e;
        if (unclamped <= MAX_ALPHA) {
            let v_sigma = -alpha * ((*p).transmittance * e - (*p).remainder / (1.0 - alpha));
            (*sums).first += v_sigma * vec4f(u, u.x * u);
            (*sums).second += v_sigma * vec2f(u.y * u.y, 1.0);
        }
    }
    (*p).transmittance = next;
    return 0.0;
}

fn stage_more(count: u32, local: u32) {
    if (WITH_WEIGHTS) {
        stage_values(count, local);
    }
}

fn leave(sums: Sums, at: u32) {
    partial_sums[at] = sums.values.x;
    partial_sums[at + 64u] = sums.values.y;
    partial_sums[at + 128u] = sums.values.z;
    partial_sums[at + 192u] = sums.values.w;
    if (WITH_WEIGHTS) {
        partial_sums[at + 256u] = sums.first.x;
        partial_sums[at + 320u] = sums.first.y;
        partial_sums[at + 384u] = sums.first.z;
        partial_sums[at + 448u] = sums.first.w;
        partial_sums[at + 512u] = sums.second.x;
        partial_sums[at + 576u] = sums.second.y;
    }
}

// No labels, no responsibilities.
fn begin_tile(labels: vec4u, local: u32) {}
fn longest_of_rows() -> u32 { return 0u; }
fn keep_responsibility(responsibility: vec4f, at: u32) {}
fn sum_responsibilities(own: u32, part: u32, local: u32, count: u32, batch: u32, longest_row: u32) {}
fn clear_row(entry: vec4u) {}

@compute @workgroup_size(64)
fn blend_backward(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    differentiate_tile(workgroup, local);
}
