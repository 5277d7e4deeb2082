//! Colours that are typical of an object: those of most of its masks.

use std::collections::BTreeMap;

use super::colors::Colors;
use super::masks::Now;

/// Pixels and masks below which the colours of an object are not known.
pub(super) const FEWEST_PIXELS: usize = 30;
const FEWEST_MASKS: usize = 8;

/// Rounds in which masks that are unlike the others are left out of what is typical, and how unlike.
const ROUNDS: usize = 3;
pub(super) const UNUSUAL: f64 = 0.1;

/// Largest share of the masks of an object that may be switched, or stray; beyond, nobody knows what is typical.
pub(super) const MOST: f64 = 0.4;

/// Typical colours of an object, and the median likeness of its masks to them.
pub(super) struct TypicalColors {
    colors: Colors,
    middle: f64,
}

impl TypicalColors {
    fn of(masks: &[&Colors]) -> Self {
        let mut colors = Colors::mean(masks.iter().map(|mask| (*mask, 1.0)));
        let mut middle = 1.0;
        for _ in 0..ROUNDS {
            let like: Vec<f64> = masks.iter().map(|mask| mask.likeness(&colors)).collect();
            let mut sorted = like.clone();
            sorted.sort_by(f64::total_cmp);
            middle = sorted[sorted.len() / 2];
            let kept = masks.iter().zip(&like).filter(|(_, like)| **like >= middle - UNUSUAL);
            colors = Colors::mean(kept.map(|(mask, _)| (*mask, 1.0)));
        }
        Self { colors, middle }
    }

    /// Likeness of the colours of a mask, or of a piece of one.
    pub(super) fn likeness(&self, colors: &Colors) -> f64 {
        colors.likeness(&self.colors)
    }

    /// By how much these are less like the object than most of its masks are.
    pub(super) fn unlike(&self, colors: &Colors) -> f64 {
        self.middle - self.likeness(colors)
    }
}

/// Typical colours of the objects with enough masks of enough pixels, by label.
pub(super) fn typical_colors(frames: &[Now<'_>]) -> BTreeMap<u16, TypicalColors> {
    let mut masks: BTreeMap<u16, Vec<&Colors>> = BTreeMap::new();
    for (label, mask) in frames.iter().flatten() {
        if mask.pixels >= FEWEST_PIXELS {
            masks.entry(*label).or_default().push(&mask.colors);
        }
    }
    masks.retain(|_, masks| masks.len() >= FEWEST_MASKS);
    masks.iter().map(|(label, masks)| (*label, TypicalColors::of(masks))).collect()
}
