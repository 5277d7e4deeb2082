//! Ways of moving held against each other: each is fitted to some views, and judged on others that were left out.

use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::ops::Range;

use cif_field::tracks::RotationEvidence;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::ball;
use super::bend;
use super::fit::{Fit, Turns};
use super::object::{Followed, Object, Started};
use super::outline::Outline;
use super::path::smooth;
use super::rotation::{Course, Revolving, Rivals, shown};
use super::shape::Pose;
use super::split::{SplitViews, times_of};
use super::texture;
use super::view::{ObjectView, are_discs};
use super::ways::{Paths, SMALLEST_SPIN, Way, is_round};
use crate::error::TrainError;

/// Gaussians of a trial.
pub(super) const GAUSSIANS: usize = 150;

/// Steps of a trial until hopeless ones are given up, and all of them.
pub(super) const STEPS: [usize; 2] = [300, 900];

/// Loss beyond the best at which a trial is hopeless.
const HOPELESS: f64 = 1.2;

/// Error of resting, relative to that of sliding without a turn, and to that of the way that is kept, up to which an
/// object is taken to rest.
pub(super) const REST_GAIN: [f64; 2] = [1.5, 1.15];

/// Steps of poses of times that were left out.
const SETTLE: usize = 40;

/// Error of the smallest turn in place, relative to that of one whose angle the pictures do not show, from which it turns
/// at all: what deforms is explained by any of them.
const SPIN_GAIN: f64 = 1.12;

/// Error from which neither resting nor sliding explains what is seen, where one camera sees it from about one side and
/// where it is seen from several, and that of a way that does, of it.
const UNEXPLAINED: [f64; 2] = [0.3, 0.1];
const EXPLAINED: f64 = 0.5;

/// Error from which an object may be one that bends.
const DOUBTED: f64 = 0.1;

/// Error of bending, of that of a rigid object, from which it explains no better.
pub(crate) const BENDS_NO_BETTER: f64 = 0.98;

/// Error of bending in one place, of that of the best motion of a rigid object, up to which an object is taken to deform
/// where it stands: what deforms is followed by motions that it does not have. Of five rendered jellies and two cloths
/// 0.8 to 1.31, of rigid objects on their way 1.73 and more.
pub(super) const BENDS_IN_PLACE: f64 = 1.5;

/// Error of resting, of that of the best motion, from which bending in place is not tried: of the same jellies it leaves
/// 0.36 to 0.77 of the former.
const BENT_AWAY: f64 = 5.0;

/// Largest error of turning in place.
const MOST_IN_PLACE: f64 = 0.1;

/// Error of an object that was followed, relative to that of paths, below which following is preferred: of most
/// objects, and of round ones, which it turns so that shading stays on them.
const FOLLOW_GAIN: [f64; 2] = [0.98, 0.85];

/// Error of an object on its support where it moves, relative to that where it is at rest, from which it may be off it, and
/// the largest error of it off its support, relative to that on it, at which it is.
const STRAINED: f64 = 1.15;
const OFF_GAIN: f64 = 0.85;

/// Largest error of turning as texture shows, relative to the best other way: a few Gaussians without texture prefer no
/// turn.
const TEXTURE_GAIN: f64 = 1.3;

/// Share of the pixels of an object that a solid of revolution about an axis covers, from which it is one, and how much more one
/// across its path covers than one about the upright axis, from which it lies, and rolls. Bars and a can that roll: 0.83 and
/// 0.31 more and above, others at most 0.12 more.
const LIES: [f64; 2] = [0.8, 0.2];

/// Largest error of rolling, relative to that of sliding, at which rolling is preferred: of most objects, and of round
/// ones.
const ROLL_GAIN: [f64; 2] = [0.97, 0.94];

/// Error by which rivals must be distinguished, relative: of most objects, and of round ones, whose shading prefers no
/// turn; and the turn from which they are rivals, degrees.
const RIVAL: ([f64; 2], i32) = ([1.02, 1.06], 60);

/// Largest error of rolling, relative to that of sliding, at which it is assumed where no turn is known.
const ROLLS_AS_WELL: f64 = 1.015;

/// The same of sliding with a turn of [`RIVAL`] degrees or more, which few things do.
const ROLLS_RATHER: f64 = 1.03;

/// Difference of errors up to which turns of round things are the same.
const SAME: f64 = 0.002;

/// Most rivals that are tried again with all pixels, of paths and of rolls, their errors relative to the best, of
/// rolls the second, and Gaussians and steps.
const RIVALS: usize = 3;
const CLOSE: f64 = 1.12;
const FAR: f64 = 1.3;
const FINE: (usize, usize) = (800, 1500);

