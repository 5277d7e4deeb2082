// Rows of an array after a change of the set of Gaussians: those that stay are moved, copies and children take their
// parent's row, or zeros where they start afresh; some floats of marked rows start afresh, too. Rust twins: densify.rs,
// adam/mod.rs `Moments::gather`.

#import constants
#import rearrangement

@group(0) @binding(0) var<uniform> rearrangement: Rearrangement;
// Per new row the old one; the highest bit marks fresh rows, the next one rows of which some floats start afresh.
@group(0) @binding(1) var<storage, read> origins: array<u32>;
@group(0) @binding(2) var<storage, read> before: array<f32>;
@group(0) @binding(3) var<storage, read_write> after: array<f32>;

@compute @workgroup_size(256)
fn rearrange(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if at >= rearrangement.rows * rearrangement.width {
        return;
    }
    let column = at % rearrangement.width;
    let origin = origins[at / rearrangement.width];
    let is_fresh = (origin & FRESH) != 0u && rearrangement.fresh_are_zero != 0u;
    let is_restarted = (origin & RESTARTED) != 0u
        && column < 32u
        && ((rearrangement.restarted_columns >> column) & 1u) != 0u;
    if is_fresh || is_restarted || column == rearrangement.zero_column {
        after[at] = 0.0;
    } else {
        after[at] = before[(origin & ~(FRESH | RESTARTED)) * rearrangement.width + column];
    }
}
