// Spherical harmonics in 32-bit floats. Twin: packed_coefficients.wgsl.

@group(0) @binding(2) var<storage, read> sh: array<f32>;

fn coefficient(row: u32, m: u32) -> vec3f {
    let at = row * SH_FLOATS + m * 3u;
    return vec3f(sh[at], sh[at + 1u], sh[at + 2u]);
}
