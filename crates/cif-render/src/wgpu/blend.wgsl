// Blends four channels of values per Gaussian over the pixels of a tile, front to back, with the weights of colour or of
// instances. A workgroup is a tile, an invocation one of its pixels, or one of each quadrant. Rust twin: cpu/blend.rs.
// Source: methods reference 3.1 (pixel loop) and 4.1.

#import constants
@group(0) @binding(6) var<storage, read_write> blended: array<f32>;
#import tile_forward
#import blend_values

struct Pixel {
    centre: vec2f,
    // The pass while it lets light through.
    open: u32,
    // Values that are blended have none.
    label: u32,
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

fn stage_more(count: u32, local: u32) {
    stage_values(count, local);
}

// Adds a splat to a pixel.
fn add(splat: Staged, own: vec4f, quadrant: u32, passes: u32, behind: u32, p: ptr<function, Pixel>) {
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

@compute @workgroup_size(INVOCATIONS)
fn blend(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    blend_tile(workgroup, local);
}
