//! Exposure and white balance per camera: what a camera records is an affine function, per channel, of what is
//! there. The field keeps the look of the average camera; what each camera makes of it is learnt beside it.

use std::collections::BTreeMap;

use cif_dataset::{Dataset, Split};
use cif_field::Field;
use serde::{Deserialize, Serialize};

use crate::adam::{Moments, RowRates};

pub use cif_field::Exposure;

/// Floats of an exposure: logarithms of gains, then offsets.
pub(crate) const WIDTH: usize = Exposure::WIDTH;

/// First and last learning rate of the logarithms of gains, and of offsets.
pub(crate) const RATES: [f32; 2] = [1e-2, 5e-4];

/// Exposures of the training cameras while they are learnt; saved with the progress of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Exposures {
    /// Names, ascending.
    pub cameras: Vec<String>,
    /// Logarithms of gains and offsets per camera.
    pub values: Vec<f32>,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
    pub steps: u32,
    #[serde(skip)]
    gradients: Vec<f32>,
}

impl Exposures {
    /// Neutral exposures of the training cameras; `None` for one camera, which has nothing to disagree with.
    pub(crate) fn of(dataset: &Dataset) -> Option<Self> {
        let frames = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
        let mut cameras: Vec<String> = frames.map(|frame| frame.camera_name.clone()).collect();
        cameras.sort_unstable();
        cameras.dedup();
        (cameras.len() > 1).then(|| Self::neutral(cameras))
    }

    /// Neutral exposures of cameras, by ascending names.
    pub(crate) fn neutral(cameras: Vec<String>) -> Self {
        let zeros = vec![0.0; WIDTH * cameras.len()];
        Self {
            cameras,
            values: zeros.clone(),
            first: zeros.clone(),
            second: zeros.clone(),
            steps: 0,
            gradients: zeros,
        }
    }

    /// True where names ascend and every camera has finite values and moments: what was read may be anything.
    pub(crate) fn are_whole(&self) -> bool {
        let fits = |values: &Vec<f32>| {
            values.len() == WIDTH * self.cameras.len() && values.iter().all(|value| value.is_finite())
        };
        self.cameras.is_sorted_by(|a, b| a < b)
            && [&self.values, &self.first, &self.second].into_iter().all(fits)
    }

    /// The exposures that a scene was trained with, where they are of these cameras.
    pub(crate) fn start_with(mut self, known: &BTreeMap<String, Exposure>) -> Self {
        for (camera, values) in self.cameras.iter().zip(self.values.chunks_exact_mut(WIDTH)) {
            if let Some(exposure) = known.get(camera) {
                for channel in 0..3 {
                    values[channel] = exposure.gain[channel].max(f32::MIN_POSITIVE).ln();
                    values[3 + channel] = exposure.offset[channel];
                }
            }
        }
        self
    }

    /// The first summed gradient beyond a limit or not a number.
    pub(crate) fn gradient_beyond(&self, limit: f32) -> Option<(usize, f32)> {
        let beyond = |value: &f32| value.is_nan() || value.abs() > limit;
        self.gradients.iter().copied().enumerate().find(|(_, value)| beyond(value))
    }

    /// Number of a camera, where it is one of these.
    pub(crate) fn position(&self, camera: &str) -> Option<usize> {
        self.cameras.binary_search_by(|name| name.as_str().cmp(camera)).ok()
    }

    /// Exposure of a camera; neutral for one that was not trained on.
    pub(crate) fn at(&self, camera: &str) -> Exposure {
        let Some(k) = self.position(camera) else { return Exposure::NEUTRAL };
        let of = &self.values[WIDTH * k..WIDTH * (k + 1)];
        Exposure {
            gain: std::array::from_fn(|channel| of[channel].exp()),
            offset: std::array::from_fn(|channel| of[3 + channel]),
        }
    }

    /// Adds a gradient, as [`Exposure::pull_back`] returns it.
    pub(crate) fn add(&mut self, camera: &str, gradient: &[f32; WIDTH]) {
        let Some(k) = self.position(camera) else { return };
        self.gradients.resize(self.values.len(), 0.0);
        for (sum, value) in self.gradients[WIDTH * k..].iter_mut().zip(gradient) {
            *sum += value;
        }
    }

    /// Forgets gradients.
    pub(crate) fn reset(&mut self) {
        self.gradients.fill(0.0);
    }

    /// Moves against the gradients, then takes off what all cameras have in common: that is the field's.
    pub(crate) fn step(&mut self, rate: f32) {
        self.gradients.resize(self.values.len(), 0.0);
        if self.gradients.iter().any(|gradient| !gradient.is_finite()) {
            self.reset();
            return;
        }
        let mut moments = Moments {
            first: std::mem::take(&mut self.first),
            second: std::mem::take(&mut self.second),
            width: WIDTH,
            steps: self.steps,
        };
        // A camera without a view in the step has no say.
        let visible: Vec<f32> = self
            .gradients
            .chunks_exact(WIDTH)
            .map(|of| f32::from(of.iter().any(|gradient| *gradient != 0.0)))
            .collect();
        let rates = RowRates::Uniform(rate);
        let finite = moments.step(&mut self.values, &mut self.gradients, rates, Some(&visible));
        debug_assert!(finite.is_ok(), "gradients were looked at");
        (self.first, self.second, self.steps) = (moments.first, moments.second, moments.steps);
        let cameras = self.cameras.len() as f32;
        for of in 0..WIDTH {
            let mean = self.values.iter().skip(of).step_by(WIDTH).sum::<f32>() / cameras;
            self.values.iter_mut().skip(of).step_by(WIDTH).for_each(|value| *value -= mean);
        }
    }

    /// Exposures by camera, as recorded in the scene.
    pub(crate) fn by_camera(&self) -> BTreeMap<&str, Exposure> {
        self.cameras.iter().map(|camera| (camera.as_str(), self.at(camera))).collect()
    }
}

/// Exposures that a scene was trained with, by camera; empty where it was trained without.
#[must_use]
pub fn trained_exposures(field: &Field) -> BTreeMap<String, Exposure> {
    field.record.drawing.exposures.clone()
}

#[cfg(test)]
mod tests;
