//! Checks of cameras, and their scaling to the images that are loaded.

use std::path::Path;

use cif_geometry::camera::check_image_size;
use cif_geometry::{LensDistortion, PinholeCamera, RigidTransform};
use glam::DVec2;

use crate::Error;
use crate::formats::{DraftCamera, DraftFocal};
use crate::sizes::same_aspect;

/// Deviation from orthonormal up to which a rotation is repaired; more is an error.
pub(crate) const ROTATION_TOLERANCE: f64 = 1e-3;

/// Camera and lens of a frame at the size at which it is loaded.
///
/// # Errors
/// When pose, focal length, principal point, size or lens make no sense; the message names file and frame.
pub(crate) fn finish(
    draft: &DraftCamera,
    frame: &str,
    stored: (u32, u32),
    loaded: (u32, u32),
) -> Result<(PinholeCamera, LensDistortion), Error> {
    let problem = |problem: String| {
        Err(Error::Intrinsics { path: draft.source.clone(), frame: frame.to_owned(), problem })
    };
    if let Err(too_large) = check_image_size(loaded.0, loaded.1) {
        return problem(format!("{too_large}; reduce the images, for example by 2 (--downscale 2)"));
    }
    let image_size = DVec2::new(f64::from(stored.0), f64::from(stored.1));
    let size = draft.size.unwrap_or(image_size);
    let whole = |size: f64| size.is_finite() && (1.0..=f64::from(u32::MAX)).contains(&size);
    if !(whole(size.x) && whole(size.y)) {
        return problem(format!("image size {} x {}; positive sizes are expected", size.x, size.y));
    }
    if !same_aspect((size.x.round() as u32, size.y.round() as u32), stored) {
        return problem(format!(
            "the camera is for {} x {} pixels, the image has {} x {}: another aspect; give the image as it was \
             captured or correct the size",
            size.x, size.y, stored.0, stored.1
        ));
    }
    let focal = match draft.focal {
        DraftFocal::Pixels(focal) => focal,
        DraftFocal::HorizontalAngle(angle) => {
            if !(angle > 0.0 && angle < std::f64::consts::PI) {
                return problem(format!("camera_angle_x is {angle}; an angle between 0 and pi is expected"));
            }
            DVec2::splat(0.5 * size.x / (0.5 * angle).tan())
        }
    };
    if !(focal.is_finite() && focal.cmpgt(DVec2::ZERO).all()) {
        return problem(format!(
            "focal length {} x {} pixels; positive values are expected",
            focal.x, focal.y
        ));
    }
    let principal = draft.principal_px.unwrap_or(size / 2.0);
    if !principal.is_finite() {
        return problem("the principal point is not finite".to_owned());
    }
    let lens = draft.lens;
    let coefficients = lens.radial.iter().chain(&lens.tangential).chain([&lens.skew_px]);
    if coefficients.into_iter().any(|value| !value.is_finite()) {
        return problem("a distortion coefficient or the skew is not finite".to_owned());
    }
    let camera = PinholeCamera {
        width: loaded.0,
        height: loaded.1,
        focal_px: focal,
        principal_px: principal,
        camera_from_world: pose(&draft.source, frame, draft.camera_from_world)?,
    };
    let factor = DVec2::new(f64::from(loaded.0), f64::from(loaded.1)) / size;
    Ok((
        PinholeCamera { focal_px: focal * factor, principal_px: principal * factor, ..camera },
        LensDistortion { skew_px: lens.skew_px * factor.x, ..lens },
    ))
}

/// A rigid pose: what is orthonormal within 1e-3 is made so exactly, the rest is an error.
fn pose(path: &Path, frame: &str, pose: RigidTransform) -> Result<RigidTransform, Error> {
    let problem =
        |problem: String| Err(Error::Pose { path: path.to_owned(), frame: frame.to_owned(), problem });
    if !(pose.rotation.is_finite() && pose.translation.is_finite()) {
        return problem("has a value that is not finite (NaN or infinite)".to_owned());
    }
    let deviation = pose.orthonormality_error();
    if deviation.is_infinite() {
        return problem("is mirrored (its rotation has a negative determinant)".to_owned());
    }
    if deviation > ROTATION_TOLERANCE {
        return problem(format!(
            "is not a rotation: its axes are off orthonormal by {deviation:.3} (up to {ROTATION_TOLERANCE} is repaired)"
        ));
    }
    // The camera centre stays; only the axes are repaired.
    let centre = -(pose.rotation.inverse() * pose.translation);
    let mut rotation = pose.rotation;
    for _ in 0..4 {
        // Newton's iteration for the nearest rotation; quadratic, so that four rounds reach rounding.
        rotation = (rotation + rotation.inverse().transpose()) * 0.5;
    }
    Ok(RigidTransform { rotation, translation: -(rotation * centre) })
}

