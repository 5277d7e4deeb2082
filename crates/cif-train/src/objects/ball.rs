//! Turns of a ball from its texture, however it turns: its outline is a circle from all sides, so every pixel shows a
//! known place of a sphere, and the rotations are those under which the times show one texture. The first are those of
//! the few times in a row that agree best with an even turn; the others follow from time to time. Several cameras show
//! most of the ball at a time, so that each time is turned by itself, however fast it turns.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::fit::log;
use super::object::STANDS;
use super::outline::Outline;
use super::sphere::{Agreement, Side, Texture, take_light_away};
use super::texture::FEWEST;
use super::view::{ObjectView, are_discs, median};

/// Difference of turns that are tried of every time, where several cameras show it, radians; and the share of the places
/// that these are judged by.
const ANY_APART: f64 = 0.2;
const FEW: usize = 4;

/// Rotations of a time that are kept of these.
const KEPT: usize = 32;

/// Cost in agreement, per radian of change from time to time, of such turns.
const FAST_COST: f64 = 0.15;

/// Agreement of the times from which such turns are accepted: among so many some agree by chance.
const LEAST_AGREEMENT_OF_ANY: f64 = 0.45;

/// Times in a row that are taken to turn evenly, and how many of them lie between beginnings that are tried.
const WINDOW: usize = 6;
const STRIDE: usize = 3;

/// Fastest turn, radians from one time of the sequence to the next, and the difference of turns that are tried.
const FASTEST: f64 = 0.8;
const APART: f64 = 0.1;

/// The same of grids around the best of these.
const FINER: [f64; 2] = [APART / 2.0, APART / 4.0];

/// Times ahead that are looked at, with the same turn, for the turn of the next.
const AHEAD: usize = 5;

/// Largest change of the turn from time to time, radians per time, and what it costs in agreement.
const CHANGE: f64 = 0.3;
const CHANGE_COST: f64 = 0.3;

/// Times that all are followed again, with the texture that was found.
const AGAIN: usize = 2;

/// Rounds in which each time is turned to agree with all others, and the first and smallest of these turns, radians.
const ROUNDS: usize = 4;
const REFINED: [f64; 2] = [0.16, 0.01];

/// Cost in agreement of the largest change of the turn, away from the middle of the neighbours.
const UNEVEN_COST: f64 = 0.1;

/// Agreement of the times from which the texture determines the turns, how many times that of no turn it must be, and share
/// of it that rolling may have.
const LEAST_AGREEMENT: f64 = 0.3;
const ABOVE_REST: f64 = 1.3;
const ROLLS: f64 = 0.3;

/// Cameras of a time from which most of the ball is seen.
const SEVERAL: usize = 3;

/// Pixels of the masks of a time below which they may look like discs by chance.
const FEWEST_PIXELS: f64 = 150.0;

/// Root mean square of the logarithms of the texture below which it may be light.
const FAINT: f64 = 0.15;

/// Weight of what several cameras show of a time, of that of the middle one, up to which it says nothing of its turn.
const HIDDEN: f64 = 0.3;

/// Agreement with the others, of the middle one, from which a time is turned well.
const WELL: f64 = 0.7;

