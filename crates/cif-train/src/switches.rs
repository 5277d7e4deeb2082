//! Masks of one object that show another, as trackers leave them when they lose an object and take up another: found
//! by the colours inside, and put right.
//!
//! Every object has a usual distribution of colours, that of most of its masks. A mask is switched where its own
//! colours are those of another object, and not those of its own. Two masks of a frame that show each other are
//! exchanged; any other switched mask is taken away, for nobody knows where the object is.

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

use crate::frames::TrainFrame;

/// Bins of a channel, and of a colour.
const BINS: usize = 6;
const COLORS: usize = BINS * BINS * BINS;

/// Pixels below which the colours of a mask say little, and masks below which those of an object do.
const FEWEST_PIXELS: usize = 30;
const FEWEST_MASKS: usize = 8;

/// Rounds in which masks that are unlike the others are left out of what is usual, and how unlike.
const ROUNDS: usize = 3;
const UNUSUAL: f64 = 0.1;

/// Likeness to another object from which a mask may show it, and by how much this exceeds the likeness to its own.
const LIKE: f64 = 0.93;
const MORE: f64 = 0.12;

/// Largest share of the masks of an object that may be switched; beyond, nobody knows what is usual.
const MOST: f64 = 0.4;

/// Distribution of colours, summing to one.
type Colors = Vec<f64>;

/// Colours of the masks of a frame that are large enough, by label.
pub(crate) fn colors(frame: &TrainFrame) -> BTreeMap<u16, Colors> {
    let Some(labels) = &frame.labels else { return BTreeMap::new() };
    let mut sums: BTreeMap<u16, (usize, Colors)> = BTreeMap::new();
    for (label, color) in labels.pixels.iter().zip(&frame.image.pixels) {
        if *label != UNLABELLED {
            let (pixels, sum) = sums.entry(*label).or_insert_with(|| (0, vec![0.0; COLORS]));
            *pixels += 1;
            add(sum, *color);
        }
    }
    let large = sums.into_iter().filter(|(_, (pixels, _))| *pixels >= FEWEST_PIXELS);
    large.map(|(label, (pixels, sum))| (label, sum.iter().map(|v| v / pixels as f64).collect())).collect()
}

/// Adds a colour to the bins around it.
fn add(sum: &mut Colors, color: [u8; 3]) {
    let places = color.map(|value| {
        let at = (f64::from(value) / 255.0 * (BINS - 1) as f64).clamp(0.0, (BINS - 1) as f64);
        let low = (at as usize).min(BINS - 2);
        (low, at - low as f64)
    });
    for corner in 0..8 {
        let (mut bin, mut share) = (0, 1.0);
        for (channel, (low, more)) in places.iter().enumerate() {
            let up = corner >> channel & 1;
            bin = bin * BINS + low + up;
            share *= if up == 1 { *more } else { 1.0 - more };
        }
        sum[bin] += share;
    }
}

/// Bhattacharyya coefficient: 1 for equal distributions, 0 for those without a common colour.
fn likeness(a: &Colors, b: &Colors) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a * b).sqrt()).sum()
}

fn mean<'a>(all: impl Iterator<Item = &'a Colors>) -> Colors {
    let mut sum = vec![0.0; COLORS];
    let mut count = 0.0_f64;
    for colors in all {
        count += 1.0;
        sum.iter_mut().zip(colors).for_each(|(sum, value)| *sum += value);
    }
    sum.iter().map(|value| value / count.max(1.0)).collect()
}

/// Usual colours of an object, and the usual likeness of its masks to them.
fn usual(masks: &[&Colors]) -> (Colors, f64) {
    let mut model = mean(masks.iter().copied());
    let mut middle = 1.0;
    for _ in 0..ROUNDS {
        let like: Vec<f64> = masks.iter().map(|colors| likeness(colors, &model)).collect();
        let mut sorted = like.clone();
        sorted.sort_by(f64::total_cmp);
        middle = sorted[sorted.len() / 2];
        let kept = masks.iter().zip(&like).filter(|(_, like)| **like >= middle - UNUSUAL);
        model = mean(kept.map(|(colors, _)| *colors));
    }
    (model, middle)
}

