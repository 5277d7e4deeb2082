// Adam's step of one float; shared by the groups. Source: Kingma and Ba 2015, methods reference 1.1 and 7 (rows 24 and
// 25); Rust twin: adam/mod.rs `move_by`.

struct Moved {
    parameter: f32,
    first: f32,
    second: f32,
}

// By the bits: compilers may assume that nothing is infinite.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// `rate` holds the correction of the first moment, `second_bias` that of the second.
fn move_by(parameter: f32, g: f32, first: f32, second: f32, rate: f32, second_bias: f32) -> Moved {
    let m = BETA_1 * first + (1.0 - BETA_1) * g;
    let v = BETA_2 * second + (1.0 - BETA_2) * g * g;
    // Below the smallest normal second moment the ratio would be noise: no step.
    let step = select(0.0, rate * m / (sqrt(v) * second_bias + EPSILON), v >= SMALLEST_SECOND);
    return Moved(parameter - step, m, v);
}
