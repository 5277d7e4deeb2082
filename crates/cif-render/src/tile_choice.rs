//! Which tiles of a view are drawn.

use crate::constants::TILE;

/// Tiles of a view that a forward pass takes part in, row by row, [`TILE`] pixels wide and high.
#[derive(Clone, Copy, Debug)]
pub struct TileChoice<'a> {
    /// Drawn and differentiated.
    pub drawn: &'a [bool],
    /// Those of them whose labels count.
    pub labelled: &'a [bool],
}

impl TileChoice<'_> {
    /// That the choice is one of the tiles of an image of so many pixels.
    ///
    /// # Panics
    /// When it has another number of tiles.
    pub(crate) fn check(&self, width: u32, height: u32) {
        let count = (width.div_ceil(TILE) * height.div_ceil(TILE)) as usize;
        assert_eq!([self.drawn.len(), self.labelled.len()], [count; 2], "tiles of the view");
    }
}
