// Carries the gradients of Gaussians that move with a group back to its frame, and sums those by its pose: a workgroup
// per group and part of its Gaussians, in a fixed order. The turn is differentiated in the frame of the group, by a
// tangent on its right, the translation for now, too. Rust twins: poses.rs `PoseGradient::add`, cpu/groups.rs. Source:
// methods reference of motion, 2.3.

#import constants
#import groups
#import quaternions
@group(0) @binding(0) var<storage, read> groups: array<GroupView>;
// Gaussian and group.
@group(0) @binding(1) var<storage, read> members: array<vec2u>;
@group(0) @binding(2) var<storage, read> canonical: array<vec4f>;
@group(0) @binding(3) var<storage, read> frames: array<GroupFrame>;
// By the turn through the colour, see shared/torques.wgsl.
@group(0) @binding(4) var<storage, read> torques: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> v_posed: array<vec4f>;
// `[groups, GROUP_PARTS]`; next to the turn the Gaussians that have a gradient.
@group(0) @binding(6) var<storage, read_write> parts: array<PoseSum>;

const INVOCATIONS: u32 = 256u;
#import workgroup

@compute @workgroup_size(256)
fn poses_backward(
    @builtin(workgroup_id) workgroup: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let of_group = groups[workgroup.x];
    let frame = frames[workgroup.x];
    var turn = vec4f(0.0);
    var translation = vec4f(0.0);
    let first = of_group.members.x + workgroup.y * INVOCATIONS + local;
    for (var member = first; member < of_group.members.y; member += GROUP_PARTS * INVOCATIONS) {
        let row = members[member].x;
        let v_mean = v_posed[3u * row];
        let v_quaternion = v_posed[3u * row + 2u];
        if (all(v_mean.xyz == vec3f(0.0)) && all(v_quaternion == vec4f(0.0))) {
            continue;
        }
        let v = frame.rotation[0].xyz * v_mean.x + frame.rotation[1].xyz * v_mean.y
            + frame.rotation[2].xyz * v_mean.z;
        let v_back = product(conjugate(frame.turn), v_quaternion);
        v_posed[3u * row] = vec4f(v, v_mean.w);
        v_posed[3u * row + 2u] = v_back;
        let y = canonical[3u * row].xyz - of_group.pivot.xyz;
        // The quaternion of the Gaussian, turned by each axis, times its gradient.
        let by_orientation = 0.5 * product(v_back, conjugate(canonical[3u * row + 2u])).yzw;
        turn += vec4f(cross(y, v) + by_orientation + torques[3u * row].xyz, 1.0);
        translation += vec4f(v, 0.0);
    }
    let turn_of_part = sum_of_workgroup(lane, turn);
    let translation_of_part = sum_of_workgroup(lane, translation);
    if (local == 0u) {
        let part = workgroup.x * GROUP_PARTS + workgroup.y;
        parts[part].turn = turn_of_part;
        parts[part].translation = translation_of_part;
    }
}
