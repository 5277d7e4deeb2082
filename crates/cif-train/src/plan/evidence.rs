//! Evidence for effects in a capture, collected before anything is trained.

use std::collections::BTreeMap;

use cif_dataset::{Dataset, Frame, Split};
use glam::DVec3;
use rayon::prelude::*;

use crate::config::MotionConfig;
use crate::error::TrainError;
use crate::exposure::{Recorded, known_points};
use crate::mask_table::MaskTable;
use crate::phase::Phase;
use crate::phases::Phases;
use crate::sightings::Sightings;
use crate::switches::{Seen, corrections};
use crate::tracks::{Observation, misfits, travels};
use crate::working_size;

/// Masks that are looked at, spread evenly over the training frames.
const MASKS: usize = 64;

/// Images of one fixed camera that are compared, spread evenly over its time.
const IMAGES: usize = 6;

/// Fixed cameras whose images are compared.
const CAMERAS: usize = 4;

/// Difference of a channel from which a pixel counts as changed; above the noise of cameras and codecs.
const CHANGE: u8 = 24;

/// Initial points that distances are measured with.
const POINTS: usize = 500;

/// Cameras whose brightness is compared, and images of each, and of a camera that is the only one.
const EXPOSED_CAMERAS: usize = 24;
const EXPOSED_IMAGES: usize = 3;
const EXPOSED_IMAGES_OF_ONE: usize = 24;

/// Evidence found in a capture.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Evidence {
    /// Distinct times.
    pub times: usize,
    /// Training frames.
    pub frames: usize,
    /// Cameras with several training frames that stay where they are, and those that do not.
    pub fixed_cameras: usize,
    pub moving_cameras: usize,
    /// Largest share of pixels that change in a fixed camera; `None` without fixed cameras.
    pub change: Option<f64>,
    /// Training frames with masks.
    pub masked: usize,
    /// Instances, and the labels of those that travel.
    pub instances: usize,
    pub travelling: Vec<String>,
    /// Labels of the instances that appear or vanish inside the view, by their masks.
    pub appearing: Vec<String>,
    /// How bright training cameras record the same points; `None` where no points have colours.
    pub exposures: Option<Exposures>,
    /// Largest over smallest number of pixels per metre at the points that frames see, by frame.
    pub footprint_ratio: f64,
    /// Largest angle between directions from which training cameras see the middle of the points, degrees.
    pub view_angle: f64,
    /// Places that training frames were taken from: of a camera that stays where it is one, of others all of their frames.
    pub places: usize,
    /// Size of the largest training image, pixels.
    pub image_size: [u32; 2],
    /// Training frames whose lens is removed.
    pub lenses: usize,
    /// True when images carry alpha.
    pub has_alpha: bool,
}

/// How bright training cameras record the same points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Exposures {
    /// Cameras that were compared.
    pub cameras: usize,
    /// Largest factor between two of them, by channel.
    pub between_cameras: f64,
    /// The same between two times of one camera; `None` where no camera has several.
    pub in_time: Option<f64>,
}

impl Evidence {
    pub(super) fn of(dataset: &Dataset, phases: &Phases) -> Result<Self, TrainError> {
        let training: Vec<(usize, &Frame)> =
            dataset.frames.iter().enumerate().filter(|(_, frame)| frame.split == Split::Train).collect();
        let mut cameras: BTreeMap<&str, Vec<(usize, &Frame)>> = BTreeMap::new();
        for (index, frame) in &training {
            cameras.entry(&frame.camera_name).or_default().push((*index, frame));
        }
        let several = || cameras.values().filter(|frames| frames.len() > 1);
        let is_fixed = |frames: &&Vec<(usize, &Frame)>| {
            let first = frames[0].1.camera.camera_from_world;
            frames.iter().all(|(_, frame)| frame.camera.camera_from_world == first)
        };
        let fixed: Vec<&Vec<(usize, &Frame)>> = several().filter(is_fixed).collect();
        let moving_cameras = several().count() - fixed.len();
        let places = training.len() - fixed.iter().map(|frames| frames.len() - 1).sum::<usize>();
        let is_compared = dataset.times.len() > 1 && moving_cameras == 0 && !fixed.is_empty();
        let masked: Vec<(usize, &Frame)> =
            training.iter().filter(|(_, frame)| frame.mask.is_some()).copied().collect();
        let looked = if dataset.times.len() > 1 { masked.len().min(MASKS) } else { 0 };
        let _phase = phases.enter(Phase::Plan, looked);
        let change = if is_compared { Some(largest_change(dataset, &fixed, phases)?) } else { None };
        let shown = observations(dataset, &masked, phases)?;
        Ok(Self {
            times: dataset.times.len(),
            frames: training.len(),
            fixed_cameras: fixed.len(),
            moving_cameras,
            change,
            masked: masked.len(),
            instances: dataset.instances.len(),
            travelling: labels(dataset, |id| travels(&shown.of(id))),
            appearing: labels(dataset, |id| shown.appears(id) || shown.vanishes(id)),
            exposures: exposures(dataset, &cameras, phases)?,
            footprint_ratio: footprint_ratio(dataset, &training),
            view_angle: view_angle(dataset, &training),
            places,
            image_size: working_size::captured(dataset),
            lenses: training.iter().filter(|(_, frame)| !frame.lens.is_identity()).count(),
            has_alpha: dataset.has_alpha,
        })
    }
}

