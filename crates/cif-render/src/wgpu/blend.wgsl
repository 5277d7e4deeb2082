// Blends four channels of values per Gaussian over the pixels of a tile, front to back, with the weights of colour or of
// instances. A workgroup is a tile, an invocation a pixel of each of its quadrants. Rust twin: cpu/blend.rs. Source:
// methods reference 3.1 (pixel loop) and 4.1.

#import constants
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
@group(0) @binding(6) var<storage, read_write> blended: array<f32>;
#import tile_staging
#import blend_values

struct Pixel {
    centre: vec2f,
    // The pass while it lets light through.
    open: u32,
    transmittance: f32,
    sum: vec4f,
}

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = pixel_in_quadrant(tile, quadrant, local);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    p.open = select(0u, chunk.passes, all(at < view.size));
    return p;
}

// Adds a splat to a pixel.
fn add(splat: Staged, own: vec4f, passes: u32, p: ptr<function, Pixel>) {
    if ((passes & (*p).open) == 0u) {
        return;
    }
    let alpha = min(MAX_ALPHA, strength_of(splat) * peak_at(splat.factor.xyz, splat.mean - (*p).centre));
    if (alpha >= MIN_ALPHA) {
        let weight = (*p).transmittance * alpha;
        let next = (*p).transmittance - weight;
        if (next < MIN_TRANSMITTANCE) {
            (*p).open = 0u;
        } else {
            (*p).sum += weight * own;
            (*p).transmittance = next;
        }
    }
}

fn write(p: Pixel) {
    let at = vec2u(p.centre);
    if (all(at < view.size)) {
        let first = position_of(at) * chunk.channels + chunk.first;
        for (var k = 0u; k < min(BLEND_CHANNELS, chunk.channels - chunk.first); k += 1u) {
            blended[first + k] = p.sum[k];
        }
    }
}

@compute @workgroup_size(64)
fn blend(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
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
            break;
        }
        let count = min(STAGED, range.y - first);
        stage_values(count, local);
        // A loop that ends at its foot: software that walks both sides of every branch goes through others once more.
        var k = 0u;
        loop {
            let splat = staged[k];
            let own = staged_values[k];
            let passes = atomicLoad(&staged_passes[k]) & alive;
            if ((passes & 3u) != 0u) {
                add(splat, own, passes & 3u, &p0);
            }
            if ((passes & 12u) != 0u) {
                add(splat, own, (passes >> 2u) & 3u, &p1);
            }
            if ((passes & 48u) != 0u) {
                add(splat, own, (passes >> 4u) & 3u, &p2);
            }
            if ((passes & 192u) != 0u) {
                add(splat, own, (passes >> 6u) & 3u, &p3);
            }
            continuing {
                k += 1u;
                break if k >= count;
            }
        }
        workgroupBarrier();
    }
    write(p0);
    write(p1);
    write(p2);
    write(p3);
}
