// What all Gaussians of a view share: time planes interpolated to lines, and the network's weights in the orders that
// the layers read. Source: methods reference 2.1 and 11 (idea 4); twin: DeformationAtTime::new in cpu/deform.rs.

#import moment

@group(0) @binding(0) var<uniform> moment: Moment;
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> mlp: array<f32>;
// First float of the time plane, and floats of one of its rows, per float of the lines.
@group(0) @binding(3) var<storage, read> line_sources: array<vec2<u32>>;
// Float of the network per prepared weight; NOTHING for padding.
@group(0) @binding(4) var<storage, read> weight_sources: array<u32>;
@group(0) @binding(5) var<storage, read_write> lines: array<f32>;
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;

const NOTHING: u32 = 0xffffffffu;

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let at = id.y * groups.x * 256u + id.x;
    if at < LINE_FLOATS {
        let source = line_sources[at];
        let below = source.x + moment.time_row * source.y;
        lines[at] = (1.0 - moment.time_fraction) * planes[below] + moment.time_fraction * planes[below + source.y];
    }
    if at < WEIGHT_FLOATS {
        let source = weight_sources[at];
        if source != NOTHING {
            weights[at] = mlp[source];
        }
    }
}
