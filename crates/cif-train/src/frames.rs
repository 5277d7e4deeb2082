//! Training frames in memory: decoded once, as bytes, up to a budget; others are decoded ahead of the steps that need
//! them.

mod ahead;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use ahead::Ahead;
pub(crate) use ahead::MOST as MOST_AHEAD;

use cif_dataset::{Dataset, Split};
use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;
use rayon::prelude::*;

use crate::error::TrainError;
use crate::mask_edges::{self, Doubt};
use crate::mask_table::MaskTable;
use crate::phase::Phase;
use crate::phases::Phases;
use crate::switches::{Correction, Seen, corrections};
use crate::tracks::misfits;

/// A decoded frame.
pub(crate) struct TrainFrame {
    /// Target colours.
    pub image: PixelGrid<[u8; 3]>,
    /// Dense instance index + 1, 0 = unlabelled; `None` without a mask.
    pub labels: Option<PixelGrid<u16>>,
    /// Labelled pixels.
    pub labelled: usize,
    /// The feature map, 0 in all channels where there is no feature; `None` where none was given.
    pub features: Option<Arc<PixelGrid<[f32; 3]>>>,
}

/// All training frames of a capture.
pub(crate) struct FrameStore {
    /// Index in the capture, and the frame where it fits into memory.
    frames: Vec<(usize, Option<Arc<TrainFrame>>)>,
    decoding: Arc<Decoding>,
    /// Frames that are being decoded for coming steps, where some do not fit into memory.
    ahead: Option<Ahead>,
    /// Masks of the training frames as they are now, once they were asked for.
    masks: Mutex<Option<Arc<FrameMasks>>>,
}

/// Masks of all training frames, by training frame; `None` without a mask.
pub(crate) type FrameMasks = Vec<Option<MaskTable>>;

/// The masks of a training frame as they were read, before any is put right.
pub(crate) struct ReadMasks {
    table: Option<MaskTable>,
    /// Colours and places, where they were asked for.
    seen: Seen,
}

/// Steps from the files of a frame to the images that are trained on.
#[derive(Clone)]
struct Decoding {
    label_of_id: Vec<u16>,
    background: [f32; 3],
    /// Files of feature maps, by index in the capture.
    maps: BTreeMap<usize, PathBuf>,
    /// Changes to masks that show something else, by index in the capture.
    corrections: BTreeMap<usize, Correction>,
    /// True where outlines of masks are moved to where colours change.
    moves_edges: bool,
}

/// Pixels of masks with less confidence than this, in units of 1 / 255, are taken as unlabelled: their ids are wrong
/// nearly as often as right (measured on propagated masks).
const LEAST_CONFIDENCE: u8 = 192;

/// Frames that decide whether masks are rough.
const LOOKED: usize = 32;

/// Frames decoded together before the budget is looked at again.
const BATCH: usize = 32;

impl FrameStore {
    /// Decodes frames, with their feature maps where there are `maps`, until the budget is used.
    pub(crate) fn open(
        dataset: &Dataset,
        background: [f32; 3],
        maps: BTreeMap<usize, PathBuf>,
        budget: u64,
        phases: &Phases,
    ) -> Result<Self, TrainError> {
        let mut label_of_id = vec![UNLABELLED; usize::from(u16::MAX) + 1];
        for (k, instance) in dataset.instances.iter().enumerate() {
            label_of_id[usize::from(instance.id)] = k as u16 + 1;
        }
        let training = dataset.frames.iter().enumerate().filter(|(_, f)| f.split == Split::Train);
        let frames = training.map(|(index, _)| (index, None)).collect();
        let corrections = BTreeMap::new();
        let decoding = Arc::new(Decoding { label_of_id, background, maps, corrections, moves_edges: false });
        let mut store = Self { frames, decoding, ahead: None, masks: Mutex::default() };
        if store.frames.is_empty() {
            return Err(TrainError::NoTrainingFrames { root: dataset.root.clone() });
        }
        let _phase = phases.enter(Phase::Decode, store.frames.len());
        let decode = |k: usize| {
            phases.check()?;
            let frame = store.load(dataset, k)?;
            phases.advance();
            Ok(frame)
        };
        let (mut used, mut kept) = (0, Vec::new());
        for start in (0..store.frames.len()).step_by(BATCH) {
            let end = (start + BATCH).min(store.frames.len());
            if used > budget {
                break;
            }
            let decoded: Vec<_> =
                (start..end).into_par_iter().map(decode).collect::<Result<_, TrainError>>()?;
            for (k, frame) in (start..end).zip(decoded) {
                used += frame.bytes();
                if used <= budget {
                    kept.push((k, frame));
                }
            }
        }
        for (k, frame) in kept {
            store.frames[k].1 = Some(Arc::new(frame));
        }
        if store.not_kept() > 0 {
            store.ahead = Some(Ahead::of(dataset));
        }
        Ok(store)
    }

