//! Removes lens distortion and skew from images and masks by resampling.

use cif_geometry::{LensDistortion, PinholeCamera, PixelGrid};
use glam::DVec2;
use rayon::prelude::*;

/// Where each ideal pixel centre lies in the image as captured, in pixels; row-major.
///
/// Captured and ideal image share size, focal lengths and principal point.
fn captured_positions(camera: &PinholeCamera, lens: &LensDistortion) -> Vec<DVec2> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    (0..height)
        .into_par_iter()
        .flat_map_iter(|y| {
            (0..width).map(move |x| {
                let ideal =
                    (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - camera.principal_px) / camera.focal_px;
                let captured = lens.distort(ideal);
                camera.focal_px * captured + DVec2::new(lens.skew_px * captured.y, 0.0) + camera.principal_px
            })
        })
        .collect()
}

/// Bilinear resampling; beyond the captured image its border colour continues.
pub(crate) fn undistort_image(
    image: &PixelGrid<[f32; 3]>,
    camera: &PinholeCamera,
    lens: &LensDistortion,
) -> PixelGrid<[f32; 3]> {
    let (last_x, last_y) = (f64::from(image.width - 1), f64::from(image.height - 1));
    let pixels = captured_positions(camera, lens)
        .into_par_iter()
        .map(|position| {
            // `max` before `min` turns a NaN of an absurd lens into 0.
            let x = (position.x - 0.5).max(0.0).min(last_x);
            let y = (position.y - 0.5).max(0.0).min(last_y);
            let (x0, y0) = (x.floor(), y.floor());
            let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
            let (x0, y0) = (x0 as u32, y0 as u32);
            let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
            let (a, b, c, d) = (image.at(x0, y0), image.at(x1, y0), image.at(x0, y1), image.at(x1, y1));
            std::array::from_fn(|k| {
                (a[k] * (1.0 - fx) + b[k] * fx) * (1.0 - fy) + (c[k] * (1.0 - fx) + d[k] * fx) * fy
            })
        })
        .collect();
    PixelGrid::from_pixels(image.width, image.height, pixels)
}

/// Nearest-pixel resampling; beyond the captured mask nothing is labelled (the default of its pixels).
pub(crate) fn undistort_mask<T: Copy + Default>(
    mask: &PixelGrid<T>,
    camera: &PinholeCamera,
    lens: &LensDistortion,
) -> PixelGrid<T> {
    let (width, height) = (f64::from(mask.width), f64::from(mask.height));
    let pixels = captured_positions(camera, lens)
        .into_iter()
        .map(|p| {
            let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height;
            if inside { *mask.at(p.x as u32, p.y as u32) } else { T::default() }
        })
        .collect();
    PixelGrid::from_pixels(mask.width, mask.height, pixels)
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;

    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera {
            width: 64,
            height: 48,
            focal_px: DVec2::new(60.0, 55.0),
            principal_px: DVec2::new(30.0, 25.0),
            camera_from_world: RigidTransform::IDENTITY,
        }
    }

    fn lens() -> LensDistortion {
        LensDistortion { radial: [-0.2, 0.05, 0.0, 0.0], tangential: [0.01, -0.02], skew_px: 1.5 }
    }

    /// An image that is linear in the ideal coordinates, as a distorting camera would capture it.
    fn captured(value: impl Fn(DVec2) -> f32) -> PixelGrid<[f32; 3]> {
        let (camera, lens) = (camera(), lens());
        let mut pixels = Vec::new();
        for y in 0..camera.height {
            for x in 0..camera.width {
                let mut p = (DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - camera.principal_px)
                    / camera.focal_px;
                p.x -= lens.skew_px * p.y / camera.focal_px.x;
                pixels.push([value(lens.undistort(p).unwrap()); 3]);
            }
        }
        PixelGrid::from_pixels(camera.width, camera.height, pixels)
    }

    #[test]
    fn removal_undoes_the_lens() {
        let value = |p: DVec2| (100.0 + 90.0 * p.x + 40.0 * p.y) as f32;
        let restored = undistort_image(&captured(value), &camera(), &lens());
        let camera = camera();
        for (x, y) in [(5, 5), (32, 24), (50, 40), (12, 30)] {
            let ideal =
                (DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - camera.principal_px) / camera.focal_px;
            let difference = restored.at(x, y)[0] - value(ideal);
            assert!(difference.abs() < 0.05, "({x}, {y}): {difference}");
        }
    }

    #[test]
    fn masks_follow_the_image_without_new_ids() {
        let side = |p: DVec2| if p.x > 0.1 { 7.0 } else { 3.0 };
        let mask = captured(side).map(|pixel| pixel[0] as u16);
        let restored = undistort_mask(&mask, &camera(), &lens());
        assert!(restored.pixels.iter().all(|id| [0, 3, 7].contains(id)));
        // The border is at x = 0.1 * 60 + 30 = 36.
        assert_eq!((*restored.at(34, 24), *restored.at(38, 24)), (3, 7));
        assert_eq!((*restored.at(34, 8), *restored.at(38, 40)), (3, 7));
    }

    #[test]
    fn an_absurd_lens_does_not_panic() {
        let lens = LensDistortion { radial: [1e300, -1e300, 1e300, 0.0], ..lens() };
        undistort_image(&captured(|_| 1.0), &camera(), &lens);
        undistort_mask(&PixelGrid::filled(64, 48, 1_u16), &camera(), &lens);
    }
}
