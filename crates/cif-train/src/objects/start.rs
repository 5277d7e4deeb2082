//! An object from its first guess to its motion: the way of moving that is kept, the times that hardly show it, and
//! everything together.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::RotationEvidence;
use cif_geometry::scalar::direct_sigmoid;
use glam::{DQuat, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::bend;
use super::fit::{Fit, Turns};
use super::grow::grow;
use super::mend::{mend, onto_masks};
use super::object::{FOLLOWED, Followed, Object, Started};
use super::path::smooth;
use super::plane::Plane;
use super::rotation::{Rivals, shown};
use super::shape::Pose;
use super::split::{SplitViews, times_of};
use super::trials::{self, GAUSSIANS, STEPS};
use super::view::{ObjectView, median};
use super::ways::{Way, rolled};
use crate::error::TrainError;

/// Reliable times below which ways of moving cannot be distinguished.
const FEWEST_TIMES: usize = 8;

/// Times at which an object must be seen to be followed.
const FEWEST_SEEN: usize = 5;

/// Views at the beginning and the end of which all must show an object elsewhere than where it is at rest, if it is.
const AT_ENDS: usize = 2;

/// Error from which an outline does not explain what is seen.
const STRANGE: f64 = 0.11;

/// Steps of the joint fit.
const JOINT: usize = 2500;

/// Share of the way that training may move the pose of a time which shows an object whole.
const LEAST_SHARE: f64 = 0.1;

/// Turns about the upright axis, degrees in all, that rotations which following found are held against.
const RIVALS: [i32; 6] = [-180, -120, -60, 60, 120, 180];

/// An object with its motion.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Fitted {
    /// World from object, by time.
    pub(crate) poses: BTreeMap<usize, (DQuat, DVec3)>,
    /// How far training may move each of these poses: 1 where its time shows all of it, which the fit does not explain.
    pub(crate) shares: BTreeMap<usize, f64>,
    /// In the frame of the object.
    #[serde(skip)]
    pub(crate) gaussians: Gaussians,
    /// Pose at the time that shows most of it.
    pub(crate) reference: (DQuat, DVec3),
    pub(crate) rotation: RotationEvidence,
    /// True where no other turn fits as well, whether or not this one is observed.
    pub(crate) is_turned: bool,
    /// Error on pixels that were left out.
    pub(crate) error: f64,
    /// The same, had it not turned.
    pub(crate) unturned: Option<f64>,
    /// The same, might it bend, of that if it may not; `None` where nobody doubts that it does not.
    pub(crate) bent: Option<f64>,
    /// True of a ball.
    pub(crate) is_ball: bool,
    /// True of what one camera sees from other sides all the time: a pose of its own explains each, so that errors are
    /// smaller.
    #[serde(alias = "is_settled")]
    pub(crate) is_surrounded: bool,
    /// Way of moving that was kept, in words.
    pub(crate) way: String,
}