    /// Frames of a capture, by their indices, of which none is kept.
    pub(crate) fn decoded_ahead(dataset: &Dataset, indices: Vec<usize>, background: [f32; 3]) -> Self {
        let decoding = Decoding {
            label_of_id: vec![UNLABELLED; usize::from(u16::MAX) + 1],
            background,
            maps: BTreeMap::new(),
            corrections: BTreeMap::new(),
            moves_edges: false,
        };
        Self {
            frames: indices.into_iter().map(|index| (index, None)).collect(),
            decoding: Arc::new(decoding),
            ahead: Some(Ahead::of(dataset)),
            masks: Mutex::default(),
        }
    }

    /// Begins to decode training frames that are needed soon, in the order given, on other threads. Frames that are in
    /// memory, or begun already, are passed over; those begun before that are not among them are given up.
    pub(crate) fn expect(&self, coming: impl IntoIterator<Item = usize>) {
        let Some(ahead) = &self.ahead else { return };
        let missing = coming.into_iter().filter(|k| self.frames[*k].1.is_none()).map(|k| self.frames[k].0);
        ahead.expect(missing, &self.decoding);
    }

    /// Number of training frames.
    pub(crate) fn len(&self) -> usize {
        self.frames.len()
    }

    /// Frames that are decoded again whenever they are needed.
    pub(crate) fn not_kept(&self) -> usize {
        self.frames.iter().filter(|(_, frame)| frame.is_none()).count()
    }

    /// Index in the capture of training frame `k`.
    pub(crate) fn index(&self, k: usize) -> usize {
        self.frames[k].0
    }

    /// Training frame `k`.
    pub(crate) fn get(&self, dataset: &Dataset, k: usize) -> Result<Arc<TrainFrame>, TrainError> {
        match &self.frames[k].1 {
            Some(frame) => Ok(Arc::clone(frame)),
            None => match self.ahead.as_ref().and_then(|ahead| ahead.take(self.frames[k].0)) {
                Some(frame) => Ok(Arc::new(frame?)),
                None => Ok(Arc::new(self.load(dataset, k)?)),
            },
        }
    }

    /// True when any frame has a labelled pixel; frames not kept count by having a mask.
    pub(crate) fn has_labels(&self, dataset: &Dataset) -> bool {
        self.frames.iter().any(|(index, frame)| match frame {
            Some(frame) => frame.labelled > 0,
            None => dataset.frames[*index].mask.is_some(),
        })
    }

