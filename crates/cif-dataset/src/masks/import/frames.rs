//! Which frame of the capture a picture of a source shows.

use std::collections::{BTreeMap, BTreeSet};

use crate::Dataset;
use crate::files::listing;
use crate::masks::{first_number, flat_name, number_of};

/// Endings that are left out of names of frames.
const ENDINGS: [&str; 10] = ["png", "jpg", "jpeg", "exr", "npy", "npz", "tif", "tiff", "webp", "bmp"];

/// Names of the frames of a capture in the ways that other tools write them.
pub(super) struct FrameNames {
    /// `None` where several frames fit.
    names: BTreeMap<String, Option<usize>>,
    /// Number at the end of the name of each frame, `[frames]`.
    numbers: Vec<Option<u64>>,
    /// Cameras by name, with their frames.
    cameras: BTreeMap<String, OfCamera>,
    example: String,
}

/// Frames of a camera.
#[derive(Default)]
struct OfCamera {
    /// Frames by their numbers in the video, else by those that their names end in.
    by_number: BTreeMap<u64, usize>,
    /// How many frames of the capture there are.
    taken: usize,
    /// File name and number of frames of the video that all of them are of.
    video: Option<(String, u64)>,
}

/// Frames that a task of another tool took of a video: every `step`th from `start` on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Task {
    pub(super) start: u64,
    pub(super) step: u64,
}

impl Task {
    /// Place of a frame of the video among those of the task.
    fn place(self, number: u64) -> Option<u64> {
        let after = number.checked_sub(self.start)?;
        after.is_multiple_of(self.step).then_some(after / self.step)
    }
}

