//! Which pixels of a picture something covers: a bit for each, whatever number of pieces adds to it.

use std::ops::Range;

/// Covered pixels of a picture.
pub(super) struct Coverage {
    pub(super) width: u32,
    pub(super) height: u32,
    /// Bits of the pixels, row by row, the lowest of a word first.
    words: Vec<u64>,
}

impl Coverage {
    /// Nothing of a picture of a size.
    pub(super) fn none((width, height): (u32, u32)) -> Self {
        let pixels = u64::from(width) * u64::from(height);
        Self { width, height, words: vec![0; pixels.div_ceil(64) as usize] }
    }

    /// Adds pixels in a row, by their places in the picture, row by row.
    pub(super) fn add(&mut self, places: Range<u64>) {
        let (mut at, end) = (places.start, places.end);
        while at < end {
            let (word, low) = (at / 64, at % 64);
            let length = (64 - low).min(end - at);
            // `length` ones from `low` on; a word has no more than 64.
            self.words[word as usize] |= (u64::MAX >> (64 - length)) << low;
            at += length;
        }
    }

    /// Forgets all pixels.
    pub(super) fn clear(&mut self) {
        self.words.fill(0);
    }

    /// Number of covered pixels.
    pub(super) fn count(&self) -> u64 {
        self.words.iter().map(|word| u64::from(word.count_ones())).sum()
    }

    /// Places of the covered pixels, ascending.
    pub(super) fn places(&self) -> impl Iterator<Item = usize> {
        self.words.iter().enumerate().filter(|(_, word)| **word != 0).flat_map(|(k, word)| {
            let mut left = *word;
            std::iter::from_fn(move || {
                let bit = left.trailing_zeros() as usize;
                (bit < 64).then(|| {
                    left &= left - 1;
                    64 * k + bit
                })
            })
        })
    }
}
