//! Ways of moving held against each other: each is fitted to some views, and judged on others that were left out.

use std::collections::BTreeMap;

use cif_field::tracks::RotationEvidence;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::ball;
use super::bend;
use super::fit::{Fit, Turns};
use super::follow::follow;
use super::outline::Outline;
use super::path::smooth;
use super::start::{Object, Started};
use super::texture;
use super::view::ObjectView;
use super::ways::{Bar, Paths, Way, is_round};
use crate::error::TrainError;
use crate::motion::Judge;

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

/// Error from which neither resting nor sliding explains what is seen, where one camera sees it from about one side and
/// where it is seen from several, and that of a way that does, of it.
const UNEXPLAINED: [f64; 2] = [0.3, 0.1];
const EXPLAINED: f64 = 0.5;

/// Error from which an object may be one that bends.
const DOUBTED: f64 = 0.1;

/// Error of bending, of that of a rigid object, from which it explains no better.
pub(crate) const BENDS_NO_BETTER: f64 = 0.98;

/// Error of an object that was followed, relative to that of paths, below which following is preferred where the judge
/// cannot tell: of most objects, and of round ones, which it turns so that shading stays on them.
const FOLLOW_GAIN: [f64; 2] = [0.98, 0.85];

/// Error of an object on its support where it moves, relative to that where it rests, from which it may be off it, and
/// the largest error of it off its support, relative to that on it, at which it is.
const STRAINED: f64 = 1.15;
const OFF_GAIN: f64 = 0.85;

/// Largest error of turning as texture tells, relative to the best other way: a few Gaussians without texture prefer
/// no turn.
const TEXTURE_GAIN: f64 = 1.3;

/// Largest error of rolling, relative to that of sliding, at which rolling is preferred: of most objects, and of round
/// ones.
const ROLL_GAIN: [f64; 2] = [0.97, 0.94];

/// Error by which rivals must be told apart, relative: of most objects, and of round ones, whose shading prefers no
/// turn; and the turn from which they are rivals, degrees.
const RIVAL: ([f64; 2], i32) = ([1.02, 1.06], 60);

/// Largest error of rolling, relative to that of sliding, at which it is assumed where no turn is told.
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

/// Finding of the judge about ways of moving.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Judged {
    way: Way,
    /// Its place among the hypotheses.
    place: usize,
    is_observed: bool,
}

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
    train: Vec<usize>,
    left_out: Vec<usize>,
    /// Times of which no view is fitted to, so that their poses lie between those of others.
    between: Vec<usize>,
}

