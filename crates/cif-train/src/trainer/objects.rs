//! Objects that move as a whole: fitted before the fine stage, given Gaussians in a group that moves by trained
//! poses.

use cif_dataset::PointSource;
use cif_dataset::meant::known_names;
use cif_field::Gaussians;
use cif_field::Instance;
use cif_field::tracks::{NO_GROUP, RotationEvidence, TrackGroup, TrackPose, Tracks};
use cif_geometry::scalar::logit;
use cif_render::cpu::Renderer;
use cif_render::{Channels, RenderSettings};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::Trainer;
use crate::config::ObjectMotion;
use crate::effects::appearing::Posed;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::losses::displacement::FREE;
use crate::objects::{self, BENDS_NO_BETTER, Bending, Fitted, Found, Order, Plane, Surroundings};
use crate::phase::Phase;
use crate::schedule::log_linear;
use crate::stage::Stage;

/// Error on pixels that were left out beyond which an object is not taken to be rigid: where the capture has points,
/// where what it stands on is itself reconstructed, and where one camera sees it from other sides all the time.
const MOST_ERROR: [f64; 2] = [0.22, 0.15];
const MOST_SURROUNDED: f64 = 0.095;

/// The same of balls, which do not deform.
const MOST_OF_BALL: f64 = 0.24;

/// Error, of that without a turn, up to which an object is rigid all the same: rough masks leave errors, but no turn
/// explains what deforms.
const TURN_EXPLAINS: f64 = 0.5;

/// Error of bending, of that of a rigid object, up to which an object deforms, whatever its error, and how much larger than
/// typical what is left may be where bending explains no better: rough masks of small things leave much.
const DEFORMS: f64 = 0.85;
const ROUGH: f64 = 2.0;

/// Views whose depths show surfaces, pixels from one of these to the next, and coverage from which they are solid.
const LOOKS: usize = 30;
const APART: usize = 3;
const OPAQUE: f32 = 0.9;

/// Largest distance between cameras, of the middle depth, from which views determine depths.
const PARALLAX: f64 = 0.1;

/// Way that a pose can go in the fine stage, of the size of its object: as far as times that no mask shows may be off.
/// What would pull the poses of many views farther is light and shadow, which stay where they are.
const TRAVEL: f64 = 0.15;

/// Largest rate of poses, of the size of the object, and rate at the end of the fine stage, of that at its start.
const FASTEST: f64 = 0.004;
const LAST: f32 = 0.05;

/// Steps of the fine stage in which poses stay, while everything settles around them.
const FROZEN: u32 = 300;

/// True where poses explain an object, given the largest error of those that are not surrounded.
pub(super) fn is_rigid(fitted: &Fitted, most: f64) -> bool {
    let most = match (fitted.is_ball, fitted.is_surrounded) {
        (true, _) => MOST_OF_BALL,
        (false, true) => MOST_SURROUNDED,
        (false, false) => most,
    };
    let explains = |unturned: f64| fitted.is_turned && fitted.error <= TURN_EXPLAINS * unturned;
    let bends_no_better = |bent: f64| bent >= BENDS_NO_BETTER && fitted.error <= ROUGH * most;
    let deforms = !fitted.is_ball && fitted.bent.is_some_and(|bent| bent <= DEFORMS);
    let is_explained = fitted.error <= most
        || fitted.unturned.is_some_and(explains)
        || (!fitted.is_surrounded && fitted.bent.is_some_and(bends_no_better));
    is_explained && !deforms
}

/// What work found, or `None` where the time of a budget ended before.
pub(super) fn in_time<T>(found: Result<T, TrainError>) -> Result<Option<T>, TrainError> {
    match found {
        Err(TrainError::OutOfTime) => Ok(None),
        found => found.map(Some),
    }
}

/// Objects that were given Gaussians before the fine stage.
#[derive(Default)]
pub(super) struct Added {
    /// What moves as a whole.
    pub(super) posed: Vec<Posed>,
    /// What deforms, with the row of its first Gaussian.
    pub(super) bending: Vec<(usize, Bending)>,
}

