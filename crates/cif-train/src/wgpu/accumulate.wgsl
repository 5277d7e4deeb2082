// Adds the gradients of a view to those of the step, and what densification keeps of a step: summed norms of the screen
// gradient, steps in which a Gaussian was visible, its largest radius; sums that no optimiser may take are reported. Rust
// twins: cpu/renderer/backward.rs `project_backward`, densify.rs `DensifyStatistics::add`. Source: methods reference 1.5.

#import constants
#import accumulation
#import faults

@group(0) @binding(0) var<uniform> accumulation: Accumulation;
@group(0) @binding(1) var<storage, read> view: array<f32>;
@group(0) @binding(2) var<storage, read_write> total: array<f32>;
// Bits of the step, and whether steps wait for the host.
@group(0) @binding(3) var<storage, read_write> faults: array<atomic<u32>>;

@compute @workgroup_size(256)
fn add(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if at < accumulation.count {
        let sum = total[at] + view[at];
        total[at] = sum;
        if is_beyond(sum) {
            let geometry = geometry_fault(at % 12u);
            atomicOr(&faults[0], select(accumulation.fault, geometry, accumulation.is_geometry != 0u));
        }
    }
}

// Rows of four: gradient along x and y, radius, whether visible.
@compute @workgroup_size(256)
fn add_screen(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = ((group.y * MAX_WORKGROUPS + group.x) * 256u + local) * 4u;
    if at < accumulation.count {
        total[at] += view[at];
        total[at + 1u] += view[at + 1u];
        total[at + 2u] = max(total[at + 2u], view[at + 2u]);
        total[at + 3u] = max(total[at + 3u], view[at + 3u]);
    }
}

// From the screen rows of a step to the statistics: summed norms, steps, largest radius.
@compute @workgroup_size(256)
fn add_statistics(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = ((group.y * MAX_WORKGROUPS + group.x) * 256u + local) * 4u;
    if at < accumulation.count && atomicLoad(&faults[1]) == 0u {
        if view[at + 3u] > 0.0 {
            total[at] += length(vec2f(view[at], view[at + 1u]));
            total[at + 1u] += 1.0;
            total[at + 2u] = max(total[at + 2u], view[at + 2u]);
        }
    }
}
