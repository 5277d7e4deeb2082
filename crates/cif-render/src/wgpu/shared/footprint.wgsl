// What projection and its backward pass share of a Gaussian: camera-space point, spread on the image, factor.
// Rust twin: cpu/project.rs, `footprint`. Source: methods reference 3.1.

struct Footprint {
    visible: bool,
    in_camera: vec3f,
    // Unit quaternion w, x, y, z, and the norm of the raw one.
    unit: vec4f,
    norm: f32,
    scales: vec3f,
    // 1 where the log-scale is inside its range, so that a gradient flows.
    scale_flows: vec3f,
    // Rows of R_v R diag(exp s).
    in_view_0: vec3f,
    in_view_1: vec3f,
    in_view_2: vec3f,
    // Non-zero entries of the Jacobian: 00, 02, 11, 12.
    jacobian: vec4f,
    // x and y of the Jacobian, clamped, and where they are.
    clamped_xy: vec2f,
    ratio_clamped: vec2<bool>,
    // Rows of T = J R_v R diag(exp s), and their cross product.
    image_0: vec3f,
    image_1: vec3f,
    normal: vec3f,
    // Determinant of C0 = T T^T.
    sharp_determinant: f32,
    // After the low pass: C 00, 01, 11.
    blurred: vec3f,
    // L00, L01, L11 of C^-1 = L^T L.
    factor: vec3f,
    // Antialiasing factor rho, and whether it sits on its floor (or is off).
    compensation: f32,
    compensation_floored: bool,
}

fn footprint_of(mean: vec3f, raw_log_scale: vec3f, quaternion: vec4f) -> Footprint {
    var f: Footprint;
    f.visible = false;
    let p = vec3f(
        dot(view.rotation[0].xyz, mean) + view.rotation[0].w,
        dot(view.rotation[1].xyz, mean) + view.rotation[1].w,
        dot(view.rotation[2].xyz, mean) + view.rotation[2].w,
    );
    f.in_camera = p;
    f.norm = length(quaternion);
    if (!are_finite(p) || !are_finite(raw_log_scale) || !is_finite(f.norm)) {
        return f;
    }
    let z = p.z;
    if (z < view.near || f.norm < MIN_QUATERNION_NORM) {
        return f;
    }
    let log_scale = clamp(raw_log_scale, vec3f(LOG_SCALE_LOW), vec3f(LOG_SCALE_HIGH));
    f.scale_flows = select(vec3f(0.0), vec3f(1.0), log_scale == raw_log_scale);
    f.scales = exp(log_scale);
    f.unit = quaternion / f.norm;
    let w = f.unit.x;
    let i = f.unit.y;
    let j = f.unit.z;
    let k = f.unit.w;
    let spread_0 =
        vec3f(1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)) * f.scales;
    let spread_1 =
        vec3f(2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i)) * f.scales;
    let spread_2 =
        vec3f(2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)) * f.scales;
    let r0 = view.rotation[0].xyz;
    let r1 = view.rotation[1].xyz;
    let r2 = view.rotation[2].xyz;
    f.in_view_0 = r0.x * spread_0 + r0.y * spread_1 + r0.z * spread_2;
    f.in_view_1 = r1.x * spread_0 + r1.y * spread_1 + r1.z * spread_2;
    f.in_view_2 = r2.x * spread_0 + r2.y * spread_1 + r2.z * spread_2;
    let ratio = p.xy / z;
    f.ratio_clamped = (ratio < view.ratio_low) | (ratio > view.ratio_high);
    f.clamped_xy = z * clamp(ratio, view.ratio_low, view.ratio_high);
    let r = 1.0 / z;
    f.jacobian = vec4f(
        view.focal.x * r,
        -view.focal.x * f.clamped_xy.x * r * r,
        view.focal.y * r,
        -view.focal.y * f.clamped_xy.y * r * r,
    );
    f.image_0 = f.jacobian.x * f.in_view_0 + f.jacobian.y * f.in_view_2;
    f.image_1 = f.jacobian.z * f.in_view_1 + f.jacobian.w * f.in_view_2;
    let largest = max(dot(f.image_0, f.image_0), dot(f.image_1, f.image_1));
    if (largest > MAX_COVARIANCE) {
        let factor = sqrt(MAX_COVARIANCE / largest);
        f.image_0 *= factor;
        f.image_1 *= factor;
    }
    let sharp = vec3f(dot(f.image_0, f.image_0), dot(f.image_0, f.image_1), dot(f.image_1, f.image_1));
    // |t0 x t1|^2: a sum of squares has nothing to cancel, however thin the Gaussian.
    f.normal = cross(f.image_0, f.image_1);
    f.sharp_determinant = dot(f.normal, f.normal);
    f.blurred = sharp + vec3f(view.low_pass, 0.0, view.low_pass);
    let determinant = f.sharp_determinant + view.low_pass * (sharp.x + sharp.z) + view.low_pass * view.low_pass;
    if (!is_finite(determinant)) {
        return f;
    }
    let l00 = sqrt(f.blurred.z / determinant);
    f.factor = vec3f(l00, -l00 * f.blurred.y / f.blurred.z, 1.0 / sqrt(f.blurred.z));
    f.compensation = 1.0;
    f.compensation_floored = true;
    if (view.antialiased != 0u) {
        let squared = f.sharp_determinant / determinant;
        let least = MIN_ANTIALIASING * MIN_ANTIALIASING;
        f.compensation = sqrt(max(squared, least));
        f.compensation_floored = squared <= least;
    }
    f.visible = true;
    return f;
}

// Unit direction from the camera to a point, and its distance.
fn view_direction(mean: vec3f) -> vec4f {
    let offset = mean - view.centre.xyz;
    let distance = max(length(offset), 1e-8);
    return vec4f(offset / distance, distance);
}
