// What the backward pass reads of a pixel, from the forward images and the gradient of the loss by colour: v_C and
// Q = v_C . C_out (background included); 1 / M_y where it carries a gradient, S_end / A under coverage normalisation,
// the label, and the position after the last splat that supports it. Rust twin: cpu/renderer/backward.rs, `tile_cotangents` and `instance_cotangents`. Source: methods
// reference 3.2 and 4.3.

#import constants
#import numbers
#import view
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> colors: array<vec4f>;
@group(0) @binding(2) var<storage, read> blended: array<vec4f>;
@group(0) @binding(3) var<storage, read> labels: array<u32>;
@group(0) @binding(4) var<storage, read> v_colors: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> cotangents: array<vec4f>;

@compute @workgroup_size(64)
fn cotangents_of_pixels(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let position = item_of(workgroup, local, 64u);
    if (position >= view.size.x * view.size.y) {
        return;
    }
    let v = v_colors[position].xyz;
    cotangents[2u * position] = vec4f(v, dot(v, colors[position].xyz));
    var inverse = 0.0;
    var ratio = 0.0;
    var label = 0u;
    var supported = 0.0;
    if (view.label_slots != 0u) {
        label = labels[position];
        let probability = blended[position].y;
        if (label != 0u && probability >= MIN_LABEL_PROBABILITY) {
            inverse = 1.0 / probability;
            supported = blended[position].w;
            if (view.coverage_normalised != 0u) {
                let rest = blended[position].z;
                ratio = rest / max(1.0 - rest, MIN_LABEL_PROBABILITY);
            }
        }
    }
    cotangents[2u * position + 1u] = vec4f(inverse, ratio, f32(label), supported);
}
