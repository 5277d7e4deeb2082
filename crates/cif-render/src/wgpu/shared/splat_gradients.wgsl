// Gradients of splats, where no Gaussian turns with a group. Twin: torques.wgsl.

@group(0) @binding(4) var<storage, read> splat_gradients: array<vec4f>;

fn keep_torque(row: u32, torque: vec3f) {}
