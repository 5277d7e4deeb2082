//! Masks of all frames of a camera from some of them.
//!
//! Between two keyframes, ids are brought from both along the optical flow, step by step; each step is weighed with what
//! the pixels look like ([`step`]), and the two are blended by distance in time and by how reliable each was
//! ([`fuse`]). Before the first and after the last keyframe there is one direction only.
//!
//! | module | answers |
//! |---|---|
//! | [`clip`] | frames of a camera, those whose ids are known, and the masks that come of them |
//! | [`motion`] | motion from a frame to its neighbour, and how far it is trusted |
//! | [`window`] | flows and looks of some frames in a row |
//! | [`scenery`] | pixels that cannot be of what stands around them |
//! | [`belief`] | probabilities of classes per pixel |
//! | [`step`] | from one frame to the next |
//! | [`agree`] | pixels that follow their neighbours of the same colour |
//! | [`fuse`] | ids and confidence from one belief or two |

mod agree;
pub(crate) mod belief;
mod clip;
mod fuse;
mod motion;
mod scenery;
mod step;
mod window;

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use cif_geometry::PixelGrid;
use cif_system::memory::Need;

pub use self::clip::{Clip, Keyframe, Mask};
use crate::Error;
use crate::appearance::{Features, Forest, Samples};
use crate::picture::Picture;
use belief::{Belief, Stored};
use step::Step;
use window::{Seen, Window};

/// Longest side at which images are followed, pixels; larger ones are reduced, and their masks enlarged at the end.
const LONGEST_SIDE: usize = 640;

/// Bytes that flows and looks of a window may take.
const WINDOW_BYTES: usize = 1 << 28;

/// Bytes that images may take while they are read and reduced, all threads together; at least one is read at a time.
const READ_BYTES: usize = 1 << 30;

/// Bytes that a pixel of an image takes meanwhile: decoded (4), in floats before and after a reduction (24), as it is handed
/// over (3), and in planes (12).
const READ_BYTES_PER_PIXEL: usize = 43;

/// Most frames of a window.
const WINDOW_FRAMES: usize = 32;

/// Keyframes whose pixels train the appearance of classes: those nearest in time.
const NEAREST_KEYFRAMES: usize = 4;

/// Confidence from which a pixel of a keyframe stands for its class.
pub(crate) const SURE: f32 = 0.5;

/// Propagates the keyframes of a clip to all frames. `done` takes each mask with its frame, in no particular order.
///
/// The result does not depend on the number of threads.
///
/// # Errors
/// When an image cannot be read, no keyframe shows an object, the caller asks to stop, or `done` fails.
pub fn propagate(
    clip: &Clip<'_>,
    done: &mut dyn FnMut(usize, Mask) -> Result<(), Error>,
) -> Result<(), Error> {
    let classes = Classes::new(clip.keyframes.values().map(|keyframe| &keyframe.ids));
    if classes.ids.len() < 2 {
        return Err(Error::NoObject);
    }
    let image = (clip.image)(*clip.keyframes.keys().next().ok_or(Error::NoObject)?)?;
    let full = (image.width as usize, image.height as usize);
    let keys: Vec<usize> = clip.keyframes.keys().copied().collect();
    memory_of_beliefs(&keys, classes.ids.len(), size_to_follow(full.0, full.1)).check()?;
    let run = Run::new(clip, classes, full)?;
    for key in &keys {
        done(*key, run.keyframe_mask(*key))?;
    }
    let (first, last) = (keys[0], keys[keys.len() - 1]);
    run.one_way(first, (0..first).rev(), done)?;
    for pair in keys.windows(2) {
        run.between(pair[0], pair[1], done)?;
    }
    run.one_way(last, last + 1..clip.frames, done)
}

/// Memory that beliefs take: of a frame about all classes, and of the frames between two keyframes about the few that are
/// kept.
fn memory_of_beliefs(keys: &[usize], classes: usize, (width, height): (usize, usize)) -> Need {
    /// Beliefs at a time, of a float per class: both directions, their blend, and that after neighbours were asked.
    const BELIEFS: u64 = 4;
    let gap = keys.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(0) as u64;
    let [pixels, classes] = [width * height, classes].map(|number| number as u64);
    let kept = Stored::BYTES_PER_PIXEL as u64;
    Need {
        bytes: pixels * (BELIEFS * classes * 4 + gap * kept),
        arithmetic: format!(
            "{width} x {height} pixels x ({BELIEFS} beliefs x {classes} classes x 4 bytes + {gap} frames between \
             keyframes x {kept} bytes)"
        ),
    }
}