/// Rotations of a ball by time, relative to some frame of it, that explain how its texture moves; `None` where it does not
/// determine them, or shows that it rolls: `rolls` are rotations of rolling without slip. `path` is that of the centre.
pub(super) fn turns(
    views: &[&ObjectView],
    path: &BTreeMap<usize, DVec3>,
    outline: &Outline,
    rolls: &[BTreeMap<usize, DQuat>],
) -> Option<BTreeMap<usize, DQuat>> {
    let mut at: BTreeMap<usize, Vec<&ObjectView>> = BTreeMap::new();
    for view in views.iter().filter(|view| path.contains_key(&view.time_index)) {
        at.entry(view.time_index).or_default().push(view);
    }
    let mut areas: Vec<f64> =
        at.values().map(|views| views.iter().map(|view| view.area()).sum::<f64>()).collect();
    if at.len() < FEWEST || median(&mut areas) < FEWEST_PIXELS || !are_discs(views.iter().copied()) {
        return None;
    }
    let are_surrounded = 2 * at.values().filter(|views| views.len() >= SEVERAL).count() > at.len();
    let side =
        |(time, views): (&usize, &Vec<&ObjectView>)| Side::of(*time, views, path[time], outline.size());
    let mut sides: Vec<Side> = at.iter().map(side).collect();
    if are_surrounded {
        let mut weights: Vec<f64> = sides.iter().map(Side::weight).collect();
        let least = HIDDEN * median(&mut weights);
        sides.retain(|side| side.weight() > least);
    }
    let moves = |time: usize| {
        let next = path.range(time + 1..).next().or_else(|| path.range(..time).next_back());
        next.is_some_and(|(other, place)| {
            (*place - path[&time]).length() > STANDS * outline.size() * time.abs_diff(*other) as f64
        })
    };
    take_light_away(&mut sides, moves);
    let (found, least) = if are_surrounded {
        (turns_by_themselves(&sides)?, LEAST_AGREEMENT_OF_ANY)
    } else {
        (followed_turns(&sides)?, LEAST_AGREEMENT)
    };
    let agreed = agreement(&sides, &found);
    let agrees = |roll: &BTreeMap<usize, DQuat>| -> f64 {
        agreement(&sides, &sides.iter().map(|side| roll[&side.time]).collect::<Vec<_>>())
    };
    let rolls = rolls.iter().map(agrees).fold(0.0, f64::max);
    let at_rest = agreement(&sides, &vec![DQuat::IDENTITY; sides.len()]);
    let is_clear = agreed > least.max(ABOVE_REST * at_rest)
        && rolls < ROLLS * agreed
        && agreed.sqrt() * Side::strength(&sides) > FAINT;
    is_clear.then(|| sides.iter().map(|side| side.time).zip(found).collect())
}

/// Rotations of all sides that make one texture of them.
fn followed_turns(sides: &[Side]) -> Option<Vec<DQuat>> {
    let evens = even_turns(sides);
    let best = evens.iter().max_by(|a, b| a.agreement.total_cmp(&b.agreement))?;
    let mut turns = grown(sides, &evens, best, Texture::empty());
    refine(sides, &mut turns);
    for _ in 0..AGAIN {
        turns = grown(sides, &evens, best, consistent(sides, &turns));
        refine(sides, &mut turns);
    }
    Some(turns)
}

/// The same of sides each of which shows most of the ball: outward from the one that shows most, each is turned as it
/// agrees best with those before, whatever the turn between them; then again with the texture of all others. Balls
/// often look nearly the same from several sides, so that of all turns that agree those are taken which together are
/// the most even.
fn turns_by_themselves(sides: &[Side]) -> Option<Vec<DQuat>> {
    let first = (0..sides.len()).max_by(|a, b| sides[*a].weight().total_cmp(&sides[*b].weight()))?;
    let mut order: Vec<usize> = (0..sides.len()).filter(|k| *k != first).collect();
    order.sort_by_key(|k| k.abs_diff(first));
    let all = grid(PI, ANY_APART);
    let mut turns = vec![DQuat::IDENTITY; sides.len()];
    let mut texture = Texture::of(&sides[first], DQuat::IDENTITY);
    for k in order {
        let best = agreeing(&sides[k], &texture, &all).into_iter();
        turns[k] = best.max_by(|a, b| a.agreement.total_cmp(&b.agreement))?.rotation;
        texture.add(&Texture::of(&sides[k], turns[k]));
    }
    for _ in 0..AGAIN {
        let others = |k: usize| {
            let mut others = texture.clone();
            others.subtract(&Texture::of(&sides[k], turns[k]));
            agreeing(&sides[k], &others, &all)
        };
        let agreeing: Vec<Vec<Agreeing>> = (0..sides.len()).map(others).collect();
        turns = evenest(sides, &agreeing);
        texture = Texture::empty();
        sides.iter().zip(&turns).for_each(|(side, turn)| texture.add(&Texture::of(side, *turn)));
    }
    Some(turns)
}

