// Quaternions (w, x, y, z). Rust twin: cif_geometry::quaternion.

fn product(a: vec4f, b: vec4f) -> vec4f {
    return vec4f(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

fn conjugate(q: vec4f) -> vec4f {
    return vec4f(q.x, -q.yzw);
}
