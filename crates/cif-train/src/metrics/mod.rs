//! Quality of a field: image and instance metrics. Source: methods reference 9.
//!
//! | module | answers |
//! |---|---|
//! | [`image`] | PSNR and SSIM of one picture |
//! | `color_fit` | colours fitted to the truth before they are compared |
//! | [`covisible`] | which pixels of a held-out view training views show too |
//! | [`instance`] | every instance metric, from per-frame confusion counts |
//! | [`panoptic`] | the same with what is unlabelled as background |
//! | [`evaluate`](mod@evaluate) | renders the held-out frames of a capture and fills both in |
//! | [`round_trip`] | what a scene loses on its way through a file |
//! | [`fit`] | whether a capture is the one that a scene was trained on |
//!
//! A metric without anything to measure is `None` (`n/a`), never 0 or 100.

mod color_fit;
pub mod covisible;
pub mod evaluate;
pub mod fit;
pub mod image;
pub mod instance;
pub mod panoptic;
pub mod round_trip;

pub use evaluate::{
    Evaluation, EvaluationError, EvaluationOptions, FrameScores, FrameView, Scores, evaluate, mask_ids,
    trained_settings, training_config,
};
pub use instance::{FrameConfusion, InstanceMetrics, InstanceScore, instance_metrics};
pub use panoptic::PanopticMetrics;
