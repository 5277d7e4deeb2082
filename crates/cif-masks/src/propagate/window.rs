//! Flows and looks of some frames in a row.

use std::ops::RangeInclusive;

use rayon::prelude::*;

use super::Clip;
use crate::Error;
use crate::appearance::{Features, Forest};
use crate::flow::{Flow, Pyramid, flow};
use crate::picture::Picture;

/// Facts about some frames in a row that propagation needs.
pub(super) struct Window {
    first: usize,
    /// Between each frame and the next: flow to the next, flow back.
    flows: Vec<[Flow; 2]>,
    /// Per frame, `[pixels][classes]`, 1 / 255.
    looks: Vec<Vec<u8>>,
}

impl Window {
    /// Prepares frames, in parallel, at a size.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub(super) fn new(
        clip: &Clip<'_>,
        frames: RangeInclusive<usize>,
        (width, height): (usize, usize),
        forest: &Forest,
    ) -> Result<Self, Error> {
        let first = *frames.start();
        let prepared: Vec<(Pyramid, Vec<u8>)> = frames
            .into_par_iter()
            .map(|frame| {
                if (clip.stop)() {
                    return Err(Error::Stopped);
                }
                let picture = Picture::new(&(clip.image)(frame)?, width, height);
                let looks = forest.classify(&Features::new(&picture));
                Ok((Pyramid::new(picture.brightness), looks))
            })
            .collect::<Result<_, Error>>()?;
        let (pyramids, looks): (Vec<Pyramid>, Vec<Vec<u8>>) = prepared.into_iter().unzip();
        let flows = pyramids
            .par_windows(2)
            .map(|pair| {
                if (clip.stop)() {
                    return Err(Error::Stopped);
                }
                let (there, back) = rayon::join(|| flow(&pair[0], &pair[1]), || flow(&pair[1], &pair[0]));
                Ok([there, back])
            })
            .collect::<Result<_, Error>>()?;
        Ok(Self { first, flows, looks })
    }

    /// Flows between two neighbouring frames: there, and back.
    pub(super) fn flows(&self, from: usize, to: usize) -> (&Flow, &Flow) {
        let [to_later, to_earlier] = &self.flows[from.min(to) - self.first];
        if from < to { (to_later, to_earlier) } else { (to_earlier, to_later) }
    }

    /// Appearance of the pixels of a frame.
    pub(super) fn looks(&self, frame: usize) -> &[u8] {
        &self.looks[frame - self.first]
    }
}
