//! Masks of one object that show another, as trackers leave them when they lose an object and take up another: found
//! by the colours inside and by the places where they are, and put right.
//!
//! Every object has a usual distribution of colours, that of most of its masks, and hardly moves from one frame of a
//! camera to the next. Two masks that change places and soon change back are exchanged (see [`exchanges`]), and so are
//! two that have each the colours of the other. A mask that has the colours of another object alone, or neither the
//! colours of its own nor its place (see [`strays`]), is taken away, for nobody knows where the object is.

mod colors;
mod exchanges;
mod place;
mod strays;

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

use colors::{Colors, FEWEST_PIXELS, UNUSUAL, usual};
use place::{Place, places};

/// Pixels below which a mask is too small to be looked at.
const FEWEST: usize = 8;

/// Likeness to another object from which a mask may show it, and by how much this exceeds the likeness to its own.
const LIKE: f64 = 0.93;
const MORE: f64 = 0.12;

/// Largest share of the masks of an object that may be switched, or stray; beyond, nobody knows what is usual.
const MOST: f64 = 0.4;

/// Captured times between two frames of which one tells of the other.
const NEAR: usize = 3;

/// A mask of one frame.
#[derive(Clone, Debug)]
struct Mask {
    /// Label in the mask file.
    label: u16,
    pixels: usize,
    colors: Colors,
    place: Place,
}

/// Masks of a frame by the label that each of them has now.
type Now<'a> = BTreeMap<u16, &'a Mask>;

/// The masks of a frame.
pub(crate) struct Seen {
    camera: String,
    time: usize,
    masks: Vec<Mask>,
}

impl Seen {
    /// The masks, if there are any, of an image that a camera took at a time of the capture.
    pub(crate) fn of(
        image: &PixelGrid<[u8; 3]>,
        labels: Option<&PixelGrid<u16>>,
        camera: &str,
        time: usize,
    ) -> Self {
        let mut seen = Self { camera: camera.to_owned(), time, masks: Vec::new() };
        let Some(labels) = labels else { return seen };
        let mut pixels: BTreeMap<u16, Vec<[u8; 3]>> = BTreeMap::new();
        for (label, color) in labels.pixels.iter().zip(&image.pixels) {
            if *label != UNLABELLED {
                pixels.entry(*label).or_default().push(*color);
            }
        }
        let mut places = places(labels);
        for (label, colors) in pixels.into_iter().filter(|(_, colors)| colors.len() >= FEWEST) {
            seen.masks.push(Mask {
                label,
                pixels: colors.len(),
                colors: Colors::of(colors.into_iter()),
                place: places.remove(&label).unwrap_or_default(),
            });
        }
        seen
    }
}

/// Frames of one camera in the order of their times.
struct Sequence {
    frames: Vec<usize>,
    times: Vec<usize>,
}

impl Sequence {
    /// Those of every camera.
    fn all(frames: &[Seen]) -> Vec<Self> {
        let mut cameras: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (k, frame) in frames.iter().enumerate() {
            cameras.entry(&frame.camera).or_default().push(k);
        }
        let in_order = |mut of: Vec<usize>| {
            of.sort_by_key(|k| frames[*k].time);
            Self { times: of.iter().map(|k| frames[*k].time).collect(), frames: of }
        };
        cameras.into_values().map(in_order).collect()
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    /// True where a frame follows that before it closely.
    fn follows(&self, at: usize) -> bool {
        at > 0 && self.times[at] - self.times[at - 1] <= NEAR
    }

    /// The frames closely before and after one.
    fn near(&self, at: usize) -> Vec<usize> {
        let before = self.follows(at).then(|| at - 1);
        let after = (at + 1 < self.len() && self.follows(at + 1)).then_some(at + 1);
        before.into_iter().chain(after).collect()
    }
}

/// New labels of the masks of every frame that show another object, by their old ones; [`UNLABELLED`] for those that
/// are taken away.
pub(crate) fn switches(frames: &[Seen]) -> Vec<BTreeMap<u16, u16>> {
    let sequences = Sequence::all(frames);
    let mut now: Vec<Now<'_>> =
        frames.iter().map(|frame| frame.masks.iter().map(|mask| (mask.label, mask)).collect()).collect();
    exchanges::put_back(&sequences, &mut now);
    follow_colors(&mut now);
    strays::take_away(&sequences, &mut now);
    let renamed = |(frame, now): (&Seen, &Now<'_>)| {
        let mut renamed: BTreeMap<u16, u16> =
            frame.masks.iter().map(|mask| (mask.label, UNLABELLED)).collect();
        renamed.extend(now.iter().map(|(label, mask)| (mask.label, *label)));
        renamed.retain(|old, new| old != new);
        renamed
    };
    frames.iter().zip(&now).map(renamed).collect()
}

/// Exchanges masks with the colours of each other, and takes away those with the colours of another object alone.
fn follow_colors(frames: &mut [Now<'_>]) {
    let usual = usual(frames);
    let shown = |label: &u16, mask: &Mask| {
        let object = usual.get(label).filter(|_| mask.pixels >= FEWEST_PIXELS)?;
        if object.unlike(mask) <= UNUSUAL {
            return None;
        }
        let others = usual.iter().filter(|(other, _)| *other != label);
        let best = others.map(|(other, object)| (*other, object.likeness(mask)));
        let (other, like) = best.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (like >= LIKE && like >= object.likeness(mask) + MORE).then_some(other)
    };
    let (mut counts, mut all): (BTreeMap<u16, usize>, BTreeMap<u16, usize>) = Default::default();
    let mut found: Vec<BTreeMap<u16, u16>> = Vec::with_capacity(frames.len());
    for frame in frames.iter() {
        for (label, _) in frame.iter().filter(|(_, mask)| mask.pixels >= FEWEST_PIXELS) {
            *all.entry(*label).or_default() += 1;
        }
        let shows: BTreeMap<u16, u16> =
            frame.iter().filter_map(|(label, mask)| Some((*label, shown(label, mask)?))).collect();
        shows.keys().for_each(|label| *counts.entry(*label).or_default() += 1);
        found.push(shows);
    }
    let doubtful = |label: &u16| counts[label] as f64 > MOST * all[label] as f64;
    for (frame, mut shows) in frames.iter_mut().zip(found) {
        shows.retain(|label, _| !doubtful(label));
        let taken: Vec<(u16, Option<&Mask>)> =
            shows.keys().map(|label| (*label, frame.remove(label))).collect();
        for (label, mask) in taken {
            let other = shows[&label];
            if shows.get(&other) == Some(&label) {
                frame.extend(mask.map(|mask| (other, mask)));
            }
        }
    }
}

/// A mask image with new labels.
pub(crate) fn put_right(labels: &PixelGrid<u16>, renamed: &BTreeMap<u16, u16>) -> PixelGrid<u16> {
    labels.map(|label| renamed.get(label).copied().unwrap_or(*label))
}

#[cfg(test)]
mod tests;
