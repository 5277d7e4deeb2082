//! Turns a field into a format-neutral scene graph; the format crates only write down what stands here.
//!
//! | module | answers |
//! |---|---|
//! | [`options`] | what an export may vary |
//! | [`graph`] | what a scene is made of: nodes, motion, splats, cameras, timeline |
//! | [`assignment`] | which node a Gaussian belongs to |
//! | [`source`] | where the moved Gaussians come from |
//! | [`frames`] | the moved Gaussians of every sampled time |
//! | [`procrustes`] | robust rigid alignment of two point sets |
//! | [`motion`] | how well standing still and one rigid body fit a group of Gaussians |
//! | [`parts`] | a few rigid parts, found by clustering the paths of Gaussians |
//! | [`keys`] | fewer samples of a track inside an error bound |
//! | [`placement`] | where a node's splats are at any time |
//! | [`extent`] | boxes that hold the 3-sigma ellipsoids |
//! | [`convex_hull`] | convex hulls with few corners |
//! | [`colliders`] | one or several hulls around most of what a node shows |
//! | [`world`] | where a graph lies in the world of its capture |
//! | [`level_of_detail`] | the most important splats of a node |
//! | [`velocity`] | how fast a node moves |
//! | [`appearance`] | opacities and colours that change over time, and when a node is hidden by them |
//! | [`proxy`] | a light point cloud standing in for the splats |
//! | [`camera_tracks`] | recorded cameras as tracks over time |
//! | [`naming`] | names that every format accepts |
//! | [`report`] | what the chosen motion models cost and miss |
//! | [`label_pattern`] | labels with wildcards |
//! | [`query`] | nodes by label |
//! | [`diff`] | what differs between two graphs, object by object |
//! | [`edits`] | what was changed in an exported file, applied to the field it came from |
//! | [`format`](mod@format) | what a file format does for graphs |
//! | [`assemble`](mod@assemble) | graphs from what readers find in files |
//! | [`field_from_graph`] | the way back: Gaussians, recorded motion and instances of a graph |
//!
//! Frames: world as captured (right-handed, metres), or a frame of the scene's own in it (see [`world`]). A node's
//! splats live in its local frame, whose axes are the world's and whose origin is the node's pivot at the reference
//! time, so that no rotation is baked into splats and their spherical harmonics are stored as trained.

pub mod appearance;
pub mod assemble;
pub mod assignment;
pub mod build;
pub mod camera_tracks;
mod choose;
pub mod colliders;
pub mod convex_hull;
mod dense;
pub mod diff;
pub mod edits;
pub mod error;
pub mod extent;
pub mod field_from_graph;
pub mod files;
pub mod format;
pub mod frames;
pub mod graph;
pub mod keys;
pub mod label_pattern;
pub mod level_of_detail;
mod loose;
pub mod motion;
pub mod naming;
mod node;
pub mod options;
pub mod parts;
pub mod placement;
pub mod procrustes;
pub mod proxy;
pub mod query;
pub mod report;
pub mod search;
pub mod source;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod time_map;
pub mod velocity;
mod visibility;
pub mod world;

pub use build::{build, build_from};
pub use diff::{ChangeKind, ObjectChange, SceneDiff};
pub use edits::import_edits;
pub use error::SceneError;
pub use field_from_graph::field_from_graph;
pub use format::{
    About, Ending, ExportOptions, ExportSummary, FormatError, Payloads, ReadOptions, Relabelled, SceneFormat,
};
pub use graph::{
    Appearance, AppearanceSample, CameraSample, CameraTrack, ConvexHull, DenseMotion, DenseSample,
    IdentityShare, IdentityShares, Motion, MotionModel, Node, NodeKind, Origin, Part, PartsMotion,
    PointProxy, PoseSample, SceneGraph, Splats, TimeCodes, VisibilitySample,
};
pub use label_pattern::LabelPattern;
pub use level_of_detail::level_of_detail;
pub use options::{FrameRange, SceneOptions, Tolerance, UpAxis};
pub use placement::PlacedSplats;
pub use query::{LabelMatch, LabelQuery, QueryError, query};
pub use report::{MotionReport, ResidualStatistics};
pub use search::{ObjectMatch, ObjectQuery, VolumeOf, When, search};
pub use source::MotionSource;
pub use velocity::Velocity;
pub use world::frame_of;

/// Where coordinates lie in the world of the capture; see [`world`].
pub use cif_dataset::CaptureFrame;
