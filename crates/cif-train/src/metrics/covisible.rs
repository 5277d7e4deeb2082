//! Pixels of a held-out view whose place training views show too. Source: the masked PSNR of DyCheck (Gao et al.,
//! "Monocular Dynamic View Synthesis: A Reality Check"), with depths of the field in place of optical flow.
//!
//! A pixel is co-visible when its point, at the rendered depth, is shown by enough training views: it lies inside
//! their images and is not hidden there, which means that its depth z in a view is at most [`TOLERANCE`] beyond what the
//! field renders there at the time of that view. Enough is [`LEAST_SHARE`] of the views, and at least [`LEAST_VIEWS`]
//! of them. A pixel that the field covers by less than half has no point, and is not co-visible.
//!
//! The point stays where it is at the time of the held-out view, so that of what moves only what passes before it
//! counts.

use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::cpu::Renderer;
use cif_render::{Channels, RenderSettings, RenderedImage};
use glam::DVec2;
use rayon::prelude::*;

/// Training views that are asked, spread evenly over cameras and times where the capture has more.
pub const MOST_VIEWS: usize = 64;
/// Share of the views that have to show a point.
pub const LEAST_SHARE: f64 = 0.1;
/// Views that have to show a point in any case, or all where there are fewer.
pub const LEAST_VIEWS: usize = 5;
/// Distance behind the rendered surface from which on a point is hidden, as a share of the depth of that surface.
pub const TOLERANCE: f64 = 0.05;
/// Pixels of a training view at most; larger ones are reduced, as what hides what takes no more.
pub const MOST_PIXELS: u32 = 1 << 18;
/// Coverage below which a pixel shows no surface.
const COVERED: f32 = 0.5;

/// Parts of a field that training views show.
#[derive(Clone, Debug)]
pub struct TrainingViews {
    /// Cameras with depth z, metres; infinite where nothing is.
    views: Vec<(PinholeCamera, PixelGrid<f32>)>,
    needed: usize,
}

impl TrainingViews {
    /// Renders the depth of the training views of a capture, each at its own time.
    #[must_use]
    pub fn of(field: &Field, dataset: &Dataset, settings: &RenderSettings, renderer: &mut Renderer) -> Self {
        let train = dataset.split_frames(Split::Train);
        let count = train.len().min(MOST_VIEWS);
        let views = (0..count).map(|k| {
            let frame = &dataset.frames[train[k * train.len() / count]];
            let channels = Channels { depth: true, instances: false };
            let camera = asked(&frame.camera);
            let rendered = renderer.render(field, &camera, frame.time, settings, channels);
            (camera, surface(&rendered, f32::INFINITY))
        });
        Self::new(views.collect())
    }

    fn new(views: Vec<(PinholeCamera, PixelGrid<f32>)>) -> Self {
        let share = (LEAST_SHARE * views.len() as f64).ceil() as usize;
        let needed = share.max(LEAST_VIEWS).min(views.len()).max(1);
        Self { views, needed }
    }

    /// Pixels of a view, rendered with its depth, that the training views show.
    ///
    /// # Panics
    /// When the view was rendered without depth.
    #[must_use]
    pub fn show(&self, camera: &PinholeCamera, rendered: &RenderedImage) -> PixelGrid<bool> {
        self.show_surface(camera, &surface(rendered, 0.0))
    }

    fn show_surface(&self, camera: &PinholeCamera, depth: &PixelGrid<f32>) -> PixelGrid<bool> {
        let (centre, width) = (camera.centre(), depth.width);
        let shown = depth.pixels.par_iter().enumerate().map(|(k, z)| {
            if *z <= 0.0 {
                return false;
            }
            let pixel = DVec2::new((k as u32 % width) as f64 + 0.5, (k as u32 / width) as f64 + 0.5);
            let point = centre + camera.ray(pixel) * f64::from(*z);
            let by = self.views.iter().filter(|(view, surface)| {
                let Some([column, row]) = view.pixel_of(point) else { return false };
                let z = view.camera_from_world.apply(point).z;
                let before = surface.pixels[(row * surface.width + column) as usize];
                z <= f64::from(before) * (1.0 + TOLERANCE)
            });
            by.take(self.needed).count() == self.needed
        });
        PixelGrid::from_pixels(depth.width, depth.height, shown.collect())
    }
}

