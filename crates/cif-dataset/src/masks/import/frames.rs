//! Which frame of the capture a picture of a source shows.

use std::collections::{BTreeMap, BTreeSet};

use crate::Dataset;
use crate::files::listing;
use crate::masks::flat_name;

/// Endings that are left out of names of frames.
const ENDINGS: [&str; 10] = ["png", "jpg", "jpeg", "exr", "npy", "npz", "tif", "tiff", "webp", "bmp"];

/// Names of the frames of a capture in the ways that other tools write them.
pub(super) struct FrameNames {
    /// `None` where several frames fit.
    names: BTreeMap<String, Option<usize>>,
    /// Number at the end of the name of each frame, `[frames]`.
    numbers: Vec<Option<u64>>,
    one_camera: bool,
    example: String,
}

/// Frames of pictures.
pub(super) struct Matched {
    /// `[pictures]`.
    pub(super) frames: Vec<Option<usize>>,
    /// How they were found, where names did not fit.
    pub(super) note: Option<String>,
}

impl FrameNames {
    pub(super) fn new(dataset: &Dataset) -> Self {
        let mut names: BTreeMap<String, Option<usize>> = BTreeMap::new();
        let mut enter = |name: String, frame: usize| {
            names.entry(name).and_modify(|one| *one = one.filter(|one| *one == frame)).or_insert(Some(frame));
        };
        for (index, frame) in dataset.frames.iter().enumerate() {
            enter(frame.name.clone(), index);
            enter(flat_name(&frame.name), index);
            enter(listing::stem(&frame.image), index);
        }
        let cameras: BTreeSet<&str> = dataset.frames.iter().map(|frame| frame.camera_name.as_str()).collect();
        Self {
            names,
            numbers: dataset.frames.iter().map(|frame| number_of(&frame.name)).collect(),
            one_camera: cameras.len() <= 1,
            example: dataset.frames.first().map(|frame| frame.name.clone()).unwrap_or_default(),
        }
    }

    /// The frame of a name, which may have an ending of images.
    pub(super) fn whole(&self, name: &str) -> Option<usize> {
        let known = |name: &str| self.names.get(name).copied().flatten();
        known(name).or_else(|| known(without_ending(name)))
    }

    /// The frame of a name, also behind folders that the capture does not have.
    fn find(&self, name: &str) -> Option<usize> {
        let mut rest = name;
        loop {
            if let Some(frame) = self.whole(rest) {
                return Some(frame);
            }
            rest = rest.split_once('/')?.1;
        }
    }

    /// How many different frames names stand for, as names, else as numbers.
    pub(super) fn reach(&self, names: &BTreeSet<&str>) -> (usize, usize) {
        let named: BTreeSet<usize> = names.iter().filter_map(|name| self.find(name)).collect();
        let list: Vec<&str> = names.iter().copied().collect();
        let numbered =
            self.by_number(&list).or_else(|| self.in_order(&list)).map_or(0, |found| found.frames.len());
        (named.len(), numbered)
    }

    /// The frames of pictures. Names count first; where none is a name of a frame, numbers at their ends do: those of
    /// the frames, whatever zeros they begin with, else places in the order of the capture.
    ///
    /// # Errors
    /// When nothing fits.
    pub(super) fn resolve(&self, names: &[&str]) -> Result<Matched, String> {
        let normal: Vec<String> = names.iter().map(|name| name.replace('\\', "/")).collect();
        let frames: Vec<Option<usize>> = normal.iter().map(|name| self.find(name)).collect();
        if frames.iter().any(Option::is_some) {
            return Ok(Matched { frames, note: None });
        }
        self.by_number(names).or_else(|| self.in_order(names)).ok_or_else(|| {
            format!(
                "none of its {} pictures belongs to a frame: they are named as {}, frames as {}; rename them as the \
                 frames",
                names.len(),
                names.first().copied().unwrap_or_default(),
                self.example
            )
        })
    }

    /// Every name by the number that it ends in, where each is the number of one frame.
    fn by_number(&self, names: &[&str]) -> Option<Matched> {
        let mut frames: BTreeMap<u64, Option<usize>> = BTreeMap::new();
        for (frame, number) in self.numbers.iter().enumerate() {
            frames.entry((*number)?).and_modify(|one| *one = None).or_insert(Some(frame));
        }
        let find = |name: &&str| frames.get(&number_of(without_ending(name))?).copied().flatten();
        let found: Vec<Option<usize>> = names.iter().map(find).collect();
        let all = found.iter().all(Option::is_some);
        all.then(|| Matched { frames: found, note: Some("frames were matched by their numbers".to_owned()) })
    }

    /// Every name by its number as a place in the order of the frames, counted from 0, or from 1 where all frames are
    /// there.
    fn in_order(&self, names: &[&str]) -> Option<Matched> {
        let numbers: Vec<u64> =
            names.iter().map(|name| number_of(without_ending(name))).collect::<Option<_>>()?;
        let (first, last) = (*numbers.iter().min()?, *numbers.iter().max()?);
        let count = self.numbers.len() as u64;
        let start = u64::from(first == 1 && last == count);
        if !self.one_camera || last - start >= count {
            return None;
        }
        let note = format!("numbers of the source count the frames of the capture in order, from {start}");
        let frames = numbers.iter().map(|number| Some((number - start) as usize)).collect();
        Some(Matched { frames, note: Some(note) })
    }
}

fn without_ending(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending)) if ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known)) => stem,
        _ => name,
    }
}

/// The number that a name ends in.
fn number_of(name: &str) -> Option<u64> {
    let digits = name.bytes().rev().take_while(u8::is_ascii_digit).count();
    name[name.len() - digits..].parse().ok()
}
