//! Reads captures (images, cameras, masks, times) into one [`Dataset`].

mod dataset;

pub use dataset::{
    Dataset, Frame, FrameData, InstanceLabel, Layout, OpenOptions, PointCloud, PointSource, Split,
};
