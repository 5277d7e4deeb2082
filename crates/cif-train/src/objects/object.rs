//! An object that is fitted: what is known of it before, and where fits of it start.

use std::collections::BTreeMap;

use cif_field::tracks::RotationEvidence;
use glam::DVec3;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::fit::{Fit, Turns};
use super::follow::follow;
use super::hull::hull;
use super::likeliest::{Explained, jump, likeliest};
use super::order::Order;
use super::outline::Outline;
use super::plane::Plane;
use super::shape::{Pose, Shape};
use super::view::{ObjectView, is_one_camera, meeting_point};
use super::ways::Way;
use crate::error::TrainError;
use crate::phases::Phases;
use crate::random::{Purpose, stream};

/// Times that one camera shows from so many sides that they are begun together, as if the object did not turn between
/// them.
const TOGETHER: usize = 7;

/// Step from time to time, of the size, up to which an object that leaves its support stands still on it.
pub(super) const STANDS: f64 = 0.03;

/// Steps of Gaussians that are made anew from where an object was followed to, and rate of poses meanwhile.
const CARVED: (usize, f64) = (600, 0.3);

/// Turn from which what was followed from another start is another motion, degrees.
const APART: f64 = 30.0;

/// Gaussians of an object that is followed.
pub(super) const FOLLOWED: usize = 300;

/// Facts about the capture that fits need.
#[derive(Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    /// The plane that objects stand on, where it was found.
    pub(crate) plane: Option<&'a Plane>,
    /// Mean direction upwards in the images.
    pub(crate) up: DVec3,
    pub(crate) order: &'a Order,
    pub(crate) times: usize,
    pub(crate) near: f32,
    pub(crate) seed: u64,
    /// Gaussians that an object leaves with.
    pub(crate) gaussians: usize,
    pub(crate) phases: &'a Phases,
}

/// An object to be fitted, with what is known of it.
#[derive(Clone, Copy)]
pub(super) struct Object<'a> {
    pub(super) label: u16,
    /// In the order of times.
    pub(super) views: &'a [ObjectView],
    pub(super) outline: &'a Outline,
    /// True where it is declared to move as a whole.
    pub(super) is_declared: bool,
    /// Place of the outline among those that the object may have: those after the first suggest no ways of moving but
    /// what following finds.
    pub(super) place: usize,
    /// Number of these outlines: several are compared with all pixels.
    pub(super) outlines: usize,
    pub(super) surroundings: Surroundings<'a>,
}

/// An object in one of the ways of moving.
pub(super) struct Started<'a> {
    pub(super) fit: Fit<'a>,
    /// Centre of its outline by time, smoothed.
    pub(super) path: BTreeMap<usize, DVec3>,
    pub(super) way: Way,
    pub(super) rotation: RotationEvidence,
    /// True where no other turn fits as well.
    pub(super) is_turned: bool,
    pub(super) error: f64,
    /// Error of moving without a turn.
    pub(super) unturned: Option<f64>,
    /// Error of bending, of that of a rigid object; `None` where it was not asked for.
    pub(super) bent: Option<f64>,
    /// Time that shows most of it.
    pub(super) reference: usize,
}

/// An object that was followed.
pub(super) struct Followed<'a> {
    pub(super) fit: Fit<'a>,
    /// True where no other start leads to other turns that explain as much.
    pub(super) is_decided: bool,
}

/// An object followed from one of its starts.
struct Path<'a> {
    fit: Fit<'a>,
    explained: Explained,
}

/// Where an object is followed from.
pub(super) struct Starts {
    /// Time that shows most of it, among those of every start.
    pub(super) reference: usize,
    /// Poses by time, as they may be: as it stands before it is lifted, and after; where it looks from one side to the next
    /// as if it did not turn; else as one time shows it.
    pub(super) poses: Vec<BTreeMap<usize, Pose>>,
}

impl<'a> Object<'a> {
    /// An object by each of the outlines that it may have.
    pub(super) fn by_outlines(
        label: u16,
        views: &'a [ObjectView],
        outlines: &'a [Outline],
        is_declared: bool,
        surroundings: Surroundings<'a>,
    ) -> Vec<Self> {
        let of = |(place, outline)| Object {
            label,
            views,
            outline,
            is_declared,
            place,
            outlines: outlines.len(),
            surroundings,
        };
        outlines.iter().enumerate().map(of).collect()
    }

