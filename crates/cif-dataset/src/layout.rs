//! The layouts of captures.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The layouts that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// `dataset.json`, `metadata.json`, `scene.json`, `camera/`, `rgb/`.
    HyperNerf,
    /// `train_meta.json` and `test_meta.json` with a camera per image and time, `ims/`, `seg/`.
    DynamicGaussians,
    /// `poses_bounds.npy` with `camXX/images` or `camXX.mp4`.
    Neu3d,
    /// `poses_bounds.npy` with `images/`: the images of one moving camera in order.
    Llff,
    /// `transforms_train.json` and its siblings.
    DNerf,
    /// One `transforms.json`.
    Nerfstudio,
    /// `sparse/0` and `images/`.
    Colmap,
}

impl Layout {
    /// Every layout that can be read.
    pub const ALL: [Self; 7] = [
        Self::HyperNerf,
        Self::DynamicGaussians,
        Self::Neu3d,
        Self::Llff,
        Self::DNerf,
        Self::Nerfstudio,
        Self::Colmap,
    ];

    /// Name as the command line spells it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::HyperNerf => "hyper-nerf",
            Self::DynamicGaussians => "dynamic-gaussians",
            Self::Neu3d => "neu3d",
            Self::Llff => "llff",
            Self::DNerf => "d-nerf",
            Self::Nerfstudio => "nerfstudio",
            Self::Colmap => "colmap",
        }
    }

    /// File or folder that marks a folder as this layout.
    #[must_use]
    pub fn marker(self) -> &'static str {
        match self {
            Self::HyperNerf => "dataset.json",
            Self::DynamicGaussians => "train_meta.json",
            Self::Neu3d => "poses_bounds.npy",
            Self::Llff => "poses_bounds.npy beside images",
            Self::DNerf => "transforms_train.json or transforms_test.json",
            Self::Nerfstudio => "transforms.json",
            Self::Colmap => "sparse/0",
        }
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}
