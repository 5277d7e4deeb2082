// Real spherical harmonics with the Condon-Shortley sign, degrees 0 to 3, and their gradients in free x, y, z.
// Rust twin: cif_geometry::spherical_harmonics.

fn harmonics(d: vec3f, degree: u32) -> array<f32, 16> {
    var b: array<f32, 16>;
    b[0] = BAND_0;
    let x = d.x;
    let y = d.y;
    let z = d.z;
    if (degree >= 1u) {
        b[1] = -BAND_1 * y;
        b[2] = BAND_1 * z;
        b[3] = -BAND_1 * x;
    }
    if (degree >= 2u) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        b[4] = BAND_2_0 * x * y;
        b[5] = BAND_2_1 * y * z;
        b[6] = BAND_2_2 * (2.0 * zz - xx - yy);
        b[7] = BAND_2_3 * x * z;
        b[8] = BAND_2_4 * (xx - yy);
        if (degree >= 3u) {
            b[9] = BAND_3_0 * y * (3.0 * xx - yy);
            b[10] = BAND_3_1 * x * y * z;
            b[11] = BAND_3_2 * y * (4.0 * zz - xx - yy);
            b[12] = BAND_3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
            b[13] = BAND_3_4 * x * (4.0 * zz - xx - yy);
            b[14] = BAND_3_5 * z * (xx - yy);
            b[15] = BAND_3_6 * x * (xx - 3.0 * yy);
        }
    }
    return b;
}

fn harmonics_gradient(d: vec3f, degree: u32) -> array<vec3f, 16> {
    var g: array<vec3f, 16>;
    let x = d.x;
    let y = d.y;
    let z = d.z;
    if (degree >= 1u) {
        g[1] = vec3f(0.0, -BAND_1, 0.0);
        g[2] = vec3f(0.0, 0.0, BAND_1);
        g[3] = vec3f(-BAND_1, 0.0, 0.0);
    }
    if (degree >= 2u) {
        g[4] = BAND_2_0 * vec3f(y, x, 0.0);
        g[5] = BAND_2_1 * vec3f(0.0, z, y);
        g[6] = BAND_2_2 * vec3f(-2.0 * x, -2.0 * y, 4.0 * z);
        g[7] = BAND_2_3 * vec3f(z, 0.0, x);
        g[8] = BAND_2_4 * vec3f(2.0 * x, -2.0 * y, 0.0);
        if (degree >= 3u) {
            let xx = x * x;
            let yy = y * y;
            let zz = z * z;
            g[9] = BAND_3_0 * vec3f(6.0 * x * y, 3.0 * (xx - yy), 0.0);
            g[10] = BAND_3_1 * vec3f(y * z, x * z, x * y);
            g[11] = BAND_3_2 * vec3f(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
            g[12] = BAND_3_3 * vec3f(-6.0 * x * z, -6.0 * y * z, 3.0 * (2.0 * zz - xx - yy));
            g[13] = BAND_3_4 * vec3f(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
            g[14] = BAND_3_5 * vec3f(2.0 * x * z, -2.0 * y * z, xx - yy);
            g[15] = BAND_3_6 * vec3f(3.0 * (xx - yy), -6.0 * x * y, 0.0);
        }
    }
    return g;
}
