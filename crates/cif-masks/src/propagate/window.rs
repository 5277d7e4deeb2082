//! Motion between frames in a row, and their looks.

use std::ops::RangeInclusive;

use rayon::prelude::*;

use super::clip::Clip;
use super::motion::Motion;
use super::scenery;
use crate::Error;
use crate::appearance::{Features, Forest};
use crate::flow::{Pyramid, flow};
use crate::picture::Picture;
use crate::plane::Plane;

/// Standard deviation of the blur under which colours are compared, pixels.
const COLOR_BLUR: f32 = 1.0;

/// A frame of a window.
struct Prepared {
    pyramid: Pyramid,
    /// L*a*b*, blurred a little.
    lab: [Plane; 3],
    looks: Vec<u8>,
}

/// Facts about some frames in a row that propagation needs.
pub(super) struct Window {
    first: usize,
    /// Between each frame and the next: the motion forwards, and back.
    motions: Vec<[Motion; 2]>,
    frames: Vec<Seen>,
}

/// Facts about one frame.
pub(super) struct Seen {
    /// Which class its pixels look like, `[pixels][classes]`, 1 / 255; unlabelled by less where [`scenery`] says so.
    pub(super) looks: Vec<u8>,
    /// L*a*b* of its pixels, blurred a little.
    pub(super) lab: [Plane; 3],
}

impl Window {
    /// Prepares frames, so many of them in parallel, at a size.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub(super) fn new(
        clip: &Clip<'_>,
        frames: RangeInclusive<usize>,
        at_once: usize,
        (width, height): (usize, usize),
        forest: &Forest,
    ) -> Result<Self, Error> {
        let first = *frames.start();
        let prepare = |frame: &usize| {
            if (clip.stop)() {
                return Err(Error::Stopped);
            }
            let picture = Picture::new(&(clip.image)(*frame)?, width, height);
            let looks = forest.classify(&Features::new(&picture));
            let lab = picture.lab.each_ref().map(|plane| plane.blurred(COLOR_BLUR));
            Ok(Prepared { pyramid: Pyramid::new(picture.brightness), lab, looks })
        };
        let frames: Vec<usize> = frames.collect();
        let mut prepared: Vec<Prepared> = Vec::with_capacity(frames.len());
        for some in frames.chunks(at_once) {
            prepared.extend(some.par_iter().map(prepare).collect::<Result<Vec<_>, Error>>()?);
        }
        let motions = prepared
            .par_windows(2)
            .map(|pair| {
                if (clip.stop)() {
                    return Err(Error::Stopped);
                }
                let (a, b) = (&pair[0], &pair[1]);
                let (there, back) =
                    rayon::join(|| flow(&a.pyramid, &b.pyramid), || flow(&b.pyramid, &a.pyramid));
                let to_later = Motion::new(back.clone(), &there, &b.lab, &a.lab);
                Ok([to_later, Motion::new(there, &back, &a.lab, &b.lab)])
            })
            .collect::<Result<Vec<[Motion; 2]>, Error>>()?;
        let factors =
            scenery::factors(&motions, &prepared.iter().map(|frame| &frame.lab).collect::<Vec<_>>());
        for (frame, factors) in prepared.iter_mut().zip(&factors) {
            let classes = frame.looks.len() / factors.len();
            for (looks, factor) in frame.looks.chunks_exact_mut(classes).zip(factors) {
                looks[0] = (f32::from(looks[0]) * factor) as u8;
            }
        }
        let frames = prepared.into_iter().map(|Prepared { lab, looks, .. }| Seen { looks, lab }).collect();
        Ok(Self { first, motions, frames })
    }

    /// Motion from a frame to its neighbour.
    pub(super) fn motion(&self, from: usize, to: usize) -> &Motion {
        let [to_later, to_earlier] = &self.motions[from.min(to) - self.first];
        if from < to { to_later } else { to_earlier }
    }

    /// Looks and colours of a frame.
    pub(super) fn seen(&self, frame: usize) -> &Seen {
        &self.frames[frame - self.first]
    }
}
