//! The common form into which captures of every layout are read.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::{Bounds, LensDistortion, PinholeCamera, PixelGrid, TimeWindow};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::cryptomatte::ObjectIds;
use crate::{CaptureFrame, FrameSource, InstanceLabel, Layout, Turn};

/// Split of a frame: trained on or held out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Used for training.
    Train,
    /// Held out by the capture's own lists.
    Val,
}

/// Options for opening a capture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OpenOptions {
    /// Mask folder: a name inside the capture (`masks_tracker`) or a path, relative to the current folder; `None` takes the
    /// masks that the capture names for its frames, else its own folder `masks`, in the layout of Dynamic 3D Gaussians
    /// else `seg`.
    pub masks: Option<PathBuf>,
    /// Ignore masks altogether.
    pub without_masks: bool,
    /// The masks are painted keyframes, of which those of the other frames are to be made: the warnings do not speak of
    /// frames without a mask and of what can be trained.
    pub keyframes: bool,
    /// Image reduction: 1, 2, 4, ...; `None` takes the largest images stored.
    pub downscale: Option<u32>,
    /// Place the principal point in the image centre, as the base code of the method does.
    pub centre_principal_point: bool,
    /// Forces a layout where two fit.
    pub layout: Option<Layout>,
    /// Cameras whose frames are left out, by [`Frame::camera_name`].
    pub without_cameras: Vec<String>,
    /// Most frames taken of a video, from its start on; [`DEFAULT_VIDEO_FRAMES`] where `None`.
    pub video_frames: Option<u32>,
    /// Read the frames of a window of time alone; `None` reads all.
    pub window: Option<TimeWindow>,
}

/// Frames taken of a video unless said otherwise: as many as the published scores of Neu3D are of.
pub const DEFAULT_VIDEO_FRAMES: u32 = 300;

/// One image of a capture: where it is, and the ideal pinhole camera it has once loaded.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Unique name inside the capture, e.g. `000012` or `cam03/0007`: a relative path without `.` and `..`, which
    /// [`cif_output::inside`] joins to a folder.
    pub name: String,
    /// Camera the frame belongs to, e.g. `cam03`; moving cameras keep one name.
    pub camera_name: String,
    /// Camera after lens removal, at the resolution that [`Dataset::load_frame`] returns.
    pub camera: PinholeCamera,
    /// Lens removed on loading; identity for ideal cameras.
    pub lens: LensDistortion,
    /// Normalised time in [0, 1].
    pub time: f64,
    /// Index into [`Dataset::times`].
    pub time_index: usize,
    /// Train or val.
    pub split: Split,
    /// Named group inside the split (`interp`, `novel`), where the capture has them.
    pub group: Option<String>,
    /// Image file.
    pub image: PathBuf,
    /// How the pixels of its files are turned when they are loaded.
    pub turn: Turn,
    /// Image of a recording that it was made of, where the capture says so.
    pub source: Option<FrameSource>,
    /// Mask file, where this frame has one.
    pub mask: Option<PathBuf>,
    /// Confidence of the mask, where it has one: `confidence/<frame>.png` in the mask folder.
    pub confidence: Option<PathBuf>,
}

/// Training frames of one time from which on their cameras are a rig: a third view checks what two agree on.
const FEWEST_AT_ONCE: usize = 3;

/// Where the initial points come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PointSource {
    /// A file of the capture.
    File(PathBuf),
    /// Images of the capture, by its own poses.
    Triangulated,
    /// Drawn at random in the box that the cameras see.
    Random,
}

/// Initial points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointCloud {
    /// World positions, metres, `[P]`.
    pub positions: Vec<[f32; 3]>,
    /// Colours, `[P]`; mid grey where the source has none.
    pub colors: Vec<[u8; 3]>,
    /// Origin of the points.
    pub source: PointSource,
}

/// The part of a capture that a dataset is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CaptureWindow {
    /// Which one.
    pub window: TimeWindow,
    /// Index of the first of its times among all those of the capture.
    pub first: usize,
    /// Its first and last time, normalised over the whole capture.
    pub times: [f64; 2],
}

