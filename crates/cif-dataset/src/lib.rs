//! Reads captures (images, cameras, masks, times) into one [`Dataset`].

mod camera_check;
mod dataset;
mod error;
mod files;
mod formats;
mod instances;
mod layout;
mod lens_removal;
mod load;
mod mask_files;
mod open;
mod points;

pub use dataset::{
    Dataset, Frame, FrameData, InstanceLabel, Layout, OpenOptions, PointCloud, PointSource, Split,
};
pub use error::Error;
