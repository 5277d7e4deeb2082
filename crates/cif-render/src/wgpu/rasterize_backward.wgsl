// Gradient of a tile, front to back: transmittances are replayed as the forward pass made them and never divided. A
// workgroup is a tile. For eight splats and a quadrant at a time, invocations are first pixels, which leave four
// numbers per splat in workgroup memory, and then eighths of splats, which sum them over pixels in a fixed order: no
// atomics, one store per (tile, splat) pair. Rust twin: cpu/rasterize_backward.rs. Source: methods reference 3.2, 4.2.
//
// A pair's ten sums: v_sigma dx, v_sigma dy (mean); v_sigma dx dx, dx dy, dy dy (conic); v_colour; v_sigma of colour;
// weighted q. And per entry of its identity row the weighted responsibility for that label.

#import constants
#import variant
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> entries: array<vec4u>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(4) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> identities: array<vec2u>;
@group(0) @binding(6) var<storage, read> cotangents: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> pair_sums: array<f32>;
@group(0) @binding(8) var<storage, read_write> label_mass: array<f32>;
#import identity

// Splats that are summed at a time.
const BATCH: u32 = 8u;

struct Staged {
    mean: vec2f,
    // Two bits of passes per quadrant.
    passes: u32,
    pair: u32,
    // Conic and opacity.
    conic: vec4f,
    // Colour and occupancy.
    color: vec4f,
    row_first: u32,
    row_end: u32,
    // First label slot.
    slot: u32,
    unused: u32,
}

var<workgroup> staged: array<Staged, 64>;
// Of the batch on the quadrant: T alpha, v_sigma of colour, weighted q, weighted r. Then partial sums.
var<workgroup> shares: array<vec4f, 512>;
// v_colour of the quadrant's pixels and their labels.
var<workgroup> pixels: array<vec4f, 64>;
var<workgroup> live: atomic<u32>;
var<workgroup> live_quadrants: u32;

struct Pixel {
    centre: vec2f,
    // Passes that still let light through.
    open: u32,
    label: u32,
    v_color: vec3f,
    // Q - E_i, and colour transmittance.
    remainder: f32,
    transmittance: f32,
    instance_transmittance: f32,
    // 1 - c_i, 1 / M_y, S_end / A.
    hidden: f32,
    inverse: f32,
    ratio: f32,
}

struct Sums {
    // Moments x, y, xx, xy.
    first: vec4f,
    // yy, v_colour.
    second: vec4f,
    // v_sigma of colour, weighted q.
    third: vec2f,
    // Responsibility for the entry of the identity row whose index is the invocation's eighth.
    mass: f32,
}

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = quadrant_origin(tile, quadrant) + vec2u(local % HALF_TILE, local / HALF_TILE);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    p.instance_transmittance = 1.0;
    p.hidden = 1.0;
    if (all(at < view.size)) {
        let position = at.y * view.size.x + at.x;
        let color = cotangents[2u * position];
        let instance = cotangents[2u * position + 1u];
        p.v_color = color.xyz;
        p.remainder = color.w;
        p.inverse = instance.x;
        p.ratio = instance.y;
        p.label = u32(instance.z);
        p.open = COLOR_PASS | select(0u, INSTANCE_PASS, WITH_INSTANCES && p.inverse > 0.0);
    }
    return p;
}

