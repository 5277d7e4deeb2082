//! The object that is searched for parts: its views, its static body, and places that it may fill.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::super::bend;
use super::super::fit::Turns;
use super::super::object::Object;
use super::super::shape::{Pose, Shape};
use super::super::split::{SplitViews, times_of};
use super::super::view::{is_one_camera, median};
use super::bending::Bending;
use super::body::{Body, JointOfBody, PosedObject};

/// Most views of a time that values are searched on.
const VIEWS: usize = 2;

/// Reach of an object that one camera sees, of the radius of its outline.
const ACROSS: f64 = 1.1;

/// Rows of times of which one is that at which the object looks most alike, their part of all times, and the fewest
/// times of one.
const ROWS: usize = 7;
const ROW: usize = 4;
const FEWEST_IN_ROW: usize = 4;

/// Pixels that the mask of an object has at least where guesses are fitted, and where they are tried.
const PIXELS: [f64; 2] = [375.0, 100.0];

/// Gaussians of an object that bends.
const BENT: usize = 500;

/// Shared facts of a search.
pub(super) struct Search<'a> {
    pub(super) object: Object<'a>,
    /// World from object, by time.
    pub(super) base: &'a BTreeMap<usize, Pose>,
    /// Views that show the object well.
    pub(super) views: SplitViews,
    pub(super) size: f64,
    /// Direction away from the support, in the frame of the object, where there is one.
    pub(super) up: Option<DVec3>,
    /// True with one camera per time.
    pub(super) one_camera: bool,
}

impl<'a> Search<'a> {
    /// A search of an object whose poses are known.
    pub(super) fn new(object: Object<'a>, base: &'a BTreeMap<usize, Pose>, views: SplitViews) -> Self {
        let rotation = base.values().next().map_or(DQuat::IDENTITY, |pose| pose.rotation);
        let up = object.surroundings.plane.map(|plane| rotation.inverse() * plane.normal);
        let size = object.outline.size();
        let one_camera =
            is_one_camera(views.train.iter().chain(&views.left_out).map(|view| &object.views[*view]));
        Self { object, base, views, size, up, one_camera }
    }

    /// Reduction at which guesses are fitted.
    pub(super) fn level(&self) -> usize {
        self.level_with(PIXELS[0])
    }

    /// The coarser one at which they are tried first.
    pub(super) fn coarse_level(&self) -> usize {
        self.level_with(PIXELS[1])
    }

    /// The coarsest reduction that leaves a mask so many pixels, in the median.
    fn level_with(&self, pixels: f64) -> usize {
        let mut areas: Vec<f64> =
            self.views.train.iter().map(|view| self.object.views[*view].detail()).collect();
        let area = median(&mut areas);
        let levels = self.object.views.first().map_or(1, |view| view.crops.len());
        (1..levels).take_while(|level| area > pixels * 4.0_f64.powi(*level as i32)).count()
    }

    /// Gaussians inside the masks in poses, within a bound in the frame of the object.
    pub(super) fn hull(
        &self,
        poses: &BTreeMap<usize, Pose>,
        bound: Option<&dyn Fn(DVec3) -> bool>,
        count: usize,
    ) -> Option<Shape> {
        let reach = 1.3 * self.size;
        // A part leaves the room of the base.
        let bounded = bound.is_none();
        let inside =
            |place: DVec3| (!bounded || self.is_within(place)) && bound.is_none_or(|bound| bound(place));
        let mut rng = self.object.rng();
        let mut shape = self.object.hull_within(poses, reach, Some(&inside), count, &mut rng)?;
        shape.fade(0.0, |_| true);
        Some(shape)
    }