/// Fits an object that has one of several outlines; `None` where it is at rest, or its masks do not show enough.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn fit_object<'a>(objects: &[Object<'a>]) -> Result<Option<Fitted>, TrainError> {
    let begin = |object: &Object<'a>| -> Result<Option<(Object<'a>, Started<'a>)>, TrainError> {
        Ok(object.begun()?.map(|started| (*object, started)))
    };
    let all = |objects: &[Object<'a>]| -> Result<Vec<_>, TrainError> {
        let begun: Vec<_> = objects.par_iter().map(begin).collect::<Result<_, TrainError>>()?;
        Ok(begun.into_iter().flatten().collect())
    };
    let (resorts, others): (Vec<Object<'a>>, Vec<Object<'a>>) =
        objects.iter().partition(|object| object.outline.is_resort);
    let mut begun: Vec<(Object<'a>, Started<'a>)> = all(&others)?;
    if begun.iter().all(|(_, started)| started.error > STRANGE) {
        begun.extend(all(&resorts)?);
    }
    let best = begun.into_iter().min_by(|a, b| a.1.error.total_cmp(&b.1.error));
    let Some((object, Started { mut fit, path, way, rotation, is_turned, error, unturned, bent, reference })) =
        best
    else {
        return Ok(None);
    };
    let (outline, phases) = (object.outline, object.surroundings.phases);
    grow(&mut fit, &path);
    onto_masks(&mut fit, phases)?;
    if way == Way::Followed {
        mend(&mut fit, phases)?;
    }
    phases.check()?;
    let all: Vec<usize> = object.views_at(&fit.poses).collect();
    let levels = fit.levels();
    fit.steps(&all, JOINT, |share| {
        let decay = 0.05_f64.powf(share);
        let level = if share < 0.2 && levels.len() > 1 { 1 } else { 0 };
        (0.6 * decay, 1.5 * decay, level)
    });
    phases.check()?;
    if let (Way::Roll(factor), Some(plane), None) = (way, object.surroundings.plane, fit.rolls) {
        roll_along(&mut fit, plane, outline.height / factor);
        if let Some(shape) = object.hull(&fit.poses, GAUSSIANS, &mut object.rng()) {
            fit.shape = shape;
            fit.turns = Turns::Given;
            fit.steps(&all, STEPS[1], |share| (0.6 * 0.2_f64.powf(share), 0.1, 0));
        }
    }
    // More Gaussians, in poses that hardly move any more.
    if let Some(shape) = object.hull(&fit.poses, object.surroundings.gaussians, &mut object.rng()) {
        fit.shape = shape;
        fit.steps(&all, STEPS[1], |share| (0.6 * 0.05_f64.powf(share), 0.1, 0));
    }
    phases.check()?;
    if let Way::Roll(factor) = way {
        fit.rolls = Some(outline.height / factor);
    }
    fit.fill_long_turns();
    let shares = shares(&mut fit);
    let at_rest = (DQuat::IDENTITY, DVec3::ZERO);
    Ok(Some(Fitted {
        shares,
        poses: fit.poses.iter().map(|(time, pose)| (*time, (pose.rotation, pose.translation))).collect(),
        gaussians: fit.shape.gaussians().clone(),
        reference: fit.poses.get(&reference).map_or(at_rest, |p| (p.rotation, p.translation)),
        rotation,
        is_turned,
        error,
        unturned,
        bent,
        is_ball: outline.roundness >= 1.0,
        is_surrounded: outline.is_surrounded && fit.one_camera,
        way: way.in_words(),
    }))
}

impl Fitted {
    /// Its Gaussians where its reference pose puts them.
    pub(crate) fn placed(&self) -> Gaussians {
        let mut placed = self.gaussians.clone();
        let (rotation, translation) = self.reference;
        Pose { rotation, translation }.carry(&mut placed);
        placed
    }
}

impl<'a> Object<'a> {
    /// The object in the best way of moving along the path of its outline; `None` where it is at rest, or its masks do not
    /// show enough.
    pub(super) fn begun(self) -> Result<Option<Started<'a>>, TrainError> {
        let Object { views, outline, .. } = self;
        let path = smooth(&outline.path, views, self.surroundings.times, outline);
        let is_reliable =
            |view: &usize| views[*view].is_reliable() && !outline.guessed.contains(&views[*view].time_index);
        let reliable: Vec<usize> = self.views_at(&path).filter(is_reliable).collect();
        if times_of(views, &reliable).len() < FEWEST_TIMES {
            return self.followed(path);
        }
        let found = trials::best_way(self, path.clone(), &reliable)?;
        if found.is_none() && self.comes_or_goes(&path, &reliable) {
            return self.followed(path);
        }
        Ok(found)
    }

    /// True of what stands still while it is seen well, but is elsewhere when it is seen first, or last.
    fn comes_or_goes(&self, path: &BTreeMap<usize, DVec3>, reliable: &[usize]) -> bool {
        let Some(place) = self.resting_place(reliable) else { return false };
        let seen: Vec<&ObjectView> = self.views_at(path).map(|view| &self.views[view]).collect();
        let is_away = |view: &&ObjectView| {
            view.camera.project(place).is_some_and(|(pixel, depth)| {
                let size = self.outline.size() * view.camera.focal_px.x / depth;
                (pixel - view.centroid).length() > size
            })
        };
        seen.len() > AT_ENDS
            && (seen.iter().take(AT_ENDS).all(is_away) || seen.iter().rev().take(AT_ENDS).all(is_away))
    }

    /// An object that is mostly cut or hidden, followed from time to time.
    fn followed(&self, path: BTreeMap<usize, DVec3>) -> Result<Option<Started<'a>>, TrainError> {
        if path.len() < FEWEST_SEEN {
            return Ok(None);
        }
        let all: Vec<usize> = self.views_at(&path).collect();
        let Some(starts) = self.starts(&path, &times_of(self.views, &all)) else { return Ok(None) };
        let Some(followed) = self.followed_from(&starts, &path, &all, None)? else { return Ok(None) };
        let Followed { mut fit, is_decided } = followed;
        let reference = starts.reference;
        let error = fit.mean_loss(&all, 0);
        let stays = |bent: f64| bent <= trials::BENDS_IN_PLACE * error;
        if !self.is_declared && self.bent_in_place(&all).is_some_and(stays) {
            return Ok(None);
        }
        let rotation = if is_decided && self.shows(&path, &fit.poses) {
            RotationEvidence::Observed
        } else {
            RotationEvidence::Assumed
        };
        let way = Way::Followed;
        let (is_turned, unturned, bent) = (true, None, None);
        Ok(Some(Started { fit, path, way, rotation, is_turned, error, unturned, bent, reference }))
    }

    /// True where the images show rotations that following found, and not turns about the upright axis instead.
    fn shows(&self, path: &BTreeMap<usize, DVec3>, poses: &BTreeMap<usize, Pose>) -> bool {
        let up = self.surroundings.plane.map_or(self.surroundings.up, |plane| plane.normal);
        let (Some(first), Some(last)) = (path.keys().next(), path.keys().next_back()) else { return false };
        let turning = |degrees: i32| {
            let angle =
                |time: usize| (time - first) as f64 / (last - first).max(1) as f64 * f64::from(degrees);
            let rotation = |time: usize| DQuat::from_axis_angle(up, angle(time).to_radians());
            path.iter().map(|(t, place)| (*t, Pose { rotation: rotation(*t), translation: *place })).collect()
        };
        let others = RIVALS.map(turning).into();
        let rivals = Rivals { unturned: turning(0), rolls: Vec::new(), others, by_outlines: true };
        shown(self.views, self.outline.size(), poses, rivals)
    }

    /// Error of the object bending in one place, on the views that it is fitted to.
    fn bent_in_place(&self, views: &[usize]) -> Option<f64> {
        let at_rest = Pose::at(self.resting_place(views)?);
        let poses = views.iter().map(|k| (self.views[*k].time_index, at_rest)).collect();
        let shape = self.hull(&poses, FOLLOWED, &mut self.rng())?;
        let mut fit = self.fit(poses, shape, self.rng());
        fit.turns = Turns::Given;
        fit.stays = true;
        fit.steps(views, STEPS[1], |share| (if share < 0.5 { 1.0 } else { 0.5 }, 0.0, 0));
        Some(bend::bent(&fit, &SplitViews::whole(views.to_vec()), 0))
    }
}

