//! The scene graph: nodes, their splats and motion, and cameras. Plain data, which uses nothing else of the crate.

mod appearance;
mod camera;
mod motion;
mod motion_table;
mod node;
mod options;
mod parts;
mod pose;
mod report;
mod scene;
mod shape;
mod splats;
mod time;
mod window;

pub use appearance::{Appearance, AppearanceSample, VisibilitySample, is_visible_at};
pub use camera::{CameraSample, CameraTrack};
pub(crate) use motion::{DENSE_BYTES, POSE_BYTES};
pub use motion::{DenseMotion, DenseSample, Motion, MotionModel};
pub use motion_table::ReportRow;
pub use node::{Node, NodeKind};
pub use options::{FrameRange, OptionError, SceneOptions, Tolerance};
pub use parts::{Part, PartJoint, PartsMotion};
pub use pose::{PoseSample, pose_at};
pub use report::{MotionReport, ResidualStatistics, TimeResidual};
pub use scene::{Origin, SceneGraph};
pub use shape::{ConvexHull, PointProxy};
pub(crate) use splats::raise_degree;
pub use splats::{IdentityShare, IdentityShares, SHARES_PER_SPLAT, Splats};
pub use time::{CodeRange, TimeCodes};
pub use window::SceneWindow;