/// Frames of pictures.
pub(super) struct Matched {
    /// `[pictures]`.
    pub(super) frames: Vec<Option<usize>>,
    /// True where pictures without a frame are of other frames of its video.
    pub(super) of_video: bool,
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
        let mut cameras: BTreeMap<String, OfCamera> = BTreeMap::new();
        for (index, frame) in dataset.frames.iter().enumerate() {
            let video = frame.source.as_ref().and_then(|source| Some((source.file.clone(), source.video?)));
            let camera = cameras.entry(frame.camera_name.clone()).or_default();
            let number = video.as_ref().map(|(_, place)| place.frame).or_else(|| number_of(&frame.name));
            camera.by_number.extend(number.map(|number| (number, index)));
            let video = video.map(|(file, place)| (file, place.of));
            camera.video = if camera.taken == 0 {
                video
            } else {
                camera.video.take().filter(|one| video.as_ref() == Some(one))
            };
            camera.taken += 1;
        }
        Self {
            names,
            numbers: dataset.frames.iter().map(|frame| number_of(&frame.name)).collect(),
            cameras,
            example: dataset.frames.first().map(|frame| frame.name.clone()).unwrap_or_default(),
        }
    }

    /// The frame of a name, which may have an ending of images.
    pub(super) fn whole(&self, name: &str) -> Option<usize> {
        let known = |name: &str| self.names.get(name).copied().flatten();
        let stem = without_ending(name);
        let as_written = known(name).or_else(|| known(stem));
        as_written.or_else(|| known(before_roboflow(stem)?)).or_else(|| known(stem.strip_suffix("_mask")?))
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
        let numbered = self.of_videos(&list, None).ok().flatten();
        let numbered = numbered.or_else(|| self.by_number(&list)).or_else(|| self.in_order(&list));
        let numbered = numbered.map_or(0, |found| found.frames.len());
        (named.len(), numbered)
    }

    /// The frames of pictures. Names count first where all are names of frames, then numbers at their ends: of the frames
    /// of the video that the capture was made of, then of the frames, whatever zeros they begin with, else places in the
    /// order of the capture. `first` says that the names end in numbers of frames of the video, and which the first has.
    ///
    /// # Errors
    /// When nothing fits, or more than one thing does.
    pub(super) fn resolve(&self, names: &[&str], first: Option<u64>) -> Result<Matched, String> {
        let normal: Vec<String> = names.iter().map(|name| name.replace('\\', "/")).collect();
        let names: Vec<&str> = normal.iter().map(String::as_str).collect();
        let frames: Vec<Option<usize>> = names.iter().map(|name| self.find(name)).collect();
        let named = frames.iter().flatten().count();
        let by_name = Matched { frames, of_video: false, note: None };
        if first.is_none() && named == names.len() {
            return Ok(by_name);
        }
        let of_videos = match self.of_videos(&names, first) {
            Ok(Some(matched)) => return Ok(matched),
            Ok(None) if named > 0 => return Ok(by_name),
            Ok(None) => None,
            Err(problem) => Some(problem),
        };
        if first.is_none()
            && let Some(matched) = self.by_number(&names).or_else(|| self.in_order(&names))
        {
            return Ok(matched);
        }
        Err(of_videos.unwrap_or_else(|| format!(
            "none of its {} pictures belongs to a frame: they are named as {}, frames as {}; rename them as the \
             frames, or, where they are numbered as the frames of the video, say which number its first frame has, as \
             with --first-number 0",
            names.len(),
            names.first().copied().unwrap_or_default(),
            self.example
        )))
    }

    /// The frames of pictures whose names are numbers of frames of a video of which a task took a part: of the video that
    /// the capture was made of where it knows that, else those whose names are such numbers where all frames of the
    /// capture are, else the frames of the capture in order, as those of the task.
    ///
    /// # Errors
    /// When the numbers are no frames of the task, or the capture has fewer frames or several cameras.
    pub(super) fn of_task(&self, names: &[&str], task: Task) -> Result<Matched, String> {
        let Task { start, step } = task;
        if self.cameras.values().all(|camera| camera.video.is_some())
            && let Some(matched) = self.of_videos(names, Some(0))?
        {
            return Ok(matched);
        }
        let of_task = |number: &Option<u64>| number.is_some_and(|number| task.place(number).is_some());
        if self.numbers.len() > 1
            && self.numbers.iter().all(of_task)
            && let Some(matched) = self.by_number(names)
        {
            return Ok(matched);
        }
        let count = self.numbers.len();
        let words = format!("its task took every frame of a video whose number is {start} + {step} k");
        let order = self.order().ok_or_else(|| {
            format!(
                "{words}, and the capture has {} cameras; give the masks of each camera in a folder of its name",
                self.cameras.len()
            )
        })?;
        let place = |name: &&str| {
            let number: u64 = name.parse().map_err(|_| format!("{name:?} is no number of a frame"))?;
            let place =
                task.place(number).ok_or_else(|| format!("{words}, and frame {number} is none of them"))?;
            usize::try_from(place).ok().filter(|place| *place < count).ok_or_else(|| {
                format!(
                    "{words}: frame {number} is number {} of them, and the capture has {count}; give the capture that these \
                     frames are of",
                    place + 1
                )
            })
        };
        let frames = names.iter().map(|name| Ok(Some(order[place(name)?]))).collect::<Result<_, String>>()?;
        let note = format!("{words}: these are the frames of the capture in order");
        Ok(Matched { frames, of_video: false, note: Some(note) })
    }

    /// The frames in the order of one recording: of one camera as they are, of several that count their frames together by
    /// their numbers; `None` where cameras count for themselves.
    fn order(&self) -> Option<Vec<usize>> {
        let mut order: Vec<usize> = (0..self.numbers.len()).collect();
        if self.cameras.len() > 1 {
            let distinct: BTreeSet<u64> = self.numbers.iter().copied().collect::<Option<_>>()?;
            if distinct.len() < order.len() {
                return None;
            }
            order.sort_by_key(|frame| self.numbers[*frame]);
        }
        Some(order)
    }

    /// Every name by the number that it ends in, as the number of a frame of the video of its camera; `None` where the
    /// capture does not know its videos, or names have no numbers.
    ///
    /// # Errors
    /// When nothing shows which number the first frame of a video has.
    fn of_videos(&self, names: &[&str], first: Option<u64>) -> Result<Option<Matched>, String> {
        let mut numbers: BTreeMap<&str, BTreeSet<u64>> = BTreeMap::new();
        let mut places = Vec::with_capacity(names.len());
        for name in names {
            let stem = without_ending(name);
            let (Some(camera), Some(number)) = (self.camera_of(stem), number_of(stem)) else {
                return Ok(None);
            };
            let is_new = numbers.entry(camera).or_default().insert(number);
            if !is_new || (first.is_none() && self.cameras[camera].video.is_none()) {
                return Ok(None);
            }
            places.push((camera, number));
        }
        let mut begins = BTreeMap::new();
        let mut notes = Vec::new();
        for (camera, numbers) in &numbers {
            let of = &self.cameras[*camera];
            let begin = match (first, &of.video) {
                (Some(first), _) => first,
                (None, None) => return Ok(None),
                (None, Some((file, frames))) => first_number(numbers, *frames).map_err(|problem| {
                    format!(
                        "{file}: {problem}; say it with --first-number 0 or 1, or rename them as the frames"
                    )
                })?,
            };
            let known =
                numbers.iter().filter_map(|number| of.by_number.get(&number.checked_sub(begin)?)).count();
            let video = of.video.as_ref().map_or("the video", |(file, _)| file);
            notes.push(format!(
                "{} masks are those of frames of {video}, numbered from {begin}; {known} of these frames are in the capture",
                numbers.len()
            ));
            begins.insert(*camera, begin);
        }
        let frame = |(camera, number): (&str, u64)| {
            self.cameras[camera].by_number.get(&number.checked_sub(begins[camera])?).copied()
        };
        let frames: Vec<Option<usize>> = places.into_iter().map(frame).collect();
        if frames.iter().all(Option::is_none) {
            return Err(format!(
                "{}; the capture has other frames of it, such as {}",
                notes.join("; "),
                self.example
            ));
        }
        Ok(Some(Matched { frames, of_video: true, note: Some(notes.join("; ")) }))
    }

    /// The camera that a name is of: the only one, else that of which a folder, or the beginning of the name, is named.
    fn camera_of(&self, name: &str) -> Option<&str> {
        let mut known = self.cameras.keys().map(String::as_str);
        if self.cameras.len() == 1 {
            return known.next();
        }
        let fits = |camera: &&str| {
            name.match_indices(camera).any(|(at, _)| {
                let before = name[..at].ends_with('/') || at == 0;
                before && name[at + camera.len()..].starts_with(['/', '_', '-', '.'])
            })
        };
        known.filter(fits).max_by_key(|camera| camera.len())
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
        let note = Some("frames were matched by their numbers".to_owned());
        all.then_some(Matched { frames: found, of_video: false, note })
    }

    /// Every name by its number as a place in the order of the frames, counted from 0, or from 1 where all frames are
    /// there. Where the capture knows its video, all have to be there: fewer may be numbers of the video as well.
    fn in_order(&self, names: &[&str]) -> Option<Matched> {
        let numbers: Vec<u64> =
            names.iter().map(|name| number_of(without_ending(name))).collect::<Option<_>>()?;
        let (first, last) = (*numbers.iter().min()?, *numbers.iter().max()?);
        let count = self.numbers.len() as u64;
        let start = u64::from(first == 1 && last == count);
        let [camera] = self.cameras.values().collect::<Vec<_>>()[..] else { return None };
        if last - start >= count || (camera.video.is_some() && names.len() as u64 != count) {
            return None;
        }
        let note = format!("numbers of the source count the frames of the capture in order, from {start}");
        let frames = numbers.iter().map(|number| Some((number - start) as usize)).collect();
        Some(Matched { frames, of_video: false, note: Some(note) })
    }
}

/// The name that a picture had before Roboflow called it `NAME_png.rf.0123456789abcdef0123456789abcdef`.
fn before_roboflow(name: &str) -> Option<&str> {
    let (before, hash) = name.rsplit_once(".rf.")?;
    let (stem, ending) = before.rsplit_once('_')?;
    let is_hash = hash.len() >= 16 && hash.bytes().all(|digit| digit.is_ascii_alphanumeric());
    (is_hash && ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known))).then_some(stem)
}

fn without_ending(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending)) if ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known)) => stem,
        _ => name,
    }
}
