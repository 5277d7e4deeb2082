//! Exposure and white balance per camera, or per image of cameras that adapt while they film: what is recorded is an
//! affine function, per channel, of what is there. The field keeps the mean look; what each camera makes of it is learnt
//! separately.

mod brightness;

use std::collections::BTreeMap;

use cif_dataset::{Dataset, Split};
use cif_field::{Drawing, TimedExposure};
use serde::{Deserialize, Serialize};

pub(crate) use self::brightness::{Recorded, known_points};
use crate::adam::{Moments, RowRates};

pub use cif_field::Exposure;

/// Floats of an exposure: logarithms of gains, then offsets.
pub(crate) const WIDTH: usize = Exposure::WIDTH;

/// First and last learning rate of the logarithms of gains, and of offsets.
pub(crate) const RATES: [f32; 2] = [1e-2, 5e-4];

/// Exposures of the training cameras while they are learnt, one of each or one of each of its images; saved with the
/// progress of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Exposures {
    /// Camera of every row, ascending.
    pub cameras: Vec<String>,
    /// Time of every row, ascending within each camera; empty where each camera has one row.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub times: Vec<f64>,
    /// Logarithms of gains and offsets per row.
    pub values: Vec<f32>,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
    pub steps: u32,
    #[serde(skip)]
    gradients: Vec<f32>,
}

impl Exposures {
    /// Neutral exposures of the training cameras, or of each of their times; `None` of one camera alone, which has nothing
    /// to disagree with.
    pub(crate) fn of(dataset: &Dataset, in_time: bool) -> Option<Self> {
        let frames = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
        let mut rows: Vec<(&str, f64)> = frames
            .map(|frame| (frame.camera_name.as_str(), if in_time { frame.time } else { 0.0 }))
            .collect();
        rows.sort_by(|a, b| a.0.cmp(b.0).then(a.1.total_cmp(&b.1)));
        rows.dedup();
        let times = if in_time { rows.iter().map(|(_, time)| *time).collect() } else { Vec::new() };
        let cameras = rows.iter().map(|(camera, _)| (*camera).to_owned()).collect();
        (rows.len() > 1).then(|| Self::neutral(cameras, times))
    }

    /// Neutral exposures of rows.
    pub(crate) fn neutral(cameras: Vec<String>, times: Vec<f64>) -> Self {
        let zeros = vec![0.0; WIDTH * cameras.len()];
        Self {
            cameras,
            times,
            values: zeros.clone(),
            first: zeros.clone(),
            second: zeros.clone(),
            steps: 0,
            gradients: zeros,
        }
    }

    /// Begins the row of a camera at a time with logarithms of gains.
    pub(crate) fn begin_with(&mut self, camera: &str, time: f64, gains: [f64; 3]) {
        let Some(row) = self.position(camera, time) else { return };
        for (value, gain) in self.values[WIDTH * row..].iter_mut().zip(gains) {
            *value = gain as f32;
        }
    }

    /// True where rows ascend and all have finite values and moments: what was read may be anything.
    pub(crate) fn are_whole(&self) -> bool {
        let fits = |values: &Vec<f32>| {
            values.len() == WIDTH * self.cameras.len() && values.iter().all(|value| value.is_finite())
        };
        let rows: Vec<(&str, f64)> = (0..self.cameras.len()).map(|row| self.row(row)).collect();
        (self.times.is_empty() || self.times.len() == self.cameras.len())
            && rows.is_sorted_by(|a, b| a < b)
            && [&self.values, &self.first, &self.second].into_iter().all(fits)
    }

    /// Camera and time of a row.
    fn row(&self, row: usize) -> (&str, f64) {
        (&self.cameras[row], self.times.get(row).copied().unwrap_or(0.0))
    }

    /// The exposures that a scene was trained with, where they are of these cameras.
    pub(crate) fn start_with(mut self, known: &Drawing) -> Self {
        for row in 0..self.cameras.len() {
            let (camera, time) = self.row(row);
            if let Some(exposure) = known.exposure(camera, time) {
                let values = &mut self.values[WIDTH * row..WIDTH * (row + 1)];
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

    /// Row of a camera at a time, where it is one of these.
    pub(crate) fn position(&self, camera: &str, time: f64) -> Option<usize> {
        let time = if self.times.is_empty() { 0.0 } else { time };
        let row = self.cameras.partition_point(|name| name.as_str() < camera);
        let of_camera = self.cameras[row..].partition_point(|name| name == camera);
        (row..row + of_camera).find(|row| self.row(*row).1 == time)
    }

    /// Exposure of a camera at a time; neutral for one that was not trained on.
    pub(crate) fn at(&self, camera: &str, time: f64) -> Exposure {
        match self.position(camera, time) {
            Some(row) => self.of_row(row),
            None => TimedExposure::at(&self.series(camera), time).unwrap_or(Exposure::NEUTRAL),
        }
    }

    fn of_row(&self, row: usize) -> Exposure {
        let of = &self.values[WIDTH * row..WIDTH * (row + 1)];
        Exposure {
            gain: std::array::from_fn(|channel| of[channel].exp()),
            offset: std::array::from_fn(|channel| of[3 + channel]),
        }
    }

    /// Exposures of a camera at its times, in their order.
    fn series(&self, camera: &str) -> Vec<TimedExposure> {
        let of = |(row, time): (usize, &f64)| {
            (self.cameras[row] == camera).then(|| TimedExposure { time: *time, exposure: self.of_row(row) })
        };
        self.times.iter().enumerate().filter_map(of).collect()
    }

    /// Adds a gradient, as [`Exposure::pull_back`] returns it.
    pub(crate) fn add(&mut self, camera: &str, time: f64, gradient: &[f32; WIDTH]) {
        let Some(row) = self.position(camera, time) else { return };
        self.gradients.resize(self.values.len(), 0.0);
        for (sum, value) in self.gradients[WIDTH * row..].iter_mut().zip(gradient) {
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
        // What no view of the step saw has no say.
        let visible: Vec<f32> = self
            .gradients
            .chunks_exact(WIDTH)
            .map(|of| f32::from(of.iter().any(|gradient| *gradient != 0.0)))
            .collect();
        let rates = RowRates::Uniform(rate);
        let finite = moments.step(&mut self.values, &mut self.gradients, rates, Some(&visible));
        debug_assert!(finite.is_ok(), "gradients were looked at");
        (self.first, self.second, self.steps) = (moments.first, moments.second, moments.steps);
        self.take_off_common();
    }

    /// Takes off what all rows have in common: that is the field's.
    pub(crate) fn take_off_common(&mut self) {
        let rows = self.cameras.len() as f32;
        for of in 0..WIDTH {
            let mean = self.values.iter().skip(of).step_by(WIDTH).sum::<f32>() / rows;
            self.values.iter_mut().skip(of).step_by(WIDTH).for_each(|value| *value -= mean);
        }
    }

    /// Exposures by camera, as recorded in the scene; none where they change with time.
    pub(crate) fn by_camera(&self) -> BTreeMap<String, Exposure> {
        let rows = if self.times.is_empty() { self.cameras.len() } else { 0 };
        (0..rows).map(|row| (self.cameras[row].clone(), self.of_row(row))).collect()
    }

    /// Exposures by camera that change with time, as recorded in the scene.
    pub(crate) fn in_time(&self) -> BTreeMap<String, Vec<TimedExposure>> {
        let cameras = if self.times.is_empty() { &[][..] } else { &self.cameras[..] };
        cameras.iter().map(|camera| (camera.clone(), self.series(camera))).collect()
    }
}

#[cfg(test)]
mod tests;
