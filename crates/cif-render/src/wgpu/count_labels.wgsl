// Mass of a tile's pairs on the pixels of some labels, and on all pixels: colour weights over the coverage of the pixel.
// Built like rasterize_backward: a workgroup is a tile; for eight splats and a quadrant at a time, invocations are first
// pixels and then eighths of splats, which sum in a fixed order. Rust twin: cpu/identity.rs, `label_mass_tile`. Source:
// methods reference 5.1.

#import constants
#import view
#import splat
#import label_chunk
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: LabelChunk;
@group(0) @binding(2) var<storage, read> splats: array<Splat>;
@group(0) @binding(3) var<storage, read> entries: array<vec4u>;
@group(0) @binding(4) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(5) var<storage, read> labels: array<u32>;
// Colour and final transmittance.
@group(0) @binding(6) var<storage, read> colors: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> pair_sums: array<f32>;

// Splats that are summed at a time.
const BATCH: u32 = 8u;
// Sum of all pixels; pixels without a label of the chunk have it for a place.
const TOTAL: u32 = PAIR_SUMS - 1u;

struct Staged {
    mean: vec2f,
    // One bit per quadrant.
    quadrants: u32,
    pair: u32,
    // Factor of the conic, and opacity.
    factor: vec4f,
}

struct Pixel {
    centre: vec2f,
    transmittance: f32,
    // 1 / coverage, 0 where nothing is counted.
    inverse_coverage: f32,
    open: bool,
}

var<workgroup> staged: array<Staged, 64>;
// Of the batch on the quadrant.
var<workgroup> shares: array<f32, 512>;
// Place of every pixel's label among the sums, quadrant by quadrant.
var<workgroup> places: array<u32, 256>;
// Of every splat of the batch, by eighths.
var<workgroup> partial_sums: array<f32, 768>;

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = pixel_in_quadrant(tile, quadrant, local);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    var place = TOTAL;
    if (all(at < view.size)) {
        let position = at.y * view.size.x + at.x;
        let coverage = 1.0 - colors[position].w;
        p.open = true;
        if (coverage >= MIN_COVERAGE) {
            p.inverse_coverage = 1.0 / coverage;
        }
        let label = labels[position];
        for (var k = 0u; k < chunk.count; k += 1u) {
            if (chunk.labels[k / 4u][k % 4u] == label) {
                place = k;
            }
        }
    }
    places[quadrant * 64u + local] = place;
    return p;
}

// Weight of a splat in a pixel over its coverage; steps the pixel.
fn replay(splat: Staged, p: ptr<function, Pixel>) -> f32 {
    let alpha = min(MAX_ALPHA, splat.factor.w * peak_at(splat.factor.xyz, splat.mean - (*p).centre));
    if (alpha < MIN_ALPHA) {
        return 0.0;
    }
    let weight = (*p).transmittance * alpha;
    let next = (*p).transmittance - weight;
    if (next < MIN_TRANSMITTANCE) {
        (*p).open = false;
        return 0.0;
    }
    (*p).transmittance = next;
    return weight * (*p).inverse_coverage;
}

// Every invocation of the workgroup must come here.
fn visit(quadrant: u32, first: u32, count: u32, local: u32, p: ptr<function, Pixel>) {
    for (var k = 0u; k < count; k += 1u) {
        var share = 0.0;
        if ((*p).open && (staged[first + k].quadrants & (1u << quadrant)) != 0u) {
            share = replay(staged[first + k], p);
        }
        shares[k * 64u + local] = share;
    }
    workgroupBarrier();
    let own = local / 8u;
    let part = local % 8u;
    if (own < count) {
        let sums = local * PAIR_SUMS;
        for (var k = 0u; k < HALF_TILE; k += 1u) {
            // Every eighth starts at another column, so that they read from different banks of memory.
            let at = part * HALF_TILE + (k + part) % HALF_TILE;
            let share = shares[own * 64u + at];
            if (share != 0.0) {
                let place = places[quadrant * 64u + at];
                partial_sums[sums + TOTAL] += share;
                if (place != TOTAL) {
                    partial_sums[sums + place] += share;
                }
            }
        }
    }
    workgroupBarrier();
}

@compute @workgroup_size(64)
fn count_labels(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = workgroup.xy;
    let range = tile_ranges[tile.y * view.tiles.x + tile.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    workgroupBarrier();
    for (var first = range.x; first < range.y; first += 64u) {
        let index = first + local;
        if (index < range.y) {
            let entry = entries[index];
            let splat = splats[entry.y & INDEX_MASK];
            var item: Staged;
            item.mean = splat.mean;
            item.pair = entry.x;
            item.factor = splat.factor;
            if (((entry.y >> PASS_SHIFT) & COLOR_PASS) != 0u) {
                for (var quadrant = 0u; quadrant < 4u; quadrant += 1u) {
                    let passes = passes_in_quadrant(splat, quadrant_origin(tile, quadrant));
                    item.quadrants |= select(0u, 1u << quadrant, (passes & COLOR_PASS) != 0u);
                }
            }
            staged[local] = item;
        }
        workgroupBarrier();
        let staged_count = min(64u, range.y - first);
        for (var batch = 0u; batch < staged_count; batch += BATCH) {
            let count = min(BATCH, staged_count - batch);
            for (var k = 0u; k < PAIR_SUMS; k += 1u) {
                partial_sums[local * PAIR_SUMS + k] = 0.0;
            }
            visit(0u, batch, count, local, &p0);
            visit(1u, batch, count, local, &p1);
            visit(2u, batch, count, local, &p2);
            visit(3u, batch, count, local, &p3);
            let own = local / 8u;
            if (own < count) {
                let pair = staged[batch + own].pair;
                for (var value = local % 8u; value < PAIR_SUMS; value += 8u) {
                    var sum = 0.0;
                    for (var k = 0u; k < 8u; k += 1u) {
                        sum += partial_sums[(own * 8u + k) * PAIR_SUMS + value];
                    }
                    pair_sums[pair * PAIR_SUMS + value] = sum;
                }
            }
            workgroupBarrier();
        }
    }
}
