// Numbers without guarantees in WGSL: what is finite is read from the bits, as compilers may assume that nothing else
// occurs.

fn is_nan(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7fffffffu) > 0x7f800000u;
}

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn are_finite(v: vec3f) -> bool {
    return is_finite(v.x) && is_finite(v.y) && is_finite(v.z);
}

// Beyond 80 the result is 0 or 1 in single precision, and exp would leave its range.
fn sigmoid(logit: f32) -> f32 {
    let e = exp(-min(abs(logit), 80.0));
    return select(e, 1.0, logit >= 0.0) / (1.0 + e);
}

// Item of an invocation in a dispatch that is folded into two dimensions.
fn item_of(workgroup: vec3u, local: u32, size: u32) -> u32 {
    return (workgroup.y * MAX_WORKGROUPS + workgroup.x) * size + local;
}
