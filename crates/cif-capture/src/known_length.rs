//! The metre from an object of known length that stands still and has masks.

use cif_geometry::stats::upper_median;
use glam::{DVec2, DVec3};

use crate::frames::Shot;
use crate::masks::Masks;
use crate::poses::{Lens, Pose, Poses};
use crate::world::{Click, meet};
use crate::{Error, Hooks};

/// Objects need this many pixels in a mask.
const PIXELS: usize = 40;

/// Views that are looked at at most, spread over the capture.
const VIEWS: usize = 40;

/// Directions in which the image of an object is measured.
const DIRECTIONS: usize = 36;

/// Where the rays to the middle of an object pass each other by more than this share of its length, it moves.
const MOVES: f64 = 0.35;

/// An object in one view.
struct Seen<'a> {
    click: Click,
    /// Longest side of its image, as an angle's tangent.
    length: f64,
    pose: &'a Pose,
}

/// Longest side of an object in the unit of the poses: seen from all around, the largest of its images that is
/// not an outlier (90th percentile), times its distance.
///
/// # Errors
/// When few masks show all of it, or it moves.
pub fn measure(
    id: u16,
    masks: &Masks,
    shots: &[Shot],
    poses: &Poses,
    hooks: &Hooks<'_>,
) -> Result<f64, Error> {
    let masked: Vec<&Shot> = shots
        .iter()
        .filter(|shot| masks.files.contains_key(&shot.name) && poses.images.contains_key(&shot.name))
        .collect();
    let mut seen = Vec::new();
    for shot in masked.iter().step_by(masked.len().div_ceil(VIEWS).max(1)) {
        hooks.go_on()?;
        let Some(ids) = masks.ids(shot)? else { continue };
        let pose = &poses.images[&shot.name];
        let lens = &poses.lenses[pose.lens];
        let pixels: Vec<DVec2> = (0..ids.pixels.len())
            .filter(|k| ids.pixels[*k] == id)
            .map(|k| DVec2::new((k % ids.width as usize) as f64, (k / ids.width as usize) as f64))
            .collect();
        let edge = DVec2::new(f64::from(ids.width - 1), f64::from(ids.height - 1));
        let is_cut = pixels.iter().any(|p| p.x == 0.0 || p.y == 0.0 || p.x == edge.x || p.y == edge.y);
        if pixels.len() < PIXELS || is_cut {
            continue;
        }
        let middle = pixels.iter().sum::<DVec2>() / pixels.len() as f64 + DVec2::splat(0.5);
        let click = Click { image: shot.name.clone(), pixel: middle };
        seen.push(Seen { click, length: longest(&pixels, lens), pose });
    }
    if seen.len() < 3 {
        return Err(Error::refused(
            format!(
                "the masks show all of the object in {} images, but 3 are needed to measure it",
                seen.len()
            ),
            "name another object, or measure two points (--measured)",
        ));
    }
    let clicks: Vec<Click> = seen.iter().map(|seen| seen.click.clone()).collect();
    let place = meet(poses, &clicks)?;
    let mut lengths = Vec::new();
    let mut misses = Vec::new();
    for seen in &seen {
        let inside = seen.pose.world_from_camera.inverse().apply(place);
        if inside.z <= 0.0 {
            continue;
        }
        lengths.push(seen.length * inside.z);
        misses.push(miss(&poses.lenses[seen.pose.lens], seen.click.pixel, inside));
    }
    lengths.sort_by(f64::total_cmp);
    let (Some(length), Some(missed)) = (lengths.get(lengths.len() * 9 / 10), upper_median(&mut misses))
    else {
        return Err(Error::refused(
            "the object lies behind its cameras, so that it cannot be measured",
            "check the masks, or measure two points (--measured)",
        ));
    };
    if missed > MOVES * length {
        return Err(Error::refused(
            "the object moves, so that its distance is not known",
            "name an object that stands still, or measure two points of the scene (--measured)",
        ));
    }
    Ok(*length)
}

/// Distance between the place and the ray through a pixel, at the depth of the place.
fn miss(lens: &Lens, pixel: DVec2, inside: DVec3) -> f64 {
    let plane = (pixel - DVec2::from(lens.principal_px)) / DVec2::from(lens.focal_px);
    let ideal = lens.distortion.undistort(plane).unwrap_or(plane);
    (ideal - DVec2::new(inside.x, inside.y) / inside.z).length() * inside.z
}

/// Largest extent of pixels over all directions, over the focal length.
fn longest(pixels: &[DVec2], lens: &Lens) -> f64 {
    let focal = DVec2::from(lens.focal_px);
    (0..DIRECTIONS)
        .map(|k| {
            let direction = DVec2::from_angle(std::f64::consts::PI * k as f64 / DIRECTIONS as f64);
            let along = pixels.iter().map(|pixel| (*pixel / focal).dot(direction));
            let [low, high] =
                along.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)]);
            // From the outer edge of the first pixel to that of the last.
            high - low + 1.0 / focal.x
        })
        .fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;
    use crate::similarity::tests::{arc, somewhere};

    /// Masks of a rod of length 0.8, whose middle is at `place(k)` in view k.
    fn rod(folder: &std::path::Path, place: impl Fn(usize) -> DVec3) -> (Masks, Vec<Shot>, Poses) {
        let mut poses = arc(16);
        let mut files = BTreeMap::new();
        let mut shots = Vec::new();
        for (k, (name, pose)) in poses.images.iter().enumerate() {
            let mut mask = image::GrayImage::new(640, 480);
            for step in 0..=400 {
                let point = place(k) + DVec3::Z * 0.8 * (f64::from(step) / 400.0 - 0.5);
                let seen = pose.world_from_camera.inverse().apply(point);
                let pixel = DVec2::new(seen.x, seen.y) / seen.z * 600.0 + DVec2::new(320.0, 240.0);
                mask.put_pixel(pixel.x as u32, pixel.y as u32, image::Luma([6]));
            }
            let file = folder.join(name);
            mask.save(&file).unwrap();
            files.insert(name.clone(), file.clone());
            shots.push(Shot {
                camera: "a".to_owned(),
                name: name.clone(),
                file,
                time: None,
                size: (640, 480),
                turned: cif_dataset::orientation::Orientation::NoTransforms,
                impression: Impression::of(&board(50, 0)),
                source: None,
            });
        }
        poses.transform(&somewhere());
        (Masks { folder: folder.to_owned(), files }, shots, poses)
    }

    #[test]
    fn an_object_that_stands_still_is_measured_whatever_the_unit() {
        let folder = tempfile::tempdir().unwrap();
        let (masks, shots, poses) = rod(folder.path(), |_| DVec3::new(0.2, -0.1, 0.1));
        let length = measure(6, &masks, &shots, &poses, &Hooks::silent()).unwrap();
        let expected = 0.8 * somewhere().scale;
        // Seen from above, a rod is a little foreshortened.
        assert!((length / expected - 1.0).abs() < 0.08, "{length} {expected}");
        let error = measure(7, &masks, &shots, &poses, &Hooks::silent()).unwrap_err().to_string();
        assert!(error.contains("in 0 images"), "{error}");
    }

    #[test]
    fn an_object_that_moves_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let walk = |k: usize| DVec3::new(0.0, if k.is_multiple_of(2) { 0.7 } else { -0.7 }, 0.0);
        let (masks, shots, poses) = rod(folder.path(), walk);
        let error = measure(6, &masks, &shots, &poses, &Hooks::silent()).unwrap_err().to_string();
        assert!(error.contains("moves"), "{error}");
    }
}
