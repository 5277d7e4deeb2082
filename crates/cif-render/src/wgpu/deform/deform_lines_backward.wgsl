// Splits the gradients of the lines over the two rows of the time planes around the time of the view, and empties
// them for the next view. Source: methods reference 11 (idea 4); twin: scatter_plane in cpu/deform.rs.

#import moment

@group(0) @binding(0) var<uniform> moment: Moment;
// As in deform_prepare.
@group(0) @binding(1) var<storage, read> line_sources: array<vec2<u32>>;
// Nodes of the planes, then of the lines.
@group(0) @binding(2) var<storage, read_write> sums: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read_write> faults: array<atomic<u32>>;

#import fixed_point

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let at = id.y * groups.x * 256u + id.x;
    if at >= LINE_FLOATS {
        return;
    }
    let place = PLANE_FLOATS + at;
    let v = take_fixed(place);
    if v != 0.0 {
        let source = line_sources[at];
        let below = source.x + moment.time_row * source.y;
        add_fixed(below, (1.0 - moment.time_fraction) * v);
        add_fixed(below + source.y, moment.time_fraction * v);
    }
}
