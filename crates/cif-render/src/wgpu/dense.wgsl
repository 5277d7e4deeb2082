// Instance images: label of the most probable instance (dense index + 1), its probability, coverage, entropy of M / A
// in nats, and the blended labelled shares. Instances are taken 16 at a time, each chunk with a walk of its own over
// the tile, so that memory does not depend on how many there are. Rust twin: cpu/dense.rs. Source: methods
// reference 4.2 (evaluation).

#import constants
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> entries: array<vec4u>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(4) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> identities: array<vec2u>;
@group(0) @binding(6) var<storage, read> labelled_shares: array<f32>;
// Label, probability, coverage, entropy.
@group(0) @binding(7) var<storage, read_write> images: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> foregrounds: array<f32>;

// A splat of the tile that falls on the quadrant.
struct Staged {
    mean: vec2f,
    depth: f32,
    // Passes that draw it, a bit each.
    passes: u32,
    // Factor of the conic, and opacity.
    factor: vec4f,
    // Colour and occupancy.
    color: vec4f,
    row: u32,
    // Its identity row.
    row_first: u32,
    row_end: u32,
    unused: u32,
}

// 64 at a time, in order.
var<workgroup> staged: array<Staged, 64>;
var<workgroup> kept: array<atomic<u32>, 2>;
var<workgroup> kept_count: u32;
var<workgroup> live: array<atomic<u32>, 1>;
var<workgroup> live_count: u32;

// Stages entries from `first` on; returns how many are kept. Every invocation of the workgroup must come here.
fn stage(first: u32, end: u32, origin: vec2u, requested: u32, local: u32) -> u32 {
    if (local < 2u) {
        atomicStore(&kept[local], 0u);
    }
    workgroupBarrier();
    var item: Staged;
    let index = first + local;
    if (index < end) {
        let tag = entries[index].y;
        item.row = tag & INDEX_MASK;
        let splat = splats[item.row];
        item.passes = (tag >> PASS_SHIFT) & requested & passes_in_quadrant(splat, origin);
        if (item.passes != 0u) {
            item.mean = splat.mean;
            item.depth = splat.depth;
            item.factor = splat.factor;
            item.color = splat.color;
            if ((item.passes & INSTANCE_PASS) != 0u) {
                item.row_first = row_offsets[item.row];
                item.row_end = row_offsets[item.row + 1u];
            }
            atomicOr(&kept[local >> 5u], 1u << (local & 31u));
        }
    }
    workgroupBarrier();
    let low = atomicLoad(&kept[0]);
    let high = atomicLoad(&kept[1]);
    let own = (1u << (local & 31u)) - 1u;
    let before = select(countOneBits(low & own), countOneBits(low) + countOneBits(high & own), local >= 32u);
    if (item.passes != 0u) {
        staged[before] = item;
    }
    if (local == 0u) {
        kept_count = countOneBits(low) + countOneBits(high);
    }
    return workgroupUniformLoad(&kept_count);
}

// Whether any invocation is live. Every invocation of the workgroup must come here.
fn any_live(is_live: bool, local: u32) -> bool {
    if (local == 0u) {
        atomicStore(&live[0], 0u);
    }
    workgroupBarrier();
    if (is_live) {
        atomicOr(&live[0], 1u);
    }
    workgroupBarrier();
    if (local == 0u) {
        live_count = atomicLoad(&live[0]);
    }
    return workgroupUniformLoad(&live_count) != 0u;
}

const CHUNK: u32 = 16u;

@compute @workgroup_size(64)
fn dense(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = workgroup.xy / 2u;
    let first_pixel = vec2u(0u, view.first_row * TILE);
    let origin = first_pixel + workgroup.xy * HALF_TILE;
    let pixel = origin + vec2u(local % HALF_TILE, local / HALF_TILE);
    let inside = all(pixel < view.size);
    let centre = vec2f(pixel) + 0.5;
    let range = tile_ranges[tile.y * view.tiles.x + tile.x];
    var label = 0u;
    var most = 0.0;
    var coverage = 0.0;
    // Sum of M ln M.
    var information = 0.0;
    var foreground = 0.0;
    for (var first_label = 0u; first_label < max(view.instances, 1u); first_label += CHUNK) {
        var masses: array<f32, CHUNK>;
        for (var k = 0u; k < CHUNK; k += 1u) {
            masses[k] = 0.0;
        }
        let requested = INSTANCE_PASS | select(0u, COLOR_PASS, first_label == 0u);
        var open = select(0u, requested, inside);
        var transmittance = 1.0;
        var instance_transmittance = 1.0;
        for (var first = range.x; first < range.y; first += 64u) {
            if (!any_live(open != 0u, local)) {
                break;
            }
            let count = stage(first, range.y, origin, requested, local);
            for (var k = 0u; k < count; k += 1u) {
                let passes = staged[k].passes & open;
                if (passes == 0u) {
                    continue;
                }
                let factor = staged[k].factor;
                let peak = peak_at(factor.xyz, staged[k].mean - centre);
                if ((passes & COLOR_PASS) != 0u) {
                    let alpha = min(MAX_ALPHA, factor.w * peak);
                    if (alpha >= MIN_ALPHA) {
                        let weight = transmittance * alpha;
                        let next = transmittance - weight;
                        if (next < MIN_TRANSMITTANCE) {
                            open &= ~COLOR_PASS;
                        } else {
                            foreground += weight * labelled_shares[staged[k].row];
                            transmittance = next;
                        }
                    }
                }
                if ((passes & INSTANCE_PASS) != 0u) {
                    let alpha = min(MAX_ALPHA, staged[k].color.w * peak);
                    if (alpha >= MIN_ALPHA) {
                        let weight = instance_transmittance * alpha;
                        let next = instance_transmittance - weight;
                        if (next < MIN_TRANSMITTANCE) {
                            open &= ~INSTANCE_PASS;
                        } else {
                            for (var e = staged[k].row_first; e < staged[k].row_end; e += 1u) {
                                let item = identities[e];
                                let slot = item.x - first_label;
                                if (slot < CHUNK) {
                                    masses[slot] += weight * bitcast<f32>(item.y);
                                }
                            }
                            instance_transmittance = next;
                        }
                    }
                }
            }
        }
        for (var k = 0u; k < CHUNK; k += 1u) {
            let mass = masses[k];
            if (mass > 0.0) {
                coverage += mass;
                information += mass * log(mass);
                // Ties go to the lowest index.
                if (mass > most) {
                    most = mass;
                    label = first_label + k + 1u;
                }
            }
        }
    }
    if (inside) {
        let position = (pixel.y - first_pixel.y) * view.size.x + pixel.x;
        var entropy = 0.0;
        if (coverage > 0.0) {
            entropy = max(log(coverage) - information / coverage, 0.0);
        }
        images[position] = vec4f(f32(label), most, coverage, entropy);
        foregrounds[position] = min(foreground, 1.0);
    }
}