    /// Masks of the training frames as they are now: read when they are asked for first, in one pass over all frames.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(crate) fn masks(&self, dataset: &Dataset, phases: &Phases) -> Result<Arc<FrameMasks>, TrainError> {
        let known = || self.masks.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(masks) = &*known() {
            return Ok(Arc::clone(masks));
        }
        let read = |k: usize| {
            phases.check()?;
            Ok(self.get(dataset, k)?.labels.as_ref().map(MaskTable::of))
        };
        let masks: FrameMasks =
            (0..self.len()).into_par_iter().map(read).collect::<Result<_, TrainError>>()?;
        Ok(Arc::clone(known().insert(Arc::new(masks))))
    }

    /// Frames, or their masks, have changed.
    fn forget_masks(&mut self) {
        *self.masks.get_mut().unwrap_or_else(PoisonError::into_inner) = None;
        self.ahead.iter().for_each(Ahead::give_up);
    }

    /// Reads the masks of the training frames, before any is put right; `with_colors` with their colours and places.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(crate) fn read_masks(
        &self,
        dataset: &Dataset,
        with_colors: bool,
        phases: &Phases,
    ) -> Result<Vec<ReadMasks>, TrainError> {
        let read = |k: usize| {
            phases.check()?;
            let of = &dataset.frames[self.index(k)];
            let frame = self.get(dataset, k)?;
            phases.advance();
            let labels = frame.labels.as_ref();
            let colored = labels.filter(|_| with_colors);
            let seen = Seen::of(&frame.image, colored, &of.camera_name, of.time_index);
            Ok(ReadMasks { table: labels.map(MaskTable::of), seen })
        };
        (0..self.len()).into_par_iter().map(read).collect()
    }

    /// Leaves out the training frames whose masks contradict the others (see [`misfits`]), also of what was `read`;
    /// their indices in the capture.
    pub(crate) fn leave_out_outliers(
        &mut self,
        dataset: &Dataset,
        read: &mut Vec<ReadMasks>,
        limit: f64,
    ) -> Vec<usize> {
        let (mut masked, mut seen) = (Vec::new(), Vec::new());
        for (k, masks) in read.iter().enumerate() {
            if let Some(table) = &masks.table {
                let frame = &dataset.frames[self.index(k)];
                masked.push(k);
                seen.push(table.observations(&frame.camera, frame.time_index));
            }
        }
        let left_out: Vec<usize> = misfits(&seen, limit).into_iter().map(|k| self.index(masked[k])).collect();
        let mut kept = self.frames.iter().map(|(index, _)| !left_out.contains(index));
        read.retain(|_| kept.next() == Some(true));
        self.frames.retain(|(index, _)| !left_out.contains(index));
        self.forget_masks();
        left_out
    }

    /// Puts right the masks that show something else by what was `read` of them (see [`crate::switches`]); the changes
    /// by index in the capture.
    pub(crate) fn put_masks_right(&mut self, read: Vec<ReadMasks>) -> &BTreeMap<usize, Correction> {
        let seen: Vec<Seen> = read.into_iter().map(|masks| masks.seen).collect();
        let found = corrections(&seen).into_iter().zip(&mut self.frames);
        for (correction, (index, frame)) in found.filter(|(correction, _)| !correction.is_none()) {
            if let Some(frame) = frame {
                let labels = frame.labels.as_ref().map(|labels| correction.applied(labels));
                *frame = Arc::new(TrainFrame::new(frame.image.clone(), labels, frame.features.clone()));
            }
            Arc::make_mut(&mut self.decoding).corrections.insert(*index, correction);
        }
        self.forget_masks();
        &self.decoding.corrections
    }

    /// Moves the outlines of masks to where colours change if they are rough (see [`crate::mask_edges`]); true where
    /// they are. Masks that state how sure they are, pixel by pixel, stay.
    pub(crate) fn put_edges_right(&mut self, dataset: &Dataset, phases: &Phases) -> Result<bool, TrainError> {
        let is_plain = |k: &usize| dataset.frames[self.index(*k)].confidence.is_none();
        let plain: Vec<usize> = (0..self.len()).filter(is_plain).collect();
        let doubt = |k: &usize| {
            phases.check()?;
            let frame = self.get(dataset, *k)?;
            Ok(frame.labels.as_ref().map(|labels| Doubt::of(&frame.image, labels)))
        };
        let looked: Vec<usize> = plain.iter().step_by(plain.len().div_ceil(LOOKED).max(1)).copied().collect();
        let doubts: Vec<Option<Doubt>> = looked.par_iter().map(doubt).collect::<Result<_, TrainError>>()?;
        if !Doubt::sum(doubts.into_iter().flatten()).is_rough() {
            return Ok(false);
        }
        let kept =
            self.frames.par_iter_mut().filter(|(index, _)| dataset.frames[*index].confidence.is_none());
        kept.filter_map(|(_, frame)| frame.as_mut()).try_for_each(|frame| {
            phases.check()?;
            let labels = frame.labels.as_ref().map(|labels| mask_edges::moved(&frame.image, labels));
            *frame = Arc::new(TrainFrame::new(frame.image.clone(), labels, frame.features.clone()));
            phases.advance();
            Ok::<(), TrainError>(())
        })?;
        Arc::make_mut(&mut self.decoding).moves_edges = true;
        self.forget_masks();
        Ok(true)
    }

    /// Renames dense labels, in frames kept and in those decoded later.
    pub(crate) fn relabel(&mut self, new_label: impl Fn(u16) -> u16) {
        let rename = |label: &u16| if *label == UNLABELLED { UNLABELLED } else { new_label(label - 1) + 1 };
        let decoding = Arc::make_mut(&mut self.decoding);
        decoding.label_of_id.iter_mut().for_each(|label| *label = rename(label));
        for correction in decoding.corrections.values_mut() {
            *correction = correction.relabelled(|label| rename(&label));
        }
        self.forget_masks();
        for frame in self.frames.iter_mut().filter_map(|(_, frame)| frame.as_mut()) {
            *frame = Arc::new(TrainFrame {
                image: frame.image.clone(),
                labels: frame.labels.as_ref().map(|labels| labels.map(rename)),
                labelled: frame.labelled,
                features: frame.features.clone(),
            });
        }
    }

    fn load(&self, dataset: &Dataset, k: usize) -> Result<TrainFrame, TrainError> {
        Ok(self.decoding.load(dataset, self.frames[k].0)?)
    }
}

