//! Vectors, quaternions and rotations between the types of fields, of graphs and of `glam`.

use glam::{DMat3, DQuat, DVec3};

pub(crate) fn vector(v: [f32; 3]) -> DVec3 {
    DVec3::from_array(v.map(f64::from))
}

/// (w, x, y, z) of a rotation matrix.
pub(crate) fn quaternion_of(rotation: &DMat3) -> [f64; 4] {
    let q = DQuat::from_mat3(rotation).normalize();
    [q.w, q.x, q.y, q.z]
}

pub(crate) fn dot(a: [f64; 4], b: [f64; 4]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Rows of a rotation matrix.
pub(crate) fn rows_of(rotation: DQuat) -> [[f32; 3]; 3] {
    DMat3::from_quat(rotation).transpose().to_cols_array_2d().map(|row| row.map(|value| value as f32))
}
