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

impl Exposure {
    /// Number of learnt values: logarithms of gains, then offsets.
    pub const WIDTH: usize = 6;
    /// The exposure that changes nothing.
    pub const NEUTRAL: Self = Self { gain: [1.0; 3], offset: [0.0; 3] };

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
