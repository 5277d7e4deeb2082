//! Objects that move as a whole: fitted before the fine stage, given Gaussians in a group that moves by trained
//! poses.

use cif_field::tracks::{NO_GROUP, RotationEvidence, TrackGroup, TrackPose, Tracks};
use glam::DVec3;

use super::Trainer;
use crate::error::TrainError;
use crate::objects::{self, Fitted, Rotation, Surroundings};
use crate::schedule::log_linear;
use crate::stage::Stage;

/// Error on pixels that were left out beyond which an object is not taken to be rigid.
const MOST_ERROR: f64 = 0.2;

/// Rates of poses at the start and the end of the fine stage, radians, and shares of the size of the object.
const RATES: [f32; 2] = [0.004, 2e-4];

/// Steps of the fine stage in which poses stay, while everything settles around them.
const FROZEN: u32 = 300;

impl Trainer {
    /// Fits a travelling object (a label: dense index + 1) and gives it a group with Gaussians; false where it is not
    /// rigid, or its masks do not tell enough.
    pub(super) fn add_object(&mut self, label: u16) -> Result<bool, TrainError> {
        if !self.state.config.motion.rigid || self.engine.gpu_name().is_some() {
            return Ok(false);
        }
        let state = &self.state;
        let surroundings = Surroundings {
            times: state.dataset.times.len(),
            near: state.config.near,
            seed: state.config.seed,
            gaussians: state.config.motion.gaussians as usize,
            stop: &state.stop,
        };
        let fitted = objects::fit(label, &state.dataset, &state.frames, surroundings)?;
        let name = state.field.instances[usize::from(label) - 1].label.clone();
        let Some(fitted) = fitted.filter(|fitted| fitted.error <= MOST_ERROR) else { return Ok(false) };
        let how = match fitted.rotation {
            Rotation::Observed => "",
            Rotation::Assumed => ", which the pictures do not tell: assumed",
        };
        self.warnings.push(format!(
            "{name} moves as a whole: {}{how} (error {:.3} on pixels left out)",
            fitted.turns, fitted.error
        ));
        self.join(name, &fitted);
        Ok(true)
    }

    /// Adds the Gaussians of an object to the field, where the best of its poses puts them, in a group of their own.
    fn join(&mut self, name: String, fitted: &Fitted) {
        let field = &mut self.state.field;
        let (rotation, place) = fitted.reference;
        let mut rows = fitted.gaussians.clone();
        for (mean, quaternion) in rows.means.iter_mut().zip(&mut rows.quaternions) {
            let moved = rotation * DVec3::from_array(mean.map(f64::from)) + place;
            *mean = moved.to_array().map(|value| value as f32);
            let [w, x, y, z] = quaternion.map(f64::from);
            let turned = rotation * glam::DQuat::from_xyzw(x, y, z, w);
            *quaternion = [turned.w, turned.x, turned.y, turned.z].map(|value| value as f32);
        }
        let occupancy = cif_geometry::scalar::logit(self.state.config.instance.occupancy);
        rows.occupancy_logits.fill(occupancy);
        let times = &self.state.dataset.times;
        let back = rotation.inverse();
        let mut poses: Vec<TrackPose> = fitted
            .poses
            .iter()
            .map(|(time, (turn, translation))| TrackPose {
                time: times[*time],
                translation: *translation,
                rotation: (*turn * back).normalize(),
            })
            .collect();
        for k in 1..poses.len() {
            if poses[k].rotation.dot(poses[k - 1].rotation) < 0.0 {
                poses[k].rotation = -poses[k].rotation;
            }
        }
        let before = field.len();
        let tracks = field.tracks.get_or_insert_with(Tracks::default);
        tracks.group_of.resize(before, NO_GROUP);
        tracks.group_of.resize(before + rows.len(), tracks.groups.len() as u32);
        let rotation = Some(match fitted.rotation {
            Rotation::Observed => RotationEvidence::Observed,
            Rotation::Assumed => RotationEvidence::Assumed,
        });
        tracks.groups.push(TrackGroup { deformed: false, poses, rotation, ..TrackGroup::still(name, place) });
        field.gaussians.append(&rows);
        if let Some(deformation) = &mut field.deformation {
            deformation.still.resize(before, false);
            deformation.still.resize(before + rows.len(), true);
        }
    }

    /// Rate of the poses at a step of a stage; 0 where they stay.
    pub(super) fn pose_rate(&self, stage: Stage, iteration: u32) -> f64 {
        let steps = self.state.config.fine_iterations().max(1);
        let rate = match stage {
            Stage::Fine if iteration > FROZEN.min(steps / 4) => log_linear(RATES, iteration, steps),
            Stage::Instance => RATES[1],
            _ => 0.0,
        };
        f64::from(rate)
    }
}
