//! Cameras out of the files of other tools, whose images may lie elsewhere.

use std::path::{Path, PathBuf};

use cif_geometry::{LensDistortion, RigidTransform};
use glam::DVec2;

use crate::files::points::RawPoints;
use crate::files::{listing, ply};
use crate::formats::{DraftCamera, DraftFocal, colmap_cameras, colmap_model_in, transforms_cameras};
use crate::points::GREY;
use crate::{Error, camera_check};

/// Points: position and colour.
pub type ColoredPoints = Vec<([f64; 3], [u8; 3])>;

/// The camera of an image, as a file gives it.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedCamera {
    /// Path of the image, as the file has it.
    pub name: String,
    /// Width and height that the pixels refer to, where the file gives them.
    pub size: Option<(u32, u32)>,
    /// Focal lengths, pixels.
    pub focal_px: [f64; 2],
    /// Principal point; the centre of the first pixel is at (0.5, 0.5).
    pub principal_px: [f64; 2],
    /// Distortion.
    pub lens: LensDistortion,
    /// World to camera; the camera looks along +z with x right and y down.
    pub camera_from_world: RigidTransform,
    /// Time, in the unit of the file.
    pub time: Option<f64>,
}

/// The COLMAP model that a folder is, or holds in `sparse`, with a sentence on others that it holds: that with most images.
#[must_use]
pub fn find_colmap(path: &Path) -> Option<(PathBuf, Option<String>)> {
    colmap_model_in(path).map(|chosen| (chosen.folder, chosen.note))
}

/// Cameras and points of a COLMAP model: a folder with cameras, images and points3D, text or binary.
///
/// # Errors
/// When a file is missing or damaged.
pub fn read_colmap(folder: &Path) -> Result<(Vec<NamedCamera>, ColoredPoints), Error> {
    let (cameras, points) = colmap_cameras(folder)?;
    let cameras = cameras.into_iter().map(|(name, camera)| named(name, camera, None));
    Ok((cameras.collect::<Result<_, _>>()?, colored(points)))
}

/// Cameras of a `transforms.json`, and the points that it names, where they are there.
///
/// # Errors
/// When a file is damaged.
pub fn read_transforms(path: &Path) -> Result<(Vec<NamedCamera>, ColoredPoints), Error> {
    let (cameras, ply_file) = transforms_cameras(path)?;
    let cameras = cameras.into_iter().map(|(name, camera, time)| named(name, camera, time));
    let folder = cif_output::folder_of(path);
    let points = match ply_file.map(|name| folder.join(name)).filter(|path| listing::is_there(path)) {
        Some(path) => ply::read_points(&path)?,
        None => RawPoints { positions: Vec::new(), colors: None, note: None },
    };
    Ok((cameras.collect::<Result<_, _>>()?, colored(points)))
}

fn named(name: String, camera: DraftCamera, time: Option<f64>) -> Result<NamedCamera, Error> {
    let size = camera.size.filter(|size| size.cmpge(DVec2::ONE).all() && size.is_finite());
    if camera.camera_from_world.orthonormality_error() > camera_check::ROTATION_TOLERANCE
        || !camera.camera_from_world.translation.is_finite()
    {
        return Err(Error::Pose {
            path: camera.source,
            frame: name,
            problem: "is not a rigid transform: its rotation is not orthonormal, or a value is not finite"
                .to_owned(),
        });
    }
    let focal = match (camera.focal, size) {
        (DraftFocal::Pixels(focal), _) => focal,
        (DraftFocal::HorizontalAngle(angle), Some(size)) => DVec2::splat(0.5 * size.x / (0.5 * angle).tan()),
        (DraftFocal::HorizontalAngle(_), None) => DVec2::NAN,
    };
    let principal = camera.principal_px.or(size.map(|size| 0.5 * size));
    match principal.filter(|_| focal.cmpgt(DVec2::ZERO).all() && focal.is_finite()) {
        Some(principal) => Ok(NamedCamera {
            name,
            size: size.map(|size| (size.x.round() as u32, size.y.round() as u32)),
            focal_px: focal.to_array(),
            principal_px: principal.to_array(),
            lens: camera.lens,
            camera_from_world: camera.camera_from_world,
            time,
        }),
        None => Err(Error::Intrinsics {
            path: camera.source,
            frame: name,
            problem: "focal length or size of the image are missing or not positive; add fl_x, w and h"
                .to_owned(),
        }),
    }
}

fn colored(points: RawPoints) -> ColoredPoints {
    let colors = points.colors.unwrap_or_else(|| vec![GREY; points.positions.len()]);
    let finite = |point: &([f64; 3], [u8; 3])| point.0.iter().all(|value| value.is_finite());
    points.positions.into_iter().zip(colors).filter(finite).collect()
}
