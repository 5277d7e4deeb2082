//! Content of a file, as its reader found it.

use std::collections::BTreeMap;

use cif_field::{Embedding, SortMetric};
use cif_geometry::UpAxis;
use glam::DVec3;

use super::track::{Placement, Track};
use crate::CaptureFrame;
use crate::graph::{
    CameraTrack, ConvexHull, MotionReport, Origin, PartJoint, PointProxy, Splats, TimeCodes, VisibilitySample,
};

/// Time codes per second of files that have none.
pub const FRAMES_PER_SECOND: f64 = 24.0;

/// Content of a file, as its reader found it.
#[derive(Clone, Debug)]
pub struct Prims {
    /// Declared up axis of the world.
    pub up_axis: UpAxis,
    /// Metres per world unit.
    pub meters_per_unit: f64,
    /// Where the scene lies in the world of its capture.
    pub frame: CaptureFrame,
    /// When the samples are.
    pub timeline: Timeline,
    /// The objects, in the order of the file.
    pub prims: Vec<Prim>,
    /// The cameras, with names that need not be unique. One without a label is called by its name.
    pub cameras: Vec<CameraTrack>,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background_color: [f32; 3],
    /// Order in which the splats are blended.
    pub sort_metric: SortMetric,
    /// True when the splats are drawn antialiased; `None` where the file does not say.
    pub antialiased: Option<bool>,
    /// Labels of instances without a node.
    pub omitted: Vec<String>,
    /// Warnings, one sentence each.
    pub warnings: Vec<String>,
    /// Where the scene came from.
    pub origin: Origin,
    /// Id and place in the instance table of objects that the file records; they are not given to others.
    pub reserved: BTreeMap<u16, usize>,
    /// Treatment of objects that repeat the id of another.
    pub copies: Copies,
}

impl Default for Prims {
    fn default() -> Self {
        Self {
            up_axis: UpAxis::default(),
            meters_per_unit: 1.0,
            frame: CaptureFrame::default(),
            timeline: Timeline::Sampled {
                codes: Vec::new(),
                start: 0.0,
                frames_per_second: FRAMES_PER_SECOND,
            },
            prims: Vec::new(),
            cameras: Vec::new(),
            background_color: [0.0; 3],
            sort_metric: SortMetric::default(),
            antialiased: None,
            omitted: Vec::new(),
            warnings: Vec::new(),
            origin: Origin::default(),
            reserved: BTreeMap::new(),
            copies: Copies::default(),
        }
    }
}

/// Treatment of objects that repeat the id of another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Copies {
    /// They keep id and name; a warning says which one is the copy.
    #[default]
    Keep,
    /// They become instances of their own.
    Renumber,
}

/// When the samples of a file are.
#[derive(Clone, Debug)]
pub enum Timeline {
    /// As the file records.
    Recorded(TimeCodes),
    /// Wherever a prim is sampled; normalised times run evenly from the first to the last.
    Sampled {
        /// Time codes of other samples.
        codes: Vec<f64>,
        /// The only time code where nothing is sampled.
        start: f64,
        /// Time codes per second.
        frames_per_second: f64,
    },
}