// What a splat does to a pixel: the four shares; steps the pixel.
fn replay(splat: Staged, passes: u32, p: ptr<function, Pixel>) -> vec4f {
    var shares_of_pixel = vec4f(0.0);
    let open = passes & (*p).open;
    if (open == 0u) {
        return shares_of_pixel;
    }
    let peak = peak_at(splat.conic.xyz, splat.mean - (*p).centre);
    if ((open & COLOR_PASS) != 0u) {
        let unclamped = splat.conic.w * peak;
        let alpha = min(MAX_ALPHA, unclamped);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).transmittance * alpha;
            let next = (*p).transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~COLOR_PASS;
            } else {
                let e = dot((*p).v_color, splat.color.xyz);
                (*p).remainder -= weight * e;
                shares_of_pixel.x = weight;
                if (unclamped <= MAX_ALPHA) {
                    let v_alpha = (*p).transmittance * e - (*p).remainder / (1.0 - alpha);
                    shares_of_pixel.y = -alpha * v_alpha;
                }
                (*p).transmittance = next;
            }
        }
    }
    if (WITH_INSTANCES && (open & INSTANCE_PASS) != 0u) {
        let unclamped = splat.color.w * peak;
        let alpha = min(MAX_ALPHA, unclamped);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).instance_transmittance * alpha;
            let next = (*p).instance_transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~INSTANCE_PASS;
            } else {
                let identity = probability_of(splat.row_first, splat.row_end, (*p).label - 1u);
                let r = weight * (identity * (*p).inverse);
                // 1 - c_i, clamped against rounding at the tail.
                (*p).hidden = max((*p).hidden - r, 0.0);
                if (unclamped <= MAX_ALPHA) {
                    let q = r - alpha * ((*p).hidden + (*p).ratio) / (1.0 - alpha);
                    shares_of_pixel.z = q * view.pixel_weight;
                }
                shares_of_pixel.w = r * view.pixel_weight;
                (*p).instance_transmittance = next;
                // Nothing behind supports the label.
                if (view.coverage_normalised == 0u && (*p).hidden <= SETTLED) {
                    (*p).open &= ~INSTANCE_PASS;
                }
            }
        }
    }
    return shares_of_pixel;
}

// Adds a quadrant's pixels to the sums of the invocation's splat; steps the invocation's pixel. Every invocation of the
// workgroup must come here.
fn visit(
    quadrant: u32,
    origin: vec2u,
    first: u32,
    count: u32,
    local: u32,
    p: ptr<function, Pixel>,
    sums: ptr<function, Sums>,
) {
    let shift = 2u * quadrant;
    let was_open = (*p).open != 0u;
    for (var k = 0u; k < count; k += 1u) {
        let passes = (staged[first + k].passes >> shift) & 3u;
        if (passes != 0u) {
            var share = vec4f(0.0);
            if ((*p).open != 0u) {
                share = replay(staged[first + k], passes, p);
            }
            shares[k * 64u + local] = share;
        }
    }
    pixels[local] = vec4f((*p).v_color, f32((*p).label));
    if ((*p).open != 0u) {
        atomicOr(&live, 1u << quadrant);
    }
    workgroupBarrier();

    let own = local / 8u;
    let part = local % 8u;
    if (own < count) {
        let splat = staged[first + own];
        let passes = (splat.passes >> shift) & 3u;
        if (passes != 0u) {
            let dy = splat.mean.y - (f32(origin.y + part) + 0.5);
            for (var k = 0u; k < HALF_TILE; k += 1u) {
                // Every eighth starts at another column, so that they read from different banks of memory.
                let column = (k + part) % HALF_TILE;
                let at = part * HALF_TILE + column;
                let share = shares[own * 64u + at];
                let dx = splat.mean.x - (f32(origin.x + column) + 0.5);
                let v_mean = share.y + view.mean_geometry * share.z;
                let v_conic = share.y + view.full_geometry * share.z;
                (*sums).first += vec4f(v_mean * dx, v_mean * dy, v_conic * dx * dx, v_conic * dx * dy);
                (*sums).second += vec4f(v_conic * dy * dy, share.x * pixels[at].xyz);
                (*sums).third += share.yz;
            }
            if (WITH_INSTANCES && (passes & INSTANCE_PASS) != 0u) {
                for (var entry = part; splat.row_first + entry < splat.row_end; entry += 8u) {
                    let label = f32(identities[splat.row_first + entry].x + 1u);
                    var mass = 0.0;
                    for (var at = 0u; at < 64u; at += 1u) {
                        if (pixels[at].w == label) {
                            mass += shares[own * 64u + at].w;
                        }
                    }
                    if (entry < 8u) {
                        (*sums).mass += mass;
                    } else {
                        label_mass[splat.slot + entry] += mass;
                    }
                }
            }
        }
    }
    workgroupBarrier();
}

