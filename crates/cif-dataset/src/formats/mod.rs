//! One module per capture layout.
//!
//! To add a layout: a variant of [`Layout`] with its name and marker, a module here with a function
//! `read(&Source) -> Result<Draft, Error>`, one line in [`read`], and a capture in `tests/`. A reader turns
//! files into a [`Draft`]: cameras in the pixels of their own files, poses converted to this project's axes
//! (nothing after it swaps axes), raw names and splits. Probing images, scaling cameras, checking poses, masks,
//! labels and points are common to all layouts (`crate::open`).

mod colmap;
mod dnerf;
mod draft;
mod dynamic_gaussians;
mod hypernerf;
mod llff;
mod nerfstudio;
mod neu3d;
mod poses_bounds;
mod transforms;

pub(crate) use colmap::{
    model_in as colmap_model_in, named_cameras as colmap_cameras, sparse_model as colmap_sparse_model,
};
pub(crate) use draft::{Draft, DraftCamera, DraftFocal, Source, some_of};
pub(crate) use llff::has_image_folder;
pub(crate) use neu3d::has_rig;
pub(crate) use transforms::named_cameras as transforms_cameras;

use crate::{Error, Layout};

/// Reads a capture of a known layout.
///
/// # Errors
/// As the layout's reader finds them; see [`Error`].
pub(crate) fn read(layout: Layout, source: &Source<'_>) -> Result<Draft, Error> {
    match layout {
        Layout::HyperNerf => hypernerf::read(source),
        Layout::DynamicGaussians => dynamic_gaussians::read(source),
        Layout::Neu3d => neu3d::read(source),
        Layout::Llff => llff::read(source),
        Layout::DNerf => dnerf::read(source),
        Layout::Nerfstudio => nerfstudio::read(source),
        Layout::Colmap => colmap::read(source),
    }
}
