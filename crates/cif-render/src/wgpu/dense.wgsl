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
#import staging

const CHUNK: u32 = 16u;

@compute @workgroup_size(64)
fn dense(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = workgroup.xy / 2u;
    let origin = workgroup.xy * HALF_TILE;
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
        let wanted = INSTANCE_PASS | select(0u, COLOR_PASS, first_label == 0u);
        var open = select(0u, wanted, inside);
        var transmittance = 1.0;
        var instance_transmittance = 1.0;
        for (var first = range.x; first < range.y; first += 64u) {
            if (!any_live(open != 0u, local)) {
                break;
            }
            let count = stage(first, range.y, origin, wanted, local);
            for (var k = 0u; k < count; k += 1u) {
                let passes = staged[k].passes & open;
                if (passes == 0u) {
                    continue;
                }
                let conic = staged[k].conic;
                let peak = peak_at(conic.xyz, staged[k].mean - centre);
                if ((passes & COLOR_PASS) != 0u) {
                    let alpha = min(MAX_ALPHA, conic.w * peak);
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
        let position = pixel.y * view.size.x + pixel.x;
        var entropy = 0.0;
        if (coverage > 0.0) {
            entropy = max(log(coverage) - information / coverage, 0.0);
        }
        images[position] = vec4f(f32(label), most, coverage, entropy);
        foregrounds[position] = min(foreground, 1.0);
    }
}