/// A rotation in which a side agrees with a texture better than in those around.
struct Agreeing {
    rotation: DQuat,
    agreement: f64,
}

/// The best of such rotations, among `all` that are tried.
fn agreeing(side: &Side, texture: &Texture, all: &[DVec3]) -> Vec<Agreeing> {
    let few = side.few(FEW);
    let scores: Vec<f64> =
        all.par_iter().map(|turn| texture.agreement(&few, DQuat::from_scaled_axis(*turn)).share()).collect();
    let mut order: Vec<usize> = (0..all.len()).collect();
    order.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]));
    let mut kept: Vec<DQuat> = Vec::with_capacity(KEPT);
    for k in order {
        let rotation = DQuat::from_scaled_axis(all[k]);
        if kept.iter().all(|kept| rotation.angle_between(*kept) > 2.0 * ANY_APART) {
            kept.push(rotation);
        }
        if kept.len() == KEPT {
            break;
        }
    }
    let changes = grid(ANY_APART, APART);
    let best = |middle: DQuat| {
        let rotation = |turn: DVec3| (DQuat::from_scaled_axis(turn) * middle).normalize();
        let score = |turn: DVec3| texture.agreement(side, rotation(turn)).share();
        let coarse = best_around((score(DVec3::ZERO), DVec3::ZERO), DVec3::ZERO, &changes, score);
        let (agreement, turn) = refined(coarse, score);
        Agreeing { rotation: rotation(turn), agreement }
    };
    kept.into_par_iter().map(best).collect()
}

/// One of the rotations of every side, so that they agree most and the turns between them change least.
fn evenest(sides: &[Side], of: &[Vec<Agreeing>]) -> Vec<DQuat> {
    // Turns from every rotation of the side before one to every rotation of it.
    let turns_to = |k: usize| -> Vec<DVec3> {
        let steps = (sides[k].time - sides[k - 1].time) as f64;
        let turn = |from: &Agreeing, to: &Agreeing| log(to.rotation * from.rotation.inverse()) / steps;
        of[k - 1].iter().flat_map(|from| of[k].iter().map(move |to| turn(from, to))).collect()
    };
    let turns: Vec<Vec<DVec3>> = (1..sides.len()).map(turns_to).collect();
    // Of every pair of rotations of neighbouring sides, the best sum that ends with it, and the rotation before.
    let mut sums: Vec<Vec<(f64, usize)>> = Vec::with_capacity(sides.len());
    for k in 1..sides.len() {
        let pairs = (0..of[k - 1].len()).flat_map(|from| (0..of[k].len()).map(move |to| (from, to)));
        let best = |(from, to): (usize, usize)| {
            let agreement = of[k][to].agreement;
            let Some(before) = sums.last() else { return (of[0][from].agreement + agreement, 0) };
            let next = turns[k - 1][from * of[k].len() + to];
            let sum = |earlier: usize| {
                let pair = earlier * of[k - 1].len() + from;
                let change = (next - turns[k - 2][pair]).length().min(PI);
                before[pair].0 - FAST_COST * change
            };
            let sums = (0..of[k - 2].len()).map(|earlier| (sum(earlier), earlier));
            let (sum, earlier) = sums.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0));
            (sum + agreement, earlier)
        };
        let found = pairs.map(best).collect();
        sums.push(found);
    }
    let mut chosen = vec![0; sides.len()];
    for k in (1..sides.len()).rev() {
        let found = &sums[k - 1];
        let width = of[k].len();
        let pair = if k + 1 == sides.len() {
            (0..found.len()).max_by(|a, b| found[*a].0.total_cmp(&found[*b].0)).unwrap_or(0)
        } else {
            chosen[k - 1] * width + chosen[k]
        };
        (chosen[k - 1], chosen[k]) = (pair / width, pair % width);
        if k > 1 {
            chosen[k - 2] = found[pair].1;
        }
    }
    chosen.iter().zip(of).map(|(chosen, of)| of[*chosen].rotation).collect()
}

