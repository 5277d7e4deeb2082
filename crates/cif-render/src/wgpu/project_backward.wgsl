// Carries the gradient of every splat to the raw parameters of its posed Gaussian; zeros where it is not visible. Also
// what densification needs: the gradient by the projected centre in normalised device coordinates (W / 2 v_x,
// H / 2 v_y), the screen radius in pixels, and 1 where visible. Rust twin: cpu/project.rs, `project_backward`.
// Source: methods reference 3.2, steps 1 to 9.

#import constants
#import numbers
#import harmonics
#import view
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> posed: array<vec4f>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(5) var<storage, read_write> v_posed: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> v_sh: array<f32>;
@group(0) @binding(7) var<storage, read_write> screen: array<vec4f>;
#import splat_gradients
#import directions
#import footprint

fn quaternion_backward(unit: vec4f, norm: f32, v0: vec3f, v1: vec3f, v2: vec3f) -> vec4f {
    let w = unit.x;
    let x = unit.y;
    let y = unit.z;
    let z = unit.w;
    let g = 2.0 * vec4f(
        x * (v2.y - v1.z) + y * (v0.z - v2.x) + z * (v1.x - v0.y),
        -2.0 * x * (v1.y + v2.z) + y * (v1.x + v0.y) + z * (v2.x + v0.z) + w * (v2.y - v1.z),
        x * (v1.x + v0.y) - 2.0 * y * (v0.x + v2.z) + z * (v2.y + v1.z) + w * (v0.z - v2.x),
        x * (v2.x + v0.z) + y * (v2.y + v1.z) - 2.0 * z * (v0.x + v1.y) + w * (v1.x - v0.y),
    );
    return (g - unit * dot(unit, g)) / norm;
}

