//! The parameters of a field in the scalar of the evaluation, and gradients of the same shape.

use cif_field::gaussians::SH_FLOATS;
use cif_field::parameters::{
    LOG_CALIBRATIONS, LOG_SCALES, MEANS, MLP, OCCUPANCY_LOGITS, OPACITY_LOGITS, PLANES, Parameter,
    QUATERNIONS, SH_COEFFICIENTS, TABLE,
};
use cif_field::{Deformation, Field, Tracks};
use cif_geometry::Real;

use super::identity_rows::IdentityRows;

/// Raw parameters of one Gaussian, canonical or moved to a time; also their gradient.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian<R> {
    /// Centre x, world, metres.
    pub mean: [R; 3],
    /// Raw log-scales s.
    pub log_scale: [R; 3],
    /// Raw quaternion q (w, x, y, z).
    pub quaternion: [R; 4],
    /// Raw opacity logit a.
    pub opacity_logit: R,
    /// Raw occupancy logit h.
    pub occupancy_logit: R,
    /// Spherical harmonics `[16, 3]`.
    pub sh: [R; SH_FLOATS],
}

impl<R: Real> Gaussian<R> {
    /// All zero.
    #[must_use]
    pub fn zero() -> Self {
        let zero = R::zero();
        Self {
            mean: [zero; 3],
            log_scale: [zero; 3],
            quaternion: [zero; 4],
            opacity_logit: zero,
            occupancy_logit: zero,
            sh: [zero; SH_FLOATS],
        }
    }
}

/// All learnable scalars of a scene, or their gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters<R> {
    /// Canonical Gaussians, `[N]`.
    pub gaussians: Vec<Gaussian<R>>,
    /// Log-calibration mu per identity entry; empty without identities.
    pub log_calibrations: Vec<R>,
    /// Plane nodes; empty without deformation.
    pub planes: Vec<R>,
    /// Weights and biases; empty without deformation.
    pub mlp: Vec<R>,
}

impl<R: Real> Parameters<R> {
    /// Zeros of the same shape.
    #[must_use]
    pub fn zeros_like(&self) -> Self {
        Self {
            gaussians: vec![Gaussian::zero(); self.gaussians.len()],
            log_calibrations: vec![R::zero(); self.log_calibrations.len()],
            planes: vec![R::zero(); self.planes.len()],
            mlp: vec![R::zero(); self.mlp.len()],
        }
    }

    /// Scalars of a parameter, numbered row by row.
    #[must_use]
    pub fn len(&self, parameter: Parameter) -> usize {
        match parameter {
            LOG_CALIBRATIONS => self.log_calibrations.len(),
            PLANES => self.planes.len(),
            MLP => self.mlp.len(),
            _ => self.gaussians.len() * parameter.width(),
        }
    }

    /// True when there is nothing at all.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        TABLE.into_iter().all(|parameter| self.len(parameter) == 0)
    }

    /// Scalar `index` of a parameter.
    ///
    /// # Panics
    /// When the index is not below [`Self::len`], or the parameter is not in the table.
    #[must_use]
    pub fn get(&self, parameter: Parameter, index: usize) -> R {
        let (row, column) = (index / parameter.width(), index % parameter.width());
        match parameter {
            MEANS => self.gaussians[row].mean[column],
            LOG_SCALES => self.gaussians[row].log_scale[column],
            QUATERNIONS => self.gaussians[row].quaternion[column],
            OPACITY_LOGITS => self.gaussians[row].opacity_logit,
            OCCUPANCY_LOGITS => self.gaussians[row].occupancy_logit,
            SH_COEFFICIENTS => self.gaussians[row].sh[column],
            LOG_CALIBRATIONS => self.log_calibrations[row],
            PLANES => self.planes[row],
            MLP => self.mlp[row],
            _ => panic!("the reference has no {}", parameter.name),
        }
    }

    /// As [`Self::get`], for writing.
    ///
    /// # Panics
    /// As [`Self::get`].
    pub fn get_mut(&mut self, parameter: Parameter, index: usize) -> &mut R {
        let (row, column) = (index / parameter.width(), index % parameter.width());
        match parameter {
            MEANS => &mut self.gaussians[row].mean[column],
            LOG_SCALES => &mut self.gaussians[row].log_scale[column],
            QUATERNIONS => &mut self.gaussians[row].quaternion[column],
            OPACITY_LOGITS => &mut self.gaussians[row].opacity_logit,
            OCCUPANCY_LOGITS => &mut self.gaussians[row].occupancy_logit,
            SH_COEFFICIENTS => &mut self.gaussians[row].sh[column],
            LOG_CALIBRATIONS => &mut self.log_calibrations[row],
            PLANES => &mut self.planes[row],
            MLP => &mut self.mlp[row],
            _ => panic!("the reference has no {}", parameter.name),
        }
    }
}

/// A field in the scalar of the evaluation.
#[derive(Clone, Debug)]
pub struct Scene<R> {
    /// Everything learnable.
    pub parameters: Parameters<R>,
    /// Identity rows without their calibration.
    pub identities: Option<IdentityRows<R>>,
    /// Configuration and bounds of the deformation; its own parameter vectors are empty, see
    /// [`Parameters::planes`] and [`Parameters::mlp`].
    pub deformation: Option<Deformation>,
    /// Recorded motion.
    pub tracks: Option<Tracks>,
    /// Number of instances K.
    pub instances: usize,
}

impl<R: Real> Scene<R> {
    /// Converts a field, exactly in `f32` and `f64`.
    #[must_use]
    pub fn from_field(field: &Field) -> Self {
        fn all<R: Real>(values: &[f32]) -> Vec<R> {
            values.iter().map(|value| real(*value)).collect()
        }
        fn real<R: Real>(value: f32) -> R {
            R::of(f64::from(value))
        }
        let canonical = &field.gaussians;
        let gaussians = (0..canonical.len())
            .map(|i| Gaussian {
                mean: canonical.means[i].map(real),
                log_scale: canonical.log_scales[i].map(real),
                quaternion: canonical.quaternions[i].map(real),
                opacity_logit: real(canonical.opacity_logits[i]),
                occupancy_logit: real(canonical.occupancy_logits[i]),
                sh: canonical.sh_coefficients[i].map(real),
            })
            .collect();
        let deformation = field.deformation.as_ref();
        let identities = field.identities.as_ref();
        Self {
            parameters: Parameters {
                gaussians,
                log_calibrations: identities.map_or_else(Vec::new, |rows| all(&rows.log_calibrations)),
                planes: deformation.map_or_else(Vec::new, |d| all(&d.planes)),
                mlp: deformation.map_or_else(Vec::new, |d| all(&d.mlp)),
            },
            identities: identities.map(|rows| IdentityRows {
                row_offsets: rows.row_offsets.clone(),
                labels: rows.labels.clone(),
                log_estimates: all(&rows.log_estimates),
            }),
            deformation: deformation.map(|d| Deformation {
                config: d.config.clone(),
                bounds: d.bounds,
                planes: Vec::new(),
                mlp: Vec::new(),
                still: d.still.clone(),
            }),
            tracks: field.tracks.clone(),
            instances: field.instances.len(),
        }
    }
}
