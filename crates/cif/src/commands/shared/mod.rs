//! Helpers of several subcommands.
//!
//! | module | answers |
//! |---|---|
//! | [`asked`] | what a detector's masks show of a scene |
//! | [`model_options`] | how motion models are chosen on the command line |
//! | [`motion_table`] | what motion reports show in tables |
//! | [`object_motion`] | how an object of a scene moves |
//! | [`scene`] | how scenes are read, and how they were trained |
//! | [`trajectories`] | which lines the paths of moving objects are in a view |

pub(in crate::commands) mod asked;
pub(in crate::commands) mod model_options;
pub(in crate::commands) mod motion_table;
pub(in crate::commands) mod object_motion;
pub(crate) mod scene;
pub(in crate::commands) mod trajectories;