fn has_row(splat: Staged) -> bool {
    return WITH_INSTANCES && splat.row_first < splat.row_end;
}

@compute @workgroup_size(64)
fn rasterize_backward(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = workgroup.xy;
    let range = tile_ranges[tile.y * view.tiles.x + tile.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    if (local == 0u) {
        live_quadrants = 15u;
    }
    workgroupBarrier();
    for (var first = range.x; first < range.y; first += 64u) {
        let index = first + local;
        if (index < range.y) {
            let entry = entries[index];
            let row = entry.y & INDEX_MASK;
            let splat = splats[row];
            var item: Staged;
            item.mean = splat.mean;
            item.pair = entry.x;
            item.conic = splat.conic;
            item.color = splat.color;
            item.slot = entry.z;
            let drawn = (entry.y >> PASS_SHIFT) & (COLOR_PASS | select(0u, INSTANCE_PASS, WITH_INSTANCES));
            for (var quadrant = 0u; quadrant < 4u; quadrant += 1u) {
                let passes = drawn & passes_in_quadrant(splat, quadrant_origin(tile, quadrant));
                item.passes |= passes << (2u * quadrant);
            }
            if (WITH_INSTANCES) {
                item.row_first = row_offsets[row];
                item.row_end = row_offsets[row + 1u];
                // Longer rows than there are eighths are summed in place.
                for (var k = item.row_first + 8u; k < item.row_end; k += 1u) {
                    label_mass[entry.z + k - item.row_first] = 0.0;
                }
            }
            staged[local] = item;
        }
        workgroupBarrier();
        let staged_count = min(64u, range.y - first);
        for (var batch = 0u; batch < staged_count; batch += BATCH) {
            let count = min(BATCH, staged_count - batch);
            let quadrants = workgroupUniformLoad(&live_quadrants);
            if (local == 0u) {
                atomicStore(&live, 0u);
            }
            workgroupBarrier();
            var sums: Sums;
            if ((quadrants & 1u) != 0u) {
                visit(0u, quadrant_origin(tile, 0u), batch, count, local, &p0, &sums);
            }
            if ((quadrants & 2u) != 0u) {
                visit(1u, quadrant_origin(tile, 1u), batch, count, local, &p1, &sums);
            }
            if ((quadrants & 4u) != 0u) {
                visit(2u, quadrant_origin(tile, 2u), batch, count, local, &p2, &sums);
            }
            if ((quadrants & 8u) != 0u) {
                visit(3u, quadrant_origin(tile, 3u), batch, count, local, &p3, &sums);
            }
            shares[3u * local] = sums.first;
            shares[3u * local + 1u] = sums.second;
            shares[3u * local + 2u] = vec4f(sums.third, 0.0, 0.0);
            if (local == 0u) {
                live_quadrants = atomicLoad(&live);
            }
            workgroupBarrier();
            let own = local / 8u;
            let part = local % 8u;
            if (own < count) {
                let splat = staged[batch + own];
                for (var value = part; value < PAIR_SUMS; value += 8u) {
                    var sum = 0.0;
                    for (var k = 0u; k < 8u; k += 1u) {
                        sum += shares[3u * (own * 8u + k) + value / 4u][value % 4u];
                    }
                    pair_sums[splat.pair * PAIR_SUMS + value] = sum;
                }
                if (has_row(splat) && splat.row_first + part < splat.row_end) {
                    label_mass[splat.slot + part] = sums.mass;
                }
            }
            workgroupBarrier();
        }
    }
}
