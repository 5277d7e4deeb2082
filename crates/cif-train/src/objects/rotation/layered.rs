//! The layered model: light fixed to the world and paint that turns with the object.

use glam::DVec3;

use super::evidence::Evidence;
use super::folds::{FEWEST, FOLDS, OBSERVED, folds, numbered};

/// Sweeps of back-fitting of the layers.
const SWEEPS: usize = 5;

/// Cells of a layer.
pub(super) struct LayerCells {
    /// Cell by pixel; `None` where it sees none.
    pub(super) of_pixel: Vec<Option<u32>>,
    /// Number of cells.
    pub(super) count: usize,
}

/// A pixel that a model predicts.
pub(super) struct Observation {
    pub(super) pixel: usize,
    pub(super) look: usize,
    /// Cell of the layer of paint, and of that of light.
    pub(super) paint: usize,
    pub(super) light: usize,
    pub(super) value: DVec3,
}

/// Absolute residuals of the layered model on left-out pixels, each layer shrunk by one pseudo-observation per cell.
pub(super) fn layered(
    evidence: &Evidence<'_>,
    paint: &LayerCells,
    light: &LayerCells,
    turns: bool,
) -> Vec<f32> {
    let mut found = vec![f32::NAN; paint.of_pixel.len()];
    let mut seen = Vec::new();
    let mut pixel = 0;
    for (look, shown) in evidence.looks.iter().enumerate() {
        for value in shown.pixels.iter().map(|pixel| pixel.value) {
            if let (Some(paint), Some(light)) = (paint.of_pixel[pixel], light.of_pixel[pixel]) {
                let (paint, light) = (paint as usize, light as usize);
                seen.push(Observation { pixel, look, paint, light, value });
            }
            pixel += 1;
        }
    }
    if seen.len() < FEWEST {
        return found;
    }
    let sizes = LayerSizes {
        paint: numbered(seen.iter_mut().map(|o| &mut o.paint), paint.count),
        light: numbered(seen.iter_mut().map(|o| &mut o.light), light.count),
        views: evidence.looks.len(),
    };
    let folds = folds(evidence);
    for fold in 0..FOLDS {
        let mut layers = Layers::start(&seen, &sizes, |o| folds[o.look] != fold);
        for _ in 0..SWEEPS {
            layers.sweep(&seen, turns);
        }
        for o in seen.iter().filter(|o| folds[o.look] == fold) {
            if layers.paint.weights[o.paint] >= OBSERVED && layers.light.weights[o.light] >= OBSERVED {
                found[o.pixel] = layers.residual(o).length() as f32;
            }
        }
    }
    found
}

/// Means by cell, view or the like.
pub(super) struct Means {
    pub(super) values: Vec<DVec3>,
    pub(super) weights: Vec<f64>,
}

impl Means {
    fn zeros(count: usize) -> Self {
        Self { values: vec![DVec3::ZERO; count], weights: vec![0.0; count] }
    }

    /// Divides sums by their weights, and these by so many pseudo-observations of zero.
    fn divide(&mut self, pseudo: f64) {
        for (value, weight) in self.values.iter_mut().zip(&self.weights) {
            *value /= (weight + pseudo).max(1.0);
        }
    }
}

/// Numbers of what the model has a mean of.
pub(super) struct LayerSizes {
    /// Cells of paint.
    pub(super) paint: usize,
    /// Cells of light.
    pub(super) light: usize,
    /// Views, each with a gain.
    pub(super) views: usize,
}

/// The layers of the model, fitted to the observations outside a fold; gains of views to all.
pub(super) struct Layers {
    gain: Means,
    light: Means,
    pub(super) paint: Means,
    is_fitted: Vec<bool>,
}

impl Layers {
    pub(super) fn start(
        seen: &[Observation],
        sizes: &LayerSizes,
        is_fitted: impl Fn(&Observation) -> bool,
    ) -> Self {
        let is_fitted: Vec<bool> = seen.iter().map(is_fitted).collect();
        let (mut gain, mut light, mut paint) =
            (Means::zeros(sizes.views), Means::zeros(sizes.light), Means::zeros(sizes.paint));
        for (o, is_fitted) in seen.iter().zip(&is_fitted) {
            gain.weights[o.look] += 1.0;
            gain.values[o.look] += o.value;
            if *is_fitted {
                light.weights[o.light] += 1.0;
                paint.weights[o.paint] += 1.0;
            }
        }
        gain.divide(0.0);
        Self { gain, light, paint, is_fitted }
    }

    fn residual(&self, o: &Observation) -> DVec3 {
        self.unpainted(o) - self.paint.values[o.paint]
    }

    /// The value of a pixel without gain and light.
    pub(super) fn unpainted(&self, o: &Observation) -> DVec3 {
        o.value - self.gain.values[o.look] - self.light.values[o.light]
    }

    /// One sweep of back-fitting: light, paint, gains.
    pub(super) fn sweep(&mut self, seen: &[Observation], turns: bool) {
        let fitted = || seen.iter().zip(&self.is_fitted).filter(|(_, is_fitted)| **is_fitted).map(|(o, _)| o);
        let mut light = vec![DVec3::ZERO; self.light.values.len()];
        for o in fitted() {
            light[o.light] += o.value - self.gain.values[o.look] - self.paint.values[o.paint];
        }
        self.light.values = light;
        self.light.divide(1.0);
        if turns {
            let mut paint = vec![DVec3::ZERO; self.paint.values.len()];
            for o in fitted() {
                paint[o.paint] += o.value - self.gain.values[o.look] - self.light.values[o.light];
            }
            self.paint.values = paint;
            self.paint.divide(1.0);
        }
        let mut gain = vec![DVec3::ZERO; self.gain.values.len()];
        for o in seen {
            gain[o.look] += o.value - self.light.values[o.light] - self.paint.values[o.paint];
        }
        self.gain.values = gain;
        self.gain.divide(0.0);
    }
}
