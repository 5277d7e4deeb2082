// The optimiser's step of the poses that views were drawn of, each at its share of the rate: translations by that of
// the size of the group, half of the largest extent of its Gaussians, turns by a part of as many radians, unless they
// are assumed. Gradients become zero. A workgroup per group.
// Rust twin: poses.rs, `PoseMoments::step` and `object_sizes`. Source: methods reference of motion, 2.1.

#import constants
#import groups
#import quaternions
#import pose_rates

@group(0) @binding(0) var<uniform> rates: PoseRates;
@group(0) @binding(1) var<storage, read> groups: array<GroupView>;
// Gaussian and group.
@group(0) @binding(2) var<storage, read> members: array<vec2u>;
@group(0) @binding(3) var<storage, read> canonical: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> poses: array<Pose>;
// Beside the turn the views that the pose was a key of.
@group(0) @binding(5) var<storage, read_write> gradients: array<PoseSum>;
@group(0) @binding(6) var<storage, read_write> moments: array<PoseState>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(7) var<storage, read_write> faults: array<atomic<u32>>;

const INVOCATIONS: u32 = 256u;

var<workgroup> lowest: array<atomic<u32>, 3>;
var<workgroup> highest: array<atomic<u32>, 3>;

// Floats as whole numbers in the same order, and back.
fn ordered(value: f32) -> u32 {
    let bits = bitcast<u32>(value);
    return select(bits | 0x80000000u, ~bits, (bits & 0x80000000u) != 0u);
}

fn unordered(bits: u32) -> f32 {
    return bitcast<f32>(select(~bits, bits & 0x7fffffffu, (bits & 0x80000000u) != 0u));
}

// Exact products, where `pow` may be off.
fn power(base: f32, exponent: u32) -> f32 {
    var result = 1.0;
    var square = base;
    for (var rest = exponent; rest > 0u; rest /= 2u) {
        if (rest & 1u) != 0u {
            result *= square;
        }
        square *= square;
    }
    return result;
}

// Quaternion of a small turn, its series without an angle to divide by.
fn small_turn(turn: vec3f) -> vec4f {
    let h = 0.25 * dot(turn, turn);
    return vec4f(1.0 - h * (0.5 - h / 24.0), turn * (0.5 - h * (1.0 / 12.0 - h / 240.0)));
}

fn move_pose(at: u32, size: f32, turns: bool) {
    let gradient = gradients[at];
    var state = moments[at];
    let steps = state.first_turn.w + 1.0;
    let turn = gradient.turn.xyz;
    let translation = gradient.translation.xyz;
    let first_turn = POSE_DECAY_1 * state.first_turn.xyz + POSE_SHARE_1 * turn;
    let first_translation = POSE_DECAY_1 * state.first_translation.xyz + POSE_SHARE_1 * translation;
    let second_turn = POSE_DECAY_2 * state.second_turn.xyz + POSE_SHARE_2 * turn * turn;
    let second_translation = POSE_DECAY_2 * state.second_translation.xyz + POSE_SHARE_2 * translation * translation;
    state.first_turn = vec4f(first_turn, steps);
    let share = state.first_translation.w;
    state.first_translation = vec4f(first_translation, share);
    state.second_turn = vec4f(second_turn, 0.0);
    state.second_translation = vec4f(second_translation, 0.0);
    moments[at] = state;
    let counted = u32(min(steps, POSE_STEPS));
    let bias_1 = 1.0 - power(POSE_DECAY_1, counted);
    let bias_2 = 1.0 - power(POSE_DECAY_2, counted);
    let by_turn = (first_turn / bias_1) / (sqrt(second_turn / bias_2) + POSE_EPSILON);
    let by_translation = (first_translation / bias_1) / (sqrt(second_translation / bias_2) + POSE_EPSILON);
    let rate = share * rates.rate;
    if turns {
        poses[at].rotation = normalize(product(poses[at].rotation, small_turn(-POSE_TURN_RATE * rate * by_turn)));
    }
    poses[at].offset -= vec4f(rate * size * by_translation, 0.0);
}

@compute @workgroup_size(256)
fn adam_poses(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let of_group = groups[group.x];
    if local < 3u {
        atomicStore(&lowest[local], 0xffffffffu);
        atomicStore(&highest[local], 0u);
    }
    workgroupBarrier();
    var low = vec3u(0xffffffffu);
    var high = vec3u(0u);
    for (var member = of_group.members.x + local; member < of_group.members.y; member += INVOCATIONS) {
        let mean = canonical[3u * members[member].x].xyz;
        let place = vec3u(ordered(mean.x), ordered(mean.y), ordered(mean.z));
        low = min(low, place);
        high = max(high, place);
    }
    for (var axis = 0u; axis < 3u; axis++) {
        atomicMin(&lowest[axis], low[axis]);
        atomicMax(&highest[axis], high[axis]);
    }
    workgroupBarrier();
    var size = 0.0;
    for (var axis = 0u; axis < 3u && of_group.members.x < of_group.members.y; axis++) {
        size = max(size, 0.5 * (unordered(atomicLoad(&highest[axis])) - unordered(atomicLoad(&lowest[axis]))));
    }
    let moves = rates.rate > 0.0 && atomicLoad(&faults[1]) == 0u;
    for (var at = of_group.poses.x + local; at < of_group.poses.y; at += INVOCATIONS) {
        if moves && gradients[at].turn.w > 0.0 {
            move_pose(at, size, of_group.turns != 0u);
        }
        gradients[at].turn = vec4f(0.0);
        gradients[at].translation = vec4f(0.0);
    }
}

// A vector turned by a unit quaternion (w, x, y, z).
fn turned(q: vec4f, v: vec3f) -> vec3f {
    let across = 2.0 * cross(q.yzw, v);
    return v + q.x * across + cross(q.yzw, across);
}

// Puts the pose of a part onto its joint, to the nearest value. Rust twin: cif-field, `Joint`.
fn hold(part: GroupView, base_pivot: vec3f, base: Pose, at: u32) {
    let axis = part.axis.xyz;
    let back = vec4f(base.rotation.x, -base.rotation.yzw);
    let arm = part.pivot.xyz - base_pivot;
    let offset = base.offset.xyz - arm;
    var pose = poses[at];
    if part.joint.x == 1u {
        let relative = product(back, pose.rotation);
        let turn = normalize(vec4f(relative.x, dot(relative.yzw, axis) * axis));
        pose.rotation = normalize(product(base.rotation, turn));
        pose.offset = vec4f(turned(base.rotation, arm) + offset, 0.0);
    } else {
        let shift = dot(turned(back, pose.offset.xyz - offset) - arm, axis);
        pose.rotation = base.rotation;
        pose.offset = vec4f(turned(base.rotation, arm + shift * axis) + offset, 0.0);
    }
    poses[at] = pose;
}

// All joints, in the order of the groups, for a part may be the base of another; none while steps wait.
@compute @workgroup_size(1)
fn hold_joints() {
    if atomicLoad(&faults[1]) != 0u {
        return;
    }
    for (var group = 0u; group < arrayLength(&groups); group++) {
        let part = groups[group];
        if part.joint.x == 0u {
            continue;
        }
        let base = groups[part.joint.y];
        let at_rest = base.poses.x == base.poses.y;
        for (var at = part.poses.x; at < part.poses.y; at++) {
            var base_pose = Pose(vec4f(1.0, 0.0, 0.0, 0.0), vec4f(0.0));
            if !at_rest {
                base_pose = poses[base.poses.x + at - part.poses.x];
            }
            hold(part, base.pivot.xyz, base_pose, at);
        }
    }
}