/// The best way of moving of an object that is seen well at enough times; `None` where it rests.
pub(super) fn best_way<'a>(
    object: Object<'a>,
    path: BTreeMap<usize, DVec3>,
    (reliable, good): (&[usize], &[usize]),
) -> Result<Option<Started<'a>>, TrainError> {
    let Object { views, outline, surroundings, .. } = object;
    let raw: BTreeMap<usize, DVec3> = good.iter().map(|time| (*time, outline.path[time])).collect();
    let along = smooth(&raw, views, surroundings.times, outline);
    let reference = object.best_seen(good.iter().copied()).unwrap_or(good[0]);
    let (train, left_out) = split(views, reliable, good);
    let is_trained = |time: usize| train.iter().any(|view| views[*view].time_index == time);
    let between = left_out.iter().map(|view| views[*view].time_index).filter(|time| !is_trained(*time));
    let mut contest = Contest {
        object,
        between: between.collect(),
        paths: Paths {
            place: object.resting_place(reliable).unwrap_or(along[&reference]),
            along,
            outline,
            up: surroundings.plane.map_or(surroundings.up, |plane| plane.normal),
            stands: surroundings.plane.is_some(),
            reference,
            followed: None,
            off: Vec::new(),
            pauses: None,
            textured: None,
        },
        train,
        left_out,
    };
    let simple = contest.simple()?;
    let simple_errors = [Way::Rest, Way::Slide(0)].map(|way| error_of(&simple, way));
    let stays = rests(&simple, Way::Slide(0), REST_GAIN[0]);
    let is_unexplained = contest.is_unexplained(&simple);
    let (trials, (way, rotation)) = if stays && !is_unexplained && !object.is_told {
        // Where it rests, all its outlines put it into the same place.
        let judge = if object.place == 0 { contest.judge_of(Way::Rest) } else { None };
        let Some(mut judge) = judge else { return Ok(None) };
        let Some(judged) = contest.judged(&mut judge, contest.paths.spins())? else { return Ok(None) };
        if !judged.is_observed || judged.way == Way::Rest {
            return Ok(None);
        }
        let mut trials = contest.finely(&[Way::Rest])?;
        trials.extend(contest.observed(&mut judge, judged, true)?);
        (trials, (judged.way, RotationEvidence::Observed))
    } else if object.is_told || contest.paths.shifts() || is_unexplained {
        contest.along_the_path(simple, reliable)?
    } else {
        return Ok(None);
    };
    // Turns that are observed need not show in the outline.
    let gain =
        if rotation == RotationEvidence::Observed && way != Way::Slide(0) { 1.0 } else { REST_GAIN[1] };
    if !object.is_told && rests(&trials, way, gain) {
        return Ok(None);
    }
    // The path of a ball whose turn does not show is best where none is looked for; its rolling is put on afterwards.
    let [slides, rolls] = [Way::Slide(0), way].map(|way| error_of(&trials, way));
    let explains = |(slides, rolls): (f64, f64)| rolls <= ROLL_GAIN[usize::from(is_round(outline))] * slides;
    let rolls_unseen = rotation == RotationEvidence::Assumed
        && matches!(way, Way::Roll(_))
        && slides.zip(rolls).is_some_and(|errors| !explains(errors));
    let kept = if rolls_unseen { Way::Slide(0) } else { way };
    let Some(trial) = trials.into_iter().find(|trial| trial.way == kept) else { return Ok(None) };
    let Trial { mut fit, losses, .. } = trial;
    let bent = (losses[1] > DOUBTED && !object.is_told)
        .then(|| bend::bent(&fit, (&contest.train, contest.judged_views()), fit.trial_level()));
    // What stays in place and looks otherwise in every turn deforms, or opens. Of thin things the outline, which is never
    // exact, is most of what is seen: they are solid where bending explains no more.
    let most = match simple_errors[0] {
        Some(rests) if stays && is_unexplained => EXPLAINED * rests,
        _ => f64::INFINITY,
    };
    let may_be_solid = !outline.is_surrounded && bent.is_some_and(|bent| bent >= BENDS_NO_BETTER);
    if losses[1] > most && !object.is_told && !may_be_solid {
        return Ok(None);
    }
    if rotation == RotationEvidence::Assumed && kept == Way::Slide(0) && is_round(outline) {
        fit.poses.values_mut().for_each(|pose| pose.rotation = DQuat::IDENTITY);
    }
    (fit.turns, fit.rolls) = match (rotation, way) {
        (RotationEvidence::Assumed, Way::Roll(factor)) => {
            (Turns::Free, (!rolls_unseen).then(|| outline.height / factor))
        }
        // Light, which stays where it is, would pull them back.
        (RotationEvidence::Assumed, Way::Textured | Way::Slide(0)) => (Turns::Given, None),
        (RotationEvidence::Assumed, _) | (_, Way::Followed) => (Turns::Free, None),
        // As the judge had it.
        (RotationEvidence::Observed, _) => (fit.turns, fit.rolls),
    };
    let unturned = simple_errors[1];
    Ok(Some(Started { fit, path, way, rotation, error: losses[1], unturned, bent, reference }))
}

