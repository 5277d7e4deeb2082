//! Exposures of cameras.

use cif_geometry::PixelGrid;
use serde::{Deserialize, Serialize};

/// Exposure of a camera: `gain * colour + offset` per channel, colours as captured, in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exposure {
    /// Factor per channel.
    pub gain: [f32; 3],
    /// Added per channel.
    pub offset: [f32; 3],
}

/// Exposure of a camera at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimedExposure {
    /// Time of the capture, in [0, 1].
    pub time: f64,
    /// What the camera makes of colours then.
    pub exposure: Exposure,
}

impl TimedExposure {
    /// Exposure at a time between those of a series in their order, whose logarithms of gains and offsets change evenly, and
    /// that of the outermost beyond them; `None` of no series.
    #[must_use]
    pub fn at(series: &[Self], time: f64) -> Option<Exposure> {
        let after = series.partition_point(|of| of.time < time);
        let next = series.get(after).or(series.last())?;
        let last = series.get(after.saturating_sub(1)).unwrap_or(next);
        let share =
            ((time - last.time) / (next.time - last.time).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0) as f32;
        let (a, b) = (last.exposure, next.exposure);
        Some(Exposure {
            gain: std::array::from_fn(|k| a.gain[k].powf(1.0 - share) * b.gain[k].powf(share)),
            offset: std::array::from_fn(|k| (1.0 - share) * a.offset[k] + share * b.offset[k]),
        })
    }
}

impl Exposure {
    /// Number of learnt values: logarithms of gains, then offsets.
    pub const WIDTH: usize = 6;
    /// The exposure that changes nothing.
    pub const NEUTRAL: Self = Self { gain: [1.0; 3], offset: [0.0; 3] };

    /// An exposure that makes all colours brighter by a number of stops, which double them each.
    #[must_use]
    pub fn of_stops(stops: f64) -> Self {
        Self { gain: [stops.exp2() as f32; 3], ..Self::NEUTRAL }
    }

    /// How much brighter it makes colours, stops: the mean of the channels, whose offsets count for nothing.
    #[must_use]
    pub fn stops(&self) -> f64 {
        self.gain.map(|gain| f64::from(gain.max(f32::MIN_POSITIVE)).log2()).iter().sum::<f64>() / 3.0
    }

    /// Colours as the camera records them.
    pub fn apply(&self, colors: &mut PixelGrid<[f32; 3]>) {
        for pixel in &mut colors.pixels {
            for channel in 0..3 {
                pixel[channel] = self.gain[channel] * pixel[channel] + self.offset[channel];
            }
        }
    }

    /// Takes gradients by recorded colours back to those by the `rendered` ones; returns the gradient by the
    /// exposure, logarithms of gains and then offsets.
    pub fn pull_back(
        &self,
        rendered: &PixelGrid<[f32; 3]>,
        v_color: &mut PixelGrid<[f32; 3]>,
    ) -> [f32; Self::WIDTH] {
        // Summed in order and in double precision: images have many pixels.
        let mut sums = [0.0_f64; Self::WIDTH];
        for (v, color) in v_color.pixels.iter_mut().zip(&rendered.pixels) {
            for channel in 0..3 {
                sums[channel] += f64::from(v[channel] * self.gain[channel] * color[channel]);
                sums[3 + channel] += f64::from(v[channel]);
                v[channel] *= self.gain[channel];
            }
        }
        sums.map(|sum| sum as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposures_change_evenly_between_times_and_stay_beyond_them() {
        let of = |time: f64, gain: f32| TimedExposure {
            time,
            exposure: Exposure { gain: [gain; 3], offset: [gain - 1.0; 3] },
        };
        let series = [of(0.0, 1.0), of(0.5, 4.0), of(1.0, 1.0)];
        let gain = |time: f64| TimedExposure::at(&series, time).unwrap().gain[1];
        for (time, expected) in
            [(-1.0, 1.0), (0.0, 1.0), (0.25, 2.0), (0.5, 4.0), (0.75, 2.0), (1.0, 1.0), (2.0, 1.0)]
        {
            assert!((gain(time) - expected).abs() < 1e-6, "{time}: {}", gain(time));
        }
        assert_eq!(TimedExposure::at(&series, 0.25).unwrap().offset, [1.5; 3]);
        assert_eq!(TimedExposure::at(&series[..1], 0.7), Some(series[0].exposure));
        assert_eq!(TimedExposure::at(&[], 0.7), None);
    }

    #[test]
    fn stops_double_colours() {
        assert_eq!(Exposure::of_stops(1.0).gain, [2.0; 3]);
        assert!((Exposure { gain: [4.0, 1.0, 2.0], offset: [0.5; 3] }.stops() - 1.0).abs() < 1e-6);
    }
}