/// True when the lens model still has an inverse at the corners of the image.
pub(crate) fn lens_covers_image(camera: &PinholeCamera, lens: &LensDistortion) -> bool {
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)].into_iter().all(|(x, y)| {
        let corner = (DVec2::new(x, y) - camera.principal_px) / camera.focal_px;
        lens.undistort(corner).is_some()
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use glam::{DMat3, DVec3};

    use super::*;

    fn draft() -> DraftCamera {
        DraftCamera {
            source: PathBuf::from("camera.json"),
            size: Some(DVec2::new(64.0, 48.0)),
            focal: DraftFocal::Pixels(DVec2::new(50.0, 55.0)),
            principal_px: None,
            lens: LensDistortion { skew_px: 2.0, ..LensDistortion::default() },
            camera_from_world: RigidTransform::IDENTITY,
        }
    }

    #[test]
    fn pixels_scale_with_the_loaded_size() {
        let (camera, lens) = finish(&draft(), "7", (32, 24), (16, 12)).unwrap();
        assert_eq!((camera.width, camera.height), (16, 12));
        assert_eq!(camera.focal_px, DVec2::new(12.5, 13.75));
        assert_eq!(camera.principal_px, DVec2::new(8.0, 6.0));
        assert_eq!(lens.skew_px, 0.5);
    }

    #[test]
    fn small_deviations_are_repaired_and_large_ones_refused() {
        let mut camera = draft();
        let axes = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.5);
        let centre = DVec3::new(1.0, 2.0, 3.0);
        let skewed = axes * DMat3::from_diagonal(DVec3::new(1.0002, 1.0, 0.9999));
        camera.camera_from_world = RigidTransform { rotation: skewed, translation: -(skewed * centre) };
        let (repaired, _) = finish(&camera, "7", (64, 48), (64, 48)).unwrap();
        assert!(repaired.camera_from_world.orthonormality_error() < 1e-12);
        assert!(repaired.centre().distance(centre) < 1e-12);

        camera.camera_from_world.rotation = axes * 1.01;
        let error = finish(&camera, "7", (64, 48), (64, 48)).unwrap_err().to_string();
        assert!(
            error.contains("camera.json") && error.contains("frame 7") && error.contains("rotation"),
            "{error}"
        );
        camera.camera_from_world.rotation = -axes;
        assert!(finish(&camera, "7", (64, 48), (64, 48)).unwrap_err().to_string().contains("mirrored"));
        camera.camera_from_world.translation.x = f64::NAN;
        assert!(finish(&camera, "7", (64, 48), (64, 48)).unwrap_err().to_string().contains("NaN"));
    }

    #[test]
    fn focal_lengths_must_be_positive() {
        for focal in [0.0, -5.0, f64::NAN] {
            let camera = DraftCamera { focal: DraftFocal::Pixels(DVec2::new(focal, 5.0)), ..draft() };
            let error = finish(&camera, "7", (64, 48), (64, 48)).unwrap_err().to_string();
            assert!(error.contains("focal length"), "{error}");
        }
    }

    #[test]
    fn sizes_beyond_the_limit_are_refused_with_the_numbers() {
        let mut camera = draft();
        camera.size = None;
        let error = finish(&camera, "7", (60_000, 60_000), (60_000, 60_000)).unwrap_err().to_string();
        assert!(error.contains("frame 7") && error.contains("3600000000"), "{error}");
        assert!(error.contains("--downscale"), "{error}");
        assert!(finish(&camera, "7", (60_000, 60_000), (15_000, 15_000)).is_ok(), "reduced on loading");
    }

    #[test]
    fn another_aspect_is_refused() {
        assert!(finish(&draft(), "7", (48, 64), (48, 64)).unwrap_err().to_string().contains("aspect"));
    }
}