/// A training view at the size at which it is asked.
fn asked(camera: &PinholeCamera) -> PinholeCamera {
    let pixels = f64::from(camera.width) * f64::from(camera.height);
    let by = (pixels / f64::from(MOST_PIXELS)).sqrt().ceil().max(1.0) as u32;
    camera.resized(camera.width.div_ceil(by), camera.height.div_ceil(by))
}

/// Depth of a render, and `nothing` where the field hardly covers a pixel.
fn surface(rendered: &RenderedImage, nothing: f32) -> PixelGrid<f32> {
    let depth = rendered.depth.as_ref().expect("depth was asked for");
    let of = |(depth, alpha): (&f32, &f32)| if *alpha < COVERED { nothing } else { *depth };
    PixelGrid::from_pixels(
        depth.width,
        depth.height,
        depth.pixels.iter().zip(&rendered.alpha.pixels).map(of).collect(),
    )
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;
    use glam::{DMat3, DVec3};

    use super::*;

    /// A camera at `x` that looks along +z: 4 x 1 pixels, one metre wide at a depth of one.
    fn camera(x: f64) -> PinholeCamera {
        PinholeCamera {
            width: 4,
            height: 1,
            focal_px: DVec2::splat(4.0),
            principal_px: DVec2::new(2.0, 0.5),
            camera_from_world: RigidTransform {
                rotation: DMat3::IDENTITY,
                translation: DVec3::new(-x, 0.0, 0.0),
            },
        }
    }

    fn depth(pixels: [f32; 4]) -> PixelGrid<f32> {
        PixelGrid::from_pixels(4, 1, pixels.to_vec())
    }

    #[test]
    fn what_no_training_image_reaches_is_not_co_visible() {
        // A wall at 1 m; the training cameras stand a quarter of their view, one pixel, to the left.
        let views = TrainingViews::new(vec![(camera(-0.25), depth([1.0; 4])); 5]);
        let shown = views.show_surface(&camera(0.0), &depth([1.0; 4]));
        assert_eq!(shown.pixels, [true, true, true, false]);
    }

    #[test]
    fn large_training_views_are_asked_at_a_smaller_size() {
        let size = |width, height| {
            let asked = asked(&PinholeCamera { width, height, ..camera(0.0) });
            [asked.width, asked.height]
        };
        assert_eq!([size(512, 512), size(640, 360)], [[512, 512], [640, 360]], "as they are");
        assert_eq!(
            [size(800, 600), size(1920, 1080), size(4000, 3000)],
            [[400, 300], [640, 360], [572, 429]]
        );
        let large = PinholeCamera {
            width: 1920,
            height: 1080,
            principal_px: DVec2::new(950.0, 530.0),
            ..camera(0.2)
        };
        let [whole, small] =
            [large, asked(&large)].map(|camera| camera.project(DVec3::new(0.3, -0.1, 2.0)).unwrap().0);
        assert!((whole / 3.0 - small).length() < 1e-9, "{whole} {small}");
    }

    #[test]
    fn what_is_hidden_or_empty_is_not_co_visible() {
        // Something stands before the second pixel; the third one's surface is behind by less than the tolerance, the
        // fourth has none.
        let views = TrainingViews::new(vec![(camera(0.0), depth([f32::INFINITY, 0.5, 0.96, 1.0])); 5]);
        let shown = views.show_surface(&camera(0.0), &depth([1.0, 1.0, 1.0, 0.0]));
        assert_eq!(shown.pixels, [true, false, true, false]);
    }

    #[test]
    fn enough_views_have_to_show_a_point() {
        let (clear, hidden) = ((camera(0.0), depth([1.0; 4])), (camera(0.0), depth([0.5; 4])));
        let shown_by = |seeing: usize, all: usize| {
            let views = (0..all).map(|k| if k < seeing { clear.clone() } else { hidden.clone() });
            TrainingViews::new(views.collect()).show_surface(&camera(0.0), &depth([1.0; 4])).pixels[0]
        };
        assert!(shown_by(5, 20) && !shown_by(4, 20), "at least five");
        assert!(shown_by(6, 60) && !shown_by(5, 60), "a tenth of them");
        assert!(shown_by(2, 2) && !shown_by(1, 2), "all where there are fewer than five");
        assert!(!shown_by(0, 0), "nothing is seen without training views");
    }
}