/// A capture, understood.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Folder of the capture.
    pub root: PathBuf,
    /// Recognised layout.
    pub layout: Layout,
    /// All frames, ordered by camera and time.
    pub frames: Vec<Frame>,
    /// Distinct normalised times, ascending, of all frames.
    pub times: Vec<f64>,
    /// The window of time that was read, of a capture that has more; `times` begin and end with it.
    pub window: Option<CaptureWindow>,
    /// Frames per second of the capture, where it says so.
    pub frames_per_second: Option<f64>,
    /// Instances, ascending id; empty without masks.
    pub instances: Vec<InstanceLabel>,
    /// Mask value of every object of Cryptomatte masks; empty for PNG masks.
    pub mask_objects: ObjectIds,
    /// Initial points.
    pub points: PointCloud,
    /// True when images carry alpha and are composited on the background when loaded.
    pub has_alpha: bool,
    /// Oddities met while reading, one sentence each, naming the file.
    pub warnings: Vec<String>,
    /// Findings and decisions of reading, one sentence each; nothing in them needs to be put right.
    pub notes: Vec<String>,
    /// A sentence on what the capture does not know of its world, its unit or its up axis; a warning too.
    pub unknown: Option<String>,
    /// Where cameras and points lie in the coordinates of the capture; the identity for ordinary captures.
    pub frame: CaptureFrame,
}

/// A loaded frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameData {
    /// Colour as captured (display-referred), composited on the background where the image has alpha.
    pub image: PixelGrid<[u8; 3]>,
    /// Instance ids, 0 = unlabelled, at the size of `image`.
    pub mask: Option<PixelGrid<u16>>,
    /// Probability that the id of a pixel is right, in units of 1 / 255, where the mask has a confidence.
    pub confidence: Option<PixelGrid<u8>>,
}

impl Dataset {
    /// The files that the frames and the initial points are read from, which nothing may overwrite.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        let points = match &self.points.source {
            PointSource::File(path) => Some(path.as_path()),
            PointSource::Triangulated | PointSource::Random => None,
        };
        let frames = self.frames.iter().flat_map(|frame| {
            [Some(frame.image.as_path()), frame.mask.as_deref(), frame.confidence.as_deref()]
        });
        frames.chain([points]).flatten()
    }

    /// Indices of the frames to train on, ascending.
    #[must_use]
    pub fn train_frames(&self) -> Vec<usize> {
        self.split_frames(Split::Train)
    }

    /// Indices of the held-out frames, ascending.
    #[must_use]
    pub fn val_frames(&self) -> Vec<usize> {
        self.split_frames(Split::Val)
    }

    /// Indices of the frames of a split, ascending.
    #[must_use]
    pub fn split_frames(&self, split: Split) -> Vec<usize> {
        (0..self.frames.len()).filter(|index| self.frames[*index].split == split).collect()
    }

    /// Most cameras that took a training frame at one time: of a rig, all; of one camera that walks, one.
    #[must_use]
    pub fn images_at_once(&self) -> usize {
        let mut cameras: BTreeMap<usize, BTreeSet<&str>> = BTreeMap::new();
        for frame in self.frames.iter().filter(|frame| frame.split == Split::Train) {
            cameras.entry(frame.time_index).or_default().insert(&frame.camera_name);
        }
        cameras.values().map(BTreeSet::len).max().unwrap_or(0)
    }

    /// True where cameras took three or more training frames at one time, among which what moves stands still.
    #[must_use]
    pub fn is_rig(&self) -> bool {
        self.images_at_once() >= FEWEST_AT_ONCE
    }

    /// Scene extent in metres: 1.1 times the largest distance of a training camera's centre from the mean of
    /// the centres; 1 when all centres coincide. Source: methods reference 0.
    #[must_use]
    pub fn extent(&self) -> f64 {
        let spread = self.camera_spread();
        if spread > 0.0 { 1.1 * spread } else { 1.0 }
    }

    /// Largest distance of a training camera's centre from their mean; 0 below rounding.
    pub(crate) fn camera_spread(&self) -> f64 {
        let centres: Vec<DVec3> =
            self.train_frames().into_iter().map(|index| self.frames[index].camera.centre()).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let spread = centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max);
        if spread > 1e-9 * (1.0 + mean.length()) { spread } else { 0.0 }
    }

    /// Smallest box around the initial points.
    #[must_use]
    pub fn point_bounds(&self) -> Bounds {
        Bounds::around(self.points.positions.iter().map(|p| DVec3::from_array(p.map(f64::from))))
    }
}
