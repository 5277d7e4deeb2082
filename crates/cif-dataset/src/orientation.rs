//! Which way up the pixels of files lie. Cameras store pictures as their sensor lies and note in EXIF how to turn them:
//! most programs show them turned, others, COLMAP among them, read them as they are stored. The size of the camera that
//! belongs to an image shows which of both it is of.

use cif_geometry::PixelGrid;
use glam::DVec2;
pub use image::metadata::Orientation;

use crate::sizes::same_aspect;

/// How the pixels of files are turned into those of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turn {
    /// Of its image.
    pub image: Orientation,
    /// Of files next to the image, such as masks, which have its width as their height.
    pub beside: Orientation,
}

impl Turn {
    /// Pixels are taken as they are stored.
    pub const NONE: Self = Self { image: Orientation::NoTransforms, beside: Orientation::NoTransforms };

    /// The image is turned as its EXIF says, files next to it where they lie as the image is stored.
    #[must_use]
    pub fn upright(exif: Orientation) -> Self {
        Self { image: exif, beside: exif }
    }

    /// The image stays as it is stored, files next to it are turned back where they were made upright.
    fn as_stored(exif: Orientation) -> Self {
        let back = match exif {
            Orientation::Rotate90 => Orientation::Rotate270,
            Orientation::Rotate270 => Orientation::Rotate90,
            // Half turns and reflections undo themselves.
            other => other,
        };
        Self { image: Orientation::NoTransforms, beside: back }
    }

    /// The turn for the camera of an image: upright where its width and height are nearer to those of the upright image.
    /// Where they do not determine it, such as for half turns, `of_stored` does.
    #[must_use]
    pub fn for_camera(exif: Orientation, stored: (u32, u32), camera: Option<DVec2>, of_stored: bool) -> Self {
        let aspect = |(width, height): (u32, u32)| (f64::from(width) / f64::from(height)).ln();
        let away = |size, camera: DVec2| ((camera.x / camera.y).ln() - aspect(size)).abs();
        let nearer =
            camera.map(|camera| away(stored, camera).total_cmp(&away(turned_size(exif, stored), camera)));
        match nearer {
            Some(std::cmp::Ordering::Less) => Self::as_stored(exif),
            Some(std::cmp::Ordering::Greater) => Self::upright(exif),
            _ if of_stored => Self::as_stored(exif),
            _ => Self::upright(exif),
        }
    }

    /// Width and height of a file next to an image of `frame` pixels, once it lies as that.
    pub(crate) fn seen_size(&self, size: (u32, u32), frame: (u32, u32)) -> (u32, u32) {
        let turned = turned_size(self.beside, size);
        if same_aspect(size, frame) || !same_aspect(turned, frame) { size } else { turned }
    }

    /// The pixels of a file next to an image of `frame` pixels as they lie in that: turned where their aspect says that
    /// they lie the other way.
    pub(crate) fn seen<T: Copy>(&self, pixels: PixelGrid<T>, frame: (u32, u32)) -> PixelGrid<T> {
        let size = (pixels.width, pixels.height);
        if self.seen_size(size, frame) == size { pixels } else { turned(&pixels, self.beside) }
    }
}

/// Width and height once pixels are turned.
#[must_use]
pub fn turned_size(orientation: Orientation, (width, height): (u32, u32)) -> (u32, u32) {
    match orientation {
        Orientation::Rotate90
        | Orientation::Rotate270
        | Orientation::Rotate90FlipH
        | Orientation::Rotate270FlipH => (height, width),
        Orientation::NoTransforms
        | Orientation::Rotate180
        | Orientation::FlipHorizontal
        | Orientation::FlipVertical => (width, height),
    }
}

fn turned<T: Copy>(stored: &PixelGrid<T>, orientation: Orientation) -> PixelGrid<T> {
    let (right, bottom) = (stored.width.saturating_sub(1), stored.height.saturating_sub(1));
    let (width, height) = turned_size(orientation, (stored.width, stored.height));
    let from = |x: u32, y: u32| match orientation {
        Orientation::NoTransforms => (x, y),
        Orientation::FlipHorizontal => (right - x, y),
        Orientation::FlipVertical => (x, bottom - y),
        Orientation::Rotate180 => (right - x, bottom - y),
        Orientation::Rotate90 => (y, bottom - x),
        Orientation::Rotate270 => (right - y, x),
        Orientation::Rotate90FlipH => (y, x),
        Orientation::Rotate270FlipH => (right - y, bottom - x),
    };
    let pixels = (0..height)
        .flat_map(|y| (0..width).map(move |x| from(x, y)))
        .map(|(x, y)| *stored.at(x, y))
        .collect();
    PixelGrid::from_pixels(width, height, pixels)
}

#[cfg(test)]
mod tests {
    use image::{DynamicImage, GrayImage};

    use super::*;

    #[test]
    fn masks_turn_as_images_do() {
        let grid = PixelGrid::from_pixels(5, 3, (0..15_u8).collect());
        for exif in 1..=8 {
            let orientation = Orientation::from_exif(exif).unwrap();
            let mut image = DynamicImage::ImageLuma8(GrayImage::from_raw(5, 3, grid.pixels.clone()).unwrap());
            image.apply_orientation(orientation);
            let ours = turned(&grid, orientation);
            assert_eq!((ours.width, ours.height), (image.width(), image.height()), "{exif}");
            assert_eq!(ours.pixels, image.into_luma8().into_raw(), "{exif}");
            let back = turned(&ours, Turn::as_stored(orientation).beside);
            assert_eq!(back, grid, "{exif}");
        }
    }

    #[test]
    fn the_size_of_the_camera_tells_how_its_image_lies() {
        let of = |camera: Option<DVec2>, of_stored| {
            Turn::for_camera(Orientation::Rotate90, (64, 48), camera, of_stored).image
        };
        let upright = Orientation::Rotate90;
        for of_stored in [false, true] {
            assert_eq!(of(Some(DVec2::new(48.0, 64.0)), of_stored), upright);
            assert_eq!(of(Some(DVec2::new(96.0, 128.0)), of_stored), upright);
            assert_eq!(of(Some(DVec2::new(640.0, 480.0)), of_stored), Orientation::NoTransforms);
        }
        assert_eq!(of(None, false), upright);
        assert_eq!(of(None, true), Orientation::NoTransforms);
        let half = |of_stored| {
            let camera = Some(DVec2::new(64.0, 48.0));
            Turn::for_camera(Orientation::Rotate180, (64, 48), camera, of_stored).image
        };
        assert_eq!([half(false), half(true)], [Orientation::Rotate180, Orientation::NoTransforms]);
    }
}
