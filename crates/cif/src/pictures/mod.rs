//! Pictures of frames: colours for instances, depth and error, lines, panels side by side, PNG files.

mod colors;
mod contact_sheet;
mod lines;
mod panel;
mod png_file;

pub use colors::{DepthRange, depth_picture, error_picture, instance_color, instance_picture, rgb_picture};
pub use contact_sheet::{ContactSheet, save_jpeg};
pub use lines::Polyline;
pub use panel::side_by_side;
pub use png_file::{PngFile, png_bytes, png_bytes_rgba, save_grey, save_rgb};

/// An 8-bit display-referred picture.
pub type Picture = cif_geometry::PixelGrid<[u8; 3]>;
