// Gradient of four channels of values that were blended over a tile, and of their weights where they are asked for; built
// like rasterize_backward. Rust twin: cpu/blend_backward.rs. Source: methods reference 3.2, with the values in place of
// colours and nothing behind them.
//
// A pair's sums: v_value of each channel; then, with u = L d, v_sigma u0, v_sigma u1 (mean); v_sigma u0 u0, u0 u1, u1 u1
// (covariance); v_sigma. What goes through the weights is a sum over channels, so that chunks of them add up.

#import constants
#import blend_variant
#import direction
#import view
#import splat
#import blend_chunk
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: BlendChunk;
@group(0) @binding(2) var<storage, read> splats: array<Splat>;
@group(0) @binding(3) var<storage, read> entries: array<vec4u>;
@group(0) @binding(4) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(5) var<storage, read> values: array<f32>;
@group(0) @binding(6) var<storage, read> v_blended: array<f32>;
// Read where gradients go through the weights.
@group(0) @binding(7) var<storage, read> blended: array<f32>;
@group(0) @binding(8) var<storage, read_write> pair_sums: array<f32>;
#import tile_staging
#import blend_values
#import partial_sums

struct Pixel {
    centre: vec2f,
    // The pass while it lets light through.
    open: u32,
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
fn add(splat: Staged, own: vec4f, passes: u32, p: ptr<function, Pixel>, sums: ptr<function, Sums>) {
    if ((passes & (*p).open) == 0u) {
        return;
    }
    let u = whitened(splat.factor.xyz, splat.mean - (*p).centre);
    let unclamped = strength_of(splat) * exp(-0.5 * dot(u, u));
    let alpha = min(MAX_ALPHA, unclamped);
    if (alpha < MIN_ALPHA) {
        return;
    }
    let weight = (*p).transmittance * alpha;
    let next = (*p).transmittance - weight;
    if (next < MIN_TRANSMITTANCE) {
        (*p).open = 0u;
        return;
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
}

// Nothing reaches these pairs.
fn clear_pairs(first: u32, end: u32) {
    for (var index = first; index < end; index += 64u) {
        for (var value = 0u; value < SUMS; value += 1u) {
            pair_sums[entries[index].x * PAIR_SUMS + value] = 0.0;
        }
    }
}

@compute @workgroup_size(64)
fn blend_backward(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    for (var first = range.x; first < range.y; first += STAGED) {
        let open = vec4u(p0.open, p1.open, p2.open, p3.open);
        let alive = stage_tile(first, range.y, tile, open, local);
        if (alive == 0u) {
            clear_pairs(first + local, range.y);
            break;
        }
        let staged_count = min(STAGED, range.y - first);
        if (WITH_WEIGHTS) {
            stage_values(staged_count, local);
        }
        // Loops that end at their foot: software that walks both sides of every branch goes through others once more.
        var batch = 0u;
        loop {
            let count = min(BATCH, staged_count - batch);
            var k = 0u;
            loop {
                let splat = staged[batch + k];
                let own = staged_values[batch + k];
                let passes = atomicLoad(&staged_passes[batch + k]) & alive;
                var sums: Sums;
                if ((passes & 3u) != 0u) {
                    add(splat, own, passes & 3u, &p0, &sums);
                }
                if ((passes & 12u) != 0u) {
                    add(splat, own, (passes >> 2u) & 3u, &p1, &sums);
                }
                if ((passes & 48u) != 0u) {
                    add(splat, own, (passes >> 4u) & 3u, &p2, &sums);
                }
                if ((passes & 192u) != 0u) {
                    add(splat, own, (passes >> 6u) & 3u, &p3, &sums);
                }
                let at = k * SUMS * 64u + local;
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
                continuing {
                    k += 1u;
                    break if k >= count;
                }
            }
            workgroupBarrier();

            let own = local / (64u / BATCH);
            let part = local % (64u / BATCH);
            if (own < count && part < SUMS) {
                pair_sums[staged[batch + own].pair * PAIR_SUMS + part] = sum_of(own * SUMS + part, local);
            }
            workgroupBarrier();
            continuing {
                batch += BATCH;
                break if batch >= staged_count;
            }
        }
    }
}