/// Evenly spread entries, the first and the last among them.
fn spread<T: Copy>(all: &[T], count: usize) -> Vec<T> {
    if all.len() <= count {
        return all.to_vec();
    }
    (0..count).map(|k| all[k * (all.len() - 1) / (count - 1)]).collect()
}

/// Largest share of pixels that differ between the first and a later image of a fixed camera.
fn largest_change(
    dataset: &Dataset,
    cameras: &[&Vec<(usize, &Frame)>],
    phases: &Phases,
) -> Result<f64, TrainError> {
    let mut largest = 0.0_f64;
    for frames in spread(cameras, CAMERAS) {
        let mut first: Option<cif_geometry::PixelGrid<[u8; 3]>> = None;
        for (index, _) in spread(frames, IMAGES) {
            phases.check()?;
            let image = dataset.load_image(index, [1.0; 3])?;
            let Some(first) = &first else {
                first = Some(image);
                continue;
            };
            let changed = first
                .pixels
                .iter()
                .zip(&image.pixels)
                .filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) >= CHANGE))
                .count();
            largest = largest.max(changed as f64 / image.pixels.len().max(1) as f64);
        }
    }
    Ok(largest)
}

/// Where masks show instances, in a sample of the frames; nothing for a single time.
fn observations<'a>(
    dataset: &Dataset,
    masked: &[(usize, &'a Frame)],
    phases: &Phases,
) -> Result<Sightings<'a>, TrainError> {
    let mut found = Sightings::default();
    if dataset.times.len() < 2 {
        return Ok(found);
    }
    let mut masked = masked.to_vec();
    masked.sort_by_key(|(_, frame)| frame.time_index);
    let load = |(index, frame): (usize, &'a Frame)| {
        phases.check()?;
        let Some(mask) = dataset.load_mask(index)? else { return Ok(None) };
        let image = dataset.load_image(index, [1.0; 3])?;
        let seen = Seen::of(&image, Some(&mask), &frame.camera_name, frame.time_index);
        phases.advance();
        Ok(Some((frame, mask, seen)))
    };
    let loaded: Vec<_> =
        spread(&masked, MASKS).into_par_iter().map(load).collect::<Result<_, TrainError>>()?;
    let (mut frames, mut masks, mut seen) = (Vec::new(), Vec::new(), Vec::new());
    for (frame, mask, of) in loaded.into_iter().flatten() {
        frames.push(frame);
        masks.push(mask);
        seen.push(of);
    }
    // As training puts them right.
    let seen = masks.iter().zip(corrections(&seen)).map(|(mask, correction)| correction.applied(mask));
    let mut seen: Vec<BTreeMap<u16, Observation>> = seen
        .zip(&frames)
        .map(|(mask, frame)| MaskTable::of(&mask).observations(&frame.camera, frame.time_index))
        .collect();
    // A wrong camera shows everything somewhere else, as if it travelled.
    for wrong in misfits(&seen, f64::from(MotionConfig::default().misfit)).into_iter().rev() {
        frames.remove(wrong);
        seen.remove(wrong);
    }
    for (frame, seen) in frames.into_iter().zip(seen) {
        found.add(&frame.camera_name, frame.time_index, seen);
    }
    Ok(found)
}

