// Directions of view in the frame that spherical harmonics are in, that of the group of a Gaussian. The module declares
// `turns`, the turn of every Gaussian's frame, a unit quaternion (w, x, y, z). Twin: directions.wgsl.

fn into_frame(row: u32, v: vec3f) -> vec3f {
    let turn = turns[row];
    return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) - turn.x * v);
}

fn out_of_frame(row: u32, v: vec3f) -> vec3f {
    let turn = turns[row];
    return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) + turn.x * v);
}