/// A way of moving under way.
struct Trial<'a> {
    way: Way,
    fit: Fit<'a>,
    /// Loss on the views it is fitted to, and on those left out.
    losses: [f64; 2],
}

/// Facts that all trials of an object share.
struct Contest<'a> {
    object: Object<'a>,
    paths: Paths<'a>,
    /// Views that show it well.
    reliable: Vec<usize>,
    /// The same, as trials are fitted to them and judged by them.
    views: SplitViews,
    /// Times of which no view is fitted to, so that their poses lie between those of others.
    between: Vec<usize>,
    /// True where following leads to other turns from another start, which explain as much.
    is_undecided: bool,
}

/// Trials of resting and of sliding without a turn, in numbers.
struct Simple {
    /// Error of resting, on the views that were left out.
    at_rest: Option<f64>,
    /// True where resting explains about as much as sliding.
    stays: bool,
    /// True where neither explains what is seen.
    is_unexplained: bool,
}

/// A motion that is kept.
struct Chosen {
    /// Way of moving.
    way: Way,
    /// Evidence of its turns.
    rotation: RotationEvidence,
    /// Way whose fit it is made from.
    fitted: Way,
    /// True where the images show its turns; `None` where that was not asked yet.
    is_shown: Option<bool>,
}

/// The best way of moving of an object that is seen well at enough times; `None` where it is at rest.
pub(super) fn best_way<'a>(
    object: Object<'a>,
    path: BTreeMap<usize, DVec3>,
    reliable: &[usize],
) -> Result<Option<Started<'a>>, TrainError> {
    let mut contest = Contest::new(object, reliable);
    let mut trials = contest.simple()?;
    let simple = contest.judged_simple(&trials);
    if !contest.may_be_followed() {
        contest.judge(&mut trials, false);
    }
    let unturned = error_of(&trials, Way::Slide(0));
    let resting = contest.bendable(&trials, &simple);
    let Some(trials) = contest.worthwhile(trials, &simple)? else { return Ok(None) };
    let Some(chosen) = contest.chosen(&trials) else { return Ok(None) };
    let Some(Trial { mut fit, losses: [_, error], .. }) =
        trials.into_iter().find(|trial| trial.way == chosen.fitted)
    else {
        return Ok(None);
    };
    if simple.at_rest.is_some_and(|at_rest| at_rest <= BENT_AWAY * error)
        && let Some((fit, level)) = resting
        && bend::bent(&fit, &contest.views, level) <= BENDS_IN_PLACE * error
    {
        return Ok(None);
    }
    let may_bend = !object.is_declared && chosen.way != Way::Lies;
    let bent = (error > DOUBTED && may_bend).then(|| bend::gain(&fit, &contest.views, fit.trial_level()));
    if contest.deforms(chosen.way, error, bent, &simple) {
        return Ok(None);
    }
    contest.hold(&mut fit, &chosen);
    let Chosen { way, rotation, .. } = chosen;
    let is_turned = rotation == RotationEvidence::Observed;
    let is_shown = match chosen.is_shown {
        Some(is_shown) if way == Way::Followed => is_shown,
        // Its rolling is put on afterwards.
        _ if chosen.fitted != way => contest.shows(way, &contest.paths.poses(way)),
        _ => contest.shows(way, &fit.poses),
    };
    let is_decided = way != Way::Followed || !contest.is_undecided;
    let rotation =
        if is_shown && is_decided { RotationEvidence::Observed } else { RotationEvidence::Assumed };
    // Light, which stays where it is, argues against rolling: how rigid it is shows where it does not turn, too.
    let error = unturned.filter(|_| way == Way::Lies).map_or(error, |unturned| unturned.min(error));
    let reference = contest.paths.reference;
    Ok(Some(Started { fit, path, way, rotation, is_turned, error, unturned, bent, reference }))
}

impl<'a> Contest<'a> {
    /// A contest over the views that show an object well, in the order of times.
    fn new(object: Object<'a>, reliable: &[usize]) -> Self {
        let Object { views, outline, surroundings, .. } = object;
        let good = times_of(views, reliable);
        let raw: BTreeMap<usize, DVec3> = good.iter().map(|time| (*time, outline.path[time])).collect();
        let along = smooth(&raw, views, surroundings.times, outline);
        let reference = object.best_seen(good.iter().copied()).unwrap_or(good[0]);
        let split = SplitViews::of(views, reliable);
        let is_trained = |time: usize| split.train.iter().any(|view| views[*view].time_index == time);
        let left_out = split.left_out.iter().map(|view| views[*view].time_index);
        Self {
            object,
            between: left_out.filter(|time| !is_trained(*time)).collect(),
            paths: Paths {
                place: object.resting_place(reliable).unwrap_or(along[&reference]),
                along,
                outline,
                up: surroundings.plane.map_or(surroundings.up, |plane| plane.normal),
                stands: surroundings.plane.is_some(),
                reference,
                followed: None,
                off: Vec::new(),
                turned: None,
            },
            reliable: reliable.to_vec(),
            views: split,
            is_undecided: false,
        }
    }

