//! Gaussians on the device, canonical or moved to a time, and their gradients: one layout for all three.
//!
//! | array | per Gaussian |
//! |---|---|
//! | `geometry` | centre and opacity logit, log-scales and occupancy logit, raw quaternion (w, x, y, z): 12 floats |
//! | `sh` | spherical harmonics `[16, 3]`: 48 floats |

use cif_field::gaussians::SH_FLOATS;
use cif_field::parameters::{LOG_SCALES, MEANS, OCCUPANCY_LOGITS, OPACITY_LOGITS, QUATERNIONS};
use cif_field::{Gaussians, Parameter};
use half::f16;

use super::{Gpu, GpuError, GpuVec};

/// Floats of [`GpuGaussians::geometry`] per Gaussian.
pub const GEOMETRY_FLOATS: usize = 12;

/// Words of packed spherical harmonics per Gaussian: three 32-bit floats and 45 of 16 bits, see [`packed_sh`].
pub const PACKED_SH_WORDS: usize = 26;

/// N Gaussians on the device.
#[derive(Debug)]
pub struct GpuGaussians {
    /// `[N]`.
    pub geometry: GpuVec<[f32; GEOMETRY_FLOATS]>,
    /// `[N]`.
    pub sh: GpuVec<[f32; SH_FLOATS]>,
}

impl GpuGaussians {
    /// Zeros.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic.
    pub fn zeros(gpu: &Gpu, n: usize) -> Result<Self, GpuError> {
        Ok(Self {
            geometry: GpuVec::zeros(gpu, "geometry of the Gaussians", n)?,
            sh: GpuVec::zeros(gpu, "spherical harmonics of the Gaussians", n)?,
        })
    }

    /// A copy.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn upload(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self, GpuError> {
        let mut uploaded = Self::zeros(gpu, 0)?;
        uploaded.replace(gpu, gaussians)?;
        Ok(uploaded)
    }

    /// Replaces the contents, growing by need.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn replace(&mut self, gpu: &Gpu, gaussians: &Gaussians) -> Result<(), GpuError> {
        self.geometry.replace(gpu, &geometry(gaussians))?;
        self.sh.replace(gpu, &gaussians.sh_coefficients)?;
        Ok(())
    }

    /// Reads everything, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn download(&self, gpu: &Gpu) -> Result<Gaussians, GpuError> {
        Ok(gaussians(&self.geometry.read(gpu)?, self.sh.read(gpu)?))
    }

    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.geometry.len()
    }

    /// True when there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.geometry.is_empty()
    }
}

/// First float of a parameter in [`GpuGaussians::geometry`]; `None` for those that lie elsewhere.
#[must_use]
pub fn geometry_column(parameter: &Parameter) -> Option<usize> {
    COLUMNS.iter().find(|(other, _)| other == parameter).map(|(_, first)| *first)
}

/// Where parameters lie in [`GpuGaussians::geometry`], by their first float.
pub const COLUMNS: [(Parameter, usize); 5] =
    [(MEANS, 0), (OPACITY_LOGITS, 3), (LOG_SCALES, 4), (OCCUPANCY_LOGITS, 7), (QUATERNIONS, 8)];

/// Rows in the layout of the device.
#[must_use]
pub fn geometry(gaussians: &Gaussians) -> Vec<[f32; GEOMETRY_FLOATS]> {
    let mut rows = vec![[0.0; GEOMETRY_FLOATS]; gaussians.len()];
    for (parameter, first) in COLUMNS {
        let width = parameter.width();
        for (row, values) in rows.iter_mut().zip(gaussians.tensor(&parameter).chunks_exact(width)) {
            row[first..first + width].copy_from_slice(values);
        }
    }
    rows
}

/// Rows of the device as arrays.
#[must_use]
pub fn gaussians(geometry: &[[f32; GEOMETRY_FLOATS]], sh_coefficients: Vec<[f32; SH_FLOATS]>) -> Gaussians {
    let mut gaussians = Gaussians::zeros(geometry.len());
    for (parameter, first) in COLUMNS {
        let width = parameter.width();
        for (row, values) in geometry.iter().zip(gaussians.tensor_mut(&parameter).chunks_exact_mut(width)) {
            values.copy_from_slice(&row[first..first + width]);
        }
    }
    Gaussians { sh_coefficients, ..gaussians }
}

/// Spherical harmonics with the bands above the constant one in 16-bit floats, two to a word: 104 bytes instead
/// of 192. Rounding is to 11 bits; what is larger than a 16-bit float becomes the largest. Source: methods
/// reference 11.
#[must_use]
pub fn packed_sh(sh: &[f32; SH_FLOATS]) -> [u32; PACKED_SH_WORDS] {
    let half = |at: usize| sh.get(at).map_or(0, |value| u32::from(half_bits(*value)));
    std::array::from_fn(|word| match word {
        0..3 => sh[word].to_bits(),
        _ => half(2 * word - 3) | half(2 * word - 2) << 16,
    })
}

/// Spherical harmonics after [`packed_sh`]: the bands above the constant one rounded to 16-bit floats.
#[must_use]
pub fn packed_sh_values(sh: &[f32; SH_FLOATS]) -> [f32; SH_FLOATS] {
    std::array::from_fn(|at| if at < 3 { sh[at] } else { f16::from_bits(half_bits(sh[at])).to_f32() })
}

fn half_bits(value: f32) -> u16 {
    // Keeps NaN.
    let (low, high) = (f16::MIN.to_f32(), f16::MAX.to_f32());
    f16::from_f32(value.clamp(low, high)).to_bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_harmonics_keep_eleven_bits_and_their_places() {
        let mut sh: [f32; SH_FLOATS] = std::array::from_fn(|k| 0.01 * (k as f32 - 20.0).powi(3) / 7.0);
        let kept = packed_sh_values(&sh);
        let words = packed_sh(&sh);
        assert_eq!(kept[..3], sh[..3]);
        for k in 3..SH_FLOATS {
            assert!((kept[k] - sh[k]).abs() <= sh[k].abs() / 2048.0 + 1e-7, "{k}: {} {}", kept[k], sh[k]);
            let half = words[3 + (k - 3) / 2] >> (16 * ((k - 3) % 2)) & 0xffff;
            assert_eq!(f16::from_bits(half as u16).to_f32(), kept[k], "{k}");
        }
        sh[47] = 1e9;
        sh[46] = f32::NAN;
        let kept = packed_sh_values(&sh);
        assert!(kept[47] == 65504.0 && kept[46].is_nan(), "{kept:?}");
    }
}
