//! Masks of one object that show another, as trackers leave them when they lose an object and take up another: found
//! by the colours inside and by the places where they are, and put right.
//!
//! Every object has a typical distribution of colours, that of most of its masks, and hardly moves from one frame of a
//! camera to the next. Two masks that change places and soon change back are exchanged (see [`exchanges`]), and so are
//! two that have each the colours of the other. A mask that has the colours of another object alone, or neither the
//! colours of its own nor its place (see [`strays`]), is taken away, for nobody knows where the object is. Before that,
//! masks lose what lies apart and has foreign colours (see [`foreign`]).

mod colors;
mod exchanges;
mod foreign;
mod masks;
mod parts;
mod pieces;
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

/// Changes to the masks of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Correction {
    /// New labels of masks that show another object, by their old ones; [`UNLABELLED`] for those that are taken away.
    pub renamed: BTreeMap<u16, u16>,
    /// Foreign parts of masks by label: the index of the first pixel of each, in the order of rows.
    pub foreign: BTreeMap<u16, Vec<u32>>,
}

impl Correction {
    /// True where all masks stay as they are.
    pub(crate) fn is_none(&self) -> bool {
        self.renamed.is_empty() && self.foreign.is_empty()
    }

    /// A mask image put right: foreign parts have the label that surrounds them most.
    pub(crate) fn applied(&self, labels: &PixelGrid<u16>) -> PixelGrid<u16> {
        let firsts = self.foreign.values().flatten().copied().collect();
        let changed = (!self.foreign.is_empty()).then(|| foreign::taken_away(labels, &firsts));
        changed.as_ref().unwrap_or(labels).map(|label| self.renamed.get(label).copied().unwrap_or(*label))
    }

    /// The same with other labels.
    pub(crate) fn relabelled(&self, label: impl Fn(u16) -> u16) -> Self {
        Self {
            renamed: self.renamed.iter().map(|(from, to)| (label(*from), label(*to))).collect(),
            foreign: self.foreign.iter().map(|(of, parts)| (label(*of), parts.clone())).collect(),
        }
    }
}

/// Finds what is wrong with the masks of every frame.
pub(crate) fn corrections(frames: &[Seen]) -> Vec<Correction> {
    let sequences = Sequence::all(frames);
    let mut now: Vec<Now<'_>> =
        frames.iter().map(|frame| frame.masks.iter().map(|mask| (mask.label, mask)).collect()).collect();
    let without = foreign::without(&sequences, &now);
    for ((frame, label), (mask, _)) in &without {
        now[*frame].insert(*label, mask);
    }
    exchanges::put_back(&sequences, &mut now);
    follow_colors(&mut now);
    strays::take_away(&sequences, &mut now);
    let renamed = |(frame, now): (&Seen, &Now<'_>)| {
        let mut renamed: BTreeMap<u16, u16> =
            frame.masks.iter().map(|mask| (mask.label, UNLABELLED)).collect();
        renamed.extend(now.iter().map(|(label, mask)| (mask.label, *label)));
        renamed.retain(|old, new| old != new);
        Correction { renamed, foreign: BTreeMap::new() }
    };
    let mut found: Vec<Correction> = frames.iter().zip(&now).map(renamed).collect();
    for ((frame, label), (_, parts)) in without {
        found[frame].foreign.insert(label, parts);
    }
    found
}

/// Exchanges masks with the colours of each other, and takes away those with the colours of another object alone.
fn follow_colors(frames: &mut [Now<'_>]) {
    let typical = typical_colors(frames);
    let shown = |label: &u16, mask: &Mask| {
        let object = typical.get(label).filter(|_| mask.pixels >= FEWEST_PIXELS)?;
        if object.unlike(&mask.colors) <= UNUSUAL {
            return None;
        }
        let others = typical.iter().filter(|(other, _)| *other != label);
        let best = others.map(|(other, object)| (*other, object.likeness(&mask.colors)));
        let (other, like) = best.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (like >= LIKE && like >= object.likeness(&mask.colors) + MORE).then_some(other)
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

#[cfg(test)]
mod tests;
