//! Contributions of Gaussians to training views, and to their errors.

use cif_geometry::PixelGrid;

/// Of every Gaussian, over a few training views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Contributions {
    /// Blending weights over the pixels of the view that shows most of it, `max over views of sum w`, pixels: what few
    /// views show counts as much as what all do.
    pub weight: Vec<f32>,
    /// The same over the pixels of all views, `sum w`.
    pub total: Vec<f32>,
    /// Errors of the pixels of all views by the same weights, `sum w |rendered - image|`, pixels times the mean over
    /// channels of values in [0, 1].
    pub error: Vec<f32>,
}

impl Contributions {
    /// No contribution of `n` Gaussians yet.
    #[must_use]
    pub fn zeros(n: usize) -> Self {
        let none = vec![0.0; n];
        Self { weight: none.clone(), total: none.clone(), error: none }
    }

    /// Adds a view: weight and error of every Gaussian there, `[N, 2]`.
    pub fn add_view(&mut self, sums: &[f32]) {
        for (row, sums) in sums.chunks_exact(2).enumerate() {
            self.weight[row] = self.weight[row].max(sums[0]);
            self.total[row] += sums[0];
            self.error[row] += sums[1];
        }
    }

    /// Error of a Gaussian in the view that shows most of it, where it is as wrong as in the mean over its pixels: what few
    /// views show is as wrong there as what all do.
    #[must_use]
    pub fn error_where_shown(&self, row: usize) -> f32 {
        let share = self.weight[row] / self.total[row].max(f32::MIN_POSITIVE);
        self.error[row] * share
    }

    /// Follows a change of the set: rows that stay keep what they contribute, of others nothing is known.
    #[must_use]
    pub fn gather(&self, origins: &[Option<u32>]) -> Self {
        let pick = |values: &[f32]| {
            origins.iter().map(|origin| origin.map_or(0.0, |row| values[row as usize])).collect()
        };
        Self { weight: pick(&self.weight), total: pick(&self.total), error: pick(&self.error) }
    }
}

/// Per pixel 1 and its error, `[height, width, 2]`: blended back to the Gaussians these are weights, and errors by them.
pub(crate) fn ones_and_errors(rendered: &PixelGrid<[f32; 3]>, image: &PixelGrid<[u8; 3]>) -> Vec<f32> {
    let pixels = rendered.pixels.iter().zip(&image.pixels);
    pixels.flat_map(|(rendered, image)| [1.0, error(*rendered, *image)]).collect()
}

/// Mean absolute difference of the channels, in [0, 1] for colours in [0, 1].
pub(crate) fn error(rendered: [f32; 3], image: [u8; 3]) -> f32 {
    let differences = rendered.iter().zip(image).map(|(seen, image)| (seen - f32::from(image) / 255.0).abs());
    differences.sum::<f32>() / 3.0
}