/// An object of a file.
#[derive(Clone, Debug)]
pub struct Prim {
    /// Name in messages, e.g. a path.
    pub place: String,
    /// Instance or background.
    pub identity: Identity,
    /// Name of the node.
    pub name: PrimName,
    /// Human name.
    pub label: String,
    /// Class.
    pub category: String,
    /// Names of its class in vocabularies of others, by taxonomy.
    pub taxonomies: BTreeMap<String, String>,
    /// Its appearance, for questions in words.
    pub embedding: Option<Embedding>,
    /// Path of the object's frame in that of the scene.
    pub track: Track,
    /// True when a pose without samples is a track of one sample even if it is not turned.
    pub keeps_pose: bool,
    /// Origin of the object's frame at the reference time, where the file records it.
    pub pivot: Option<DVec3>,
    /// Splats, in one or several frames below that of the object.
    pub pieces: Vec<Piece>,
    /// True when every piece is a part of the object, with a path of its own; else they become one.
    pub in_parts: bool,
    /// Time codes at which all pieces give [`Piece::shapes`], ascending; empty where none deforms.
    pub shape_codes: Vec<f64>,
    /// True when scales are among what is sampled.
    pub scales_change: bool,
    /// Time codes at which all pieces give [`Piece::opacities`], ascending.
    pub opacity_codes: Vec<f64>,
    /// Time codes at which all pieces give [`Piece::colors`], ascending.
    pub color_codes: Vec<f64>,
    /// Light stand-in; points sit on the splats of the pieces in their order.
    pub proxy: Option<PointProxy>,
    /// Convex hulls.
    pub colliders: Vec<ConvexHull>,
    /// Changes of visibility, ascending time codes.
    pub visibility: Vec<VisibilitySample>,
    /// First and last frame over which it exists, where that is known; else those of the timeline.
    pub source_frames: Option<(usize, usize)>,
    /// As recorded; computed where it is not.
    pub mean_occupancy: Option<f32>,
    /// Motion report of the export; it counts as long as the motion model is the one that it describes.
    pub report: Option<MotionReport>,
}

impl Prim {
    /// A still object in the frame of the scene, with splats of its own and nothing else.
    #[must_use]
    pub fn still(place: String, label: String, splats: Splats) -> Self {
        let piece = Piece {
            name: String::new(),
            splats,
            placement: Placement::still(None),
            pivot: None,
            joint: None,
            shapes: Vec::new(),
            opacities: Vec::new(),
            colors: Vec::new(),
        };
        Self {
            place,
            identity: Identity::New,
            name: PrimName::OfLabel,
            category: label.clone(),
            taxonomies: BTreeMap::new(),
            embedding: None,
            label,
            track: Track::still(),
            keeps_pose: false,
            pivot: None,
            pieces: vec![piece],
            in_parts: false,
            shape_codes: Vec::new(),
            scales_change: false,
            opacity_codes: Vec::new(),
            color_codes: Vec::new(),
            proxy: None,
            colliders: Vec::new(),
            visibility: Vec::new(),
            source_frames: None,
            mean_occupancy: None,
            report: None,
        }
    }
}

/// Instance or background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Identity {
    /// The background.
    Background,
    /// An instance that the file numbers.
    Recorded {
        /// Mask value, above 0.
        id: u16,
        /// Place in the instance table; `None` for the next free one.
        index: Option<usize>,
        /// True when it is called as it was exported: no copy, if another has the same id.
        original: bool,
    },
    /// An instance that gets the lowest free id.
    New,
}

/// Name of a node; made unique in any case.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PrimName {
    /// As the object is called in the file.
    Given(String),
    /// As it was exported; a renumbered copy is called by its label.
    Exported(String),
    /// By its label and id.
    OfLabel,
}

/// Splats of a prim that share a frame.
#[derive(Clone, Debug)]
pub struct Piece {
    /// Name of the part, where pieces are parts.
    pub name: String,
    /// Splats in the frame of the piece.
    pub splats: Splats,
    /// Where that frame is in the frame of the object.
    pub placement: Placement,
    /// Origin of the part's frame at the reference time, where the file records it.
    pub pivot: Option<DVec3>,
    /// Ties it to another piece; its base counts the pieces.
    pub joint: Option<PartJoint>,
    /// One entry per [`Prim::shape_codes`].
    pub shapes: Vec<Shape>,
    /// Opacities, one entry per [`Prim::opacity_codes`].
    pub opacities: Vec<Vec<f32>>,
    /// Coefficients of the degree of `splats`, one entry per [`Prim::color_codes`].
    pub colors: Vec<Vec<f32>>,
}

/// Attributes of splats that change when they deform.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shape {
    /// Centres.
    pub means: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z).
    pub orientations: Vec<[f32; 4]>,
    /// Standard deviations.
    pub scales: Vec<[f32; 3]>,
}

/// Why prims are no scene.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {what}")]
pub struct AssembleError {
    /// The object; see [`Prim::place`].
    pub place: String,
    /// The problem, and its remedy.
    pub what: &'static str,
}
