//! Cost and residuals of the chosen motion models.

use cif_field::RotationEvidence;
use cif_geometry::Bounds;
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::motion::{Motion, MotionModel};
use super::splats::Splats;

/// Residuals of a motion model against the trained motion, world units.
///
/// Residuals are distances between the centres that the model predicts and the trained ones, over all sampled
/// times, weighted by opacity times size. Orientations are reported, but do not decide: the turn of a nearly
/// round Gaussian cannot be seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ResidualStatistics {
    /// Root of the weighted mean squared residual, over all times and Gaussians, outliers included.
    pub rms: f64,
    /// As `rms`, at the worst time, without the outlying weight (5 %; background 1 %) that has the largest
    /// residuals at that time. The tolerance is held against this value.
    pub decisive: f64,
    /// 95th weighted percentile at the worst time.
    pub percentile_95: f64,
    /// Largest residual of any Gaussian at any time.
    pub max: f64,
    /// Share of the weight whose residual is above the tolerance, at the worst time.
    pub outlier_share: f64,
    /// Weighted RMS turn between predicted and trained orientations, degrees; round Gaussians count less.
    pub orientation_rms_degrees: f64,
}

/// Residual at one sampled time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TimeResidual {
    /// As [`ResidualStatistics::decisive`], at this time.
    pub decisive: f64,
    /// Share of the weight that `decisive` is taken over.
    pub inlier_share: f64,
}

/// Motion of one node, as chosen.
///
/// Two reports are equal whatever the seconds.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MotionReport {
    /// Chosen model.
    pub model: MotionModel,
    /// Evidence for the rotations of a rigid node; `None` where it is not known, and for other models.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<RotationEvidence>,
    /// Gaussians of the node.
    pub gaussians: usize,
    /// Diagonal of the box of the centres at the reference time, outermost 2 % of the weight left out, world
    /// units.
    pub size: f64,
    /// Largest `decisive` residual allowed to a fitted motion, world units.
    pub tolerance: f64,
    /// Residual of what is exported: of the chosen model, with the samples that were left out interpolated; zero for
    /// recorded poses.
    pub residual: ResidualStatistics,
    /// Residual of the static model; zero where the poses are those that the field records, as nothing is fitted then.
    pub static_residual: ResidualStatistics,
    /// Residual of one rigid body; `None` where poses are recorded, and for the background, which is never one body.
    pub rigid_residual: Option<ResidualStatistics>,
    /// Residual of the best rigid parts; `None` where they were not tried.
    #[serde(default)]
    pub parts_residual: Option<ResidualStatistics>,
    /// Rigid parts; 0 for the other models.
    #[serde(default)]
    pub parts: usize,
    /// Time samples written: poses of the node and its parts, or dense samples.
    pub samples: usize,
    /// Bytes of the sampled values.
    pub motion_bytes: usize,
    /// Seconds spent fitting and choosing; not serialised, so that files of one scene are equal.
    #[serde(skip)]
    pub seconds: f64,
}

impl PartialEq for MotionReport {
    fn eq(&self, other: &Self) -> bool {
        let known = |report: &Self| {
            let Self {
                model,
                rotation,
                gaussians,
                size,
                tolerance,
                residual,
                static_residual,
                rigid_residual,
                parts_residual,
                parts,
                samples,
                motion_bytes,
                seconds: _,
            } = report.clone();
            let residuals = (residual, static_residual, rigid_residual, parts_residual);
            (model, rotation, gaussians, size, tolerance, residuals, parts, samples, motion_bytes)
        };
        known(self) == known(other)
    }
}

impl MotionReport {
    /// Report on motion that was read from a file of others, not fitted.
    #[must_use]
    pub fn unfitted(splats: &Splats, motion: &Motion) -> Self {
        let centres = splats.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from)));
        Self {
            model: motion.model(),
            rotation: None,
            gaussians: splats.len(),
            size: Bounds::around(centres).size().length(),
            tolerance: 0.0,
            residual: ResidualStatistics::default(),
            static_residual: ResidualStatistics::default(),
            rigid_residual: None,
            samples: motion.sample_count(),
            motion_bytes: motion.bytes(),
            parts_residual: None,
            parts: motion.part_count(),
            seconds: 0.0,
        }
    }
}
