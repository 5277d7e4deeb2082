//! The parameters of a field in the scalar of the evaluation, and gradients of the same shape.

use cif_field::gaussians::SH_FLOATS;
use cif_field::{Deformation, Field, Tracks};
use cif_geometry::Real;

use super::identity::IdentityRows;

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

/// A group of parameters; within a group, scalars are numbered row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParameterGroup {
    /// `[N, 3]`.
    Means,
    /// `[N, 3]`.
    LogScales,
    /// `[N, 4]`.
    Quaternions,
    /// `[N]`.
    OpacityLogits,
    /// `[N]`.
    OccupancyLogits,
    /// `[N, 48]`.
    ShCoefficients,
    /// One per identity entry.
    LogCalibrations,
    /// All plane nodes.
    Planes,
    /// All weights and biases.
    Mlp,
}

impl ParameterGroup {
    /// Every group.
    pub const ALL: [Self; 9] = [
        Self::Means,
        Self::LogScales,
        Self::Quaternions,
        Self::OpacityLogits,
        Self::OccupancyLogits,
        Self::ShCoefficients,
        Self::LogCalibrations,
        Self::Planes,
        Self::Mlp,
    ];

    /// Scalars per Gaussian; 0 for groups that are not per Gaussian.
    fn row_len(self) -> usize {
        match self {
            Self::Means | Self::LogScales => 3,
            Self::Quaternions => 4,
            Self::OpacityLogits | Self::OccupancyLogits => 1,
            Self::ShCoefficients => SH_FLOATS,
            Self::LogCalibrations | Self::Planes | Self::Mlp => 0,
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

    /// Scalars in a group.
    #[must_use]
    pub fn len(&self, group: ParameterGroup) -> usize {
        match group {
            ParameterGroup::LogCalibrations => self.log_calibrations.len(),
            ParameterGroup::Planes => self.planes.len(),
            ParameterGroup::Mlp => self.mlp.len(),
            _ => self.gaussians.len() * group.row_len(),
        }
    }

    /// True when there is nothing at all.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        ParameterGroup::ALL.iter().all(|group| self.len(*group) == 0)
    }

    /// Scalar `index` of a group.
    ///
    /// # Panics
    /// When the index is not below [`Self::len`].
    #[must_use]
    pub fn get(&self, group: ParameterGroup, index: usize) -> R {
        let row = |len: usize| (&self.gaussians[index / len], index % len);
        match group {
            ParameterGroup::Means => row(3).0.mean[row(3).1],
            ParameterGroup::LogScales => row(3).0.log_scale[row(3).1],
            ParameterGroup::Quaternions => row(4).0.quaternion[row(4).1],
            ParameterGroup::OpacityLogits => self.gaussians[index].opacity_logit,
            ParameterGroup::OccupancyLogits => self.gaussians[index].occupancy_logit,
            ParameterGroup::ShCoefficients => row(SH_FLOATS).0.sh[row(SH_FLOATS).1],
            ParameterGroup::LogCalibrations => self.log_calibrations[index],
            ParameterGroup::Planes => self.planes[index],
            ParameterGroup::Mlp => self.mlp[index],
        }
    }

    /// Scalar `index` of a group, for writing.
    ///
    /// # Panics
    /// When the index is not below [`Self::len`].
    pub fn get_mut(&mut self, group: ParameterGroup, index: usize) -> &mut R {
        match group {
            ParameterGroup::Means => &mut self.gaussians[index / 3].mean[index % 3],
            ParameterGroup::LogScales => &mut self.gaussians[index / 3].log_scale[index % 3],
            ParameterGroup::Quaternions => &mut self.gaussians[index / 4].quaternion[index % 4],
            ParameterGroup::OpacityLogits => &mut self.gaussians[index].opacity_logit,
            ParameterGroup::OccupancyLogits => &mut self.gaussians[index].occupancy_logit,
            ParameterGroup::ShCoefficients => &mut self.gaussians[index / SH_FLOATS].sh[index % SH_FLOATS],
            ParameterGroup::LogCalibrations => &mut self.log_calibrations[index],
            ParameterGroup::Planes => &mut self.planes[index],
            ParameterGroup::Mlp => &mut self.mlp[index],
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
