//! Helpers of several subcommands.
//!
//! | module | answers |
//! |---|---|
//! | [`asked`] | what a detector's masks show of a scene |
//! | [`capture`] | which capture is read, and how |
//! | [`command_line`] | how a command is pasted into a shell |
//! | [`expected`] | what a run is expected to take |
//! | [`model_options`] | how motion models are chosen on the command line |
//! | [`motion`] | how well the motion of a scene is that of known points |
//! | [`motion_table`] | what motion reports show in tables |
//! | [`named`] | which preset or head a name means |
//! | [`object_motion`] | how an object of a scene moves |
//! | [`scene`] | how scenes are read, and how they were trained |
//! | [`simd`] | which vector instructions are used |
//! | [`split`] | which frames are meant |
//! | [`step`] | how a command runs and shows others |
//! | [`table`] | how tables look |
//! | [`trajectories`] | which lines the paths of moving objects are in a view |

pub(in crate::commands) mod asked;
pub(in crate::commands) mod capture;
pub(in crate::commands) mod command_line;
pub(in crate::commands) mod expected;
pub(in crate::commands) mod model_options;
pub(in crate::commands) mod motion;
pub(in crate::commands) mod motion_table;
pub(in crate::commands) mod named;
pub(in crate::commands) mod object_motion;
pub(crate) mod scene;
pub(in crate::commands) mod simd;
pub(in crate::commands) mod split;
pub(in crate::commands) mod step;
pub(in crate::commands) mod table;
pub(in crate::commands) mod trajectories;

pub(in crate::commands) use capture::{
    CaptureOptions, FrameOptions, LayoutName, print_misfits, print_warnings,
};
pub(in crate::commands) use command_line::command_line;
pub(in crate::commands) use table::table;