/// Ids as consecutive classes.
pub(crate) struct Classes {
    /// Id of every class; the first is 0, unlabelled.
    pub(crate) ids: Vec<u16>,
}

/// The size at which images of a size are followed.
pub(crate) fn size_to_follow(width: usize, height: usize) -> (usize, usize) {
    let reduction = (width.max(height) as f64 / LONGEST_SIDE as f64).max(1.0);
    let reduced = |side: usize| ((side as f64 / reduction).round() as usize).max(1);
    (reduced(width), reduced(height))
}

impl Classes {
    pub(crate) fn new<'a>(masks: impl Iterator<Item = &'a PixelGrid<u16>>) -> Self {
        let mut seen = std::collections::BTreeSet::from([0]);
        for mask in masks {
            // Runs of one id are long.
            seen.extend(mask.pixels.chunk_by(|a, b| a == b).map(|run| run[0]));
        }
        Self { ids: seen.into_iter().collect() }
    }

    pub(crate) fn class_of(&self, id: u16) -> u16 {
        self.ids.binary_search(&id).expect("classes hold every id of the keyframes") as u16
    }
}

/// A clip being propagated.
struct Run<'a> {
    clip: &'a Clip<'a>,
    classes: Classes,
    /// Width and height of the images.
    full: (usize, usize),
    /// Width and height at which they are followed.
    size: (usize, usize),
    /// Pixels of every keyframe that stand for their classes.
    samples: BTreeMap<usize, Samples>,
}

impl<'a> Run<'a> {
    fn new(clip: &'a Clip<'a>, classes: Classes, full: (usize, usize)) -> Result<Self, Error> {
        let size = size_to_follow(full.0, full.1);
        let mut run = Self { clip, classes, full, size, samples: BTreeMap::new() };
        for (frame, keyframe) in clip.keyframes {
            run.go_on()?;
            let features = Features::new(&Picture::new(&(clip.image)(*frame)?, size.0, size.1));
            let (classes, reliability) = run.known(keyframe);
            let samples = Samples::new(&features, run.classes.ids.len(), |pixel| {
                (reliability[pixel] >= SURE).then_some(classes[pixel])
            });
            run.samples.insert(*frame, samples);
        }
        Ok(run)
    }

    fn go_on(&self) -> Result<(), Error> {
        if (self.clip.stop)() { Err(Error::Stopped) } else { Ok(()) }
    }

    /// Class and reliability of every pixel of a keyframe, at the size at which frames are followed.
    fn known(&self, keyframe: &Keyframe) -> (Vec<u16>, Vec<f32>) {
        let (width, height) = self.size;
        let ids = &keyframe.ids;
        let source = |k: usize, target: usize, source: u32| (2 * k + 1) * source as usize / (2 * target);
        let pixels = (0..width * height).map(|k| {
            let (x, y) = (source(k % width, width, ids.width), source(k / width, height, ids.height));
            let at = y * ids.width as usize + x;
            let confidence = keyframe.confidence.as_ref().map_or(1.0, |grid| grid.pixels[at]);
            (self.classes.class_of(ids.pixels[at]), confidence)
        });
        pixels.unzip()
    }

    fn start(&self, frame: usize) -> Belief {
        let (classes, reliability) = self.known(&self.clip.keyframes[&frame]);
        Belief::in_classes(self.classes.ids.len(), &classes, reliability)
    }

    /// A keyframe as it leaves: as it was given, at the size of the images.
    fn keyframe_mask(&self, frame: usize) -> Mask {
        let keyframe = &self.clip.keyframes[&frame];
        let (width, height) = self.full;
        let source = |k: usize, target: usize, source: u32| (2 * k + 1) * source as usize / (2 * target);
        let at = |k: usize| {
            let x = source(k % width, width, keyframe.ids.width);
            source(k / width, height, keyframe.ids.height) * keyframe.ids.width as usize + x
        };
        let confidence = |k: usize| {
            keyframe.confidence.as_ref().map_or(255, |grid| (grid.pixels[at(k)] * 255.0 + 0.5) as u8)
        };
        let pixels = 0..width * height;
        let (width, height) = (width as u32, height as u32);
        Mask {
            ids: PixelGrid::from_pixels(
                width,
                height,
                pixels.clone().map(|k| keyframe.ids.pixels[at(k)]).collect(),
            ),
            confidence: PixelGrid::from_pixels(width, height, pixels.map(confidence).collect()),
        }
    }

