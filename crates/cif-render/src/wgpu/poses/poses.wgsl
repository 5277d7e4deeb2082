// Groups of Gaussians that move as a whole, at the time of a view: `frames_of_groups` finds where every group is, between
// two of its poses, `carry` puts its Gaussians there and gives the rotation of their frame. Rust twin: cif_field::tracks,
// `TracksAtTime::apply`. Source: methods reference of motion, 2.2.

#import constants
#import numbers
#import groups
#import quaternions
@group(0) @binding(0) var<uniform> sizes: GroupSizes;
@group(0) @binding(1) var<storage, read> groups: array<GroupView>;
@group(0) @binding(2) var<storage, read> poses: array<Pose>;
// Gaussian and group.
@group(0) @binding(3) var<storage, read> members: array<vec2u>;
@group(0) @binding(4) var<storage, read> canonical: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> frames: array<GroupFrame>;
@group(0) @binding(6) var<storage, read_write> posed: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> turns: array<vec4f>;

// Angle between quaternions below which the chord is the arc in single precision, radians.
const STRAIGHT: f32 = 1e-3;

fn between(a: vec4f, b: vec4f, share: f32) -> vec4f {
    if (share == 0.0) {
        return a;
    }
    let near = select(b, -b, dot(a, b) < 0.0);
    let angle = 2.0 * atan2(length(a - near), length(a + near));
    var weights = vec2f(1.0 - share, share);
    if (angle > STRAIGHT) {
        weights = sin(angle * weights) / sin(angle);
    }
    return normalize(weights.x * a + weights.y * near);
}

@compute @workgroup_size(64)
fn frames_of_groups(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = item_of(workgroup, local, 64u);
    if (index >= sizes.groups) {
        return;
    }
    let of_group = groups[index];
    var turn = vec4f(1.0, 0.0, 0.0, 0.0);
    var offset = vec3f(0.0);
    if (of_group.keys.x != NO_POSE) {
        let before = poses[of_group.keys.x];
        let after = poses[of_group.keys.y];
        let share = of_group.pivot.w;
        turn = between(before.rotation, after.rotation, share);
        offset = mix(before.offset.xyz, after.offset.xyz, share);
    }
    let w = turn.x;
    let x = turn.y;
    let y = turn.z;
    let z = turn.w;
    let place = of_group.pivot.xyz + offset;
    frames[index].rotation[0] =
        vec4f(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y), place.x);
    frames[index].rotation[1] =
        vec4f(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x), place.y);
    frames[index].rotation[2] =
        vec4f(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y), place.z);
    frames[index].turn = turn;
}

@compute @workgroup_size(64)
fn carry(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let member = item_of(workgroup, local, 64u);
    if (member >= sizes.members) {
        return;
    }
    let row = members[member].x;
    let of_group = groups[members[member].y];
    let frame = frames[members[member].y];
    let a = canonical[3u * row];
    let b = canonical[3u * row + 1u];
    let y = a.xyz - of_group.pivot.xyz;
    let place = vec3f(frame.rotation[0].w, frame.rotation[1].w, frame.rotation[2].w);
    let turned =
        vec3f(dot(frame.rotation[0].xyz, y), dot(frame.rotation[1].xyz, y), dot(frame.rotation[2].xyz, y));
    let is_drawn = of_group.visible != 0u;
    posed[3u * row] = vec4f(turned + place, select(HIDDEN_LOGIT, a.w, is_drawn));
    posed[3u * row + 1u] = vec4f(b.xyz, select(HIDDEN_LOGIT, b.w, is_drawn));
    posed[3u * row + 2u] = product(frame.turn, canonical[3u * row + 2u]);
    turns[row] = frame.turn;
}
