//! The readable oracle, generic over `f32` and `f64`.
