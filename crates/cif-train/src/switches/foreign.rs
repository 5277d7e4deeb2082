//! Foreign pieces of masks: what lies apart from the rest of a mask, and has other colours than its object, is none of it.
//! Trackers and networks that segment leave such blobs somewhere in the image.

use std::collections::{BTreeMap, BTreeSet};

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

use super::masks::{Mask, Now, Sequence};
use super::parts::{Part, parts};
use super::pieces::Piece;
use super::place::Place;
use super::usual::{MOST, TypicalColors, typical_colors};

/// By how much less than the most typical piece of a mask another one has the colours of the object, from which it is
/// foreign. With 0.15 it is 201 blobs and 3 pieces, with 0.25 191 and 2, with 0.3 184 and 1.
const FOREIGN: f64 = 0.2;

/// Share of a piece that the mask before or after has from which it bears it out.
const BORNE_OUT: f64 = 0.5;

/// Masks without their foreign pieces, and the first pixels of the parts of these, by frame and label.
pub(super) fn without(
    sequences: &[Sequence],
    frames: &[Now<'_>],
) -> BTreeMap<(usize, u16), (Mask, Vec<u32>)> {
    let typical = typical_colors(frames);
    let mut found = BTreeMap::new();
    let mut counts: BTreeMap<u16, usize> = BTreeMap::new();
    for sequence in sequences {
        for at in 0..sequence.len() {
            for (label, mask) in &frames[sequence.frames[at]] {
                let Some(typical) = typical.get(label) else { continue };
                let near = sequence.near(at).into_iter();
                let near: Vec<&Place> =
                    near.filter_map(|at| Some(&frames[sequence.frames[at]].get(label)?.place)).collect();
                let is_foreign = foreign(&mask.pieces, typical, &near);
                if is_foreign.contains(&true) {
                    *counts.entry(*label).or_default() += 1;
                    found.insert((sequence.frames[at], *label), mask.split(&is_foreign));
                }
            }
        }
    }
    let of = |label: &u16| frames.iter().filter(|now| now.contains_key(label)).count();
    counts.retain(|label, count| *count as f64 <= MOST * of(label) as f64);
    found.retain(|(_, label), _| counts.contains_key(label));
    found
}

/// Which pieces of a mask are foreign, given the places of the masks before and after it.
fn foreign(pieces: &[Piece], typical: &TypicalColors, near: &[&Place]) -> Vec<bool> {
    let unlike: Vec<f64> = pieces.iter().map(|piece| typical.unlike(&piece.colors)).collect();
    let least = unlike.iter().copied().fold(f64::INFINITY, f64::min);
    let is_borne_out = |piece: &Piece| near.iter().any(|near| piece.place.share_in(near) >= BORNE_OUT);
    let is_foreign = |(piece, unlike): (&Piece, &f64)| *unlike > least + FOREIGN && !is_borne_out(piece);
    pieces.iter().zip(&unlike).map(is_foreign).collect()
}

/// A mask image in which parts of masks, by their first pixels, have the label that surrounds them most.
pub(super) fn taken_away(labels: &PixelGrid<u16>, firsts: &BTreeSet<u32>) -> PixelGrid<u16> {
    let (width, height) = (labels.width, labels.height);
    let mut changed = labels.clone();
    for (own, parts) in parts(labels) {
        let is_first = |part: &&Part| part.indices(width).next().is_some_and(|first| firsts.contains(&first));
        for part in parts.iter().filter(is_first) {
            let mut around: BTreeMap<u16, usize> = BTreeMap::from([(UNLABELLED, 0)]);
            for index in part.indices(width) {
                let (x, y) = (index % width, index / width);
                for (x, y) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                    if x < width && y < height && *labels.at(x, y) != own {
                        *around.entry(*labels.at(x, y)).or_default() += 1;
                    }
                }
            }
            let most = around.into_iter().max_by_key(|(_, sides)| *sides);
            let label = most.map_or(UNLABELLED, |(label, _)| label);
            part.indices(width).for_each(|index| changed.pixels[index as usize] = label);
        }
    }
    changed
}
