// Blends the splats of a tile into pixels, front to back, for colour and for the probability of each pixel's own label
// at once. A workgroup is a tile, an invocation one of its pixels, or one of each quadrant. Writes the composited colour
// with the transmittance, and depth D, label probability M_y, instance transmittance S and the position in the list of
// the tile after the last splat that supports the label. Rust twin: cpu/rasterize.rs. Source: methods reference 3.1
// (pixel loop) and 4.2.

#import constants
#import variant
@group(0) @binding(4) var<storage, read> labels: array<u32>;
@group(0) @binding(5) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(6) var<storage, read> identities: array<vec2u>;
@group(0) @binding(7) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> blended: array<vec4f>;
#import tile_forward
#import identity

struct Pixel {
    centre: vec2f,
    // Passes that still let light through.
    open: u32,
    label: u32,
    color: vec3f,
    depth: f32,
    transmittance: f32,
    probability: f32,
    instance_transmittance: f32,
    // One past the last entry of the tile that supports the label.
    supported: u32,
}

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = pixel_in_quadrant(tile, quadrant, local);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    p.instance_transmittance = 1.0;
    if (all(at < view.size)) {
        if (WITH_INSTANCES && view.label_pixels != 0u) {
            p.label = labels[at.y * view.size.x + at.x];
        }
        p.open = COLOR_PASS | select(0u, INSTANCE_PASS, p.label != 0u);
    }
    return p;
}

// Adds a splat to a pixel.
fn add(splat: Staged, values: vec4f, quadrant: u32, passes: u32, behind: u32, p: ptr<function, Pixel>) {
    let identity = values[quadrant];
    let open = passes & (*p).open;
    if (open == 0u) {
        return;
    }
    let peak = peak_at(splat.factor.xyz, splat.mean - (*p).centre);
    if ((open & COLOR_PASS) != 0u) {
        let alpha = min(MAX_ALPHA, splat.factor.w * peak);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).transmittance * alpha;
            let next = (*p).transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~COLOR_PASS;
            } else {
                (*p).color += weight * splat.color.xyz;
                (*p).depth += weight * splat.depth;
                (*p).transmittance = next;
            }
        }
    }
    if (WITH_INSTANCES && (open & INSTANCE_PASS) != 0u) {
        let alpha = min(MAX_ALPHA, splat.color.w * peak);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).instance_transmittance * alpha;
            let next = (*p).instance_transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~INSTANCE_PASS;
            } else {
                (*p).probability += weight * identity;
                (*p).supported = select((*p).supported, behind, identity > 0.0);
                (*p).instance_transmittance = next;
            }
        }
    }
}

fn write(p: Pixel) {
    let at = vec2u(p.centre);
    if (all(at < view.size)) {
        let position = (at.y - view.first_row * TILE) * view.size.x + at.x;
        colors[position] = vec4f(p.color + p.transmittance * view.background.xyz, p.transmittance);
        blended[position] = vec4f(p.depth, p.probability, p.instance_transmittance, f32(p.supported));
    }
}

@compute @workgroup_size(INVOCATIONS)
fn rasterize(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    blend_tile(workgroup, local);
}
