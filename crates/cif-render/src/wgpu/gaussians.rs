//! Gaussians on the device, canonical or moved to a time, and their gradients: one layout for all three.
//!
//! | array | per Gaussian |
//! |---|---|
//! | `geometry` | centre and opacity logit, log-scales and occupancy logit, raw quaternion (w, x, y, z): 12 floats |
//! | `sh` | spherical harmonics `[16, 3]`: 48 floats |

use cif_field::Gaussians;
use cif_field::gaussians::SH_FLOATS;

use super::{Gpu, GpuError, GpuVec};

/// Floats of [`GpuGaussians::geometry`] per Gaussian.
pub const GEOMETRY_FLOATS: usize = 12;

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

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.geometry.is_empty()
    }
}

/// Rows in the layout of the device.
#[must_use]
pub fn geometry(gaussians: &Gaussians) -> Vec<[f32; GEOMETRY_FLOATS]> {
    (0..gaussians.len())
        .map(|row| {
            let ([x, y, z], [s, t, u]) = (gaussians.means[row], gaussians.log_scales[row]);
            let [w, i, j, k] = gaussians.quaternions[row];
            [x, y, z, gaussians.opacity_logits[row], s, t, u, gaussians.occupancy_logits[row], w, i, j, k]
        })
        .collect()
}

/// Rows of the device as arrays.
#[must_use]
pub fn gaussians(geometry: &[[f32; GEOMETRY_FLOATS]], sh_coefficients: Vec<[f32; SH_FLOATS]>) -> Gaussians {
    let part =
        |first: usize| move |row: &[f32; GEOMETRY_FLOATS]| [row[first], row[first + 1], row[first + 2]];
    Gaussians {
        means: geometry.iter().map(part(0)).collect(),
        log_scales: geometry.iter().map(part(4)).collect(),
        quaternions: geometry.iter().map(|row| [row[8], row[9], row[10], row[11]]).collect(),
        opacity_logits: geometry.iter().map(|row| row[3]).collect(),
        occupancy_logits: geometry.iter().map(|row| row[7]).collect(),
        sh_coefficients,
    }
}
