//! Masks of one object that show another, as trackers leave them when they lose an object and take up another: found
//! by the colours inside and by the places where they are, and put right.
//!
//! Every object has a typical distribution of colours, that of most of its masks, and hardly moves from one frame of a
//! camera to the next. Two masks that change places and soon change back are exchanged (see [`exchanges`]), and so are
//! two that have each the colours of the other. A mask that has the colours of another object alone, or neither the
//! colours of its own nor its place (see [`strays`]), is taken away, for nobody knows where the object is.

mod colors;
mod exchanges;
mod masks;
mod place;
mod strays;
mod usual;

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

pub(crate) use masks::Seen;
use masks::{Mask, Now, Sequence};
use usual::{FEWEST_PIXELS, MOST, UNUSUAL, typical_colors};

/// Likeness to another object from which a mask may show it, and by how much this exceeds the likeness to its own.
const LIKE: f64 = 0.93;
const MORE: f64 = 0.12;

/// New labels of the masks of every frame that show another object, by their old ones; [`UNLABELLED`] for those that
/// are taken away.
pub(crate) fn switches(frames: &[Seen]) -> Vec<BTreeMap<u16, u16>> {
    let sequences = Sequence::all(frames);
    let mut now: Vec<Now<'_>> =
        frames.iter().map(|frame| frame.masks.iter().map(|mask| (mask.label, mask)).collect()).collect();
    exchanges::put_back(&sequences, &mut now);
    follow_colors(&mut now);
    strays::take_away(&sequences, &mut now);
    let renamed = |(frame, now): (&Seen, &Now<'_>)| {
        let mut renamed: BTreeMap<u16, u16> =
            frame.masks.iter().map(|mask| (mask.label, UNLABELLED)).collect();
        renamed.extend(now.iter().map(|(label, mask)| (mask.label, *label)));
        renamed.retain(|old, new| old != new);
        renamed
    };
    frames.iter().zip(&now).map(renamed).collect()
}

/// Exchanges masks with the colours of each other, and takes away those with the colours of another object alone.
fn follow_colors(frames: &mut [Now<'_>]) {
    let typical = typical_colors(frames);
    let shown = |label: &u16, mask: &Mask| {
        let object = typical.get(label).filter(|_| mask.pixels >= FEWEST_PIXELS)?;
        if object.unlike(mask) <= UNUSUAL {
            return None;
        }
        let others = typical.iter().filter(|(other, _)| *other != label);
        let best = others.map(|(other, object)| (*other, object.likeness(mask)));
        let (other, like) = best.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (like >= LIKE && like >= object.likeness(mask) + MORE).then_some(other)
    };
    let (mut counts, mut all): (BTreeMap<u16, usize>, BTreeMap<u16, usize>) = Default::default();
    let mut found: Vec<BTreeMap<u16, u16>> = Vec::with_capacity(frames.len());
    for frame in frames.iter() {
        for (label, _) in frame.iter().filter(|(_, mask)| mask.pixels >= FEWEST_PIXELS) {
            *all.entry(*label).or_default() += 1;
        }
        let shows: BTreeMap<u16, u16> =
            frame.iter().filter_map(|(label, mask)| Some((*label, shown(label, mask)?))).collect();
        shows.keys().for_each(|label| *counts.entry(*label).or_default() += 1);
        found.push(shows);
    }
    let doubtful = |label: &u16| counts[label] as f64 > MOST * all[label] as f64;
    for (frame, mut shows) in frames.iter_mut().zip(found) {
        shows.retain(|label, _| !doubtful(label));
        let taken: Vec<(u16, Option<&Mask>)> =
            shows.keys().map(|label| (*label, frame.remove(label))).collect();
        for (label, mask) in taken {
            let other = shows[&label];
            if shows.get(&other) == Some(&label) {
                frame.extend(mask.map(|mask| (other, mask)));
            }
        }
    }
}

/// A mask image with new labels.
pub(crate) fn put_right(labels: &PixelGrid<u16>, renamed: &BTreeMap<u16, u16>) -> PixelGrid<u16> {
    labels.map(|label| renamed.get(label).copied().unwrap_or(*label))
}

#[cfg(test)]
mod tests;