impl Trainer {
    /// Finds objects that move although no path of theirs shows it: a little, late, or in place.
    pub(super) fn find_other_movers(&mut self) -> Result<(), TrainError> {
        let travelling = &self.state.guidance.travelling;
        let others: Vec<u16> = (1..travelling.len()).filter(|k| !travelling[*k]).map(|k| k as u16).collect();
        if others.is_empty() {
            return Ok(());
        }
        let plane = self.support()?;
        let left_out = self.fit_objects(Phase::Search, &others, plane.as_ref())?;
        for label in &others {
            if self.state.objects.is_found(*label) {
                self.state.guidance.travelling[usize::from(*label)] = true;
            }
        }
        self.note_left_out(&left_out, "taken to rest");
        self.find_parts(&others, plane.as_ref())
    }

    /// Fits the travelling objects that were not fitted yet.
    pub(super) fn fit_travelling(&mut self) -> Result<(), TrainError> {
        let travelling = self.state.guidance.travelling.iter().enumerate().filter(|(_, travels)| **travels);
        let rest: Vec<u16> = travelling
            .map(|(label, _)| label as u16)
            .filter(|label| !self.state.objects.is_found(*label))
            .collect();
        if rest.is_empty() {
            return Ok(());
        }
        let plane = self.support()?;
        let left_out = self.fit_objects(Phase::Objects, &rest, plane.as_ref())?;
        self.note_left_out(&left_out, "moved by the deformation network, not by poses of their own");
        Ok(())
    }

    /// Notes the objects for which a budget left no time, and what is made of them instead.
    pub(super) fn note_left_out(&mut self, labels: &[u16], instead: &str) {
        let name = |label: &u16| self.state.field.instances[usize::from(*label) - 1].label.as_str();
        let names: Vec<&str> = labels.iter().map(name).collect();
        if !names.is_empty() {
            let message = format!("the budget leaves no time to fit {}: {instead}", names.join(", "));
            self.messages.push(TrainEvent::note(message));
        }
    }

    /// Refuses motion that is declared of objects that there are not.
    pub(super) fn check_declared(&self) -> Result<(), TrainError> {
        let labels: Vec<String> = self.state.field.instances.iter().map(|i| i.label.clone()).collect();
        match self.state.config.motion.of.keys().find(|label| !labels.contains(label)) {
            None => Ok(()),
            Some(label) => Err(TrainError::UnknownObject {
                root: self.state.dataset.root.clone(),
                label: label.clone(),
                known: known_names(label, "there are", &labels),
            }),
        }
    }

