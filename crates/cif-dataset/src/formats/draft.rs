//! A capture as its files give it, and what several layouts have in common.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec2, DVec3};

use crate::files::points::{self, RawPoints};
use crate::files::{listing, ply};
use crate::{Error, FrameSource, OpenOptions, Split};

/// Input of a reader: the folder of the capture, and options.
pub(crate) struct Source<'a> {
    pub(crate) root: &'a Path,
    pub(crate) options: &'a OpenOptions,
}

/// A capture as its files give it.
#[derive(Default)]
pub(crate) struct Draft {
    pub(crate) frames: Vec<DraftFrame>,
    /// Reduction of the images named, relative to the largest ones of the capture.
    pub(crate) stored_reduction: u32,
    /// Points that the layout brings along, with the file.
    pub(crate) points: Option<(RawPoints, PathBuf)>,
    /// Half edge of the box for random points around the origin, for layouts that have a customary one.
    pub(crate) random_box: Option<f64>,
    pub(crate) frames_per_second: Option<f64>,
    /// Cameras of [`OpenOptions::without_cameras`] that the reader left out itself.
    pub(crate) left_out: Vec<String>,
    pub(crate) warnings: Vec<String>,
    /// Findings and decisions of the reader.
    pub(crate) notes: Vec<String>,
    /// Parts of the capture that are left out, such as "12 images that dataset.json does not list".
    pub(crate) unused: Vec<String>,
    /// Recordings that frames were made of, by the name of the frame, where they are known.
    pub(crate) sources: BTreeMap<String, FrameSource>,
    /// Cameras are of the pixels as image files store them, where sizes do not show that they are of upright ones.
    pub(crate) of_stored_pixels: bool,
    /// Facts of its world that the capture does not know.
    pub(crate) unknown: Option<String>,
}

impl Draft {
    /// Removes the frames of unwanted cameras.
    ///
    /// # Errors
    /// When there is no such camera.
    pub(crate) fn leave_out(&mut self, root: &Path, unwanted: &[String]) -> Result<(), Error> {
        let known: BTreeSet<&str> = self.frames.iter().map(|frame| frame.camera_name.as_str()).collect();
        let missing = |name: &&String| !known.contains(name.as_str()) && !self.left_out.contains(*name);
        if let Some(name) = unwanted.iter().find(missing) {
            return Err(Error::invalid(
                root,
                format!("it has no camera {name} to leave out; its cameras: {}", some_of(known.into_iter())),
            ));
        }
        self.frames.retain(|frame| !unwanted.contains(&frame.camera_name));
        Ok(())
    }
}

/// One frame as its files give it.
pub(crate) struct DraftFrame {
    pub(crate) name: String,
    pub(crate) camera_name: String,
    /// Normalised.
    pub(crate) time: f64,
    pub(crate) split: Split,
    pub(crate) image: PathBuf,
    /// Mask that the layout itself names.
    pub(crate) mask: Option<PathBuf>,
    pub(crate) camera: DraftCamera,
}

/// A camera in the pixels of its own file.
#[derive(Clone)]
pub(crate) struct DraftCamera {
    /// File that holds it.
    pub(crate) source: PathBuf,
    /// Image size that the pixels refer to; that of the stored image where `None`.
    pub(crate) size: Option<DVec2>,
    pub(crate) focal: DraftFocal,
    /// Centre of the image where `None`.
    pub(crate) principal_px: Option<DVec2>,
    pub(crate) lens: LensDistortion,
    pub(crate) camera_from_world: RigidTransform,
}

#[derive(Clone, Copy)]
pub(crate) enum DraftFocal {
    Pixels(DVec2),
    /// Horizontal field of view in radians, square pixels.
    HorizontalAngle(f64),
}

/// Every eighth frame is held out, from the first on, as 3D Gaussian splatting does; a single frame is trained
/// on.
pub(crate) fn hold_out_every_eighth(frames: &mut [DraftFrame]) {
    if frames.len() < 2 {
        return;
    }
    for (index, frame) in frames.iter_mut().enumerate() {
        frame.split = if index % 8 == 0 { Split::Val } else { Split::Train };
    }
}

/// Our camera from an OpenGL camera-to-world matrix (x right, y up, z backward), row by row.
pub(crate) fn from_opengl(rows: &[[f64; 4]]) -> RigidTransform {
    let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
    world_to_camera(DMat3::from_cols(column(0), -column(1), -column(2)), column(3))
}

/// World to camera from the camera's axes (columns right, down, forward) and centre. The rotation is
/// transposed, not inverted, and so must still be checked.
pub(crate) fn world_to_camera(axes: DMat3, centre: DVec3) -> RigidTransform {
    let rotation = axes.transpose();
    RigidTransform { rotation, translation: -(rotation * centre) }
}

/// First few names of a list, for messages.
pub(crate) fn some_of<'a>(names: impl ExactSizeIterator<Item = &'a str>) -> String {
    let count = names.len();
    let mut text = names.take(3).collect::<Vec<_>>().join(", ");
    if count > 3 {
        text.push_str(&format!(" and {} more", count - 3));
    }
    text
}

/// The first point file that exists, of the names that captures use.
///
/// # Errors
/// When the file is damaged.
pub(crate) fn customary_points(root: &Path) -> Result<Option<(RawPoints, PathBuf)>, Error> {
    for name in [
        "points3D_downsample2.ply",
        "points3D.ply",
        "points3d.ply",
        "sparse_pc.ply",
        "points.ply",
        "fused.ply",
    ] {
        let path = root.join(name);
        if listing::is_there(&path) {
            return Ok(Some((ply::read_points(&path)?, path)));
        }
    }
    let path = root.join("points.npy");
    if listing::is_there(&path) {
        return Ok(Some((points::read_npy(&path)?, path)));
    }
    Ok(None)
}
