// Directions of view in the frame that spherical harmonics are in, here the world for all. Twin: turned_directions.wgsl.

fn into_frame(row: u32, v: vec3f) -> vec3f {
    return v;
}

fn out_of_frame(row: u32, v: vec3f) -> vec3f {
    return v;
}
