// Spherical harmonics with the bands above the constant one in 16-bit floats, two to a word, the earlier one lower. Needs
// no feature: core WGSL unpacks them. Rust twin: gaussians.rs, `packed_sh`.

@group(0) @binding(2) var<storage, read> sh: array<u32>;

fn coefficient(row: u32, m: u32) -> vec3f {
    let first = row * PACKED_SH_WORDS;
    if (m == 0u) {
        return bitcast<vec3f>(vec3u(sh[first], sh[first + 1u], sh[first + 2u]));
    }
    let half = 3u * (m - 1u);
    let at = first + 3u + half / 2u;
    let low = unpack2x16float(sh[at]);
    let high = unpack2x16float(sh[at + 1u]);
    return select(vec3f(low, high.x), vec3f(low.y, high), (half & 1u) != 0u);
}
