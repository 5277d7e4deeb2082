//! Settings of a render.

use cif_field::SortMetric;

use crate::Channels;
use crate::constants::LOW_PASS;

/// Where the blending weight of the instance pass comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OccupancySource {
    /// The occupancy logit h, with its own transmittance.
    #[default]
    Own,
    /// The colour opacity (ablation ii): gradients reach the opacity logit.
    Opacity,
}

/// Which geometry the instance loss trains (methods reference 4.5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GeometryPath {
    /// Means, scales and rotations.
    #[default]
    Full,
    /// Means only.
    MeansOnly,
    /// None.
    Off,
}

/// Division of rendered identities by coverage before the logarithm (methods reference 4.3).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum InstanceNormalisation {
    /// `-log M_y`.
    #[default]
    None,
    /// `-log (M_y / A)`.
    Coverage,
}

/// Instance pass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct InstanceSettings {
    /// Blending weight.
    pub occupancy: OccupancySource,
    /// Gradient to geometry.
    pub geometry: GeometryPath,
    /// Loss normalisation.
    pub normalisation: InstanceNormalisation,
}

/// Settings of one render, apart from camera and time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Active spherical-harmonics degree.
    pub sh_degree: u8,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Gaussians nearer than this camera depth are culled, metres.
    pub near: f32,
    /// Dilation added to both diagonal entries of a projected covariance, px^2.
    pub low_pass: f32,
    /// Compensates opacity for the low-pass dilation (rho of methods reference 3.1).
    pub antialiased: bool,
    /// Depth order.
    pub sort_metric: SortMetric,
    /// Evaluate the learned deformation; off in the coarse stage. Recorded motion always counts.
    pub deform: bool,
    /// Instance pass; `None` skips it.
    pub instances: Option<InstanceSettings>,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            sh_degree: 3,
            background: [1.0; 3],
            near: 0.2,
            low_pass: LOW_PASS,
            antialiased: false,
            sort_metric: SortMetric::Z,
            deform: true,
            instances: None,
        }
    }
}

impl RenderSettings {
    /// With the instance pass where the outputs need it and the field has identities, and only there.
    #[must_use]
    pub(crate) fn for_outputs(&self, field: &cif_field::Field, channels: Channels) -> Self {
        let drawn = channels.instances && field.identities.is_some();
        Self { instances: drawn.then(|| self.instances.unwrap_or_default()), ..*self }
    }

    /// The settings a field was trained with.
    #[must_use]
    pub fn of_field(field: &cif_field::Field) -> Self {
        Self {
            sh_degree: field.sh_degree,
            background: field.background,
            sort_metric: field.sort_metric,
            deform: field.deformation.is_some(),
            instances: field.identities.is_some().then(InstanceSettings::default),
            ..Self::default()
        }
    }
}
