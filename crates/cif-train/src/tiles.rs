//! Random tiles of a view, from which a step learns in expectation what it would learn from all of them.
//!
//! A step draws so many of the view's tiles without replacement. Every pixel of a drawn tile counts as many times as
//! there are tiles for each drawn one, so that losses and gradients are unbiased. The similarity of a pixel depends
//! on its window, which reaches into the tiles beside its own: those are rendered and differentiated too, but their
//! own pixels do not count. Source: methods reference 11, idea 6.

use cif_render::TileChoice;
use cif_render::constants::TILE;
use rand::Rng;
use rand::seq::SliceRandom;

/// Tiles of a view that a step learns from.
#[derive(Clone, Debug, PartialEq)]
pub struct TileSample {
    columns: u32,
    /// `[rows * columns]`.
    counted: Vec<bool>,
    /// `[rows * columns]`: what is counted, and its neighbours where windows reach into them.
    drawn: Vec<bool>,
    weight: f64,
}

impl TileSample {
    /// A random `share` of the tiles of an image, at least one, all choices of that number alike; `None` when that
    /// is every tile. `windows` asks for the neighbours that the windows of the similarity reach into.
    pub fn draw(width: u32, height: u32, share: f32, windows: bool, rng: &mut impl Rng) -> Option<Self> {
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let tiles = (columns * rows) as usize;
        let wanted = ((tiles as f64 * f64::from(share)).round() as usize).max(1);
        if wanted >= tiles {
            return None;
        }
        let mut order: Vec<u32> = (0..columns * rows).collect();
        let (chosen, _) = order.partial_shuffle(rng, wanted);
        let mut counted = vec![false; tiles];
        for tile in chosen {
            counted[*tile as usize] = true;
        }
        Some(Self::of(columns, counted, windows))
    }

    /// Tiles chosen by the caller, as if at random.
    fn of(columns: u32, counted: Vec<bool>, windows: bool) -> Self {
        let rows = counted.len() as u32 / columns;
        let mut drawn = counted.clone();
        for tile in (0..counted.len() as u32).filter(|tile| windows && counted[*tile as usize]) {
            let (column, row) = (tile % columns, tile / columns);
            for row in row.saturating_sub(1)..(row + 2).min(rows) {
                for column in column.saturating_sub(1)..(column + 2).min(columns) {
                    drawn[(row * columns + column) as usize] = true;
                }
            }
        }
        let chosen = counted.iter().filter(|counted| **counted).count();
        Self { columns, weight: counted.len() as f64 / chosen.max(1) as f64, counted, drawn }
    }

    /// Whether the loss of a pixel counts.
    #[must_use]
    pub fn counts(&self, x: usize, y: usize) -> bool {
        let tile = TILE as usize;
        self.counted[(y / tile) * self.columns as usize + x / tile]
    }

    /// How many times each counts: the tiles for each chosen one.
    #[must_use]
    pub fn weight(&self) -> f64 {
        self.weight
    }

    /// What the renderer has to do.
    #[must_use]
    pub fn choice(&self) -> TileChoice<'_> {
        TileChoice { drawn: &self.drawn, labelled: &self.counted }
    }
}

#[cfg(test)]
mod tests;