    /// Appearance of the classes around a time: the nearest keyframes, of two equally near ones the earlier.
    fn forest(&self, frames: RangeInclusive<usize>) -> Forest {
        let distance = |key: &usize| frames.start().abs_diff(*key) + frames.end().abs_diff(*key);
        let mut keys: Vec<usize> = self.samples.keys().copied().collect();
        keys.sort_by_key(distance);
        let mut samples = Samples::default();
        for key in keys.iter().take(NEAREST_KEYFRAMES) {
            samples.extend(&self.samples[key]);
        }
        Forest::new(&samples, self.classes.ids.len())
    }

    /// Frames that a window takes with its flows and looks.
    fn window_frames(&self) -> usize {
        // Two flows of two numbers of four bytes with their trust, three of colour, and a byte per class.
        let frame = self.size.0 * self.size.1 * (36 + self.classes.ids.len());
        (WINDOW_BYTES / frame.max(1)).clamp(2, WINDOW_FRAMES)
    }

    fn window(&self, frames: RangeInclusive<usize>, forest: &Forest) -> Result<Window, Error> {
        self.go_on()?;
        let image = READ_BYTES_PER_PIXEL * self.full.0 * self.full.1;
        let at_once = (READ_BYTES / image.max(1)).max(1);
        Window::new(self.clip, frames, at_once, self.size, forest)
    }

    fn step(&self, window: &Window, from: usize, to: usize, known: &Belief) -> Result<Belief, Error> {
        self.go_on()?;
        let (width, height) = self.size;
        Ok(Step { width, height, motion: window.motion(from, to), seen: window.seen(to) }.take(known))
    }

    fn mask(&self, directions: &[(f32, &Belief)], seen: &Seen) -> Mask {
        fuse::mask(directions, &seen.lab, &self.classes.ids, self.size, self.full)
    }

    /// From a keyframe through frames that have no keyframe beyond them.
    fn one_way(
        &self,
        key: usize,
        frames: impl Iterator<Item = usize>,
        done: &mut dyn FnMut(usize, Mask) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let frames: Vec<usize> = frames.collect();
        if frames.is_empty() {
            return Ok(());
        }
        let forest = self.forest(key..=key);
        let mut belief = self.start(key);
        // Nothing else shows what the keyframe does not.
        belief.shown.fill(true);
        let mut at = key;
        for some in frames.chunks(self.window_frames() - 1) {
            let end = some[some.len() - 1];
            let window = self.window(at.min(end)..=at.max(end), &forest)?;
            for next in some {
                belief = self.step(&window, at, *next, &belief)?;
                at = *next;
                done(at, self.mask(&[(1.0, &belief)], window.seen(at)))?;
            }
        }
        Ok(())
    }

    /// Between two keyframes: forwards first, remembering what is believed; then backwards, blending both.
    fn between(
        &self,
        first: usize,
        last: usize,
        done: &mut dyn FnMut(usize, Mask) -> Result<(), Error>,
    ) -> Result<(), Error> {
        if last - first < 2 {
            return Ok(());
        }
        let forest = self.forest(first..=last);
        let length = self.window_frames() - 1;
        let starts: Vec<usize> = (first..last).step_by(length).collect();
        let frames = |start: usize| start..=(start + length).min(last);
        let mut forwards = BTreeMap::new();
        let mut belief = self.start(first);
        let mut window = None;
        for start in &starts {
            let these = window.insert(self.window(frames(*start), &forest)?);
            for at in *start..*frames(*start).end() {
                belief = self.step(these, at, at + 1, &belief)?;
                forwards.insert(at + 1, Stored::new(&belief));
            }
        }
        let mut belief = self.start(last);
        for start in starts.iter().rev() {
            // The last window is still there.
            let these = match window.take() {
                Some(window) => window,
                None => self.window(frames(*start), &forest)?,
            };
            for at in (*start..*frames(*start).end()).rev().filter(|at| *at > first) {
                belief = self.step(&these, at + 1, at, &belief)?;
                let forward = forwards[&at].restored();
                let share = (last - at) as f32 / (last - first) as f32;
                let directions = [(share, &forward), (1.0 - share, &belief)];
                done(at, self.mask(&directions, these.seen(at)))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_beliefs_grows_with_classes_and_with_frames_between_keyframes() {
        assert_eq!(Stored::BYTES_PER_PIXEL, 10);
        let need = memory_of_beliefs(&[0, 30, 130, 131], 65, (640, 360));
        assert_eq!(need.bytes, 640 * 360 * (16 * 65 + 100 * 10));
        assert!(need.arithmetic.contains("65 classes") && need.arithmetic.contains("100 frames"), "{need:?}");
    }
}