/// Texture without sides that agree least with the others, which may be turned wrongly.
fn consistent(sides: &[Side], turns: &[DQuat]) -> Texture {
    let own: Vec<Texture> = sides.iter().zip(turns).map(|(side, turn)| Texture::of(side, *turn)).collect();
    let mut all = Texture::empty();
    own.iter().for_each(|own| all.add(own));
    let agreement = |k: usize| {
        let mut others = all.clone();
        others.subtract(&own[k]);
        others.agreement(&sides[k], turns[k]).share()
    };
    let agreements: Vec<f64> = (0..sides.len()).map(agreement).collect();
    let least = WELL * median(&mut agreements.clone());
    let mut texture = Texture::empty();
    own.iter()
        .zip(&agreements)
        .filter(|(_, agreement)| **agreement > least)
        .for_each(|(own, _)| texture.add(own));
    texture
}

/// Turns on a grid of a spacing within a distance of the origin, nearest first.
fn grid(reach: f64, spacing: f64) -> Vec<DVec3> {
    let count = (reach / spacing).floor() as i32;
    let mut turns: Vec<DVec3> = Vec::new();
    for x in -count..=count {
        for y in -count..=count {
            for z in -count..=count {
                let turn = spacing * DVec3::new(f64::from(x), f64::from(y), f64::from(z));
                if turn.length() <= reach + 1e-9 {
                    turns.push(turn);
                }
            }
        }
    }
    turns.sort_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    turns
}

/// The best of some turn and its score, and of those a grid away from a middle.
fn best_around(
    mut best: (f64, DVec3),
    middle: DVec3,
    changes: &[DVec3],
    score: impl Fn(DVec3) -> f64,
) -> (f64, DVec3) {
    for change in changes {
        let found = score(middle + *change);
        if found > best.0 {
            best = (found, middle + *change);
        }
    }
    best
}

/// The same on ever finer grids around the best.
fn refined(mut best: (f64, DVec3), score: impl Fn(DVec3) -> f64) -> (f64, DVec3) {
    for spacing in FINER {
        best = best_around(best, best.1, &grid(1.8 * spacing, spacing), &score);
    }
    best
}

/// Rotations of sides that turn evenly, by so much from one time of the sequence to the next, from none at the first.
fn evenly(sides: &[Side], turn: DVec3) -> Vec<DQuat> {
    let steps = |side: &Side| side.time as f64 - sides[0].time as f64;
    sides.iter().map(|side| DQuat::from_scaled_axis(steps(side) * turn)).collect()
}

/// A few sides in a row that turn evenly.
struct Even {
    /// Place of the first of them.
    first: usize,
    /// Turn from one time of the sequence to the next.
    turn: DVec3,
    agreement: f64,
}

/// Even turns of a few sides in a row, from place to place.
fn even_turns(sides: &[Side]) -> Vec<Even> {
    let turns = grid(FASTEST, APART);
    let best = |first: usize| {
        let few = &sides[first..(first + WINDOW).min(sides.len())];
        let score = |turn: DVec3| agreement(few, &evenly(few, turn));
        let coarse = best_around((f64::NEG_INFINITY, DVec3::ZERO), DVec3::ZERO, &turns, score);
        let (agreement, turn) = refined(coarse, score);
        Even { first, turn, agreement }
    };
    let starts: Vec<usize> = (0..sides.len().saturating_sub(WINDOW - 1)).step_by(STRIDE).collect();
    starts.into_par_iter().map(best).collect()
}