    /// The simple trials in numbers.
    fn judged_simple(&self, trials: &[Trial<'_>]) -> Simple {
        Simple {
            at_rest: error_of(trials, Way::Rest),
            stays: is_at_rest(trials, Way::Slide(0), REST_GAIN[0]),
            is_unexplained: self.is_unexplained(trials),
        }
    }

    /// The fit at rest, with the level of its trial, of an object that may deform in place.
    fn bendable(&self, trials: &[Trial<'a>], simple: &Simple) -> Option<(Fit<'a>, usize)> {
        let object = self.object;
        let may_deform =
            !object.is_declared && object.outline.roundness < 1.0 && (!simple.stays || simple.is_unexplained);
        let Trial { fit, .. } = trials.iter().find(|trial| may_deform && trial.way == Way::Rest)?;
        Some((object.fit(fit.poses.clone(), fit.shape.copied(), fit.rng.clone()), fit.trial_level()))
    }

    /// Trials of the ways that may explain what the simple ones, which are given, do not; `None` where it is at rest.
    fn worthwhile(
        &mut self,
        trials: Vec<Trial<'a>>,
        simple: &Simple,
    ) -> Result<Option<Vec<Trial<'a>>>, TrainError> {
        let Simple { stays, is_unexplained, .. } = *simple;
        if let Some(textured) = self.textured(&trials, stays)? {
            return Ok(Some(vec![textured]));
        }
        if self.object.is_declared {
            return self.along_the_path(trials).map(Some);
        }
        if stays && !is_unexplained {
            let may_turn = self.paths.may_turn_unseen(self.object.views);
            return may_turn.then(|| self.finely(&self.paths.spins())).transpose();
        }
        let moves = self.paths.shifts() || is_unexplained;
        moves.then(|| self.along_the_path(trials)).transpose()
    }

    /// The motion that explains most of what trials were judged by; `None` where it is at rest.
    fn chosen(&self, trials: &[Trial<'_>]) -> Option<Chosen> {
        let Object { outline, is_declared, .. } = self.object;
        let followed = trials.iter().find(|trial| trial.way == Way::Followed);
        let shown = OnceCell::new();
        let is_shown = || {
            *shown.get_or_init(|| {
                followed.is_some_and(|followed| self.shows(Way::Followed, &followed.fit.poses))
            })
        };
        let (way, rotation) = decide(&meant(errors(trials), outline, is_shown), outline)
            .filter(|(way, _)| is_declared || !is_at_rest(trials, *way, REST_GAIN[1]))?;
        if rotation == RotationEvidence::Assumed && !is_declared && !turns(|way| error_of(trials, way), way) {
            return None;
        }
        // The path of a ball whose turn does not show is best where none is looked for; its rolling is put on afterwards.
        let rolls_unseen = rotation == RotationEvidence::Assumed && matches!(way, Way::Roll(_));
        let slides = error_of(trials, Way::Slide(0)).is_some();
        let fitted = if rolls_unseen && slides { Way::Slide(0) } else { way };
        Some(Chosen { way, rotation, fitted, is_shown: shown.get().copied() })
    }

    /// True where an object deforms, or opens: it stays in place, and looks otherwise in every turn.
    fn deforms(&self, way: Way, error: f64, bent: Option<f64>, simple: &Simple) -> bool {
        let most = match simple.at_rest {
            _ if matches!(way, Way::Spin(_) | Way::Turns) => MOST_IN_PLACE,
            Some(at_rest) if simple.stays && simple.is_unexplained => EXPLAINED * at_rest,
            _ => f64::INFINITY,
        };
        // Of thin things the outline, which is never exact, is most of what is seen: they are solid where bending explains
        // no more.
        let may_be_solid = !self.object.outline.is_surrounded
            && !matches!(way, Way::Spin(_) | Way::Turns)
            && bent.is_some_and(|bent| bent >= BENDS_NO_BETTER);
        error > most && !self.object.is_declared && !may_be_solid
    }

    /// Holds the turns of a fit to what is known of them.
    fn hold(&self, fit: &mut Fit<'_>, chosen: &Chosen) {
        let outline = self.object.outline;
        let Chosen { way, rotation, fitted, .. } = *chosen;
        if rotation == RotationEvidence::Assumed && fitted == Way::Slide(0) && is_round(outline) {
            fit.poses.values_mut().for_each(|pose| pose.rotation = DQuat::IDENTITY);
        }
        (fit.turns, fit.rolls) = match (rotation, way) {
            (RotationEvidence::Assumed, Way::Roll(_)) => (Turns::Free, None),
            (RotationEvidence::Assumed, _) => (Turns::Given, None),
            (_, Way::Roll(factor)) => (Turns::Free, Some(outline.height / factor)),
            // Light, which stays where it is, would pull it back.
            (_, Way::Textured | Way::Lies | Way::Turns) => (Turns::Given, None),
            _ => (Turns::Free, None),
        };
    }

    /// True where the images show the turns of the poses of a way, and not those of any that differs.
    fn shows(&self, way: Way, poses: &Course) -> bool {
        let paths = &self.paths;
        let (rolls, others): (Vec<Way>, Vec<Way>) =
            paths.ways().into_iter().chain(paths.spins()).partition(|way| matches!(way, Way::Roll(_)));
        let courses = |ways: Vec<Way>| ways.into_iter().map(|way| paths.poses(way)).collect::<Vec<_>>();
        let mut others = courses(others);
        let by_outlines = way == Way::Followed;
        if by_outlines {
            // Paths have their turns among the ways.
            others.extend(paths.twisted(poses));
        }
        let unturned = paths.poses(Way::Slide(0));
        let rivals = Rivals { unturned, rolls: courses(rolls), others, by_outlines };
        shown(self.object.views, self.object.outline.size(), poses, rivals)
    }

    /// Trials of resting, and of moving along the path without a turn: most objects that do not travel rest, and poses that
    /// are moved onto rough masks explain more than rest does. What may be followed is judged as it will be.
    fn simple(&self) -> Result<Vec<Trial<'a>>, TrainError> {
        let mut trials = self.begin(&[Way::Rest, Way::Slide(0)], GAUSSIANS);
        self.advance(&mut trials, 0..STEPS[1], false)?;
        self.judge_as(&mut trials, false, self.may_be_followed());
        Ok(trials)
    }

    /// Turning as texture shows, where it does and the outline says nothing else, or rolling of what lies on its side.
    fn textured(&mut self, simple: &[Trial<'_>], stays: bool) -> Result<Option<Trial<'a>>, TrainError> {
        let Some((way, poses)) = self.turned(simple, stays) else { return Ok(None) };
        self.paths.turned = Some(poses);
        let mut trials = self.begin(&[way], GAUSSIANS);
        self.advance(&mut trials, 0..STEPS[1], false)?;
        self.judge(&mut trials, false);
        let least = simple.iter().map(|trial| trial.losses[1]).fold(f64::INFINITY, f64::min);
        let is_kept = |error: f64| way == Way::Lies || error <= TEXTURE_GAIN * least;
        Ok(trials.pop().filter(|trial| is_kept(trial.losses[1])))
    }

    /// Poses of rolling of what lies, or with turns that its texture shows.
    fn turned(&self, simple: &[Trial<'_>], stays: bool) -> Option<(Way, BTreeMap<usize, Pose>)> {
        let (outline, paths) = (self.object.outline, &self.paths);
        let seen: Vec<&ObjectView> = self.reliable.iter().map(|view| &self.object.views[*view]).collect();
        if !stays && let Some(lying) = self.lying(simple, &seen) {
            return Some((Way::Lies, lying));
        }
        if let Some(turns) = texture::turns(seen.iter().copied(), &paths.along, outline, paths.up) {
            return Some((Way::Textured, paths.along_with(&turns)));
        }
        // What stays in place neither rolls nor flies.
        if !paths.shifts() {
            return Some((Way::Turns, self.turning(&seen)?));
        }
        let turns = ball::turns(&seen, &paths.along, outline, &paths.rolls())?;
        Some((Way::Textured, paths.along_with(&turns)))
    }

    /// Poses of turning in place about the upright axis, where the object is a solid of revolution about it, and its paint
    /// shows turns.
    fn turning(&self, seen: &[&ObjectView]) -> Option<BTreeMap<usize, Pose>> {
        let (paths, size) = (&self.paths, self.object.outline.size());
        if is_round(self.object.outline) || self.object.surroundings.plane.is_none() {
            return None;
        }
        let rest = paths.poses(Way::Rest);
        let revolving = Revolving::new(seen.iter().copied(), size, &rest, paths.up, None)?;
        if revolving.covered(paths.up) > LIES[0] { revolving.turned(paths.up) } else { None }
    }

    /// Poses of rolling without slip about an axis across the path, where the object is a solid of revolution about it.
    fn lying(&self, simple: &[Trial<'_>], seen: &[&ObjectView]) -> Option<BTreeMap<usize, Pose>> {
        if are_discs(seen.iter().copied()) {
            return None;
        }
        let slides = simple.iter().find(|trial| trial.way == Way::Slide(0))?;
        let height = self.object.surroundings.plane.and_then(|plane| {
            let heights = slides.fit.poses.values().map(|pose| plane.height(pose.translation));
            cif_geometry::stats::median(&mut heights.collect::<Vec<_>>())
        });
        let revolving = Revolving::new(
            seen.iter().copied(),
            self.object.outline.size(),
            &slides.fit.poses,
            self.paths.up,
            height,
        )?;
        let axis = self.paths.across()?;
        let covered = revolving.covered(axis);
        let lies = covered > LIES[0] && covered > LIES[1] + revolving.covered(self.paths.up);
        if lies { revolving.rolled(axis) } else { None }
    }

    /// True where views of all sides show how it turns from time to time, or it is lifted from where it stood, so that
    /// its path does not show it.
    fn may_be_followed(&self) -> bool {
        let outline = self.object.outline;
        outline.is_surrounded
            || (!is_round(outline) && !self.object.runs_at_rest(&self.paths.along).is_empty())
    }

    /// True where following may find what neither resting nor sliding explains.
    fn is_unexplained(&self, simple: &[Trial<'_>]) -> bool {
        let least = UNEXPLAINED[usize::from(self.object.outline.is_surrounded)];
        simple.iter().all(|trial| trial.losses[1] > least)
    }

    /// The object followed over the times of views that are fitted to: on its support where its path is, and off it if that
    /// explains more where it is not at rest, as of what is lifted and tilted, so that its size does not show it.
    fn follow(&self) -> Result<Option<Followed<'a>>, TrainError> {
        let (object, along) = (self.object, &self.paths.along);
        let views = &self.views.train;
        let Some(starts) = object.starts(along, &times_of(object.views, views)) else { return Ok(None) };
        let followed = |off: Option<&[usize]>| object.followed_from(&starts, along, views, off);
        let Some(mut on) = followed(None)? else { return Ok(None) };
        let at_rest: Vec<usize> = object.runs_at_rest(along).into_iter().flatten().collect();
        let (resting, moving): (Vec<usize>, Vec<usize>) =
            views.iter().partition(|view| at_rest.contains(&object.views[**view].time_index));
        if resting.is_empty() || !on.fit.air.is_empty() || !on.fit.is_held() {
            return Ok(Some(on));
        }
        let level = on.fit.trial_level();
        let error = on.fit.mean_loss(&moving, level);
        if error < STRAINED * on.fit.mean_loss(&resting, level) {
            return Ok(Some(on));
        }
        let moves: Vec<usize> = along.keys().copied().filter(|time| !at_rest.contains(time)).collect();
        let Some(mut off) = followed(Some(&moves))? else { return Ok(Some(on)) };
        let gains = off.fit.mean_loss(&moving, level) < OFF_GAIN * error;
        Ok(Some(if gains { off } else { on }))
    }

    /// All other ways along the path, in addition to the simple ones.
    fn along_the_path(&mut self, simple: Vec<Trial<'a>>) -> Result<Vec<Trial<'a>>, TrainError> {
        let mut trials = simple;
        if self.may_be_followed()
            && let Some(Followed { fit, is_decided }) = self.follow()?
        {
            (self.paths.followed, self.paths.off) = (Some(fit.poses), fit.air);
            self.is_undecided = !is_decided;
        }
        let ways = if self.object.place > 0 && self.paths.followed.is_some() {
            vec![Way::Followed]
        } else {
            self.paths.ways()
        };
        let mut more = self.begin(&ways, GAUSSIANS);
        self.advance(&mut more, 0..STEPS[0], false)?;
        give_up_hopeless(&mut more, |way| matches!(way, Way::Followed | Way::Roll(_)));
        self.advance(&mut more, STEPS[0]..STEPS[1], false)?;
        self.judge(&mut more, false);
        trials.extend(more);
        let rivals = rivals(&trials);
        // Shading prefers no turn of round things, at any resolution.
        if is_round(self.object.outline) || (rivals.len() < 2 && self.object.outlines < 2) {
            return Ok(trials);
        }
        self.finely(&rivals)
    }

    /// Trials with all pixels and small Gaussians, where fine texture may decide.
    fn finely(&self, ways: &[Way]) -> Result<Vec<Trial<'a>>, TrainError> {
        let mut trials = self.begin(ways, FINE.0);
        let early = FINE.1 / 3;
        self.advance(&mut trials, 0..early, true)?;
        give_up_hopeless(&mut trials, |way| way == Way::Rest);
        self.advance(&mut trials, early..FINE.1, true)?;
        self.judge(&mut trials, true);
        Ok(trials)
    }

    fn begin(&self, ways: &[Way], gaussians: usize) -> Vec<Trial<'a>> {
        let begin = |way: &Way| {
            let mut rng = self.object.rng();
            let mut poses = self.paths.poses(*way);
            let shape = self.object.hull(&poses, gaussians, &mut rng)?;
            for time in &self.between {
                poses.remove(time);
            }
            let mut fit = self.object.fit(poses, shape, rng);
            (fit.turns, fit.rolls) = match way {
                Way::Rest | Way::Lies | Way::Turns => (Turns::Given, None),
                Way::Slide(_) | Way::Spin(_) => (Turns::Upright, None),
                Way::Roll(factor) => (Turns::Free, Some(self.paths.outline.height / factor)),
                Way::Followed | Way::Textured => (Turns::Free, None),
            };
            if *way == Way::Followed {
                fit.air.clone_from(&self.paths.off);
            }
            fit.stays = matches!(way, Way::Rest | Way::Spin(_));
            Some(Trial { way: *way, fit, losses: [0.0; 2] })
        };
        ways.par_iter().filter_map(begin).collect()
    }

    /// A range of the steps of all trials.
    fn advance(&self, trials: &mut [Trial<'a>], steps: Range<usize>, finely: bool) -> Result<(), TrainError> {
        let all = if finely { FINE.1 } else { STEPS[1] };
        trials.par_iter_mut().for_each(|trial| {
            let level = if finely { 0 } else { trial.fit.trial_level() };
            let moves = if trial.way == Way::Rest { 0.0 } else { 1.0 };
            trial.fit.steps(&self.views.train, steps.len(), |share| {
                let done = steps.start as f64 + share * steps.len() as f64;
                let rate = if done < 0.5 * all as f64 { 1.0 } else { 0.5 };
                (rate, moves * rate, level)
            });
            trial.losses[0] = trial.fit.mean_loss(&self.views.train, level);
        });
        self.object.surroundings.phases.check()
    }

    /// Moves the poses of times that were left out onto their views, the shape as it is: an object moves otherwise than its
    /// neighbours in time imply, and how it looks from there is what is judged, not where it is.
    fn settle(&self, fit: &mut Fit<'_>, level: usize) {
        let mut shape = fit.shape.copied();
        let is_between = |view: &&usize| self.between.contains(&self.object.views[**view].time_index);
        for view in self.views.left_out.iter().filter(is_between) {
            let time = fit.views[*view].time_index;
            let Some(pose) = fit.poses.get(&time).copied() else { continue };
            let pose = fit.settled(&mut shape, &[*view], level, pose, SETTLE);
            fit.poses.insert(time, pose);
        }
    }

    /// Losses on the views that were left out, with poses of times between that are moved onto these.
    fn judge(&self, trials: &mut [Trial<'a>], finely: bool) {
        self.judge_as(trials, finely, true);
    }

    /// The same, or with poses of times between that lie between those of their neighbours.
    fn judge_as(&self, trials: &mut [Trial<'a>], finely: bool, settles: bool) {
        trials.par_iter_mut().for_each(|trial| {
            for time in &self.between {
                if let Some(pose) = trial.fit.pose_at(*time) {
                    trial.fit.poses.insert(*time, pose);
                }
            }
            let level = if finely { 0 } else { trial.fit.trial_level() };
            // A turn in place is judged by how far it is between.
            if settles && !trial.fit.stays {
                self.settle(&mut trial.fit, level);
            }
            trial.losses[1] = trial.fit.mean_loss(self.views.judged(), level);
        });
    }
}

/// Drops trials that are far from the best on the views that they are fitted to, but for ways that are always kept.
fn give_up_hopeless(trials: &mut Vec<Trial<'_>>, is_kept: impl Fn(Way) -> bool) {
    let best = trials.iter().map(|trial| trial.losses[0]).fold(f64::INFINITY, f64::min);
    trials.retain(|trial| trial.losses[0] <= HOPELESS * best || is_kept(trial.way));
}

/// Ways that are near the best: paths, rolls, and what following found.
fn rivals(trials: &[Trial<'_>]) -> Vec<Way> {
    let mut best = errors(trials);
    best.sort_by(|a, b| a.1.total_cmp(&b.1));
    let is_near = |factor: f64, error: f64| error < factor * best[0].1;
    let (mut paths, mut rolls, mut rivals) = (0, 0, Vec::new());
    for (way, error) in &best {
        // What turns about a long axis shows it by its texture alone.
        let (count, most, factor) = match way {
            Way::Roll(_) => (&mut rolls, RIVALS, FAR),
            Way::Rest | Way::Followed => (&mut 0, 1, FAR),
            _ => (&mut paths, RIVALS, CLOSE),
        };
        if *count < most && is_near(factor, *error) {
            *count += 1;
            rivals.push(*way);
        }
    }
    rivals
}

/// Error of a way that was tried, on the views that were left out.
fn error_of(trials: &[Trial<'_>], way: Way) -> Option<f64> {
    trials.iter().find(|trial| trial.way == way).map(|trial| trial.losses[1])
}

/// True of ways whose pictures show that it turns, if not how far: the smallest turn in place explains less.
fn turns(error_of: impl Fn(Way) -> Option<f64>, way: Way) -> bool {
    let Way::Spin(degrees) = way else { return true };
    let smallest = Way::Spin(SMALLEST_SPIN * degrees.signum());
    // What was given up explains less.
    let least = error_of(smallest).filter(|_| smallest != way);
    least.zip(error_of(way)).is_none_or(|(least, error)| least > SPIN_GAIN * error)
}

/// True where the error of resting is at most `gain` times that of a way of moving.
fn is_at_rest(trials: &[Trial<'_>], way: Way, gain: f64) -> bool {
    error_of(trials, Way::Rest).zip(error_of(trials, way)).is_some_and(|(rest, moves)| rest <= gain * moves)
}

/// Ways that were tried with their errors on the views that were left out.
fn errors(trials: &[Trial<'_>]) -> Vec<(Way, f64)> {
    trials.iter().map(|trial| (trial.way, trial.losses[1])).collect()
}

/// Ways without that of following where it shows nothing: it turns what is round so that shading stays on it, and the images
/// show no such turn.
fn meant(mut tried: Vec<(Way, f64)>, outline: &Outline, is_shown: impl FnOnce() -> bool) -> Vec<(Way, f64)> {
    let is_followed = |(way, _): &(Way, f64)| *way == Way::Followed;
    if is_round(outline) && tried.len() > 1 && tried.iter().any(is_followed) && !is_shown() {
        tried.retain(|tried| !is_followed(tried));
    }
    tried
}

/// The best way of moving, by the errors of those that were tried, and whether the pictures show its turns.
fn decide(tried: &[(Way, f64)], outline: &Outline) -> Option<(Way, RotationEvidence)> {
    let (is_round, in_contact) = (is_round(outline), outline.air.is_empty());
    let best = |fits: &dyn Fn(&Way) -> bool| {
        tried.iter().filter(|(way, _)| fits(way)).min_by(|a, b| a.1.total_cmp(&b.1)).copied()
    };
    let (moving, moving_error) = best(&|way| *way != Way::Rest)?;
    let roll = best(&|way| matches!(way, Way::Roll(_)));
    let Some((turning, turning_error)) = best(&|way| way.degrees().is_some()) else {
        return Some((moving, RotationEvidence::Observed));
    };
    let others = roll.map_or(turning_error, |(_, error)| error.min(turning_error));
    if moving == Way::Followed && moving_error < FOLLOW_GAIN[usize::from(is_round)] * others {
        return Some((moving, RotationEvidence::Observed));
    }
    if let Some((way, error)) = roll
        && error <= ROLL_GAIN[usize::from(is_round)] * turning_error
    {
        return Some((way, RotationEvidence::Observed));
    }
    let turns_far = turning.degrees().is_some_and(|degrees| degrees.abs() >= RIVAL.1);
    if let Some((way, error)) = roll
        && in_contact
        && turns_far
        && error <= ROLLS_RATHER * turning_error
    {
        return Some((way, RotationEvidence::Assumed));
    }
    let apart = |other: i32| {
        let difference = (other - turning.degrees().unwrap_or(0)).rem_euclid(360);
        difference.min(360 - difference) >= RIVAL.1
    };
    let rival = best(&|way| way.degrees().is_some_and(apart));
    let same = if is_round { SAME } else { 0.0 };
    let least = (RIVAL.0[usize::from(is_round)] * turning_error).max(turning_error + same);
    let has = |other: Way| tried.iter().any(|(way, _)| *way == other);
    // Where no turn of something round was tried, none is known.
    let is_untried = is_round && tried.iter().filter(|(way, _)| way.degrees().is_some()).count() < 2;
    if is_untried || rival.is_some_and(|(_, error)| error < least) {
        if is_round && in_contact && has(Way::Roll(1.0)) {
            return Some((Way::Roll(1.0), RotationEvidence::Assumed));
        }
        // What may roll without a change of its outline is made to.
        let rolls_as_well = |(_, error): &(Way, f64)| *error <= ROLLS_AS_WELL * turning_error;
        if let Some((way, _)) = roll.filter(|roll| in_contact && rolls_as_well(roll)) {
            return Some((way, RotationEvidence::Assumed));
        }
        if has(Way::Slide(0)) {
            return Some((Way::Slide(0), RotationEvidence::Assumed));
        }
        return Some((turning, RotationEvidence::Assumed));
    }
    Some((turning, RotationEvidence::Observed))
}

#[cfg(test)]
mod tests {
    use super::super::testing::shaped;
    use super::*;

    #[test]
    fn turns_that_nothing_shows_are_assumed() {
        let outline = |roundness: f64, air: Vec<usize>| Outline {
            air,
            ..shaped(0.05, 0.05, roundness, BTreeMap::new())
        };
        let slides = [(Way::Slide(0), 0.1), (Way::Slide(90), 0.101)];
        let with = |more: &[(Way, f64)]| [&slides[..], more].concat();
        let (edgy, round) = (outline(0.7, Vec::new()), outline(1.0, vec![3]));
        let assumed = |way: Way| Some((way, RotationEvidence::Assumed));
        // What may roll does, where it explains as much as sliding, and touches its support.
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.101)]), &edgy), assumed(Way::Roll(0.8)));
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.102)]), &edgy), assumed(Way::Slide(0)));
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.099)]), &outline(0.7, vec![3])), assumed(Way::Slide(0)));
        // What would have to turn far while it slides rolls, even a little worse.
        let turning = [(Way::Slide(-120), 0.1), (Way::Roll(1.08), 0.102)];
        assert_eq!(decide(&turning, &edgy), assumed(Way::Roll(1.08)));
        let observed = |way: Way| Some((way, RotationEvidence::Observed));
        assert_eq!(decide(&[(Way::Slide(-30), 0.1), turning[1]], &edgy), observed(Way::Slide(-30)));
        assert_eq!(decide(&[turning[0], (Way::Roll(1.08), 0.104)], &edgy), observed(Way::Slide(-120)));
        // Of a ball in the air no turn was tried but those that following found.
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.2)], &round), assumed(Way::Slide(0)));
        let followed = Some((Way::Followed, RotationEvidence::Observed));
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.05)], &round), followed);
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.09)], &round), assumed(Way::Slide(0)));
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.2)], &edgy), observed(Way::Slide(0)));
    }

    #[test]
    fn a_ball_that_is_followed_without_a_turn_that_shows_rolls() {
        // Errors of a ball that is thrown before a rig, bounces and rolls to rest.
        let tried = vec![
            (Way::Rest, 0.457),
            (Way::Slide(0), 0.0685),
            (Way::Slide(180), 0.0656),
            (Way::Roll(0.96), 0.0776),
            (Way::Roll(1.0), 0.0865),
            (Way::Followed, 0.0557),
        ];
        let outline = |roundness: f64| shaped(0.035, 0.035, roundness, BTreeMap::new());
        let decided = |roundness: f64, is_shown: bool| {
            let outline = outline(roundness);
            decide(&meant(tried.clone(), &outline, || is_shown), &outline)
        };
        assert_eq!(decided(1.0, false), Some((Way::Roll(1.0), RotationEvidence::Assumed)));
        assert_eq!(decided(1.0, true), Some((Way::Followed, RotationEvidence::Observed)));
        assert_eq!(decided(0.8, false), Some((Way::Followed, RotationEvidence::Observed)));
    }

    #[test]
    fn what_any_turn_in_place_explains_does_not_turn() {
        let with = |smallest: Option<f64>| {
            move |way: Way| if way == Way::Spin(SMALLEST_SPIN) { smallest } else { Some(0.04) }
        };
        assert!(!turns(with(Some(0.042)), Way::Spin(160)));
        assert!(turns(with(Some(0.05)), Way::Spin(160)));
        assert!(turns(with(None), Way::Spin(160)), "given up");
        assert!(turns(with(Some(0.042)), Way::Spin(SMALLEST_SPIN)));
        assert!(turns(with(Some(0.042)), Way::Slide(0)));
    }
}