/// Labels of the instances of which something is true, by their ids.
fn labels(dataset: &Dataset, holds: impl Fn(u16) -> bool) -> Vec<String> {
    let instances = dataset.instances.iter().filter(|instance| holds(instance.id));
    instances.map(|instance| instance.label.clone()).collect()
}

/// Compared training cameras, and how bright they record the same points.
fn exposures(
    dataset: &Dataset,
    cameras: &BTreeMap<&str, Vec<(usize, &Frame)>>,
    phases: &Phases,
) -> Result<Option<Exposures>, TrainError> {
    let points = known_points(dataset);
    if points.is_empty() {
        return Ok(None);
    }
    let (mut of_cameras, mut drift) = (Vec::new(), None::<f64>);
    for frames in spread(&cameras.values().collect::<Vec<_>>(), EXPOSED_CAMERAS) {
        let most = if cameras.len() > 1 { EXPOSED_IMAGES } else { EXPOSED_IMAGES_OF_ONE };
        let mut recorded = Recorded::of(&points);
        for (index, frame) in spread(frames, most) {
            phases.check()?;
            recorded.add(&dataset.load_image(index, [1.0; 3])?, &frame.camera);
        }
        of_cameras.extend(recorded.relative_to_colors());
        // Photographs of one moment have exposures of their own too, but nothing shows those of others.
        let mut times: Vec<usize> = frames.iter().map(|(_, frame)| frame.time_index).collect();
        times.sort_unstable();
        times.dedup();
        let gains: Vec<[f64; 3]> = recorded.gains().into_iter().flatten().collect();
        if times.len() == frames.len() && gains.len() > 1 {
            drift = Some(drift.unwrap_or(0.0).max(widest(&gains)));
        }
    }
    let cameras = of_cameras.len();
    Ok((cameras > 0).then(|| Exposures { cameras, between_cameras: widest(&of_cameras), in_time: drift }))
}

/// Largest factor between two of several logarithms of brightness, by channel.
fn widest(medians: &[[f64; 3]]) -> f64 {
    let range = |channel: usize| {
        let of = || medians.iter().map(|medians| medians[channel]);
        of().fold(f64::NEG_INFINITY, f64::max) - of().fold(f64::INFINITY, f64::min)
    };
    (0..3).map(range).fold(0.0, f64::max).exp()
}

/// Largest over smallest median of pixels per metre at what a frame sees; 1 with nothing to compare.
fn footprint_ratio(dataset: &Dataset, training: &[(usize, &Frame)]) -> f64 {
    let points: Vec<[f32; 3]> = spread(&dataset.points.positions, POINTS);
    let (mut low, mut high) = (f64::INFINITY, 0.0_f64);
    for (_, frame) in training {
        let camera = &frame.camera;
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let mut densities: Vec<f64> = points
            .iter()
            .filter_map(|point| camera.project(DVec3::from(point.map(f64::from))))
            .filter(|(pixel, _)| pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width && pixel.y < height)
            .map(|(_, depth)| camera.focal_px.x / depth)
            .collect();
        // A frame that sees next to nothing of the points says nothing.
        if densities.len() < 10 {
            continue;
        }
        densities.sort_by(f64::total_cmp);
        let median = densities[densities.len() / 2];
        (low, high) = (low.min(median), high.max(median));
    }
    if high > 0.0 { high / low } else { 1.0 }
}

/// Largest angle between the directions from which training cameras see the middle of the points, degrees.
fn view_angle(dataset: &Dataset, training: &[(usize, &Frame)]) -> f64 {
    let points = &dataset.points.positions;
    let middle =
        points.iter().map(|p| DVec3::from(p.map(f64::from))).sum::<DVec3>() / points.len().max(1) as f64;
    let directions: Vec<DVec3> = spread(training, POINTS)
        .iter()
        .filter_map(|(_, frame)| (frame.camera.centre() - middle).try_normalize())
        .collect();
    let mut smallest = 1.0_f64;
    for (k, a) in directions.iter().enumerate() {
        for b in &directions[..k] {
            smallest = smallest.min(a.dot(*b));
        }
    }
    smallest.clamp(-1.0, 1.0).acos().to_degrees()
}