impl Decoding {
    /// Frame `index` of a capture.
    fn load(&self, dataset: &Dataset, index: usize) -> Result<TrainFrame, cif_dataset::Error> {
        let data = dataset.load_frame(index, self.background)?;
        let mut labels = data.mask.map(|mask| mask.map(|id| self.label_of_id[usize::from(*id)]));
        if let Some(correction) = self.corrections.get(&index) {
            labels = labels.map(|labels| correction.applied(&labels));
        }
        if self.moves_edges && data.confidence.is_none() {
            labels = labels.map(|labels| mask_edges::moved(&data.image, &labels));
        }
        if let (Some(labels), Some(confidence)) = (&mut labels, &data.confidence) {
            for (label, confidence) in labels.pixels.iter_mut().zip(&confidence.pixels) {
                if *confidence < LEAST_CONFIDENCE {
                    *label = UNLABELLED;
                }
            }
        }
        let features = self.maps.get(&index).map(|path| dataset.load_feature_map(index, path)).transpose()?;
        Ok(TrainFrame::new(data.image, labels, features.map(Arc::new)))
    }
}

impl TrainFrame {
    pub(crate) fn new(
        image: PixelGrid<[u8; 3]>,
        labels: Option<PixelGrid<u16>>,
        features: Option<Arc<PixelGrid<[f32; 3]>>>,
    ) -> Self {
        let count = |grid: &PixelGrid<u16>| grid.pixels.iter().filter(|l| **l != UNLABELLED).count();
        let labelled = labels.as_ref().map_or(0, count);
        Self { image, labels, labelled, features }
    }

