//! Pixels by which hypotheses about the motion of an object are judged: the inner pixels of its masks, in logarithms of
//! brightness and colour.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use super::super::view::ObjectView;

/// Added to colours before their logarithm is taken: the noise of dark pixels.
const DARK: f64 = 0.03;

/// Shares of red, green and blue in brightness (Rec. 601).
const LUMINANCE: DVec3 = DVec3::new(0.299, 0.587, 0.114);

/// Pixels of a mask from which those at its outline, which mix with what is behind, are left out.
const ERODED: usize = 150;

/// Median area of masks, pixels, beyond which images are reduced, and most pixels of all views together: more pixels cost
/// time and do not change verdicts.
const LARGE: f64 = 1600.0;
const MOST: usize = 60_000;

/// Views and times below which hypotheses cannot be compared.
const FEWEST_VIEWS: usize = 8;
const FEWEST_TIMES: usize = 6;

/// One pixel of an object.
pub(super) struct Pixel {
    /// Direction through it, in the world.
    pub(super) ray: DVec3,
    /// Logarithms of the brightness, of red to green and of blue to green.
    pub(super) value: DVec3,
}

/// The object in one image.
pub(super) struct Look<'a> {
    pub(super) view: &'a ObjectView,
    /// The same for all images of a camera that stays in place.
    pub(super) camera: u32,
    /// Width of a pixel at unit distance.
    pub(super) footprint: f64,
    pub(super) pixels: Vec<Pixel>,
}

/// All that the images show of an object.
pub(super) struct Evidence<'a> {
    pub(super) looks: Vec<Look<'a>>,
    /// True where several cameras that stay in place see it at each time.
    pub(super) is_rig: bool,
}

impl<'a> Evidence<'a> {
    /// Views of an object, in the order of times; `None` where they are too few.
    pub(super) fn of(views: impl Iterator<Item = &'a ObjectView>) -> Option<Self> {
        let views: Vec<&ObjectView> = views.collect();
        let mut areas: Vec<f64> = views.iter().map(|view| view.detail()).collect();
        let area = cif_geometry::stats::median(&mut areas)?;
        let level = [1.0, 4.0, 16.0].iter().position(|reduced| area / reduced <= LARGE).unwrap_or(2);
        let mut cameras = BTreeMap::new();
        let mut looks: Vec<Look<'_>> = Vec::with_capacity(views.len());
        for view in views {
            let count = cameras.len() as u32;
            let camera = *cameras.entry(view.camera_key).or_insert(count);
            let footprint = 1.0 / view.crops[level].camera.focal_px.x;
            looks.push(Look { view, camera, footprint, pixels: pixels(view, level) });
        }
        let mut times: Vec<usize> = looks.iter().map(|look| look.view.time_index).collect();
        times.dedup();
        if looks.len() < FEWEST_VIEWS || times.len() < FEWEST_TIMES {
            return None;
        }
        let is_rig = looks.len() > times.len() && cameras.len() < looks.len() / 2;
        if !is_rig {
            looks.iter_mut().for_each(|look| look.camera = 0);
        }
        let all: usize = looks.iter().map(|look| look.pixels.len()).sum();
        let step = all.div_ceil(MOST);
        if step > 1 {
            for look in &mut looks {
                let mut place = 0;
                look.pixels.retain(|_| {
                    place += 1;
                    (place - 1) % step == 0
                });
            }
        }
        Some(Self { looks, is_rig })
    }

    /// Number of pixels.
    pub(super) fn len(&self) -> usize {
        self.looks.iter().map(|look| look.pixels.len()).sum()
    }
}

fn pixels(view: &ObjectView, level: usize) -> Vec<Pixel> {
    let crop = &view.crops[level];
    let (width, height) = (crop.camera.width as usize, crop.camera.height as usize);
    let has = |x: usize, y: usize| crop.mask[y * width + x] > 0.5;
    let erodes = (0..width * height).filter(|k| has(k % width, k / width)).count() > ERODED;
    let is_inner = |x: usize, y: usize| {
        x > 0
            && y > 0
            && x + 1 < width
            && y + 1 < height
            && (y - 1..=y + 1).all(|y| (x - 1..=x + 1).all(|x| has(x, y)))
    };
    let places = (0..width * height).map(|k| (k % width, k / width));
    let inner = places.filter(|(x, y)| if erodes { is_inner(*x, *y) } else { has(*x, *y) });
    let pixel = |(x, y): (usize, usize)| {
        let color = DVec3::from(crop.colors[y * width + x].map(f64::from));
        let logs = DVec3::from((color + DARK).to_array().map(f64::ln));
        Pixel {
            ray: crop.camera.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)),
            value: DVec3::new(LUMINANCE.dot(logs), logs.x - logs.y, logs.z - logs.y),
        }
    };
    inner.map(pixel).collect()
}
