//! Turns a field into a format-neutral scene graph; the format crates only write down what stands here.
//!
//! | module | answers |
//! |---|---|
//! | [`options`] | what an export may vary |
//! | [`graph`] | what a scene is made of: nodes, motion, splats, cameras, timeline |
//! | [`joint`] | joints between the parts of a node |
//! | [`world`] | where a graph lies in the world of its capture |
//! | [`naming`] | names that every format accepts |
//! | [`from_field::assignment`] | which node a Gaussian belongs to |
//! | [`from_field::source`] | where the moved Gaussians come from |
//! | [`from_field::frames`] | the moved Gaussians of every sampled time |
//! | [`from_field::camera_tracks`] | recorded cameras as tracks over time |
//! | [`motion`] | how well standing still and one rigid body fit a group of Gaussians |
//! | [`motion_scores`] | how well the motion of a graph follows known surface points |
//! | [`motion::parts`] | a few rigid parts, found by clustering the paths of Gaussians |
//! | [`motion::keys`] | fewer samples of a track inside an error bound |
//! | [`motion::placement`] | where a node's splats are at any time |
//! | [`motion::velocity`] | how fast a node moves |
//! | [`appearance`] | opacities and colours that change over time, when a node is hidden by them, and the filter of the renderer as part of splats |
//! | [`shape::extent`] | boxes that hold the 3-sigma ellipsoids |
//! | [`shape::convex_hull`] | convex hulls with few corners |
//! | [`shape::colliders`] | one or several hulls around most of what a node shows |
//! | [`shape::ground`] | where the surface is that objects stand on |
//! | [`shape::mass`] | how heavy bodies are |
//! | [`shape::level_of_detail`] | the most important splats of a node |
//! | [`shape::proxy`] | a light point cloud standing in for the splats |
//! | [`report`] | what the chosen motion models cost and miss |
//! | [`query`] | nodes by label |
//! | [`query::label_pattern`] | labels with wildcards |
//! | [`query::search`](mod@query::search) | nodes by label, class, time and place |
//! | [`query::trajectory`] | paths of nodes over all captured times |
//! | [`diff`] | what differs between two graphs, object by object |
//! | [`edits`] | what was changed in an exported file, applied to the field it came from |
//! | [`format`](mod@format) | what a file format does for graphs |
//! | [`assemble`](mod@assemble) | graphs from what readers find in files |
//! | [`to_field`] | the way back: Gaussians, recorded motion and instances of a graph |
//!
//! Frames: world as captured (right-handed, metres), or a frame of the scene's own in it (see [`world`]). A node's
//! splats live in its local frame, whose axes are the world's and whose origin is the node's pivot at the reference
//! time, so that no rotation is baked into splats and their spherical harmonics are stored as trained.

pub mod appearance;
pub mod assemble;

pub mod diff;
pub mod edits;
pub mod error;
pub mod files;
pub mod format;
pub mod from_field;
pub mod graph;
pub mod joint;
pub mod motion;
pub mod motion_scores;
pub mod naming;
pub mod options;
pub mod query;
pub mod report;
pub mod shape;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod to_field;
pub mod world;

pub use diff::{ChangeKind, ObjectChange, SceneDiff};
pub use edits::import_edits;
pub use error::SceneError;
pub use format::{
    About, Ending, ExportOptions, ExportSummary, FormatError, Ground, Payloads, ReadOptions, Relabelled,
    SceneFormat,
};
pub use from_field::source::MotionSource;
pub use from_field::{build, build_from};
pub use graph::{
    Appearance, AppearanceSample, CameraSample, CameraTrack, CodeRange, ConvexHull, DenseMotion, DenseSample,
    IdentityShare, IdentityShares, Motion, MotionModel, Node, NodeKind, Origin, Part, PartsMotion,
    PointProxy, PoseSample, SceneGraph, Splats, TimeCodes, VisibilitySample,
};
pub use joint::PartJoint;
pub use motion::loose::LOOSE_SPLATS;
pub use motion::placement::PlacedSplats;
pub use motion::velocity::Velocity;
pub use motion_scores::{InstanceMotion, MotionErrors, MotionScores, motion_scores};
pub use options::{FrameRange, SceneOptions, Tolerance};
pub use query::label_pattern::LabelPattern;
pub use query::search::{self, ObjectMatch, ObjectQuery, VolumeOf, When, search};
pub use query::trajectory::{Trajectory, TrajectorySample, trajectories};
pub use query::{LabelMatch, LabelQuery, QueryError, query};
pub use report::{MotionReport, ResidualStatistics};
pub use shape::extent;
pub use shape::ground::ground_height;
pub use shape::level_of_detail::level_of_detail;
pub use shape::mass::{DENSITY, masses};
pub use to_field::{field_from_graph, time_in_field};
pub use world::frame_of;

/// Where coordinates lie in the world of the capture; see [`world`].
pub use cif_dataset::CaptureFrame;
pub use cif_dataset::meant::known_names;
/// The axis of a world that points up.
pub use cif_geometry::UpAxis;