/// Shares of the way that training may move poses, by time.
fn shares(fit: &mut Fit<'_>) -> BTreeMap<usize, f64> {
    let mut seen: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
    for view in 0..fit.views.len() {
        let (time, visible) = (fit.views[view].time_index, fit.views[view].visible);
        let loss = fit.loss(view, 0);
        let (most, worst) = seen.entry(time).or_default();
        (*most, *worst) = (most.max(visible), worst.max(loss));
    }
    let median_loss = median(&mut seen.values().map(|(_, loss)| *loss).collect::<Vec<_>>());
    let of = |time: &usize| {
        seen.get(time).map_or(LEAST_SHARE, |(visible, loss)| share(*visible, loss / median_loss))
    };
    fit.poses.keys().map(|time| (*time, of(time))).collect()
}

/// Share of the way that training may move a pose at whose time a share of the object is visible, by its loss over the
/// median one: the less is seen the less, as slivers lead the pose astray, and with it those at times that do not show the
/// object, which follow; and little where it is explained as well as is typical.
fn share(visible: f64, loss: f64) -> f64 {
    visible * (1.0 - (1.0 - LEAST_SHARE) * loss.max(1.0).powi(-2))
}

/// Turns an object as it rolls without slip along its path, about its middle.
fn roll_along(fit: &mut Fit<'_>, plane: &Plane, radius: f64) {
    let g = fit.shape.gaussians();
    let weight = |row: usize| direct_sigmoid(f64::from(g.opacity_logits[row]));
    let total: f64 = (0..g.len()).map(weight).sum();
    let sum: DVec3 =
        (0..g.len()).map(|row| weight(row) * DVec3::from_array(g.means[row].map(f64::from))).sum();
    let middle = sum / total.max(1e-9);
    let places: Vec<DVec3> =
        fit.poses.values().map(|pose| pose.rotation * middle + pose.translation).collect();
    let rotations = rolled(&places, plane.normal, radius);
    for ((pose, rotation), translation) in fit.poses.values_mut().zip(rotations).zip(places) {
        *pose = Pose { rotation, translation };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn training_moves_poses_that_are_seen_and_not_explained() {
        assert!((share(1.0, 1.0) - LEAST_SHARE).abs() < 1e-12);
        assert!((share(1.0, 0.5) - LEAST_SHARE).abs() < 1e-12, "better than usual");
        assert!(share(1.0, 4.0) > 0.9);
        // A sliver at the border of the image, explained or not.
        assert!(share(0.1, 4.0) < LEAST_SHARE && share(0.1, 1.0) < 0.02);
    }
}
