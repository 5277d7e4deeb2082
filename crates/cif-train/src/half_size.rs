//! Images at half their width and height, which the first steps of a run see: few Gaussians show no more, and large
//! structure is learnt before detail. Source: Chen et al. 2025 ("DashGaussian"), there by the spectrum of the images.

use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::UNLABELLED;

use crate::frames::TrainFrame;

/// A frame whose pixels are the mean colours of four, with the label of the last of these; an odd row or column at the
/// end is left out.
pub(crate) fn of_frame(frame: &TrainFrame) -> TrainFrame {
    let (width, height) = (frame.image.width / 2, frame.image.height / 2);
    let from = frame.image.width as usize;
    let mut image = PixelGrid::filled(width, height, [0; 3]);
    let rows = image.pixels.chunks_exact_mut(width as usize).zip(frame.image.pixels.chunks_exact(2 * from));
    for (row, two) in rows {
        let (above, below) = two.split_at(from);
        for ((pixel, above), below) in row.iter_mut().zip(above.chunks_exact(2)).zip(below.chunks_exact(2)) {
            for (channel, mean) in pixel.iter_mut().enumerate() {
                let of_two =
                    |pixels: &[[u8; 3]]| u16::from(pixels[0][channel]) + u16::from(pixels[1][channel]);
                *mean = ((of_two(above) + of_two(below) + 2) / 4) as u8;
            }
        }
    }
    let labels = frame.labels.as_ref().map(|labels| {
        let mut half = PixelGrid::filled(width, height, UNLABELLED);
        let rows = half.pixels.chunks_exact_mut(width as usize).zip(labels.pixels.chunks_exact(2 * from));
        for (row, two) in rows {
            for (label, below) in row.iter_mut().zip(two[from..].chunks_exact(2)) {
                *label = below[1];
            }
        }
        half
    });
    TrainFrame::new(image, labels, None)
}

/// The camera of such a frame.
pub(crate) fn of_camera(camera: &PinholeCamera) -> PinholeCamera {
    PinholeCamera {
        width: camera.width / 2,
        height: camera.height / 2,
        focal_px: camera.focal_px / 2.0,
        principal_px: camera.principal_px / 2.0,
        camera_from_world: camera.camera_from_world,
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn pixels_are_means_of_four_where_the_camera_sees_them() {
        // 5 x 3 pixels: the last column and row have no partners.
        let color = |x: u32, y: u32| [(10 * x) as u8, (10 * y + 1) as u8, 255];
        let at = |k: u32| (k % 5, k / 5);
        let mut image = PixelGrid::filled(5, 3, [0; 3]);
        let mut labels = PixelGrid::filled(5, 3, UNLABELLED);
        for k in 0..15 {
            let (x, y) = at(k);
            image.pixels[k as usize] = color(x, y);
            labels.pixels[k as usize] = u16::from(x >= 2);
        }
        let half = of_frame(&TrainFrame::new(image, Some(labels), None));
        assert_eq!((half.image.width, half.image.height), (2, 1));
        assert_eq!(half.image.pixels, [[5, 6, 255], [25, 6, 255]]);
        assert_eq!((half.labels.unwrap().pixels, half.labelled), (vec![UNLABELLED, 1], 1));
        let camera = PinholeCamera {
            width: 5,
            height: 3,
            focal_px: DVec2::new(7.0, 8.0),
            principal_px: DVec2::new(2.3, 1.4),
            camera_from_world: cif_geometry::RigidTransform::IDENTITY,
        };
        let small = of_camera(&camera);
        assert_eq!((small.width, small.height), (half.image.width, half.image.height));
        let place = DVec3::new(0.3, -0.2, 1.7);
        let [of_whole, of_half] = [&camera, &small].map(|camera| camera.project(place).unwrap().0);
        assert!((of_whole / 2.0 - of_half).length() < 1e-12, "{of_whole} {of_half}");
    }
}
