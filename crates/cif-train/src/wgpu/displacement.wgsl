// Holds Gaussians to known motion: `follow` finds how each travelling object lies against its path, a workgroup per
// object; `displace` adds the gradients by what the deformation adds to the centres. They reach the deformation alone:
// what the direct path will add to the canonical centres is taken away before. Rust twins: losses/displacement.rs
// `displacement_loss` and `rotations`.

#import constants
#import motion

// An object at the time of the view.
struct Guide {
    // Mean displaced and canonical centre.
    now: vec3f,
    before: vec3f,
    // Gradient by the mean centre, for each of its Gaussians.
    v_mean: vec3f,
    rotation: mat3x3f,
}

@group(0) @binding(0) var<uniform> motion: Motion;
@group(0) @binding(1) var<storage, read> posed: array<vec4f>;
@group(0) @binding(2) var<storage, read> canonical: array<vec4f>;
// Object + 1 per Gaussian, 0 for what is held in place, FREE for what nothing holds.
@group(0) @binding(3) var<storage, read> guide_of: array<u32>;
// How far each object is from its canonical place.
@group(0) @binding(4) var<storage, read> shifts: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> guides: array<Guide>;
@group(0) @binding(6) var<storage, read_write> v_posed: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> v_canonical: array<vec4f>;

const INVOCATIONS: u32 = 128u;
#import workgroup

// Gradient of a pull of weight and reach.
fn pulled(r: vec3f, pull: vec2f) -> vec3f {
    return r * (pull.x / sqrt(dot(r, r) + pull.y * pull.y));
}

fn inverse_transposed(m: mat3x3f) -> mat3x3f {
    let a = cross(m[1], m[2]);
    return mat3x3f(a, cross(m[2], m[0]), cross(m[0], m[1])) * (1.0 / dot(m[0], a));
}

// Newton's iteration for the orthogonal factor of the polar decomposition; none where a reflection is nearer.
fn nearest_rotation(correlation: mat3x3f) -> mat3x3f {
    let identity = mat3x3f(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let size = sqrt(
        dot(correlation[0], correlation[0]) + dot(correlation[1], correlation[1])
            + dot(correlation[2], correlation[2]),
    );
    if !(size > 0.0) {
        return identity;
    }
    var m = correlation * (1.0 / size) + identity * NO_ROTATION;
    let d = determinant(m);
    if !(d > 1e-9) {
        return identity;
    }
    m *= pow(d, -1.0 / 3.0);
    for (var k = 0u; k < 40u; k++) {
        let next = (m + inverse_transposed(m)) * 0.5;
        let change = next - m;
        m = next;
        if dot(change[0], change[0]) + dot(change[1], change[1]) + dot(change[2], change[2]) < 1e-13 {
            break;
        }
    }
    return m;
}

@compute @workgroup_size(128)
fn follow(
    @builtin(workgroup_id) group: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let own = group.x + 1u;
    var displaced = vec4f(0.0);
    var place = vec4f(0.0);
    for (var row = local; row < motion.gaussians; row += 128u) {
        if guide_of[row] == own {
            displaced += vec4f(posed[3u * row].xyz, 1.0);
            place += vec4f(canonical[3u * row].xyz, 0.0);
        }
    }
    let sum_displaced = sum_of_workgroup(lane, displaced);
    let sum_place = sum_of_workgroup(lane, place);
    let count = max(sum_displaced.w, 1.0);
    let now = sum_displaced.xyz / count;
    let before = sum_place.xyz / count;
    var columns: array<vec4f, 3>;
    for (var k = 0u; k < 3u; k++) {
        columns[k] = vec4f(0.0);
    }
    for (var row = local; row < motion.gaussians; row += 128u) {
        if guide_of[row] == own {
            let a = vec4f(posed[3u * row].xyz - now, 0.0);
            let b = canonical[3u * row].xyz - before;
            columns[0] += a * b.x;
            columns[1] += a * b.y;
            columns[2] += a * b.z;
        }
    }
    let c0 = sum_of_workgroup(lane, columns[0]);
    let c1 = sum_of_workgroup(lane, columns[1]);
    let c2 = sum_of_workgroup(lane, columns[2]);
    let rotation = nearest_rotation(mat3x3f(c0.xyz, c1.xyz, c2.xyz));
    var pull = vec4f(0.0);
    for (var row = local; row < motion.gaussians; row += 128u) {
        if guide_of[row] == own {
            let r = (posed[3u * row].xyz - now) - rotation * (canonical[3u * row].xyz - before);
            pull += vec4f(pulled(r, motion.path), 0.0);
        }
    }
    let sum_pull = sum_of_workgroup(lane, pull);
    if local == 0u {
        let away = now - before - shifts[group.x].xyz;
        guides[group.x].now = now;
        guides[group.x].before = before;
        guides[group.x].rotation = rotation;
        guides[group.x].v_mean = pulled(away, motion.path) - sum_pull.xyz / count;
    }
}

@compute @workgroup_size(128)
fn displace(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = (group.y * MAX_WORKGROUPS + group.x) * 128u + local;
    if row >= motion.gaussians || guide_of[row] == FREE {
        return;
    }
    let displaced = posed[3u * row].xyz;
    let place = canonical[3u * row].xyz;
    var v: vec3f;
    if guide_of[row] == 0u {
        v = pulled(displaced - place, motion.place);
    } else {
        let guide = guides[guide_of[row] - 1u];
        let r = (displaced - guide.now) - guide.rotation * (place - guide.before);
        v = pulled(r, motion.path) + guide.v_mean;
    }
    v *= motion.scale;
    v_posed[3u * row] += vec4f(v, 0.0);
    v_canonical[3u * row] -= vec4f(v, 0.0);
}