    /// The Gaussians of a shape as the object with joints, each Gaussian of the base (0) or of the part of a joint.
    pub(super) fn body(&self, shape: Shape, joints: Vec<JointOfBody>, group_of: Vec<usize>) -> Body<'a> {
        let Search { object, base, size, up, .. } = *self;
        Body::new(PosedObject { views: object.views, base, size, up }, shape, joints, group_of, object.rng())
    }

    /// The object without parts, as some views show it: with a number of Gaussians, after some steps.
    pub(super) fn rigid(
        &self,
        views: &[usize],
        gaussians: usize,
        steps: usize,
        level: usize,
    ) -> Option<Body<'a>> {
        let times = views.iter().map(|view| self.object.views[*view].time_index);
        let poses = times.filter_map(|time| Some((time, *self.base.get(&time)?))).collect();
        let mut body = self.body(self.hull(&poses, None, gaussians)?, Vec::new(), Vec::new());
        body.steps(views, steps, level, |share| (if share < 0.5 { 1.0 } else { 0.5 }, 0.0));
        Some(body)
    }

    /// The object as it bends on its base.
    pub(super) fn bending(&self) -> Option<Bending> {
        let shape = self.hull(self.base, None, BENT)?;
        let mut fit = self.object.fit(self.base.clone(), shape, self.object.rng());
        fit.turns = Turns::Given;
        fit.stays = true;
        let (gaussians, shifts, error) = bend::bending(&fit, &self.views)?;
        Some(Bending { gaussians, shifts, place: DVec3::ZERO, error })
    }

    /// The object without parts as it looks in the row of times that are most alike, with the views of these.
    pub(super) fn closed(
        &self,
        gaussians: usize,
        steps: usize,
        level: usize,
    ) -> Option<(Body<'a>, Vec<usize>)> {
        let time_of = |view: usize| self.object.views[view].time_index;
        let times = times_of(self.object.views, &self.views.train);
        let length = (times.len() / ROW).max(FEWEST_IN_ROW).min(times.len());
        let of_row = |row: usize| {
            let first = row * (times.len() - length) / (ROWS - 1);
            let range = times[first]..=times[first + length - 1];
            let views: Vec<usize> =
                self.views.train.iter().copied().filter(|view| range.contains(&time_of(*view))).collect();
            let body = self.rigid(&views, gaussians, steps, level)?;
            Some((body.mean_loss(&views, level), body, views))
        };
        let rows: Vec<_> = (0..ROWS).into_par_iter().filter_map(of_row).collect();
        let (_, mut body, views) = rows.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
        body.steps(&views, steps, level, |_| (0.5, 0.0));
        Some((body, views))
    }

    /// Views of some times, one each, or of all times, a few each.
    pub(super) fn times(&self, count: usize) -> BTreeMap<usize, Vec<usize>> {
        let mut of: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for view in &self.views.train {
            of.entry(self.object.views[*view].time_index).or_default().push(*view);
        }
        let all = of.len();
        let needed = count.min(all).max(2);
        let kept: Vec<usize> = (0..needed).map(|k| k * (all - 1) / (needed - 1)).collect();
        let mut times: BTreeMap<usize, Vec<usize>> = of
            .into_iter()
            .enumerate()
            .filter(|(k, _)| kept.contains(k))
            .map(|(_, of_time)| of_time)
            .collect();
        for (k, views) in times.values_mut().enumerate() {
            let needed = if count < all { 1 } else { VIEWS.min(views.len()) };
            *views = (0..needed).map(|view| views[(k + view * views.len() / needed) % views.len()]).collect();
        }
        times
    }

    /// True for places that what the object stands on leaves room for and that, where one camera sees it at a time and
    /// does not show how deep it is, are not farther away from its middle than it is wide.
    pub(super) fn is_within(&self, place: DVec3) -> bool {
        let Some((plane, up)) = self.object.surroundings.plane.zip(self.up) else { return true };
        let Some(pose) = self.base.values().next() else { return true };
        let across = (place - up * up.dot(place)).length();
        let is_near = !self.one_camera || across < ACROSS * self.object.outline.radius;
        is_near && plane.height(pose.rotation * place + pose.translation) > -0.05 * self.size
    }
}