    /// The plane that objects stand on: in the points of the capture, in those of them that lie below objects or, where
    /// it has none, in what is reconstructed so far.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(super) fn support(&self) -> Result<Option<Plane>, TrainError> {
        let (state, seed) = (&self.state, self.state.config.seed);
        let _phase = state.phases.enter(Phase::Paths, 0);
        if state.dataset.points.source != PointSource::Random {
            return match objects::support(&state.dataset, &state.dataset.points.positions, seed) {
                Some(plane) => Ok(Some(plane)),
                None => objects::support_below(&state.dataset, &state.frames, seed, &state.phases),
            };
        }
        Ok(objects::support(&state.dataset, &self.seen_surfaces()?, seed))
    }

    /// Points of the surfaces that training views see of what is reconstructed so far; none where all see it from about one
    /// place, so that its depths are guesses.
    fn seen_surfaces(&self) -> Result<Vec<[f32; 3]>, TrainError> {
        let state = &self.state;
        let settings = RenderSettings { deform: false, ..state.color_settings() };
        let mut renderer = Renderer::new(self.simd);
        let (mut points, mut depths_seen, mut centres) = (Vec::new(), Vec::new(), Vec::new());
        for view in (0..state.frames.len()).step_by(state.frames.len().div_ceil(LOOKS)) {
            state.phases.check()?;
            let frame = &state.dataset.frames[state.frames.index(view)];
            let channels = Channels { depth: true, instances: false };
            let seen = renderer.render(&state.field, &frame.camera, frame.time, &settings, channels);
            let Some(depths) = &seen.depth else { continue };
            let origin = frame.camera.centre();
            centres.push(origin);
            for y in (0..depths.height).step_by(APART) {
                for x in (0..depths.width).step_by(APART) {
                    if *seen.alpha.at(x, y) > OPAQUE {
                        let ray = frame.camera.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                        let depth = f64::from(*depths.at(x, y));
                        depths_seen.push(depth);
                        points.push((origin + depth * ray).as_vec3().to_array());
                    }
                }
            }
        }
        let far = |centre: &DVec3| centres.iter().map(|other| other.distance(*centre)).fold(0.0, f64::max);
        let apart = centres.iter().map(far).fold(0.0, f64::max);
        depths_seen.sort_by(f64::total_cmp);
        let shows_depths =
            depths_seen.get(depths_seen.len() / 2).is_some_and(|middle| apart > PARALLAX * middle);
        Ok(if shows_depths { points } else { Vec::new() })
    }

    /// Facts that fits of objects need.
    pub(super) fn surroundings<'a>(&'a self, plane: Option<&'a Plane>, order: &'a Order) -> Surroundings<'a> {
        let state = &self.state;
        Surroundings {
            plane,
            up: objects::up(&state.dataset),
            order,
            times: state.dataset.times.len(),
            near: state.near,
            seed: state.config.seed,
            gaussians: state.config.motion.gaussians as usize,
            phases: &state.phases,
        }
    }

    /// Fits rigid motions of those objects (labels: dense index + 1) of which nothing is known yet, in a phase; returns
    /// those that a budget left no time for.
    fn fit_objects(
        &mut self,
        phase: Phase,
        labels: &[u16],
        plane: Option<&Plane>,
    ) -> Result<Vec<u16>, TrainError> {
        let known = &self.state.objects.rigid;
        let unknown: Vec<u16> = labels.iter().filter(|label| !known.contains_key(*label)).copied().collect();
        if unknown.is_empty() || !self.state.config.motion.rigid {
            return Ok(Vec::new());
        }
        self.fit_unknown(phase, &unknown, plane)
    }

    /// Fits objects of which nothing is known yet, and keeps what is found, also where the run is stopped meanwhile;
    /// returns those that a budget left no time for.
    fn fit_unknown(
        &mut self,
        phase: Phase,
        labels: &[u16],
        plane: Option<&Plane>,
    ) -> Result<Vec<u16>, TrainError> {
        let state = &self.state;
        let entered = state.phases.enter(phase, labels.len());
        let order = Order::of(&state.dataset, &state.frames, &state.phases)?;
        entered.until(self.deadline(phase));
        let surroundings = self.surroundings(plane, &order);
        let most = MOST_ERROR[usize::from(state.dataset.points.source == PointSource::Random)];
        let candidates: Vec<(u16, Option<ObjectMotion>)> =
            labels.iter().map(|label| (*label, self.state.told(*label))).collect();
        let fit = |(label, declared): &(u16, Option<ObjectMotion>)| {
            let is_declared = *declared == Some(ObjectMotion::Rigid);
            let found = if *declared == Some(ObjectMotion::Free) {
                Some(Found::Nothing)
            } else {
                in_time(objects::fit(*label, &state.dataset, &state.frames, surroundings, is_declared))?
            };
            state.phases.advance();
            Ok(match found {
                Some(Found::Moves(fitted)) if !is_declared && !is_rigid(&fitted, most) => {
                    Some(Found::Nothing)
                }
                found => found,
            })
        };
        let found: Vec<Result<Option<Found>, TrainError>> = candidates.par_iter().map(fit).collect();
        drop(entered);
        let (mut left_out, mut failed) = (Vec::new(), None);
        for (label, found) in labels.iter().zip(found) {
            match found {
                Ok(Some(Found::Turns(part))) => self.state.objects.insert_turning(*label, *part),
                Ok(Some(found)) => drop(self.state.objects.rigid.insert(*label, found)),
                Ok(None) => left_out.push(*label),
                Err(error) => failed = failed.or(Some(error)),
            }
        }
        failed.map_or(Ok(left_out), Err)
    }

    /// Gives an object (a label: dense index + 1) that was fitted Gaussians, in a group where it has poses; false where it was
    /// not. What moves as a whole or deforms joins `added`.
    pub(super) fn add_object(&mut self, label: u16, added: &mut Added) -> bool {
        let instance = self.state.field.instances[usize::from(label) - 1].clone();
        let name = &instance.label;
        if let Some(fitted) = self.state.objects.moving(label).cloned() {
            let how = match fitted.rotation {
                RotationEvidence::Observed => "",
                RotationEvidence::Assumed => ", which the pictures do not tell: assumed",
            };
            self.messages.push(TrainEvent::note(format!(
                "{name} moves as a whole: {}{how} (error {:.3} on pixels left out)",
                fitted.way, fitted.error
            )));
            let group = self.join(&instance, &fitted);
            added.posed.push(Posed { label, group });
            return true;
        }
        if let Some(found) = self.state.objects.jointed(label).cloned() {
            self.add_parts(&instance, &found);
            return true;
        }
        if let Some(found) = self.state.objects.bending.get(&label).cloned() {
            self.messages.push(TrainEvent::note(format!(
                "{name} rests, but deforms (error {:.3} on pixels left out)",
                found.error
            )));
            let first = self.add_deforming(&found);
            added.bending.push((first, found));
            return true;
        }
        self.messages.extend(self.warning_without_poses(label, name));
        false
    }

    /// The warning that belongs to a travelling object without poses; none where a budget left no time for them, which
    /// was noted.
    fn warning_without_poses(&self, label: u16, name: &str) -> Option<TrainEvent> {
        let is_set = self.state.told(label) == Some(ObjectMotion::Rigid);
        let message = match self.state.objects.rigid.get(&label) {
            Some(Found::Nowhere) => format!(
                "{name}: depth uncertain: one camera sees it, and nothing that it stands on is known, so its size and \
                 distance are guesses{}",
                if is_set {
                    "; it is set to be rigid, but without them it has no poses: a second camera would show them"
                } else {
                    ""
                }
            ),
            None if self.state.config.motion.rigid => return None,
            _ if is_set => format!(
                "{name} is set to be rigid, but its poses were not found, so that the deformation network moves it: no \
                 motion along what objects stand on, and none followed from image to image, explains its masks and \
                 colours. What is turned in a hand before one camera is not found yet; several cameras at once, or \
                 larger masks without gaps, show more"
            ),
            _ => return None,
        };
        Some(TrainEvent::warning(message))
    }

    /// Adds the Gaussians of an object to the field, where the best of its poses puts them, in a group of their own, of
    /// which it returns the place.
    fn join(&mut self, instance: &Instance, fitted: &Fitted) -> u32 {
        let (rotation, place) = fitted.reference;
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
        let rotation = Some(fitted.rotation);
        let group = TrackGroup { poses, rotation, ..TrackGroup::of_instance(instance, place) };
        let shares: Vec<f64> = fitted.shares.values().copied().collect();
        self.add_group(fitted.placed(), group, &shares)
    }

    /// Adds Gaussians to the field, in a group of their own that skips the network; returns its place. Its poses are
    /// trained at `shares` of the common rate.
    pub(super) fn add_group(&mut self, rows: Gaussians, group: TrackGroup, shares: &[f64]) -> u32 {
        self.state.pose_moments.extend(shares);
        let before = self.append(rows);
        let field = &mut self.state.field;
        let now = field.len();
        let tracks = field.tracks.get_or_insert_with(Tracks::default);
        let place = tracks.groups.len() as u32;
        tracks.group_of.resize(before, NO_GROUP);
        tracks.group_of.resize(now, place);
        tracks.groups.push(group);
        if let Some(deformation) = &mut field.deformation {
            deformation.still.resize(before, false);
            deformation.still.resize(now, true);
        }
        place
    }

    /// Adds Gaussians to the field, as occupied as all are at first; returns the row of the first.
    pub(super) fn append(&mut self, mut rows: Gaussians) -> usize {
        rows.occupancy_logits.fill(logit(self.state.config.instance.occupancy));
        let first = self.state.field.len();
        self.state.field.gaussians.append(&rows);
        first
    }

    /// Adds the Gaussians of an object that deforms to the field, which the network moves and nothing holds; returns the row
    /// of the first.
    fn add_deforming(&mut self, found: &Bending) -> usize {
        let first = self.append(found.placed());
        self.state.guidance.extend(first, found.gaussians.len(), FREE);
        first
    }

    /// Rate of the poses at a step of a stage; 0 where they stay.
    pub(super) fn pose_rate(&self, stage: Stage, iteration: u32) -> f64 {
        let config = &self.state.config;
        let steps = config.fine_iterations().max(1);
        let visits =
            f64::from(steps) * f64::from(config.stages.batch) / self.state.dataset.times.len() as f64;
        // Mean of rates that fall log-linearly, of the first.
        let mean = f64::from((LAST - 1.0) / LAST.ln());
        let rate = (TRAVEL / (mean * visits)).min(FASTEST);
        let share = match stage {
            Stage::Fine if iteration > FROZEN.min(steps / 4) => log_linear([1.0, LAST], iteration, steps),
            Stage::Instance => LAST,
            _ => 0.0,
        };
        rate * f64::from(share)
    }
}