/// Rotations of all sides, followed in both directions from some that turn evenly; `texture` is what is known of it.
fn grown(sides: &[Side], evens: &[Even], start: &Even, mut texture: Texture) -> Vec<DQuat> {
    let Even { first, turn, .. } = *start;
    let last = (first + WINDOW).min(sides.len()) - 1;
    let mut turns = vec![DQuat::IDENTITY; sides.len()];
    for (k, rotation) in (first..=last).zip(evenly(&sides[first..=last], turn)) {
        turns[k] = rotation;
        texture.add(&Texture::of(&sides[k], rotation));
    }
    // Turn that agrees best among those of the few sides around one.
    let even = |k: usize| {
        let around = evens.iter().filter(|even| (even.first..even.first + WINDOW).contains(&k));
        around.max_by(|a, b| a.agreement.total_cmp(&b.agreement)).map_or(turn, |even| even.turn)
    };
    let onwards: [Vec<usize>; 2] = [(last..sides.len()).collect(), (0..=first).rev().collect()];
    for places in onwards {
        let mut rate = turn;
        for at in 1..places.len() {
            let (known, k) = (places[at - 1], places[at]);
            let known = Turned { side: &sides[known], rotation: turns[known] };
            let ahead: Vec<&Side> = places[at..].iter().take(AHEAD).map(|place| &sides[*place]).collect();
            rate = rate_ahead(&known, &ahead, &texture, rate, even(k));
            turns[k] = known.onward(&sides[k], rate);
            texture.add(&Texture::of(&sides[k], turns[k]));
        }
    }
    turns
}

/// A side whose rotation is known.
struct Turned<'a> {
    side: &'a Side,
    rotation: DQuat,
}

impl Turned<'_> {
    /// Rotation of another side, after so much of a turn from each time of the sequence to the next.
    fn onward(&self, other: &Side, turn: DVec3) -> DQuat {
        let steps = other.time as f64 - self.side.time as f64;
        DQuat::from_scaled_axis(steps * turn) * self.rotation
    }
}

/// Turn from one time of the sequence to the next with which the texture of the sides ahead of a known one agrees best,
/// near the `rate` of before it or that of an even turn of the sides around.
fn rate_ahead(known: &Turned<'_>, ahead: &[&Side], texture: &Texture, rate: DVec3, even: DVec3) -> DVec3 {
    let score = |turn: DVec3| {
        let mut sum = Agreement::default();
        ahead.iter().for_each(|side| sum += texture.agreement(side, known.onward(side, turn)));
        let change = (turn - rate).length().min(2.0 * (turn - even).length() + 0.1);
        sum.share() - CHANGE_COST * change * change / (CHANGE * CHANGE)
    };
    let changes = grid(CHANGE, APART);
    let mut best = (score(rate), rate);
    for around in [rate, even] {
        best = best_around(best, around, &changes, score);
    }
    refined(best, score).1
}

/// Turns every side to agree with all others.
fn refine(sides: &[Side], turns: &mut [DQuat]) {
    let mut texture = Texture::empty();
    sides.iter().zip(turns.iter()).for_each(|(side, turn)| texture.add(&Texture::of(side, *turn)));
    for _ in 0..ROUNDS {
        for k in 0..sides.len() {
            let (side, turn) = (&sides[k], turns[k]);
            texture.subtract(&Texture::of(side, turn));
            let between = (k > 0 && k + 1 < sides.len()).then(|| {
                let [a, b, c] = [k - 1, k, k + 1].map(|k| sides[k].time as f64);
                turns[k - 1].slerp(turns[k + 1], (b - a) / (c - a))
            });
            let score = |turn: DQuat| {
                let off = between.map_or(0.0, |between| turn.angle_between(between) / CHANGE);
                texture.agreement(side, turn).share() - UNEVEN_COST * off * off
            };
            let mut best = (score(turn), turn);
            let mut size = REFINED[0];
            while size >= REFINED[1] {
                let middle = best.1;
                for axis in 0..3 {
                    for sign in [-1.0, 1.0] {
                        let mut change = DVec3::ZERO;
                        change[axis] = sign * size;
                        let turn = DQuat::from_scaled_axis(change) * middle;
                        let found = score(turn);
                        if found > best.0 {
                            best = (found, turn);
                        }
                    }
                }
                if best.1 == middle {
                    size *= 0.5;
                }
            }
            turns[k] = best.1;
            texture.add(&Texture::of(side, best.1));
        }
    }
}

