//! COLMAP camera models.

use std::path::Path;

use cif_geometry::{LensDistortion, RigidTransform};
use glam::DVec2;

use super::reconstruction::Camera;
use crate::Error;
use crate::formats::{DraftCamera, DraftFocal};

/// Models by the number of the binary files, with their count of parameters.
pub(super) const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// The camera of an image.
///
/// # Errors
/// When the model is not supported or has another number of parameters.
pub(super) fn camera(
    camera: &Camera,
    path: &Path,
    frame: &str,
    camera_from_world: RigidTransform,
) -> Result<DraftCamera, Error> {
    let intrinsics =
        |problem: String| Error::Intrinsics { path: path.to_owned(), frame: frame.to_owned(), problem };
    let p = camera.params.as_slice();
    let lens = |radial: [f64; 4], tangential: [f64; 2]| LensDistortion { radial, tangential, skew_px: 0.0 };
    let (focal, principal, lens) = match (camera.model.as_str(), p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], LensDistortion::default()),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], LensDistortion::default()),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => ([f, f], [cx, cy], lens([k1, 0.0, 0.0, 0.0], [0.0; 2])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], lens([k1, k2, 0.0, 0.0], [0.0; 2])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy], [cx, cy], lens([k1, k2, 0.0, 0.0], [p1, p2]))
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            if [k4, k5, k6] != [0.0; 3] {
                return Err(intrinsics(
                    "camera model FULL_OPENCV with non-zero k4, k5 or k6 is not supported; undistort the images \
                     with `colmap image_undistorter`"
                        .to_owned(),
                ));
            }
            ([fx, fy], [cx, cy], lens([k1, k2, k3, 0.0], [p1, p2]))
        }
        (model, params) => {
            let expected = MODELS.iter().find(|(name, _)| *name == model).map(|(_, count)| *count);
            return Err(intrinsics(match expected {
                Some(count) if count != params.len() => {
                    format!("camera model {model} has {} parameters, {count} are expected", params.len())
                }
                _ => format!(
                    "camera model {model} is not supported; undistort the images with `colmap image_undistorter`"
                ),
            }));
        }
    };
    Ok(DraftCamera {
        source: path.to_owned(),
        size: Some(DVec2::from_array(camera.size)),
        focal: DraftFocal::Pixels(DVec2::from_array(focal)),
        principal_px: Some(DVec2::from_array(principal)),
        lens,
        camera_from_world,
    })
}
