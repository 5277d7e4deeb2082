//! What steps count of every Gaussian for densification.

use cif_render::Gradients;

/// Densification statistics of every Gaussian since the last change of the set.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensifyStatistics {
    /// Summed norms of the screen gradient.
    pub gradient: Vec<f32>,
    /// Steps in which the Gaussian was visible.
    pub count: Vec<u32>,
    /// Largest screen radius, pixels.
    pub radius: Vec<f32>,
}

impl DensifyStatistics {
    /// Nothing seen of `n` Gaussians.
    #[must_use]
    pub fn zeros(n: usize) -> Self {
        Self { gradient: vec![0.0; n], count: vec![0; n], radius: vec![0.0; n] }
    }

    /// Adds a step: the screen gradients are summed over the views of the batch already.
    pub fn add(&mut self, gradients: &Gradients) {
        for row in 0..self.gradient.len() {
            let radius = gradients.radii[row];
            if radius > 0.0 {
                let [x, y] = gradients.screen[row];
                self.gradient[row] += x.hypot(y);
                self.count[row] += 1;
                self.radius[row] = self.radius[row].max(radius);
            }
        }
    }

    /// Follows a change of the set: rows that stay keep what was seen of them.
    pub fn gather(&mut self, origins: &[Option<u32>]) {
        fn pick<T: Copy + Default>(values: &[T], origins: &[Option<u32>]) -> Vec<T> {
            origins.iter().map(|origin| origin.map_or(T::default(), |row| values[row as usize])).collect()
        }
        self.gradient = pick(&self.gradient, origins);
        self.count = pick(&self.count, origins);
        self.radius = pick(&self.radius, origins);
    }

    /// Mean norm of the screen gradient over the steps in which a row was visible; 0 where it never was.
    pub(super) fn mean_gradient(&self, row: usize) -> f32 {
        if self.count[row] == 0 { 0.0 } else { self.gradient[row] / self.count[row] as f32 }
    }
}
