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

fn leave(sums: Sums, k: u32, lane: Lane) {
    if (WITH_WEIGHTS) {
        leave_ten(k, sums.values, sums.first, sums.second, lane);
    } else {
        leave_four(k, sums.values, lane);
    }
}

// No labels, no responsibilities.
const WITH_LABELS: bool = false;
fn longest_of_rows() -> u32 { return 0u; }
fn keep_responsibility(responsibility: f32, k: u32, pixel: u32) {}
fn sum_responsibilities(lane: Lane, count: u32, batch: u32, longest_row: u32) {}
fn clear_row(entry: vec4u) {}

@compute @workgroup_size(INVOCATIONS)
fn blend_backward(
    @builtin(workgroup_id) workgroup: vec3u,
    #paste lane_builtins
) {
    #paste lane
    differentiate_tile(workgroup, lane);
}
