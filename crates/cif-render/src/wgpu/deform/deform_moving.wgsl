// Gaussians that the network moves, where others stand still: they are worked on in arrays of their own, without gaps.
// Source: methods reference 11 (idea 5); twin: `Deformation::moving_rows` of cif-field.

#import faults
#import moving

@group(0) @binding(0) var<uniform> moving: Moving;
// Gaussian of every row without gaps.
@group(0) @binding(1) var<storage, read> rows: array<u32>;
// Row without gaps of every Gaussian and one more, or 0 where it stands still.
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read> source: array<f32>;
@group(0) @binding(4) var<storage, read_write> target_rows: array<f32>;
@group(0) @binding(5) var<storage, read> v_posed: array<f32>;
@group(0) @binding(6) var<storage, read_write> faults: array<atomic<u32>>;

fn item(group: vec3<u32>, groups: vec3<u32>, thread: u32) -> u32 {
    return (group.y * groups.x + group.x) * 256u + thread;
}

// Takes rows out.
@compute @workgroup_size(256)
fn take(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = item(group, groups, thread);
    if at < moving.rows * moving.width {
        target_rows[at] = source[rows[at / moving.width] * moving.width + at % moving.width];
    }
}

// Puts them back.
@compute @workgroup_size(256)
fn put(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = item(group, groups, thread);
    if at < moving.rows * moving.width {
        target_rows[rows[at / moving.width] * moving.width + at % moving.width] = source[at];
    }
}

// Gradients of the canonical geometry: those of moving rows come back, what stands still takes the direct path.
@compute @workgroup_size(256)
fn put_gradients(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = item(group, groups, thread);
    if at >= moving.gaussians * 12u {
        return;
    }
    let place = places[at / 12u];
    if place != 0u {
        target_rows[at] = source[(place - 1u) * 12u + at % 12u];
    } else {
        let total = target_rows[at] + v_posed[at];
        target_rows[at] = total;
        if is_beyond(total) {
            atomicOr(&faults[0], geometry_fault(at % 12u));
        }
    }
}
