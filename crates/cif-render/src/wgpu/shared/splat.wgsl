// A Gaussian on the image, and how it blends into a pixel. Every kernel that walks the splats of a tile uses these
// functions, so that all take the same decisions. Rust twin: cpu/tile.rs. Source: methods reference 3.1.

const PASS_SHIFT: u32 = 30u;
const INDEX_MASK: u32 = 0x3fffffffu;
const NO_SPLAT: u32 = 0xffffffffu;

// u = L d: an offset in standard deviations. The factor L is upper triangular, 00, 01, 11, and L^T L the conic.
fn whitened(factor: vec3f, d: vec2f) -> vec2f {
    return vec2f(factor.x * d.x + factor.y * d.y, factor.z * d.y);
}

// Exponent of the footprint: a sum of squares, in which nothing cancels.
fn sigma_at(factor: vec3f, d: vec2f) -> f32 {
    let u = whitened(factor, d);
    return 0.5 * dot(u, u);
}

// Smallest sigma over a rectangle of pixel centres.
fn smallest_sigma(splat: Splat, first: vec2f, last: vec2f) -> f32 {
    let low = first - splat.mean;
    let high = last - splat.mean;
    let inside = (low <= vec2f(0.0)) & (high >= vec2f(0.0));
    if (all(inside)) {
        return 0.0;
    }
    let factor = splat.factor.xyz;
    var smallest = 3.4e38;
    if (!inside.x) {
        let x = select(high.x, low.x, low.x > 0.0);
        let y = clamp(-factor.x * factor.y * x / dot(factor.yz, factor.yz), low.y, high.y);
        smallest = min(smallest, sigma_at(factor, vec2f(x, y)));
    }
    if (!inside.y) {
        let y = select(high.y, low.y, low.y > 0.0);
        let x = clamp(-factor.y * y / factor.x, low.x, high.x);
        smallest = min(smallest, sigma_at(factor, vec2f(x, y)));
    }
    return smallest;
}

// Passes that draw the splat somewhere in a rectangle of pixel centres, a bit each; a hair more than the gate, so that
// rounding never drops a drawn pixel.
fn passes_in(splat: Splat, first: vec2f, last: vec2f) -> u32 {
    let sigma = smallest_sigma(splat, first, last);
    let reach = splat.reach * 1.00001 + 1e-5;
    return select(0u, COLOR_PASS, sigma <= reach.x) | select(0u, INSTANCE_PASS, sigma <= reach.y);
}

// Footprint P at an offset from the mean, at most 1.
fn peak_at(factor: vec3f, d: vec2f) -> f32 {
    return exp(-sigma_at(factor, d));
}

// First pixel of a quadrant of a tile: 0 and 1 above, 2 and 3 below.
fn quadrant_origin(tile: vec2u, quadrant: u32) -> vec2u {
    return tile * TILE + vec2u(quadrant & 1u, quadrant >> 1u) * HALF_TILE;
}

// Pixel of an invocation, of 64, in a quadrant.
fn pixel_in_quadrant(tile: vec2u, quadrant: u32, local: u32) -> vec2u {
    return quadrant_origin(tile, quadrant) + vec2u(local % HALF_TILE, local / HALF_TILE);
}

// Passes of a splat in a quadrant.
fn passes_in_quadrant(splat: Splat, origin: vec2u) -> u32 {
    let first = vec2f(origin) + 0.5;
    return passes_in(splat, first, first + f32(HALF_TILE - 1u));
}