/// Agreement of all sides in some rotations with the texture of the others.
fn agreement(sides: &[Side], turns: &[DQuat]) -> f64 {
    let mut texture = Texture::empty();
    let mut sum = Agreement::default();
    for (side, turn) in sides.iter().zip(turns) {
        sum += texture.agreement(side, *turn);
        texture.add(&Texture::of(side, *turn));
    }
    sum.share()
}

#[cfg(test)]
mod tests {
    use super::super::outlines::outlines;
    use super::super::testing::{Cameras, TIMES, jumping, patches, rig, solid, sphere_places, views};
    use super::*;

    /// Turns found of a ball that flies, with these rotations, by time.
    fn thrown(
        color: impl Fn(DVec3) -> [f32; 3],
        rotation: impl Fn(usize) -> DQuat,
        cameras: Cameras,
    ) -> Option<BTreeMap<usize, DQuat>> {
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES)
            .map(|time| {
                let share = time as f64 / (TIMES - 1) as f64;
                let place = DVec3::new(0.3 * share - 0.15, 0.0, 0.06 + 0.6 * share * (1.0 - share));
                (rotation(time), place)
            })
            .collect();
        let views = views(solid(&sphere_places(0.05), color, 0.006), &truth, cameras);
        let outline = outlines(&views, None, TIMES).remove(0);
        let seen: Vec<&ObjectView> = views.iter().collect();
        turns(&seen, &outline.path, &outline, &[])
    }

    /// Rotation of a ball that turns evenly about a tilted axis.
    fn even(time: usize) -> DQuat {
        DQuat::from_scaled_axis(time as f64 * DVec3::new(0.1, 0.12, -0.15))
    }

    /// Middle error of turns relative to the first, degrees.
    fn error(found: &BTreeMap<usize, DQuat>, truth: impl Fn(usize) -> DQuat) -> f64 {
        let of = |time: usize| {
            let relative = found[&time] * found[&0].inverse();
            relative.angle_between(truth(time) * truth(0).inverse()).to_degrees()
        };
        median(&mut (1..TIMES).map(of).collect::<Vec<_>>())
    }

    #[test]
    fn turns_in_flight_show_by_the_texture() {
        let error = error(&thrown(patches, even, jumping).unwrap(), even);
        assert!(error < 10.0, "{error}");
    }

    #[test]
    #[ignore = "long: make test-long"]
    fn several_cameras_show_turns_however_fast() {
        // A third of a turn from time to time, and the other way round after a bounce.
        let fast = |time: usize| {
            let turned = if time < 15 { time } else { 30 - time };
            DQuat::from_scaled_axis(2.1 * turned as f64 * DVec3::new(0.4, 0.7, -0.6).normalize())
        };
        let error = error(&thrown(patches, fast, rig).unwrap(), fast);
        assert!(error < 8.0, "{error}");
    }

    #[test]
    fn of_rotations_that_agree_the_most_even_are_taken() {
        let even = |time: usize| DQuat::from_scaled_axis(0.3 * time as f64 * DVec3::Y);
        let sides: Vec<Side> = (0..10).map(|time| Side::of(time, &[], DVec3::ZERO, 1.0)).collect();
        // At some times a ball that looks nearly the same from elsewhere agrees better there.
        let agreeing: Vec<Vec<Agreeing>> = (0..10)
            .map(|time| {
                let other = even(time) * DQuat::from_scaled_axis(2.0 * DVec3::X);
                let agreement = if time % 3 == 1 { 0.62 } else { 0.58 };
                vec![
                    Agreeing { rotation: other, agreement },
                    Agreeing { rotation: even(time), agreement: 0.6 },
                ]
            })
            .collect();
        for (time, rotation) in evenest(&sides, &agreeing).into_iter().enumerate() {
            assert!(rotation.angle_between(even(time)) < 1e-6, "{time}");
        }
    }

    #[test]
    #[ignore = "long: make test-long"]
    fn a_plain_ball_does_not_show_its_turns() {
        assert!(thrown(|_| [0.8, 0.5, 0.2], even, jumping).is_none());
        assert!(thrown(|_| [0.8, 0.5, 0.2], even, rig).is_none());
    }
}
