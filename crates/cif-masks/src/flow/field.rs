//! Displacements of pixels.

use crate::plane::Plane;

/// A displacement per pixel: pixel (x, y) of the first image shows what lies at (x + u, y + v) in the second.
#[derive(Clone, Debug, PartialEq)]
pub struct Flow {
    /// Displacement to the right, pixels.
    pub u: Plane,
    /// Displacement downwards, pixels.
    pub v: Plane,
}

impl Flow {
    pub(super) fn zero(width: usize, height: usize) -> Self {
        Self { u: Plane::filled(width, height, 0.0), v: Plane::filled(width, height, 0.0) }
    }

    /// The same motion in pixels of a grid of another size.
    pub(super) fn resized(&self, width: usize, height: usize) -> Self {
        let scale = |plane: &Plane, factor: f32| {
            let mut plane = plane.resized(width, height);
            plane.data.iter_mut().for_each(|value| *value *= factor);
            plane
        };
        Self {
            u: scale(&self.u, width as f32 / self.u.width as f32),
            v: scale(&self.v, height as f32 / self.v.height as f32),
        }
    }
}
