//! Reads captures (images, cameras, masks, times) into one [`Dataset`].
//!
//! | layout | marked by | held out |
//! |---|---|---|
//! | HyperNeRF, Nerfies, DyCheck | `dataset.json` | `splits/val.json`, `val_ids`, else every fourth frame from the third on |
//! | Dynamic 3D Gaussians (CMU Panoptic) | `train_meta.json` | `test_meta.json` |
//! | Neu3D, DyNeRF | `poses_bounds.npy` with `cam00`, ... | `cam00` |
//! | LLFF sequences (NSFF, NVIDIA, NR-NeRF, EndoNeRF) | `poses_bounds.npy` with `images` | `mv_images`, else every eighth image from the second on |
//! | D-NeRF, Blender | `transforms_train.json` | `transforms_test.json` |
//! | nerfstudio, instant-ngp | `transforms.json` | its lists, else every eighth frame |
//! | COLMAP | `sparse/0`; of several models the largest | every eighth image |
//!
//! Masks are PNG files of instance ids, 0 for unlabelled, or EXR files with a [`cryptomatte`]; they lie in `masks`, in a
//! folder of that name next to the images, or in `seg` (Dynamic 3D Gaussians). Labels come from `instances.json`, which
//! may also lie in the mask folder and may name `taxonomies` per instance, from `class_mapping.json`
//! (`{"1": "sphere_1"}`), or from the Cryptomatte. Points that a program drew at random count as none. [`masks::Import`] makes such a folder of what other tools write. A mask folder may hold
//! `confidence/<frame>.png`: 8-bit grey, the probability that the id of a pixel is right in units of 1 / 255. Named groups of held-out frames
//! come from `splits.json`, known motion from `motion.json` and `tracks.npz` (see [`motion_truth`]). All cameras are
//! ideal pinholes in this project's axes once a frame is loaded; times are normalised to [0, 1], of the first and the last.
//! Images are upright where their camera is (see [`orientation`]).
//!
//! ```no_run
//! use cif_dataset::{Dataset, OpenOptions};
//!
//! let dataset = Dataset::open("captures/kitchen", &OpenOptions::default())?;
//! for warning in &dataset.warnings {
//!     eprintln!("warning: {warning}");
//! }
//! let first = dataset.train_frames()[0];
//! let frame = dataset.load_frame(first, [1.0, 1.0, 1.0])?;
//! println!("{} x {}", frame.image.width, frame.image.height);
//! # Ok::<(), cif_dataset::Error>(())
//! ```

mod camera_check;
pub mod cryptomatte;
mod dataset;
mod error;
mod feature_maps;
mod files;
pub mod foreign;
mod formats;
mod frame_source;
mod instances;
mod layout;
mod lens_removal;
mod load;
mod made_from;
mod mask_files;
pub mod masks;
pub mod meant;
pub mod motion_truth;
mod open;
pub mod orientation;
mod placement;
mod points;
mod recognition;
mod sizes;
mod summary;
mod trained_images;
mod window;

/// Where a dataset lies in the coordinates of its capture.
pub use cif_geometry::CaptureFrame;
/// One of the windows of time that a long capture is divided into.
pub use cif_geometry::TimeWindow;
pub use dataset::{
    CaptureWindow, DEFAULT_VIDEO_FRAMES, Dataset, Frame, FrameData, OpenOptions, PointCloud, PointSource,
    Split,
};
pub use error::Error;
pub use feature_maps::feature_maps;
pub use frame_source::{FrameSource, VideoFrame};
pub use instances::InstanceLabel;
pub use layout::Layout;
pub use made_from::MadeFrom;
pub use motion_truth::{MotionTruth, TrueMotion};
pub use orientation::Turn;
pub use sizes::same_aspect;
pub use summary::{CameraSummary, CaptureSummary, InstanceSummary, MaskSummary};
pub use trained_images::TrainedImages;
