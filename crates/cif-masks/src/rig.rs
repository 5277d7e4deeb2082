//! Ids from cameras whose masks are known to others, by points in the world.
//!
//! Points are given the ids that known views show where they are seen; seen from another camera, they are seeds there.
//! Between seeds, pixels go to the class that they look like. What results is a keyframe that is not certain, from
//! which [`propagate`](crate::propagate()) goes on.

use cif_dataset::Frame;
use cif_geometry::PixelGrid;
use glam::{DVec2, DVec3};

use crate::Keyframe;
use crate::appearance::{Features, Forest, Samples};
use crate::picture::Picture;
use crate::plane::Plane;
use crate::propagate::{Classes, SURE, size_to_follow};

/// Side of the squares in which the nearest point hides those behind it, as a fraction of the larger side of the image.
const COVER: f64 = 1.0 / 48.0;

/// A point is hidden where another lies nearer by more than this fraction of its depth.
const BEHIND: f64 = 0.05;

/// Standard deviation of the reach of a seed, as a fraction of the larger side of the image.
const REACH: f32 = 1.0 / 64.0;

/// Keeps every class possible when evidence is multiplied.
const FLOOR: f32 = 0.02;

/// A view of which the mask is known, or is to be found.
pub struct View<'a> {
    /// Camera and lens.
    pub frame: &'a Frame,
    /// Image of the frame, with its lens distortion.
    pub image: &'a PixelGrid<[u8; 3]>,
}

/// Pixel position of a point of the world in the image of a frame, lens distortion included, and its depth; `None` behind
/// the camera or beyond the image.
fn pixel_of(frame: &Frame, point: DVec3) -> Option<(DVec2, f64)> {
    let camera = &frame.camera;
    let seen = camera.camera_from_world.apply(point);
    if seen.z <= 0.0 {
        return None;
    }
    let captured = frame.lens.distort(DVec2::new(seen.x, seen.y) / seen.z);
    let pixel =
        camera.focal_px * captured + DVec2::new(frame.lens.skew_px * captured.y, 0.0) + camera.principal_px;
    let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let inside = pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all();
    inside.then_some((pixel, seen.z))
}

/// Pixels of the points that a frame shows; `None` for those that are outside it or behind others.
fn seen(frame: &Frame, points: &[DVec3]) -> Vec<Option<DVec2>> {
    let side = (COVER * f64::from(frame.camera.width.max(frame.camera.height))).max(1.0);
    let columns = (f64::from(frame.camera.width) / side) as usize + 1;
    let rows = (f64::from(frame.camera.height) / side) as usize + 1;
    let square = |pixel: DVec2| (pixel.y / side) as usize * columns + (pixel.x / side) as usize;
    let projected: Vec<Option<(DVec2, f64)>> = points.iter().map(|point| pixel_of(frame, *point)).collect();
    let mut nearest = vec![f64::INFINITY; columns * rows];
    for (pixel, depth) in projected.iter().flatten() {
        let at = square(*pixel);
        nearest[at] = nearest[at].min(*depth);
    }
    let visible =
        |(pixel, depth): (DVec2, f64)| (depth <= nearest[square(pixel)] * (1.0 + BEHIND)).then_some(pixel);
    projected.into_iter().map(|found| found.and_then(visible)).collect()
}

/// The mask of a view from views of the same moment whose masks are known. `points` are world positions, metres, at that
/// moment.
///
/// `None` where no point is seen both by a known view and by the requested one.
///
/// # Panics
/// When masks and images of known views differ in size.
#[must_use]
pub fn carry(known: &[(View<'_>, &Keyframe)], requested: &View<'_>, points: &[DVec3]) -> Option<Keyframe> {
    let classes = Classes::new(known.iter().map(|(_, keyframe)| &keyframe.ids));
    let count = classes.ids.len();
    let mut votes = vec![0_u32; points.len() * count];
    let mut samples = Samples::default();
    for (view, keyframe) in known {
        let ids = &keyframe.ids;
        assert_eq!((ids.width, ids.height), (view.image.width, view.image.height), "a mask of another size");
        let sure = |at: usize| keyframe.confidence.as_ref().is_none_or(|grid| grid.pixels[at] >= SURE);
        for (point, pixel) in seen(view.frame, points).iter().enumerate() {
            let Some(pixel) = pixel else { continue };
            let at = pixel.y as usize * ids.width as usize + pixel.x as usize;
            if sure(at) {
                votes[point * count + usize::from(classes.class_of(ids.pixels[at]))] += 1;
            }
        }
        let (width, height) = size_to_follow(ids.width as usize, ids.height as usize);
        let features = Features::new(&Picture::new(view.image, width, height));
        samples.extend(&Samples::new(&features, count, |pixel| {
            let (x, y) = (pixel % width, pixel / width);
            let from = |k: usize, target: usize, source: u32| (2 * k + 1) * source as usize / (2 * target);
            let at = from(y, height, ids.height) * ids.width as usize + from(x, width, ids.width);
            sure(at).then(|| classes.class_of(ids.pixels[at]))
        }));
    }
    let (full_width, full_height) = (requested.image.width as usize, requested.image.height as usize);
    let (width, height) = size_to_follow(full_width, full_height);
    let mut seeds = vec![Plane::filled(width, height, 0.0); count];
    let mut any = false;
    for (pixel, votes) in seen(requested.frame, points).iter().zip(votes.chunks_exact(count)) {
        let total: u32 = votes.iter().sum();
        let (Some(pixel), true) = (pixel, total > 0) else { continue };
        let x = pixel.x as usize * width / full_width;
        let y = pixel.y as usize * height / full_height;
        for (plane, votes) in seeds.iter_mut().zip(votes) {
            plane.data[y * width + x] += *votes as f32 / total as f32;
        }
        any = true;
    }
    if !any {
        return None;
    }
    let sigma = (REACH * width.max(height) as f32).max(1.0);
    let spread: Vec<Plane> = seeds.iter().map(|plane| plane.blurred(sigma)).collect();
    let features = Features::new(&Picture::new(requested.image, width, height));
    let looks = Forest::new(&samples, count).classify(&features);
    // The blurred value of a single seed a standard deviation away.
    let one = (-0.5_f32).exp() / (std::f32::consts::TAU * sigma * sigma);
    let pixels = (0..width * height).map(|pixel| {
        let near: f32 = spread.iter().map(|plane| plane.data[pixel]).sum();
        let (mut best, mut most, mut sum) = (0, 0.0, 0.0);
        for class in 0..count {
            let share = spread[class].data[pixel] / near.max(f32::MIN_POSITIVE);
            let look = f32::from(looks[pixel * count + class]) / 255.0;
            let belief = ((share + FLOOR) * (look + FLOOR)).sqrt();
            sum += belief;
            if belief > most {
                (best, most) = (class, belief);
            }
        }
        (classes.ids[best], most / sum * near / (near + one))
    });
    let (ids, confidence): (Vec<u16>, Vec<f32>) = pixels.unzip();
    let (width, height) = (width as u32, height as u32);
    Some(Keyframe {
        ids: PixelGrid::from_pixels(width, height, ids),
        confidence: Some(PixelGrid::from_pixels(width, height, confidence)),
    })
}
