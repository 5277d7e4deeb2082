//! Masks that show something else than their object for a moment: recognised by colours that are not those of the object,
//! at a place, of a size or at a time that the frames before and after do not bear out.

use std::collections::BTreeMap;

use super::masks::{Mask, Now, Sequence};
use super::usual::{FEWEST_PIXELS, MOST, TypicalColors, UNUSUAL, typical_colors};

/// By how much less than is typical the colours of a mask are those of its object: where nothing is at its place in the
/// frames before and after, and where these show nothing, because the object or the camera is too fast. In twelve
/// captures all masks of up to [`MOMENT`] frames without the object before and after are within 0.1 where they show their
/// object, and 0.28 to 0.97 less alike where they do not.
const FOREIGN: f64 = 0.2;
const FOREIGN_ANYWHERE: f64 = 0.6;

/// Frames in a row that may show something else, when the object is in neither the frame before nor that after them.
const MOMENT: usize = 2;

/// Overlap of the masks of an object from frame to frame, in the middle, from which places are evidence.
const STEADY: f64 = 0.3;

/// Overlap below which nothing is at the place of a mask.
const NOTHING: f64 = 0.05;

/// Overlap of the masks before and after from which that between has to overlap both, and by what share of theirs.
const AGREED: f64 = 0.5;
const SHARE: f64 = 0.5;

/// Share of the area of a mask below which those before and after are smaller than it.
const SMALLER: f64 = 0.6;

/// Takes stray masks away.
pub(super) fn take_away(sequences: &[Sequence], frames: &mut [Now<'_>]) {
    let typical = typical_colors(frames);
    let mut found: BTreeMap<u16, Vec<usize>> = BTreeMap::new();
    for sequence in sequences {
        let steady = steady(sequence, frames);
        for at in 0..sequence.len() {
            for (label, mask) in &frames[sequence.frames[at]] {
                let (Some(typical), Some(steady)) = (typical.get(label), steady.get(label)) else { continue };
                let near: Vec<&Mask> = sequence
                    .near(at)
                    .into_iter()
                    .filter_map(|at| frames[sequence.frames[at]].get(label).copied())
                    .collect();
                if strays(mask, typical, *steady, &near) || momentary(*label, at, sequence, frames, typical) {
                    found.entry(*label).or_default().push(sequence.frames[at]);
                }
            }
        }
    }
    for (label, strays) in found {
        let all = frames.iter().filter(|now| now.contains_key(&label)).count();
        if strays.len() as f64 <= MOST * all as f64 {
            strays.into_iter().for_each(|frame| {
                frames[frame].remove(&label);
            });
        }
    }
}

/// True where a mask is not that of its object, given the masks before and after, where there are any.
fn strays(mask: &Mask, typical: &TypicalColors, steady: f64, near: &[&Mask]) -> bool {
    let unlike = typical.unlike(&mask.colors);
    let overlap = |other: &Mask| mask.place.overlap(&other.place);
    if steady < STEADY {
        return unlike > FOREIGN_ANYWHERE && mask.pixels >= FEWEST_PIXELS;
    }
    if unlike > FOREIGN && near.iter().all(|other| overlap(other) < NOTHING) {
        return true;
    }
    let [before, after] = near else { return false };
    let agreed = before.place.overlap(&after.place);
    let elsewhere = agreed >= AGREED && near.iter().all(|other| overlap(other) < SHARE * agreed);
    let larger = near.iter().all(|other| other.place.area() < SMALLER * mask.place.area());
    unlike > UNUSUAL && (elsewhere || larger)
}

/// True where the object of a mask is seen for a moment only, and all masks of this moment have foreign colours.
fn momentary(
    label: u16,
    at: usize,
    sequence: &Sequence,
    frames: &[Now<'_>],
    typical: &TypicalColors,
) -> bool {
    let mask = |at: usize| frames[sequence.frames[at]].get(&label);
    let Some(moment) = sequence.moment(at, |at| mask(at).is_some()) else { return false };
    moment.len() <= MOMENT && moment.filter_map(mask).all(|mask| typical.unlike(&mask.colors) > FOREIGN)
}

/// Overlap of the masks of every object from frame to frame, in the middle, by label.
fn steady(sequence: &Sequence, frames: &[Now<'_>]) -> BTreeMap<u16, f64> {
    let mut overlaps: BTreeMap<u16, Vec<f64>> = BTreeMap::new();
    for at in (1..sequence.len()).filter(|at| sequence.follows(*at)) {
        let before = &frames[sequence.frames[at - 1]];
        for (label, mask) in &frames[sequence.frames[at]] {
            if let Some(before) = before.get(label) {
                overlaps.entry(*label).or_default().push(before.place.overlap(&mask.place));
            }
        }
    }
    overlaps
        .into_iter()
        .map(|(label, mut all)| {
            all.sort_by(f64::total_cmp);
            (label, all[all.len() / 2])
        })
        .collect()
}
