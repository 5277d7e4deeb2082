// Gradients of splats, the first four numbers of which give way to the gradient by the turn of the Gaussian's frame that
// comes through its colour. Twin: splat_gradients.wgsl.

@group(0) @binding(4) var<storage, read_write> splat_gradients: array<vec4f>;
@group(0) @binding(8) var<storage, read> turns: array<vec4f>;

fn keep_torque(row: u32, torque: vec3f) {
    splat_gradients[3u * row] = vec4f(torque, 0.0);
}