@compute @workgroup_size(64)
fn project_backward(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = item_of(workgroup, local, 64u);
    if (row >= view.gaussians) {
        return;
    }
    for (var k = 0u; k < SH_FLOATS; k += 1u) {
        v_sh[row * SH_FLOATS + k] = 0.0;
    }
    v_posed[3u * row] = vec4f(0.0);
    v_posed[3u * row + 1u] = vec4f(0.0);
    v_posed[3u * row + 2u] = vec4f(0.0);
    screen[row] = vec4f(0.0);
    let splat = splats[row];
    if (!(splat.radius > 0.0)) {
        return;
    }
    let g0 = splat_gradients[3u * row];
    let g1 = splat_gradients[3u * row + 1u];
    let g2 = splat_gradients[3u * row + 2u];
    keep_torque(row, vec3f(0.0));
    let v_mean2d = g0.xy;
    screen[row] = vec4f(0.5 * vec2f(view.size) * v_mean2d, splat.radius, 1.0);
    if (all(g0 == vec4f(0.0)) && all(g1 == vec4f(0.0)) && all(g2.xy == vec2f(0.0))) {
        return;
    }
    let a = posed[3u * row];
    let b = posed[3u * row + 1u];
    let f = footprint_of(a.xyz, b.xyz, posed[3u * row + 2u]);
    if (!f.visible) {
        return;
    }
    let base_opacity = sigmoid(a.w);
    let opacity = splat.factor.w;
    let occupancy = splat.color.w;

    // Step 1: v_T = -L^T M W with W = L T, whose first row is L00 (t0 - C01 / C11 t1): the difference is
    // (0.3 t0 + t1 x (t0 x t1)) / C11, in which nothing cancels for needles.
    let turned = cross(f.image_1, f.normal);
    let w0 = f.factor.x / f.blurred.z * (view.low_pass * f.image_0 + turned);
    let w1 = f.factor.z * f.image_1;
    var m = vec3f(g0.zw, g1.x);
    var v_image_0 = vec3f(0.0);
    var v_image_1 = vec3f(0.0);
    // With opacity as occupancy, -q / o is the instance loss by the blended opacity.
    var v_blended = g2.x;
    if (view.occupancy == OCCUPANCY_OPACITY) {
        v_blended -= g2.y / opacity;
    }
    let v_opacity = v_blended * f.compensation;
    // Step 2: d log rho / dT is C0^-1 T - C^-1 T, and C^-1 T = L^T W.
    if (!f.compensation_floored) {
        let slope = v_blended * base_opacity * f.compensation;
        m += vec3f(slope, 0.0, slope);
        v_image_0 = slope / f.sharp_determinant * turned;
        v_image_1 = slope / f.sharp_determinant * cross(f.normal, f.image_0);
    }

    // Step 6: the log-scale of column c gets T_c . v_T_c = -W_c^T M W_c, again without cancellation.
    let moved_0 = m.x * w0 + m.y * w1;
    let moved_1 = m.y * w0 + m.z * w1;
    let v_log_scale = f.scale_flows
        * (f.image_0 * v_image_0 + f.image_1 * v_image_1 - (w0 * moved_0 + w1 * moved_1));
    v_image_0 -= f.factor.x * moved_0;
    v_image_1 -= f.factor.y * moved_0 + f.factor.z * moved_1;

    // Step 3: T = J M gives v_J = v_T M^T and v_M = J^T v_T.
    let v_j00 = dot(v_image_0, f.in_view_0);
    let v_j02 = dot(v_image_0, f.in_view_2);
    let v_j11 = dot(v_image_1, f.in_view_1);
    let v_j12 = dot(v_image_1, f.in_view_2);

    // Step 4: camera-space point.
    let p = f.in_camera;
    let r = 1.0 / p.z;
    let r2 = r * r;
    var v_point = vec3f(
        view.focal * r * v_mean2d,
        -dot(view.focal * p.xy, v_mean2d) * r2 - r2 * (view.focal.x * v_j00 + view.focal.y * v_j11),
    );
    let v_j = vec2f(v_j02, v_j12);
    let slope = view.focal * f.clamped_xy * (r2 * r) * v_j;
    let sideways = view.focal * r2 * v_j;
    v_point = vec3f(v_point.xy - select(sideways, vec2f(0.0), f.ratio_clamped), v_point.z);
    let along = select(2.0 * slope, slope, f.ratio_clamped);
    v_point.z += along.x + along.y;
    let size = length(v_point);
    if (size > MAX_POSITION_GRADIENT) {
        v_point *= MAX_POSITION_GRADIENT / size;
    }

    // Step 5: to the world, M = R_v B.
    let r0 = view.rotation[0].xyz;
    let r1 = view.rotation[1].xyz;
    let r2v = view.rotation[2].xyz;
    var v_mean = r0 * v_point.x + r1 * v_point.y + r2v * v_point.z;
    let v_in_view_0 = f.jacobian.x * v_image_0;
    let v_in_view_1 = f.jacobian.z * v_image_1;
    let v_in_view_2 = f.jacobian.y * v_image_0 + f.jacobian.w * v_image_1;
    let v_spread_0 = r0.x * v_in_view_0 + r1.x * v_in_view_1 + r2v.x * v_in_view_2;
    let v_spread_1 = r0.y * v_in_view_0 + r1.y * v_in_view_1 + r2v.y * v_in_view_2;
    let v_spread_2 = r0.z * v_in_view_0 + r1.z * v_in_view_1 + r2v.z * v_in_view_2;

    // Step 7: rotation.
    let v_quaternion = quaternion_backward(
        f.unit,
        f.norm,
        v_spread_0 * f.scales,
        v_spread_1 * f.scales,
        v_spread_2 * f.scales,
    );

    // Step 9: colour; no gradient where a channel sits at 0.
    let v_color = select(g1.yzw, vec3f(0.0), splat.color.xyz <= vec3f(0.0));
    if (any(v_color != vec3f(0.0))) {
        let direction = view_direction(a.xyz);
        let in_frame = into_frame(row, direction.xyz);
        let basis = harmonics(in_frame, view.sh_degree);
        let gradient = harmonics_gradient(in_frame, view.sh_degree);
        let count = (view.sh_degree + 1u) * (view.sh_degree + 1u);
        var v_in_frame = vec3f(0.0);
        for (var m = 0u; m < count; m += 1u) {
            let at = row * SH_FLOATS + m * 3u;
            let v = basis[m] * v_color;
            v_sh[at] = v.x;
            v_sh[at + 1u] = v.y;
            v_sh[at + 2u] = v.z;
            if (m > 0u) {
                v_in_frame += gradient[m] * dot(vec3f(sh[at], sh[at + 1u], sh[at + 2u]), v_color);
            }
        }
        keep_torque(row, cross(v_in_frame, in_frame));
        let v_direction = out_of_frame(row, v_in_frame);
        v_mean += (v_direction - direction.xyz * dot(direction.xyz, v_direction)) / direction.w;
    }

    // Step 8.
    let v_opacity_logit = base_opacity * (1.0 - base_opacity) * v_opacity;
    var v_occupancy_logit = 0.0;
    if (view.occupancy == OCCUPANCY_OWN) {
        v_occupancy_logit = -(1.0 - occupancy) * g2.y;
    }
    v_posed[3u * row] = vec4f(v_mean, v_opacity_logit);
    v_posed[3u * row + 1u] = vec4f(v_log_scale, v_occupancy_logit);
    v_posed[3u * row + 2u] = v_quaternion;
}
