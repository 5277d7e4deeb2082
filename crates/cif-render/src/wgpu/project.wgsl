// Projects posed Gaussians to the image: centre, factor of the conic, colour from spherical harmonics, reach of both
// passes, depth key. A Gaussian that draws nothing gets radius 0 and the last key. Rust twin: cpu/project.rs, `project`.
// Source: methods reference 3.1.

#import constants
#import numbers
#import harmonics
#import view
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> posed: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(4) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> depth_order: array<u32>;
#import coefficients
#import directions
#import footprint

fn color_of(row: u32, direction: vec3f) -> vec3f {
    let basis = harmonics(direction, view.sh_degree);
    let count = (view.sh_degree + 1u) * (view.sh_degree + 1u);
    var color = vec3f(0.5);
    for (var m = 0u; m < count; m += 1u) {
        color += basis[m] * coefficient(row, m);
    }
    return color;
}

fn splat_of(row: u32) -> Splat {
    var s: Splat;
    let a = posed[3u * row];
    let b = posed[3u * row + 1u];
    let f = footprint_of(a.xyz, b.xyz, posed[3u * row + 2u]);
    if (!f.visible || is_nan(a.w)) {
        return s;
    }
    let opacity = f.compensation * sigmoid(a.w);
    var occupancy = 0.0;
    if (view.occupancy == OCCUPANCY_OWN) {
        if (is_nan(b.w)) {
            return s;
        }
        occupancy = sigmoid(b.w);
    } else if (view.occupancy == OCCUPANCY_OPACITY) {
        occupancy = opacity;
    }
    let strongest = max(opacity, occupancy);
    if (strongest < MIN_ALPHA) {
        return s;
    }
    // Negative where a pass draws nothing.
    let reach = log(max(vec2f(opacity, occupancy), vec2f(1e-30)) / MIN_ALPHA);
    let furthest = max(reach.x, reach.y);
    let mean = view.focal * f.in_camera.xy / f.in_camera.z + view.principal;
    let extent = sqrt(2.0 * furthest * f.blurred.xz);
    let size = vec2f(view.size);
    if (!is_finite(extent.x) || !is_finite(extent.y) || !is_finite(mean.x) || !is_finite(mean.y)) {
        return s;
    }
    if (any(mean + extent <= vec2f(0.0)) || any(mean - extent >= size)) {
        return s;
    }
    let direction = view_direction(a.xyz);
    let color = color_of(row, into_frame(row, direction.xyz));
    if (!are_finite(color)) {
        return s;
    }
    let difference = f.blurred.x - f.blurred.z;
    let spread = sqrt(0.25 * difference * difference + f.blurred.y * f.blurred.y);
    s.mean = mean;
    s.extent = extent;
    s.factor = vec4f(f.factor, opacity);
    s.color = vec4f(max(color, vec3f(0.0)), occupancy);
    s.reach = reach;
    s.depth = f.in_camera.z;
    s.radius = 3.0 * sqrt(0.5 * (f.blurred.x + f.blurred.z) + spread);
    depth_keys[row] = bitcast<u32>(select(f.in_camera.z, direction.w, view.sort_by_distance != 0u));
    return s;
}

@compute @workgroup_size(64)
fn project(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = item_of(workgroup, local, 64u);
    if (row >= view.gaussians) {
        return;
    }
    depth_keys[row] = NOT_VISIBLE;
    depth_order[row] = row;
    splats[row] = splat_of(row);
}