    fn bytes(&self) -> u64 {
        let of_labels = self.labels.as_ref().map_or(0, |grid| grid.pixels.len() * 2);
        let of_features = self.features.as_ref().map_or(0, |grid| grid.pixels.len() * 12);
        (self.image.pixels.len() * 3 + of_labels + of_features) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trainer::guard_tests::support::{HEIGHT, Scene, WIDTH, capture};

    #[test]
    fn masks_are_read_once_until_they_change() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
        let phases = Phases::default();
        let mut store = FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), u64::MAX, &phases).unwrap();
        let masks = store.masks(&dataset, &phases).unwrap();
        assert!(Arc::ptr_eq(&masks, &store.masks(&dataset, &phases).unwrap()));
        let tables =
            (0..store.len()).map(|k| store.get(&dataset, k).unwrap().labels.as_ref().map(MaskTable::of));
        assert!(tables.eq(masks.iter().cloned()) && masks[0].as_ref().unwrap().rows.len() == 3);
        store.relabel(|label| label + 5);
        let renamed = store.masks(&dataset, &phases).unwrap();
        let labels = |masks: &FrameMasks| masks[0].as_ref().unwrap().rows.keys().copied().collect::<Vec<_>>();
        assert_eq!((labels(&masks), labels(&renamed)), (vec![1, 2, 3], vec![6, 7, 8]));
    }

    #[test]
    fn unsure_pixels_are_unlabelled_and_the_others_keep_their_labels() {
        let folder = tempfile::tempdir().unwrap();
        let mut dataset = capture(folder.path(), Scene { times: 1, views: 2, ..Scene::default() });
        let open = |dataset: &Dataset| {
            FrameStore::open(dataset, [1.0; 3], BTreeMap::new(), u64::MAX, &Phases::default()).unwrap()
        };
        let certain = open(&dataset);
        // Rows alternate between just too little and just enough.
        let path = folder.path().join("confidence.png");
        let row = |y: u32| if y.is_multiple_of(2) { LEAST_CONFIDENCE - 1 } else { LEAST_CONFIDENCE };
        let grey = image::GrayImage::from_fn(WIDTH, HEIGHT, |_, y| image::Luma([row(y)]));
        grey.save(&path).unwrap();
        dataset.frames[certain.index(0)].confidence = Some(path);
        let unsure = open(&dataset);
        let labels = |store: &FrameStore, k| store.get(&dataset, k).unwrap().labels.clone().unwrap();
        let (before, after) = (labels(&certain, 0), labels(&unsure, 0));
        for (k, (before, after)) in before.pixels.iter().zip(&after.pixels).enumerate() {
            let sure = (k / WIDTH as usize) % 2 == 1;
            assert_eq!(*after, if sure { *before } else { UNLABELLED }, "pixel {k}");
        }
        let labelled = |labels: &PixelGrid<u16>| labels.pixels.iter().filter(|l| **l != UNLABELLED).count();
        assert!(labelled(&before) > labelled(&after) && labelled(&after) > 0);
        assert_eq!(unsure.get(&dataset, 0).unwrap().labelled, labelled(&after));
        // Frames without a confidence are as before, and so are frames that memory has no room for.
        assert_eq!(labels(&unsure, 1), labels(&certain, 1));
        let none_kept = FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), 0, &Phases::default()).unwrap();
        assert_eq!(none_kept.not_kept(), none_kept.len());
        assert_eq!(labels(&none_kept, 0), after);
    }

    #[test]
    fn frames_read_ahead_are_those_read_when_they_are_needed() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 2, views: 3, ..Scene::default() });
        let open = |budget| {
            FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), budget, &Phases::default()).unwrap()
        };
        let (kept, mut read) = (open(u64::MAX), open(0));
        let same = |a: &FrameStore, b: &FrameStore, k: usize| {
            let (a, b) = (a.get(&dataset, k).unwrap(), b.get(&dataset, k).unwrap());
            a.image == b.image && a.labels == b.labels && a.labelled == b.labelled
        };
        let begun = |store: &FrameStore| store.ahead.as_ref().map(Ahead::begun);
        assert_eq!(begun(&kept), None);
        read.expect(0..read.len());
        assert_eq!(begun(&read), Some((0..read.len()).map(|k| read.index(k)).collect()));
        assert!((0..read.len()).all(|k| same(&kept, &read, k)));
        assert_eq!(begun(&read), Some(vec![]), "frames that were taken are not kept");
        // Others are expected than came before; frames that nobody expected are read all the same.
        read.expect([0, 1]);
        read.expect([1, 2]);
        assert_eq!(begun(&read), Some(vec![read.index(1), read.index(2)]));
        assert!((0..read.len()).rev().all(|k| same(&kept, &read, k)));
        // New labels hold for frames that were begun with the old ones.
        read.expect([0]);
        let mut renamed = kept;
        for store in [&mut renamed, &mut read] {
            store.relabel(|label| 1 - label.min(1));
        }
        assert!(same(&renamed, &read, 0));
    }

    #[test]
    fn rough_outlines_are_moved_in_frames_kept_and_in_those_read_later() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 2, views: 3, ..Scene::default() });
        let open = |budget| {
            FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), budget, &Phases::default()).unwrap()
        };
        let labels = |store: &FrameStore, k| store.get(&dataset, k).unwrap().labels.clone().unwrap();
        // Plain balls, and masks that are larger than these by two pixels.
        let mut grown_masks = Vec::new();
        for frame in &dataset.frames {
            let path = frame.mask.as_ref().unwrap();
            let ids = image::open(path).unwrap().into_luma8();
            let color = |id: u8| image::Rgb([20 * id, 90, 250 - 20 * id]);
            let plain = |x, y| color(ids.get_pixel(x, y).0[0]);
            image::RgbImage::from_fn(ids.width(), ids.height(), plain).save(&frame.image).unwrap();
            let grown = image::GrayImage::from_fn(ids.width(), ids.height(), |x, y| {
                let near = |at: u32, end: u32| at.saturating_sub(2)..(at + 3).min(end);
                let around = near(y, ids.height()).flat_map(|y| near(x, ids.width()).map(move |x| (x, y)));
                image::Luma([around.map(|(x, y)| ids.get_pixel(x, y).0[0]).max().unwrap_or(0)])
            });
            grown_masks.push((path, grown));
        }
        let mut exact = open(u64::MAX);
        let before = labels(&exact, 0);
        assert!(!exact.put_edges_right(&dataset, &Phases::default()).unwrap());
        assert_eq!(labels(&exact, 0), before);
        grown_masks.into_iter().for_each(|(path, grown)| grown.save(path).unwrap());
        let (mut kept, mut read) = (open(u64::MAX), open(0));
        let off = |labels: &PixelGrid<u16>| {
            labels.pixels.iter().zip(&before.pixels).filter(|(a, b)| a != b).count()
        };
        let grown = off(&labels(&kept, 0));
        for store in [&mut kept, &mut read] {
            assert!(store.put_edges_right(&dataset, &Phases::default()).unwrap());
            assert!(4 * off(&labels(store, 0)) < grown, "{} of {grown}", off(&labels(store, 0)));
        }
        assert_eq!(labels(&kept, 3), labels(&read, 3));
    }

    #[test]
    fn no_more_frames_are_read_ahead_than_there_is_room_for() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 8, views: 3, ..Scene::default() });
        let store = FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), 0, &Phases::default()).unwrap();
        assert!(store.len() > ahead::MOST);
        for _ in 0..3 {
            store.expect(0..store.len());
            assert_eq!(store.ahead.as_ref().unwrap().begun().len(), ahead::MOST);
        }
    }

    #[test]
    fn a_damaged_frame_read_ahead_is_named_when_it_is_needed() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
        let store = FrameStore::open(&dataset, [1.0; 3], BTreeMap::new(), 0, &Phases::default()).unwrap();
        let image = &dataset.frames[store.index(1)].image;
        std::fs::write(image, b"no image").unwrap();
        store.expect([0, 1]);
        assert!(store.get(&dataset, 0).is_ok());
        let Err(error) = store.get(&dataset, 1) else { panic!("a damaged image was read") };
        assert!(error.to_string().contains(&*image.file_name().unwrap().to_string_lossy()), "{error}");
    }
}