impl<'a> Contest<'a> {
    /// Trials of resting, and of moving along the path without a turn: most objects that do not travel rest.
    fn simple(&self) -> Result<Vec<Trial<'a>>, TrainError> {
        let mut trials = self.begin(&[Way::Rest, Way::Slide(0)], GAUSSIANS);
        self.advance(&mut trials, (0, STEPS[1]), false)?;
        self.judge(&mut trials, false);
        Ok(trials)
    }

    /// Poses that the texture of the object suggests, where it suggests any.
    fn find_texture(&mut self, simple: &[Trial<'_>], reliable: &[usize]) {
        let seen = reliable.iter().map(|view| &self.object.views[*view]);
        let (outline, up, reference) = (self.object.outline, self.paths.up, self.paths.reference);
        let slides = simple.iter().find(|trial| trial.way == Way::Slide(0)).map(|trial| &trial.fit);
        let bar = slides.and_then(|fit| Bar::of(fit.shape.gaussians(), &fit.poses, up));
        self.paths.textured = if let Some(bar) = bar {
            let rolled = bar.rolled(up, outline.height, reference);
            let turns = texture::rolls(seen, &bar.poses, (bar.axis, up), &rolled, outline);
            turns.map(|turns| bar.turned(&turns))
        } else {
            let mut turns = texture::turns(seen.clone(), &self.paths.along, outline, up);
            // What stays in place neither rolls nor flies.
            if turns.is_none() && self.paths.shifts() {
                let seen: Vec<&ObjectView> = seen.collect();
                turns = ball::turns(&seen, &self.paths.along, outline, &self.paths.rolls());
            }
            turns.map(|turns| self.paths.turned(&turns))
        };
    }

    /// A judge of the rotation of the object, and pauses that it sees; `unturned` is the way without turns.
    fn judge_of(&mut self, unturned: Way) -> Option<Judge<'a>> {
        let judge = Judge::new(self.object.views, self.object.outline.size(), self.paths.poses(unturned));
        self.paths.pauses = judge.as_ref().and_then(Judge::pauses);
        judge
    }

    /// The way, of those that agree on where the object is, that the judge of rotations finds: the first does not turn.
    /// Ways beside the best are added, so that its amount is near. `None` where too little is seen to compare them.
    fn judged(&self, judge: &mut Judge<'a>, mut ways: Vec<Way>) -> Result<Option<Judged>, TrainError> {
        let phases = self.object.surroundings.phases;
        let course = |way: &Way| self.paths.poses(*way);
        judge.add(ways.iter().skip(1).map(course).collect());
        phases.check()?;
        let Some(found) = judge.verdict() else { return Ok(None) };
        let beside = self.paths.beside(ways[found.best]);
        judge.add(beside.iter().map(course).collect());
        phases.check()?;
        ways.extend(beside);
        // Shading, which stays where it is, looks like paint that does: of what may roll it does not tell that it slides.
        let may_hide = self.paths.shifts() && self.paths.may_roll();
        Ok(judge.verdict().map(|found| Judged {
            way: ways[found.best],
            place: found.best,
            is_observed: found.is_observed && (found.turns || !may_hide),
        }))
    }

    /// A trial of an observed way: its turns stay as the judge found them, unless those that the pixels move them to
    /// explain more: light, which stays where it is, pulls turns back.
    fn observed(
        &self,
        judge: &mut Judge<'a>,
        judged: Judged,
        finely: bool,
    ) -> Result<Vec<Trial<'a>>, TrainError> {
        let way = judged.way;
        let gaussians = if finely { FINE.0 } else { GAUSSIANS };
        let steps = if finely { FINE.1 } else { STEPS[1] };
        let mut trials = self.begin(&[way, way], gaussians);
        if let Some(trial) = trials.first_mut().filter(|_| way != Way::Followed) {
            (trial.fit.turns, trial.fit.rolls) = (Turns::Given, None);
        }
        self.advance(&mut trials, (0, steps), finely)?;
        self.judge(&mut trials, finely);
        judge.add(trials.last().map(|trial| trial.fit.poses.clone()).into_iter().collect());
        let kept = usize::from(judge.prefers_last(judged.place));
        Ok(trials.into_iter().skip(kept).take(1).collect())
    }

    /// True where views of all sides show how it turns from time to time, or it is lifted from where it stood, so that
    /// its path does not tell.
    fn may_be_followed(&self) -> bool {
        let outline = self.object.outline;
        outline.is_surrounded || (!is_round(outline) && !self.object.rests(&self.paths.along).is_empty())
    }

    /// True where following may find what neither resting nor sliding explains.
    fn is_unexplained(&self, simple: &[Trial<'_>]) -> bool {
        let least = UNEXPLAINED[usize::from(self.object.outline.is_surrounded)];
        simple.iter().all(|trial| trial.losses[1] > least)
    }

    /// The object followed over known times: on its support where its path is, and off it if that explains more where
    /// it does not rest, as of what is lifted and tilted, so that its size does not tell.
    fn follow(&self, known: &[usize]) -> Result<Option<Fit<'a>>, TrainError> {
        let (object, along) = (self.object, &self.paths.along);
        let followed = |air: Option<Vec<usize>>| -> Result<Option<Fit<'a>>, TrainError> {
            let Some((reference, mut fit)) = object.first(along, known) else { return Ok(None) };
            fit.air = air.unwrap_or(fit.air);
            follow(&mut fit, reference, along, &self.train, object.surroundings.phases)?;
            Ok(Some(fit))
        };
        let Some(mut on) = followed(None)? else { return Ok(None) };
        let rests: Vec<usize> = object.rests(along).into_iter().flatten().collect();
        let (resting, moving): (Vec<usize>, Vec<usize>) =
            self.train.iter().partition(|view| rests.contains(&object.views[**view].time_index));
        if resting.is_empty() || !on.air.is_empty() || !on.is_held() {
            return Ok(Some(on));
        }
        let level = on.trial_level();
        let error = on.mean_loss(&moving, level);
        if error < STRAINED * on.mean_loss(&resting, level) {
            return Ok(Some(on));
        }
        let moves = along.keys().copied().filter(|time| !rests.contains(time));
        let Some(mut off) = followed(Some(moves.collect()))? else { return Ok(Some(on)) };
        let gains = off.mean_loss(&moving, level) < OFF_GAIN * error;
        Ok(Some(if gains { off } else { on }))
    }

    /// The way along the path that the judge finds or, where it cannot tell, one that explains the pixels, and trials of
    /// these beside the simple ones.
    fn along_the_path(
        &mut self,
        simple: Vec<Trial<'a>>,
        reliable: &[usize],
    ) -> Result<(Vec<Trial<'a>>, (Way, RotationEvidence)), TrainError> {
        self.find_texture(&simple, reliable);
        if self.may_be_followed() {
            let mut known: Vec<usize> =
                self.train.iter().map(|view| self.object.views[*view].time_index).collect();
            known.dedup();
            if let Some(fit) = self.follow(&known)? {
                (self.paths.followed, self.paths.off) = (Some(fit.poses), fit.air);
            }
        }
        let judge = self.judge_of(Way::Slide(0));
        let mut trials = simple;
        if let Some(mut judge) = judge {
            let judged = self.judged(&mut judge, self.paths.ways())?;
            if let Some(judged) = judged.filter(|judged| judged.is_observed) {
                // One of several outlines is chosen with all pixels.
                let finely = self.object.outlines > 1 && !is_round(self.object.outline);
                trials.retain(|trial| trial.way != judged.way);
                trials.extend(self.observed(&mut judge, judged, finely)?);
                return Ok((trials, (judged.way, RotationEvidence::Observed)));
            }
        }
        let trials = self.unobserved(trials)?;
        let way = decide(&errors(&trials), self.object.outline);
        Ok((trials, (way, RotationEvidence::Assumed)))
    }

    /// Trials of an object whose rotation the judge does not tell: of the turns that its texture suggests or else of all
    /// ways along the path, those near the best with all pixels.
    fn unobserved(&self, simple: Vec<Trial<'a>>) -> Result<Vec<Trial<'a>>, TrainError> {
        let least = simple.iter().map(|trial| trial.losses[1]).fold(f64::INFINITY, f64::min);
        if self.paths.textured.is_some() {
            let mut trials = self.begin(&[Way::Textured], GAUSSIANS);
            self.advance(&mut trials, (0, STEPS[1]), false)?;
            self.judge(&mut trials, false);
            if trials.first().is_some_and(|trial| trial.losses[1] <= TEXTURE_GAIN * least) {
                return Ok(trials);
            }
        }
        let mut trials = simple;
        let mut more = self.begin(&self.paths.unobserved(self.object.place), GAUSSIANS);
        self.advance(&mut more, (0, STEPS[0]), false)?;
        give_up_hopeless(&mut more, |way| matches!(way, Way::Followed | Way::Roll(_)));
        self.advance(&mut more, (STEPS[0], STEPS[1]), false)?;
        self.judge(&mut more, false);
        trials.extend(more);
        let rivals = rivals(&trials);
        // Shading prefers no turn of round things, at any resolution.
        if is_round(self.object.outline) || (rivals.len() < 2 && self.object.outlines < 2) {
            return Ok(trials);
        }
        self.finely(&rivals)
    }

    /// Trials with all pixels and small Gaussians, where fine texture may tell.
    fn finely(&self, ways: &[Way]) -> Result<Vec<Trial<'a>>, TrainError> {
        let mut trials = self.begin(ways, FINE.0);
        let early = FINE.1 / 3;
        self.advance(&mut trials, (0, early), true)?;
        give_up_hopeless(&mut trials, |way| way == Way::Rest);
        self.advance(&mut trials, (early, FINE.1), true)?;
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
                Way::Rest => (Turns::Given, None),
                Way::Slide(_) | Way::Spin(_) | Way::Pausing(_) => (Turns::Upright, None),
                Way::Roll(factor) => (Turns::Free, Some(self.paths.outline.height / factor)),
                Way::Followed | Way::Scaled(_) | Way::Textured => (Turns::Free, None),
            };
            if *way == Way::Followed {
                fit.air.clone_from(&self.paths.off);
            }
            fit.stays = matches!(way, Way::Rest)
                || (!self.paths.shifts() && matches!(way, Way::Spin(_) | Way::Pausing(_)));
            Some(Trial { way: *way, fit, losses: [0.0; 2] })
        };
        ways.par_iter().filter_map(begin).collect()
    }

    /// Steps of all trials, from one count to another.
    fn advance(
        &self,
        trials: &mut [Trial<'a>],
        (from, to): (usize, usize),
        finely: bool,
    ) -> Result<(), TrainError> {
        let all = if finely { FINE.1 } else { STEPS[1] };
        trials.par_iter_mut().for_each(|trial| {
            let level = if finely { 0 } else { trial.fit.trial_level() };
            let moves = if trial.way == Way::Rest { 0.0 } else { 1.0 };
            trial.fit.steps(&self.train, to - from, |share| {
                let done = from as f64 + share * (to - from) as f64;
                let rate = if done < 0.5 * all as f64 { 1.0 } else { 0.5 };
                (rate, moves * rate, level)
            });
            trial.losses[0] = trial.fit.mean_loss(&self.train, level);
        });
        self.object.surroundings.phases.check()
    }

    /// Moves the poses of times that were left out onto their views, the shape as it is: from one side to the next an
    /// object turns more than its neighbours tell, and how it looks from there is what is judged.
    fn settle(&self, fit: &mut Fit<'_>, level: usize) {
        let mut shape = fit.shape.copied();
        for view in self.left_out.iter().filter(|view| self.between.contains(&fit.views[**view].time_index)) {
            let time = fit.views[*view].time_index;
            let Some(pose) = fit.poses.get(&time).copied() else { continue };
            let pose = fit.settled(&mut shape, &[*view], level, pose, SETTLE);
            fit.poses.insert(time, pose);
        }
    }

    /// Views that were left out, or all where none were.
    fn judged_views(&self) -> &[usize] {
        if self.left_out.is_empty() { &self.train } else { &self.left_out }
    }

    /// Losses on the views that were left out.
    fn judge(&self, trials: &mut [Trial<'a>], finely: bool) {
        trials.par_iter_mut().for_each(|trial| {
            for time in &self.between {
                if let Some(pose) = trial.fit.pose_at(*time) {
                    trial.fit.poses.insert(*time, pose);
                }
            }
            let level = if finely { 0 } else { trial.fit.trial_level() };
            if self.may_be_followed() && trial.way != Way::Rest {
                self.settle(&mut trial.fit, level);
            }
            trial.losses[1] = trial.fit.mean_loss(self.judged_views(), level);
        });
    }
}

/// Drops trials that are far from the best on the views that they are fitted to, but for ways that are always kept.
fn give_up_hopeless(trials: &mut Vec<Trial<'_>>, is_kept: impl Fn(Way) -> bool) {
    let best = trials.iter().map(|trial| trial.losses[0]).fold(f64::INFINITY, f64::min);
    trials.retain(|trial| trial.losses[0] <= HOPELESS * best || is_kept(trial.way));
}

/// Views to fit to, and views left out: a camera in the middle where there are several at a time, else every fourth
/// time.
pub(super) fn split(views: &[ObjectView], reliable: &[usize], good: &[usize]) -> (Vec<usize>, Vec<usize>) {
    if reliable.len() > good.len() {
        let mut cameras: Vec<[i64; 3]> = reliable.iter().map(|view| views[*view].camera_key).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let middle = cameras[cameras.len() / 2];
        return reliable.iter().partition(|view| views[**view].camera_key != middle);
    }
    let is_left_out = |time: usize| {
        let place = good.iter().position(|other| *other == time).unwrap_or(0);
        good.len() > 8 && place >= 2 && place + 1 < good.len() && (place - 2).is_multiple_of(4)
    };
    reliable.iter().partition(|view| !is_left_out(views[**view].time_index))
}

/// Error of a way that was tried, on the views that were left out.
fn error_of(trials: &[Trial<'_>], way: Way) -> Option<f64> {
    trials.iter().find(|trial| trial.way == way).map(|trial| trial.losses[1])
}

/// True where the error of resting is at most `gain` times that of a way of moving.
fn rests(trials: &[Trial<'_>], way: Way, gain: f64) -> bool {
    error_of(trials, Way::Rest).zip(error_of(trials, way)).is_some_and(|(rest, moves)| rest <= gain * moves)
}

/// Ways that were tried with their errors on the views that were left out.
fn errors(trials: &[Trial<'_>]) -> Vec<(Way, f64)> {
    trials.iter().map(|trial| (trial.way, trial.losses[1])).collect()
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

/// The way of moving that is assumed where the judge cannot tell the rotation, by the errors of those that were tried.
fn decide(tried: &[(Way, f64)], outline: &Outline) -> Way {
    let (is_round, in_contact) = (is_round(outline), outline.air.is_empty());
    let best = |wanted: &dyn Fn(&Way) -> bool| {
        tried.iter().filter(|(way, _)| wanted(way)).min_by(|a, b| a.1.total_cmp(&b.1)).copied()
    };
    let Some((moving, moving_error)) = best(&|way| *way != Way::Rest) else { return Way::Slide(0) };
    let roll = best(&|way| matches!(way, Way::Roll(_)));
    let Some((turning, turning_error)) = best(&|way| way.degrees().is_some()) else {
        return moving;
    };
    let others = roll.map_or(turning_error, |(_, error)| error.min(turning_error));
    if moving == Way::Followed && moving_error < FOLLOW_GAIN[usize::from(is_round)] * others {
        return moving;
    }
    if let Some((way, error)) = roll
        && error <= ROLL_GAIN[usize::from(is_round)] * turning_error
    {
        return way;
    }
    let turns_far = turning.degrees().is_some_and(|degrees| degrees.abs() >= RIVAL.1);
    if let Some((way, error)) = roll
        && in_contact
        && turns_far
        && error <= ROLLS_RATHER * turning_error
    {
        return way;
    }
    let apart = |other: i32| {
        let difference = (other - turning.degrees().unwrap_or(0)).rem_euclid(360);
        difference.min(360 - difference) >= RIVAL.1
    };
    let rival = best(&|way| way.degrees().is_some_and(apart));
    let same = if is_round { SAME } else { 0.0 };
    let least = (RIVAL.0[usize::from(is_round)] * turning_error).max(turning_error + same);
    let has = |wanted: Way| tried.iter().any(|(way, _)| *way == wanted);
    // Where no turn of something round was tried, none is known.
    let is_untried = is_round && tried.iter().filter(|(way, _)| way.degrees().is_some()).count() < 2;
    if is_untried || rival.is_some_and(|(_, error)| error < least) {
        if is_round && in_contact && has(Way::Roll(1.0)) {
            return Way::Roll(1.0);
        }
        // What may roll without a change of its outline is made to.
        let rolls_as_well = |(_, error): &(Way, f64)| *error <= ROLLS_AS_WELL * turning_error;
        if let Some((way, _)) = roll.filter(|roll| in_contact && rolls_as_well(roll)) {
            return way;
        }
        if has(Way::Slide(0)) {
            return Way::Slide(0);
        }
        return turning;
    }
    turning
}

#[cfg(test)]
mod tests {
    use super::super::testing::shaped;
    use super::*;

    #[test]
    fn turns_that_nothing_tells_are_assumed() {
        let outline = |roundness: f64, air: Vec<usize>| Outline {
            air,
            ..shaped((0.05, 0.05), roundness, BTreeMap::new())
        };
        let slides = [(Way::Slide(0), 0.1), (Way::Slide(90), 0.101)];
        let with = |more: &[(Way, f64)]| [&slides[..], more].concat();
        let (edgy, round) = (outline(0.7, Vec::new()), outline(1.0, vec![3]));

        // What may roll does, where it explains as much as sliding, and touches its support.
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.101)]), &edgy), Way::Roll(0.8));
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.102)]), &edgy), Way::Slide(0));
        assert_eq!(decide(&with(&[(Way::Roll(0.8), 0.099)]), &outline(0.7, vec![3])), Way::Slide(0));
        // What would have to turn far while it slides rolls, even a little worse.
        let turning = [(Way::Slide(-120), 0.1), (Way::Roll(1.08), 0.102)];
        assert_eq!(decide(&turning, &edgy), Way::Roll(1.08));

        assert_eq!(decide(&[(Way::Slide(-30), 0.1), turning[1]], &edgy), Way::Slide(-30));
        assert_eq!(decide(&[turning[0], (Way::Roll(1.08), 0.104)], &edgy), Way::Slide(-120));
        // Of a ball in the air no turn was tried but those that following found.
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.2)], &round), Way::Slide(0));
        let followed = Way::Followed;
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.05)], &round), followed);
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.09)], &round), Way::Slide(0));
        assert_eq!(decide(&[slides[0], (Way::Followed, 0.2)], &edgy), Way::Slide(0));
    }
}