/// New labels of the switched masks of every frame, by their old ones; [`UNLABELLED`] for those that are taken away.
/// `frames` hold the [`colors`] of each.
pub(crate) fn switches(frames: &[BTreeMap<u16, Colors>]) -> Vec<BTreeMap<u16, u16>> {
    let mut masks: BTreeMap<u16, Vec<&Colors>> = BTreeMap::new();
    for (label, colors) in frames.iter().flatten() {
        masks.entry(*label).or_default().push(colors);
    }
    masks.retain(|_, masks| masks.len() >= FEWEST_MASKS);
    let models: BTreeMap<u16, (Colors, f64)> =
        masks.iter().map(|(label, masks)| (*label, usual(masks))).collect();
    let shown = |label: &u16, colors: &Colors| {
        let (model, middle) = models.get(label)?;
        let own = likeness(colors, model);
        if own >= middle - UNUSUAL {
            return None;
        }
        let others = models.iter().filter(|(other, _)| *other != label);
        let best = others.map(|(other, (model, _))| (*other, likeness(colors, model)));
        let (other, like) = best.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (like >= LIKE && like >= own + MORE).then_some(other)
    };
    let mut found: Vec<BTreeMap<u16, u16>> = Vec::with_capacity(frames.len());
    let mut counts: BTreeMap<u16, usize> = BTreeMap::new();
    for frame in frames {
        let shows: BTreeMap<u16, u16> =
            frame.iter().filter_map(|(label, colors)| Some((*label, shown(label, colors)?))).collect();
        shows.keys().for_each(|label| *counts.entry(*label).or_default() += 1);
        found.push(shows);
    }
    let doubtful = |label: &u16| counts[label] as f64 > MOST * masks[label].len() as f64;
    for shows in &mut found {
        shows.retain(|label, _| !doubtful(label));
        let pairs = shows.clone();
        for (label, other) in shows.iter_mut() {
            if pairs.get(other) != Some(label) {
                *other = UNLABELLED;
            }
        }
    }
    found
}

/// A mask image with new labels.
pub(crate) fn put_right(labels: &PixelGrid<u16>, renamed: &BTreeMap<u16, u16>) -> PixelGrid<u16> {
    labels.map(|label| renamed.get(label).copied().unwrap_or(*label))
}

#[cfg(test)]
mod tests {
    use super::*;

    const RED: [u8; 3] = [200, 30, 30];
    const GREEN: [u8; 3] = [30, 180, 40];
    const STRIPES: [[u8; 3]; 2] = [[240, 240, 230], [20, 20, 120]];

    /// A red thing (1), a green one (2) and a striped one (3) in shadow and light; `shown` tells which a mask shows.
    fn frames(count: usize, shown: impl Fn(usize, u16) -> Option<u16>) -> Vec<BTreeMap<u16, Colors>> {
        let frame = |k: usize| {
            let image = PixelGrid::from_pixels(
                30,
                10,
                (0..300_u32)
                    .map(|at| {
                        let label = (at % 30 / 10) as u16 + 1;
                        let light = 0.9 + 0.1 * (k as f64 + f64::from(at) * 0.01).sin();
                        let color = match shown(k, label) {
                            Some(1) => RED,
                            Some(2) => GREEN,
                            _ => STRIPES[(at / 2 % 2) as usize],
                        };
                        color.map(|c| (f64::from(c) * light) as u8)
                    })
                    .collect(),
            );
            let labels = PixelGrid::from_pixels(
                30,
                10,
                (0..300_u32)
                    .map(|at| {
                        let label = (at % 30 / 10) as u16 + 1;
                        if shown(k, label).is_some() { label } else { UNLABELLED }
                    })
                    .collect(),
            );
            colors(&TrainFrame { image, labels: Some(labels), labelled: 0, features: None })
        };
        (0..count).map(frame).collect()
    }

    #[test]
    fn exchanged_masks_are_put_back_and_others_are_taken_away() {
        let shown = |k: usize, label: u16| match (k, label) {
            (5 | 6, 1) => Some(2),
            (5 | 6, 2) => Some(1),
            // The red thing is hidden, and its mask on the striped one.
            (11, 1) => Some(3),
            // One mask is missing, which is no switch.
            (13, 2) => None,
            (_, label) => Some(label),
        };
        let found = switches(&frames(20, shown));
        for (k, renamed) in found.iter().enumerate() {
            let expected = match k {
                5 | 6 => BTreeMap::from([(1, 2), (2, 1)]),
                11 => BTreeMap::from([(1, UNLABELLED)]),
                _ => BTreeMap::new(),
            };
            assert_eq!(*renamed, expected, "frame {k}");
        }
        let labels = PixelGrid::from_pixels(3, 1, vec![1, 2, 3]);
        assert_eq!(put_right(&labels, &found[5]).pixels, [2, 1, 3]);
    }

    #[test]
    fn light_and_twins_and_too_many_switches_change_nothing() {
        assert!(switches(&frames(20, |_, label| Some(label))).iter().all(BTreeMap::is_empty));
        let twins = |k: usize, label: u16| Some(if label == 2 || k == 7 { 1 } else { label });
        let found = switches(&frames(20, twins));
        assert!(
            found.iter().all(|renamed| !renamed.contains_key(&1) && !renamed.contains_key(&2)),
            "{found:?}"
        );
        let often =
            |k: usize, label: u16| Some(if k.is_multiple_of(2) && label < 3 { 3 - label } else { label });
        assert!(switches(&frames(20, often)).iter().all(BTreeMap::is_empty));
        assert!(switches(&frames(4, |k, l| Some(if k == 1 { 2 } else { l }))).iter().all(BTreeMap::is_empty));
        assert!(switches(&[]).is_empty());
    }
}
