//! Pieces of masks: what lies apart from the rest of a mask, and has other colours than its object, is none of it.
//! Trackers and networks that segment leave such blobs somewhere in the image.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

use super::colors::Colors;
use super::masks::{Mask, Now, Sequence};
use super::place::Place;
use super::usual::{MOST, TypicalColors, typical_colors};

/// Distance from the rest of a mask from which a piece lies apart, of the radius of a disc of its area. At this distance and
/// the next threshold 195 of 234 blobs of twelve captures with masks of trackers are found, and of 229 true pieces that
/// something in front of the object leaves 3; at half the distance 208 and 6, and 30 of 46 pieces of a person behind grass,
/// of which this takes none; at twice 171 and 0.
const APART: f64 = 1.0;

/// By how much less than the most typical piece of a mask another one has the colours of the object, from which it is
/// foreign. With 0.15 it is 201 blobs and 3 pieces, with 0.25 191 and 2, with 0.3 184 and 1.
const FOREIGN: f64 = 0.2;

/// Share of a piece that the mask before or after has from which it bears it out.
const BORNE_OUT: f64 = 0.5;

/// Connected pixels below which colours say nothing: they belong to the largest piece.
const FEWEST: usize = 8;

/// Pixels of a mask that lie near each other.
#[derive(Clone, Debug)]
pub(super) struct Piece {
    /// First pixel of each of its connected parts, by index in the image.
    pub firsts: Vec<u32>,
    pub pixels: usize,
    pub colors: Colors,
    pub place: Place,
}

/// Pieces of the masks of an image, by label, the largest first.
pub(super) fn pieces(image: &PixelGrid<[u8; 3]>, labels: &PixelGrid<u16>) -> BTreeMap<u16, Vec<Piece>> {
    let mut parts: BTreeMap<u16, Vec<Vec<u32>>> = BTreeMap::new();
    let mut met = vec![false; labels.pixels.len()];
    for (index, label) in labels.pixels.iter().enumerate() {
        if *label != UNLABELLED && !met[index] {
            parts.entry(*label).or_default().push(connected(labels, index as u32, &mut met));
        }
    }
    let piece = |parts: Vec<Vec<u32>>| Piece {
        firsts: parts.iter().map(|part| part[0]).collect(),
        pixels: parts.iter().map(Vec::len).sum(),
        colors: Colors::of(parts.iter().flatten().map(|index| image.pixels[*index as usize])),
        place: Place::of(parts.into_iter().flatten(), labels.width),
    };
    parts
        .into_iter()
        .map(|(label, parts)| (label, joined(parts, labels.width).into_iter().map(piece).collect()))
        .collect()
}

/// Pixels of one label that touch each other, also by corners, from the first of them on, ascending.
fn connected(labels: &PixelGrid<u16>, first: u32, met: &mut [bool]) -> Vec<u32> {
    let (width, height) = (labels.width, labels.height);
    let label = labels.pixels[first as usize];
    met[first as usize] = true;
    let (mut found, mut at) = (vec![first], 0);
    while let Some(index) = found.get(at).copied() {
        at += 1;
        let (x, y) = (index % width, index / width);
        for y in y.saturating_sub(1)..(y + 2).min(height) {
            for x in x.saturating_sub(1)..(x + 2).min(width) {
                let other = y * width + x;
                if labels.pixels[other as usize] == label && !met[other as usize] {
                    met[other as usize] = true;
                    found.push(other);
                }
            }
        }
    }
    found.sort_unstable();
    found
}

/// Connected parts of a mask by the pieces that they belong to, the largest of each first.
fn joined(mut parts: Vec<Vec<u32>>, width: u32) -> Vec<Vec<Vec<u32>>> {
    let area: usize = parts.iter().map(Vec::len).sum();
    let reach = (APART * (area as f64 / PI).sqrt()) as i64;
    parts.sort_by_key(|part| std::cmp::Reverse(part.len()));
    let mut pieces: Vec<Vec<Vec<u32>>> = Vec::new();
    for part in parts {
        let is_near = |piece: &Vec<Vec<u32>>| {
            part.len() < FEWEST || piece.iter().any(|other| are_near(&part, other, width, reach))
        };
        match pieces.iter().position(is_near) {
            Some(near) => pieces[near].push(part),
            None => pieces.push(vec![part]),
        }
    }
    pieces.sort_by_key(|piece| std::cmp::Reverse(piece.iter().map(Vec::len).sum::<usize>()));
    pieces
}

/// True where some pixels of two lists, of which the second is ascending, are within a distance.
fn are_near(some: &[u32], others: &[u32], width: u32, reach: i64) -> bool {
    let width = i64::from(width);
    some.iter().any(|index| {
        let (x, y) = (i64::from(*index) % width, i64::from(*index) / width);
        (-reach..=reach).any(|down| {
            let half = (reach * reach - down * down).isqrt();
            let row = (y + down) * width;
            let (low, high) = (row + (x - half).max(0), row + (x + half).min(width - 1));
            let next = others.partition_point(|other| i64::from(*other) < low);
            others.get(next).is_some_and(|other| i64::from(*other) <= high)
        })
    })
}

/// Masks without their foreign pieces, and the first pixels of the parts of these, by frame and label.
pub(super) fn without_foreign(
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

/// Gives parts of masks, by their first pixels, the label that surrounds them most.
pub(super) fn take_away(labels: &mut PixelGrid<u16>, firsts: &[u32]) {
    let (width, height) = (labels.width, labels.height);
    let mut met = vec![false; labels.pixels.len()];
    for first in firsts {
        let part = connected(labels, *first, &mut met);
        let own = labels.pixels[*first as usize];
        let mut around: BTreeMap<u16, usize> = BTreeMap::from([(UNLABELLED, 0)]);
        for index in &part {
            let (x, y) = (index % width, index / width);
            for (x, y) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                if x < width && y < height && *labels.at(x, y) != own {
                    *around.entry(*labels.at(x, y)).or_default() += 1;
                }
            }
        }
        let most = around.into_iter().max_by_key(|(_, sides)| *sides).map_or(UNLABELLED, |(label, _)| label);
        part.iter().for_each(|index| labels.pixels[*index as usize] = most);
    }
}