    /// Random numbers of the object, from their start.
    pub(super) fn rng(&self) -> Pcg64 {
        stream(self.surroundings.seed, Purpose::Objects, u64::from(self.label))
    }

    /// Views at times.
    pub(super) fn views_at<T>(&self, times: &BTreeMap<usize, T>) -> impl Iterator<Item = usize> {
        (0..self.views.len()).filter(|view| times.contains_key(&self.views[*view].time_index))
    }

    /// A fit that starts with poses and a shape.
    pub(super) fn fit(&self, poses: BTreeMap<usize, Pose>, shape: Shape, rng: Pcg64) -> Fit<'a> {
        let Surroundings { plane, times, near, .. } = self.surroundings;
        Fit {
            views: self.views,
            plane: plane.copied(),
            outline: self.outline,
            poses,
            shape,
            turns: Turns::Free,
            rolls: None,
            times,
            near,
            one_camera: is_one_camera(self.views),
            rng,
            stays: false,
            air: self.outline.air.clone(),
            moments: BTreeMap::new(),
            runs: Vec::new(),
        }
    }

    /// Gaussians inside the masks in poses.
    pub(super) fn hull(&self, poses: &BTreeMap<usize, Pose>, count: usize, rng: &mut Pcg64) -> Option<Shape> {
        self.hull_within(poses, self.outline.size(), None, count, rng)
    }

    /// The same of an object of another size, metres, within a bound in its frame.
    pub(super) fn hull_within(
        &self,
        poses: &BTreeMap<usize, Pose>,
        size: f64,
        bound: Option<&dyn Fn(DVec3) -> bool>,
        count: usize,
        rng: &mut Pcg64,
    ) -> Option<Shape> {
        let Surroundings { near, phases, .. } = self.surroundings;
        hull(self.views, poses, size, bound, count, rng)?.shape(near, phases)
    }

    /// Of some times the one that shows most of it: the largest mask, whole if there is one.
    pub(super) fn best_seen(&self, times: impl Iterator<Item = usize>) -> Option<usize> {
        let seen = |time: &usize| -> f64 {
            let of = self.views.iter().filter(|view| view.time_index == *time);
            of.map(|view| view.area() * (1.0 - 0.7 * view.touched) * if view.cut { 0.2 } else { 1.0 }).sum()
        };
        times.max_by(|a, b| seen(a).total_cmp(&seen(b)))
    }

    /// The object followed over the times of views, along a path, from the best of some starts; off its support at times
    /// that are given, or at those at which its outline may be off. `None` where no start shows it.
    ///
    /// # Errors
    /// [`TrainError::Stopped`] when the run is to stop.
    pub(super) fn followed_from(
        &self,
        starts: &Starts,
        path: &BTreeMap<usize, DVec3>,
        views: &[usize],
        off: Option<&[usize]>,
    ) -> Result<Option<Followed<'a>>, TrainError> {
        let followed = |poses: &BTreeMap<usize, Pose>| -> Result<Option<Path<'a>>, TrainError> {
            let Some(mut fit) = self.started(poses, path) else { return Ok(None) };
            if let Some(off) = off {
                fit.air = off.to_vec();
            }
            follow(&mut fit, starts.reference, path, views, self.surroundings.phases)?;
            let loss = if starts.poses.len() > 1 { self.carved_loss(&fit, views)? } else { 0.0 };
            let explained = Explained { loss, jump: jump(&fit.poses, poses) };
            Ok(Some(Path { fit, explained }))
        };
        let followed = starts.poses.par_iter().map(followed).collect::<Result<Vec<_>, TrainError>>()?;
        let mut followed: Vec<Path<'a>> = followed.into_iter().flatten().collect();
        let explained: Vec<Explained> = followed.iter().map(|path| path.explained).collect();
        let Some(likeliest) = likeliest(&explained) else { return Ok(None) };
        let Path { fit, explained } = followed.swap_remove(likeliest);
        let turned = |other: &Fit<'_>| {
            let angle = |(time, pose): (&usize, &Pose)| {
                Some(pose.rotation.angle_between(other.poses.get(time)?.rotation).to_degrees())
            };
            fit.poses.iter().filter_map(angle).fold(0.0, f64::max)
        };
        let rivals = |path: &Path<'a>| path.explained.rivals(&explained) && turned(&path.fit) > APART;
        let is_decided = !followed.iter().any(rivals);
        Ok(Some(Followed { fit, is_decided }))
    }

    /// Loss of Gaussians that are made anew from all poses of a fit: where it was followed wrongly, poses that each explain
    /// their time contradict each other.
    fn carved_loss(&self, fit: &Fit<'a>, views: &[usize]) -> Result<f64, TrainError> {
        let mut rng = self.rng();
        let Some(shape) = self.hull(&fit.poses, FOLLOWED, &mut rng) else { return Ok(f64::INFINITY) };
        let mut again = self.fit(fit.poses.clone(), shape, rng);
        again.air.clone_from(&fit.air);
        let level = again.trial_level();
        let (steps, pose_rate) = CARVED;
        again.steps(views, steps, |share| (if share < 0.5 { 1.0 } else { 0.5 }, pose_rate, level));
        self.surroundings.phases.check()?;
        Ok(again.mean_loss(views, level))
    }

    /// Where an object is followed from to other times of its path, among `times`; `None` without any.
    pub(super) fn starts(&self, path: &BTreeMap<usize, DVec3>, times: &[usize]) -> Option<Starts> {
        let mut rests = self.runs_at_rest(path);
        rests.iter_mut().for_each(|rest| rest.retain(|time| times.contains(time)));
        rests.sort_by_key(|rest| std::cmp::Reverse(rest.len()));
        let at_rest = if rests.is_empty() { Vec::new() } else { rests.remove(0) };
        let reference = self.best_seen(if at_rest.is_empty() { times } else { &at_rest }.iter().copied())?;
        let mut poses = BTreeMap::from([(reference, Pose::at(path[&reference]))]);
        let is_one_camera = is_one_camera(self.views);
        if !at_rest.is_empty() {
            let middle = at_rest.iter().map(|time| path[time]).sum::<DVec3>() / at_rest.len() as f64;
            poses.extend(at_rest.iter().map(|time| (*time, Pose::at(middle))));
        } else if self.outline.is_surrounded && is_one_camera {
            let mut near = times.to_vec();
            near.sort_by_key(|time| time.abs_diff(reference));
            poses.extend(near.iter().take(TOGETHER).map(|time| (*time, Pose::at(path[time]))));
        }
        let poses = if is_one_camera { self.with_rests(poses, &rests, path) } else { vec![poses] };
        Some(Starts { reference, poses })
    }

    /// The object as it is before it is followed from poses; `None` where these contradict its masks.
    pub(super) fn started(
        &self,
        poses: &BTreeMap<usize, Pose>,
        path: &BTreeMap<usize, DVec3>,
    ) -> Option<Fit<'a>> {
        let upright = self.outline.upright(self.surroundings.plane);
        let size = self.outline.size();
        let shape = self.hull_within(poses, size, Some(&upright), FOLLOWED, &mut self.rng())?;
        let mut fit = self.fit(poses.clone(), shape, self.rng());
        fit.air = self.may_be_off(path);
        Some(fit)
    }

    /// Runs of times at which an object stands in one place on its support.
    pub(super) fn runs_at_rest(&self, path: &BTreeMap<usize, DVec3>) -> Vec<Vec<usize>> {
        let air = &self.outline.air;
        let times: Vec<usize> = path.keys().copied().collect();
        let stands = |a: &usize, b: &usize| {
            let step = (path[b] - path[a]).length() / (b - a) as f64;
            step < STANDS * self.outline.size() && !air.contains(a) && !air.contains(b)
        };
        let runs = times.chunk_by(stands).filter(|run| run.len() > 2);
        runs.map(<[usize]>::to_vec).collect()
    }

    /// Times at which an object that is followed may be off its support: all at which it does not rest, where it
    /// leaves it at all.
    pub(super) fn may_be_off(&self, path: &BTreeMap<usize, DVec3>) -> Vec<usize> {
        let at_rest: Vec<usize> = self.runs_at_rest(path).into_iter().flatten().collect();
        let leaves = !self.outline.air.is_empty();
        path.keys().copied().filter(|time| leaves && !at_rest.contains(time)).collect()
    }

    /// The place where views see it together.
    pub(super) fn resting_place(&self, views: &[usize]) -> Option<DVec3> {
        meeting_point(views.iter().map(|k| (&self.views[*k], self.views[*k].visible.powi(2))))
    }
}