#[cfg(test)]
mod tests {
    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::*;

    #[test]
    fn poses_go_as_far_in_long_stages_as_in_short_ones() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene::default());
        let times = dataset.times.len() as f64;
        let mut trainer = Trainer::new(dataset, small_config()).unwrap();
        let mut way = |steps: u32| -> f64 {
            trainer.state.config.stages.fine = steps;
            let rates = (1..=steps).map(|step| trainer.pose_rate(Stage::Fine, step));
            rates.sum::<f64>() / times
        };
        // All but what the steps in which poses stay would add.
        for steps in [4_000, 40_000] {
            let share = way(steps) / TRAVEL;
            assert!((0.75..=1.0).contains(&share), "{share} in {steps} steps");
        }
        assert!(way(100) < 0.5 * TRAVEL, "no step is too large");
        assert_eq!(trainer.pose_rate(Stage::Coarse, 1), 0.0);
        assert!(trainer.pose_rate(Stage::Instance, 1) > 0.0);
    }

    #[test]
    fn without_points_what_is_seen_of_the_reconstruction_tells_the_support() {
        let folder = tempfile::tempdir().unwrap();
        let mut dataset = capture(folder.path(), Scene::default());
        dataset.points.source = PointSource::Random;
        let mut trainer = Trainer::new(dataset, small_config()).unwrap();
        // A slab before the cameras, which see one side of it.
        let (side, reach) = (40, 0.6 * trainer.state.dataset.extent());
        let centres: Vec<DVec3> = trainer.state.dataset.frames.iter().map(|f| f.camera.centre()).collect();
        let normal = centres.iter().sum::<DVec3>().normalize();
        let (first, second) = normal.any_orthonormal_pair();
        let place = |k: usize| {
            let at = |k: usize| reach * (2.0 * k as f64 / (side - 1) as f64 - 1.0);
            let layer = (k / (side * side)) as f64;
            (at(k % side) * first + at(k / side % side) * second - 0.1 * layer * reach * normal)
                .as_vec3()
                .to_array()
        };
        let places: Vec<[f32; 3]> = (0..3 * side * side).map(place).collect();
        let mut slab = Gaussians::from_points(&places, &vec![[0.5; 3]; places.len()]).unwrap();
        slab.log_scales.fill([(0.5 * reach / side as f64).ln() as f32; 3]);
        slab.opacity_logits.fill(4.0);
        trainer.state.field.gaussians = slab;
        let plane = trainer.support().unwrap().unwrap();
        let height = plane.height(DVec3::ZERO);
        assert!(plane.normal.dot(normal) > 0.999 && height.abs() < 0.01 * reach, "{plane:?}, {height}");
        trainer.state.field.gaussians.opacity_logits.fill(-4.0);
        assert_eq!(trainer.support().unwrap(), None);
    }
}
