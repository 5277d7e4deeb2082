//! Turns a field into a format-neutral scene graph; the format crates only write down what stands here.
//!
//! | module | answers |
//! |---|---|
//! | [`graph`] | what a scene is made of: nodes, motion, splats, cameras, timeline; options and reports; plain data |
//! | [`world`] | where a graph lies in the world of its capture |
//! | [`naming`] | names that every format accepts |
//! | [`field_motion`] | where the Gaussians of a field are at the sampled times |
//! | [`from_field`] | a field as a graph |
//! | [`from_field::assignment`] | which node a Gaussian belongs to |
//! | [`from_field::camera_tracks`] | recorded cameras as tracks over time |
//! | [`to_field`] | a graph as a field: Gaussians, recorded motion and instances |
//! | [`motion`] | how a node moves: by recorded poses, or by how well standing still and one rigid body fit its Gaussians |
//! | [`motion::parts`] | a few rigid parts, found by clustering the paths of Gaussians |
//! | [`motion::keys`] | fewer samples of a track inside an error bound |
//! | [`motion::velocity`] | how fast a node moves |
//! | [`motion_scores`] | how well the motion of a graph follows known surface points |
//! | [`windows`](mod@windows) | graphs of windows of one long capture as one |
//! | [`placement`] | where a node's splats are at any time |
//! | [`appearance`] | opacities and colours that change over time, when a node is hidden by them, and the filter of the renderer as part of splats |
//! | [`shape::extent`] | boxes that hold the 3-sigma ellipsoids |
//! | [`shape::boxes`] | boxes of nodes over time |
//! | [`shape::convex_hull`] | convex hulls with few corners |
//! | [`shape::colliders`] | one or several hulls around most of what a node shows |
//! | [`shape::ground`] | where the surface is that objects stand on |
//! | [`shape::mass`] | how heavy bodies are |
//! | [`shape::level_of_detail`] | the most important splats of a node |
//! | [`shape::proxy`] | a light point cloud standing in for the splats |
//! | [`query`] | nodes by label |
//! | [`query::label_pattern`] | labels with wildcards |
//! | [`query::search`](mod@query::search) | nodes by label, class, time and place |
//! | [`query::trajectory`] | paths of nodes over all captured times |
//! | [`diff`] | what differs between two graphs, object by object |
//! | [`edits`] | what was changed in an exported file, applied to the field it came from |
//! | [`format`](mod@format) | what a file format does for graphs |
//! | [`assemble`](mod@assemble) | graphs from what readers find in files |
//!
//! Frames: world as captured (right-handed, metres), or a frame of the scene's own in it (see [`world`]). A node's
//! splats live in its local frame, so that no rotation is baked into splats and their spherical harmonics are stored as
//! trained. The origin of the frame is the node's pivot at the reference time; its axes are those in which the field
//! stores the Gaussians where poses are recorded, else those of the world at the reference time.

pub mod appearance;
pub mod assemble;

pub mod diff;
pub mod edits;
pub mod error;
pub mod field_motion;
pub mod files;
pub mod format;
pub mod from_field;
pub mod graph;
pub mod motion;
pub mod motion_scores;
pub mod naming;
pub mod placement;
pub mod query;
pub mod shape;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod to_field;
pub(crate) mod vectors;
pub mod windows;
pub mod world;

pub use diff::{ChangeKind, ObjectChange, SceneDiff};
pub use edits::import_edits;
pub use error::SceneError;
pub use field_motion::MotionSource;
pub use format::{
    About, Ending, ExportOptions, ExportSummary, FormatError, Ground, Payloads, ReadOptions, Relabelled,
    SceneFormat,
};
pub use from_field::{build, build_from};
pub use graph::{
    Appearance, AppearanceSample, CameraSample, CameraTrack, CodeRange, ConvexHull, DenseMotion, DenseSample,
    FrameRange, IdentityShare, IdentityShares, Motion, MotionModel, MotionReport, Node, NodeKind,
    OptionError, Origin, Part, PartJoint, PartsMotion, PointProxy, PoseSample, ResidualStatistics,
    SceneGraph, SceneOptions, SceneWindow, Splats, TimeCodes, Tolerance, VisibilitySample,
};
pub use motion::loose::LOOSE_SPLATS;
pub use motion::velocity::Velocity;
pub use motion_scores::{InstanceMotion, MotionErrors, MotionScores, motion_scores};
pub use placement::PlacedSplats;
pub use query::label_pattern::LabelPattern;
pub use query::search::{self, ObjectMatch, ObjectQuery, VolumeOf, When, search};
pub use query::trajectory::{Trajectory, TrajectorySample, trajectories};
pub use query::{LabelMatch, LabelQuery, QueryError, query};
pub use shape::extent;
pub use shape::ground::ground_height;
pub use shape::level_of_detail::level_of_detail;
pub use shape::mass::{DENSITY, masses};
pub use to_field::{field_from_graph, time_in_field};
pub use windows::{Seam, SeamOfObject, joined, window_alone};
pub use world::frame_of;

/// Where coordinates lie in the world of the capture; see [`world`].
pub use cif_dataset::CaptureFrame;
pub use cif_dataset::meant::known_names;
/// The axis of a world that points up.
pub use cif_geometry::UpAxis;
