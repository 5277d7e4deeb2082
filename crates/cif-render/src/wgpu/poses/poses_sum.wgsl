// Adds the gradient of every group to those of the two poses around the time of the view, by their shares: turns in the
// frame of the group, translations in the world. Rust twin: cpu/groups.rs, `groups_backward`.

#import constants
#import numbers
#import groups
#import faults
@group(0) @binding(0) var<uniform> sizes: GroupSizes;
@group(0) @binding(1) var<storage, read> groups: array<GroupView>;
@group(0) @binding(2) var<storage, read> frames: array<GroupFrame>;
@group(0) @binding(3) var<storage, read> parts: array<PoseSum>;
// Beside the turn the views that the pose was a key of.
@group(0) @binding(4) var<storage, read_write> gradients: array<PoseSum>;
// Bits of the step, and whether steps wait for the host.
@group(0) @binding(5) var<storage, read_write> faults: array<atomic<u32>>;

@compute @workgroup_size(64)
fn poses_sum(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = item_of(workgroup, local, 64u);
    if (index >= sizes.groups || groups[index].keys.x == NO_POSE) {
        return;
    }
    let frame = frames[index];
    var turn = vec4f(0.0);
    var v = vec3f(0.0);
    for (var part = index * GROUP_PARTS; part < (index + 1u) * GROUP_PARTS; part += 1u) {
        turn += parts[part].turn;
        v += parts[part].translation.xyz;
    }
    if (turn.w == 0.0) {
        return;
    }
    let translation =
        vec3f(dot(frame.rotation[0].xyz, v), dot(frame.rotation[1].xyz, v), dot(frame.rotation[2].xyz, v));
    for (var k = 0u; k < 2u; k += 1u) {
        let share = select(groups[index].pivot.w, 1.0 - groups[index].pivot.w, k == 0u);
        if (share > 0.0) {
            let key = groups[index].keys[k];
            let by_turn = gradients[key].turn + vec4f(share * turn.xyz, 1.0);
            let by_translation = gradients[key].translation + vec4f(share * translation, 0.0);
            gradients[key].turn = by_turn;
            gradients[key].translation = by_translation;
            var is_bad = false;
            for (var axis = 0u; axis < 3u; axis += 1u) {
                is_bad = is_bad || is_beyond(by_turn[axis]) || is_beyond(by_translation[axis]);
            }
            if (is_bad) {
                atomicOr(&faults[0], POSES_FAULT);
            }
        }
    }
}
