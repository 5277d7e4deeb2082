//! Pure geometry shared by every crate of cif: no I/O, no threads.
//!
//! | module | answers |
//! |---|---|
//! | [`scalar`] | which number type a formula runs in (`f32` or `f64`) |
//! | [`transform`] | rigid transforms `a_from_b` |
//! | [`align`] | rigid transforms and similarities that align point sets |
//! | [`stats`] | medians and quantiles |
//! | [`quaternion`] | rotation of a (w, x, y, z) quaternion, with derivative |
//! | [`spherical_harmonics`] | view-dependent colour basis, degrees 0 to 3, with derivative and rotation |
//! | [`camera`] | ideal pinhole cameras |
//! | [`rays`] | how far points are from rays, and where rays meet |
//! | [`capture_frame`] | where coordinates lie in the world of a capture |
//! | [`lens`] | lens distortion and its removal |
//! | [`time_window`] | which times of a long capture are trained together |
//! | [`up_axis`] | which axis of a world points up |
//! | [`grid`] | row-major pixel grids |
//! | [`bounds`] | axis-aligned boxes |
//! | [`overlap`] | which members make the set of the largest expected overlap |
//!
//! Conventions: right-handed world; camera frame x right, y down, z forward (OpenCV); pixel (i, j) has its
//! centre at (i + 0.5, j + 0.5); quaternions are (w, x, y, z) in memory; matrices act on column vectors.

pub mod align;
pub mod bounds;
pub mod camera;
pub mod capture_frame;
pub mod grid;
pub mod lens;
pub mod overlap;
pub mod quaternion;
pub mod rays;
pub mod scalar;
pub mod spherical_harmonics;
pub mod stats;
pub mod time_window;
pub mod transform;
pub mod up_axis;

pub use align::similarity::Similarity;
pub use bounds::Bounds;
pub use camera::PinholeCamera;
pub use capture_frame::CaptureFrame;
pub use grid::PixelGrid;
pub use lens::LensDistortion;
pub use rays::Ray;
pub use scalar::Real;
pub use time_window::TimeWindow;
pub use transform::RigidTransform;
pub use up_axis::UpAxis;
