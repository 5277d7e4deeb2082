// Blends the splats of a tile into pixels, front to back, for colour and for the probability of each pixel's own label
// at once. A workgroup is a quadrant of a tile, an invocation a pixel. Writes the composited colour with the
// transmittance, and depth D, label probability M_y and instance transmittance S. Rust twin: cpu/rasterize.rs.
// Source: methods reference 3.1 (pixel loop) and 4.2.

#import constants
#import variant
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> entries: array<vec4u>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(4) var<storage, read> labels: array<u32>;
@group(0) @binding(5) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(6) var<storage, read> identities: array<vec2u>;
@group(0) @binding(7) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> blended: array<vec4f>;
#import staging
#import identity

@compute @workgroup_size(64)
fn rasterize(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = workgroup.xy / 2u;
    let origin = workgroup.xy * HALF_TILE;
    let pixel = origin + vec2u(local % HALF_TILE, local / HALF_TILE);
    let inside = all(pixel < view.size);
    let position = pixel.y * view.size.x + pixel.x;
    let centre = vec2f(pixel) + 0.5;
    var label = 0u;
    if (WITH_INSTANCES && inside && view.label_pixels != 0u) {
        label = labels[position];
    }
    // Passes that still let light through here.
    var open = select(0u, COLOR_PASS | select(0u, INSTANCE_PASS, label != 0u), inside);
    var color = vec3f(0.0);
    var depth = 0.0;
    var transmittance = 1.0;
    var probability = 0.0;
    var instance_transmittance = 1.0;

    let range = tile_ranges[tile.y * view.tiles.x + tile.x];
    let wanted = COLOR_PASS | select(0u, INSTANCE_PASS, WITH_INSTANCES && view.label_pixels != 0u);
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
                        color += weight * staged[k].color.xyz;
                        depth += weight * staged[k].depth;
                        transmittance = next;
                    }
                }
            }
            if (WITH_INSTANCES && (passes & INSTANCE_PASS) != 0u) {
                let alpha = min(MAX_ALPHA, staged[k].color.w * peak);
                if (alpha >= MIN_ALPHA) {
                    let weight = instance_transmittance * alpha;
                    let next = instance_transmittance - weight;
                    if (next < MIN_TRANSMITTANCE) {
                        open &= ~INSTANCE_PASS;
                    } else {
                        probability +=
                            weight * probability_of(staged[k].row_first, staged[k].row_end, label - 1u);
                        instance_transmittance = next;
                    }
                }
            }
        }
    }
    if (inside) {
        colors[position] = vec4f(color + transmittance * view.background.xyz, transmittance);
        blended[position] = vec4f(depth, probability, instance_transmittance, 0.0);
    }
}
