//! Colours inside masks, and those that are usual for an object.

use std::collections::BTreeMap;

use super::{Mask, Now};

/// Bins of a channel, and of a colour.
const BINS: usize = 6;
const COLORS: usize = BINS * BINS * BINS;

/// Pixels and masks below which the colours of an object are not known.
pub(super) const FEWEST_PIXELS: usize = 30;
const FEWEST_MASKS: usize = 8;

/// Rounds in which masks that are unlike the others are left out of what is usual, and how unlike.
const ROUNDS: usize = 3;
pub(super) const UNUSUAL: f64 = 0.1;

/// Distribution of colours, summing to one.
#[derive(Clone, Debug)]
pub(super) struct Colors(Vec<f64>);

impl Colors {
    /// Distribution of the colours of some pixels.
    pub(super) fn of(pixels: impl Iterator<Item = [u8; 3]>) -> Self {
        let mut sum = vec![0.0; COLORS];
        let mut count = 0.0_f64;
        for color in pixels {
            add(&mut sum, color);
            count += 1.0;
        }
        sum.iter_mut().for_each(|value| *value /= count.max(1.0));
        Self(sum)
    }

    fn mean<'a>(all: impl Iterator<Item = &'a Self>) -> Self {
        let mut sum = vec![0.0; COLORS];
        let mut count = 0.0_f64;
        for Self(colors) in all {
            count += 1.0;
            sum.iter_mut().zip(colors).for_each(|(sum, value)| *sum += value);
        }
        sum.iter_mut().for_each(|value| *value /= count.max(1.0));
        Self(sum)
    }

    /// Bhattacharyya coefficient: 1 for equal distributions, 0 for those without a common colour.
    pub(super) fn likeness(&self, other: &Self) -> f64 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a * b).sqrt()).sum()
    }
}

/// Adds a colour to the bins around it.
fn add(sum: &mut [f64], color: [u8; 3]) {
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

/// Usual colours of an object, and the usual likeness of its masks to them.
pub(super) struct Usual {
    colors: Colors,
    middle: f64,
}

impl Usual {
    fn of(masks: &[&Colors]) -> Self {
        let mut colors = Colors::mean(masks.iter().copied());
        let mut middle = 1.0;
        for _ in 0..ROUNDS {
            let like: Vec<f64> = masks.iter().map(|mask| mask.likeness(&colors)).collect();
            let mut sorted = like.clone();
            sorted.sort_by(f64::total_cmp);
            middle = sorted[sorted.len() / 2];
            let kept = masks.iter().zip(&like).filter(|(_, like)| **like >= middle - UNUSUAL);
            colors = Colors::mean(kept.map(|(mask, _)| *mask));
        }
        Self { colors, middle }
    }

    /// Likeness of a mask.
    pub(super) fn likeness(&self, mask: &Mask) -> f64 {
        mask.colors.likeness(&self.colors)
    }

    /// By how much a mask is less like the object than most of its masks are.
    pub(super) fn unlike(&self, mask: &Mask) -> f64 {
        self.middle - self.likeness(mask)
    }
}

/// Usual colours of the objects with enough masks of enough pixels, by label.
pub(super) fn usual(frames: &[Now<'_>]) -> BTreeMap<u16, Usual> {
    let mut masks: BTreeMap<u16, Vec<&Colors>> = BTreeMap::new();
    for (label, mask) in frames.iter().flatten() {
        if mask.pixels >= FEWEST_PIXELS {
            masks.entry(*label).or_default().push(&mask.colors);
        }
    }
    masks.retain(|_, masks| masks.len() >= FEWEST_MASKS);
    masks.iter().map(|(label, masks)| (*label, Usual::of(masks))).collect()
}
