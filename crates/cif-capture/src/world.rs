//! The direction of up and the length of a metre: poses from images alone give neither.

use cif_geometry::Ray;
use cif_geometry::rays::nearest_point;
use glam::{DMat3, DVec2, DVec3};

use crate::Error;
use crate::poses::Poses;
use crate::similarity::Similarity;

/// Cameras whose horizontal axes span a plane: the second largest share of their spread is at least this.
/// Below it the axes are parallel, and exclude only one direction.
const SPANS: f64 = 0.02;

/// Cameras are held upright where the mean of their own up directions is at least this long along the estimate.
const UPRIGHT: f64 = 0.3;

/// Sine of the widest angle between rays from which they show where they meet.
const CROSSES: f64 = 0.02;

/// The direction against gravity, from the cameras: their rows of pixels are level, so that up is
/// perpendicular to all of them; `None` where the cameras were not held so.
#[must_use]
pub fn up_of_cameras(poses: &Poses) -> Option<DVec3> {
    let axes =
        |column: usize| poses.images.values().map(move |pose| pose.world_from_camera.rotation.col(column));
    let mean_up: DVec3 = -axes(1).sum::<DVec3>() / poses.images.len().max(1) as f64;
    let mut spread = nalgebra::Matrix3::<f64>::zeros();
    for axis in axes(0) {
        let axis = axis.to_array();
        spread += nalgebra::Matrix3::from_fn(|i, j| axis[i] * axis[j]) / poses.images.len() as f64;
    }
    let eigen = spread.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let direction = |k: usize| DVec3::from_array(std::array::from_fn(|i| eigen.eigenvectors[(i, order[k])]));
    let up = if eigen.eigenvalues[order[1]] > SPANS {
        let normal = direction(0);
        if normal.dot(mean_up) < 0.0 { -normal } else { normal }
    } else {
        // All rows are parallel: the mean up direction, made level with them.
        let row = direction(2);
        (mean_up - row * mean_up.dot(row)).try_normalize()?
    };
    (up.dot(mean_up) >= UPRIGHT).then_some(up)
}

/// The rotation that brings `up` to +z, turning as little as it can.
#[must_use]
pub fn upright(up: DVec3) -> Similarity {
    let rotation = DMat3::from_quat(glam::DQuat::from_rotation_arc(up.normalize(), DVec3::Z));
    Similarity { rotation, ..Similarity::IDENTITY }
}

/// One end of a known length in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Click {
    /// Image.
    pub image: String,
    /// Pixel, from the top left.
    pub pixel: DVec2,
}

/// The place where the rays of clicks on one point meet.
///
/// # Errors
/// When an image has no pose, there are fewer than two, or the rays are nearly parallel.
pub fn meet(poses: &Poses, clicks: &[Click]) -> Result<DVec3, Error> {
    let mut rays = Vec::new();
    for click in clicks {
        let pose = crate::times::entry(&poses.images, &click.image).ok_or_else(|| {
            Error::refused(
                format!("{}: this image has no pose, so that no length can be measured in it", click.image),
                "click in another image",
            )
        })?;
        let lens = &poses.lenses[pose.lens];
        let plane = DVec2::new(
            (click.pixel.x - lens.principal_px[0]) / lens.focal_px[0],
            (click.pixel.y - lens.principal_px[1]) / lens.focal_px[1],
        );
        let ideal = lens.distortion.undistort(plane).unwrap_or(plane);
        let direction = (pose.world_from_camera.rotation * ideal.extend(1.0)).normalize();
        rays.push(Ray::new(pose.world_from_camera.translation, direction));
    }
    let widest = rays
        .iter()
        .flat_map(|a| rays.iter().map(|b| a.direction.cross(b.direction).length()))
        .fold(0.0, f64::max);
    let met = nearest_point(rays.iter().map(|ray| (*ray, 1.0)), 0.0);
    met.filter(|_| widest >= CROSSES).ok_or_else(|| {
        Error::refused(
            format!(
                "{} clicks see the point from nearly one direction, so that it has no depth",
                clicks.len()
            ),
            "click the same point in two or more images from different sides",
        )
    })
}

/// The scale by which a length between two places becomes `metres`.
///
/// # Errors
/// When the places coincide.
pub fn scale_of(a: DVec3, b: DVec3, metres: f64) -> Result<f64, Error> {
    let length = a.distance(b);
    if !(length > 0.0 && length.is_finite()) {
        return Err(Error::refused(
            "the two ends of the known length are one place",
            "click two different points, each in two or more images",
        ));
    }
    Ok(metres / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::similarity::tests::{arc, somewhere};

    #[test]
    fn up_is_found_whatever_the_world() {
        let mut poses = arc(20);
        assert!(up_of_cameras(&poses).unwrap().dot(DVec3::Z) > 0.999);
        poses.transform(&somewhere());
        let up = up_of_cameras(&poses).unwrap();
        assert!(up.dot(somewhere().rotation * DVec3::Z) > 0.999);
        poses.transform(&upright(up));
        assert!(up_of_cameras(&poses).unwrap().dot(DVec3::Z) > 0.999);
        // Down exactly, where a rotation arc is not unique.
        assert!((upright(-DVec3::Z).apply(-DVec3::Z) - DVec3::Z).length() < 1e-9);
    }

    #[test]
    fn cameras_that_roll_tell_no_up() {
        let mut poses = arc(20);
        for (k, pose) in poses.images.values_mut().enumerate() {
            pose.world_from_camera.rotation *= DMat3::from_rotation_z(k as f64 * 2.0);
        }
        assert_eq!(up_of_cameras(&poses), None);
    }

    #[test]
    fn a_known_length_sets_the_metre() {
        let poses = {
            let mut poses = arc(20);
            poses.lenses[0].distortion.radial[0] = -0.05;
            poses.transform(&somewhere());
            poses
        };
        let ends = [DVec3::new(0.2, 0.1, 0.3), DVec3::new(-0.1, 0.4, 0.2)];
        let clicks = |end: DVec3| -> Vec<Click> {
            ["003.png", "011.png"]
                .iter()
                .map(|name| {
                    let pose = &poses.images[*name];
                    let seen = pose.world_from_camera.inverse().apply(somewhere().apply(end));
                    let plane = poses.lenses[0].distortion.distort(DVec2::new(seen.x, seen.y) / seen.z);
                    Click { image: (*name).to_owned(), pixel: plane * 600.0 + DVec2::new(320.0, 240.0) }
                })
                .collect()
        };
        let met: Vec<DVec3> = ends.iter().map(|end| meet(&poses, &clicks(*end)).unwrap()).collect();
        let metres = ends[0].distance(ends[1]);
        let scale = scale_of(met[0], met[1], metres).unwrap();
        assert!((scale * somewhere().scale - 1.0).abs() < 1e-5, "{scale}");
        assert!(scale_of(met[0], met[0], 1.0).is_err());
        let one = meet(&poses, &clicks(ends[0])[..1]).unwrap_err().to_string();
        assert!(one.contains("one direction"), "{one}");
        let none = meet(&poses, &[Click { image: "x.png".into(), pixel: DVec2::ZERO }]).unwrap_err();
        assert!(none.to_string().contains("x.png"));
    }
}
