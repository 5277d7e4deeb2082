//! What a capture shows before anything is trained.

use std::collections::BTreeMap;

use cif_dataset::{Dataset, Frame, Split};
use glam::DVec3;

use crate::config::MotionConfig;
use crate::error::TrainError;
use crate::tracks::{Observation, misfits, observe, travels};

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

/// What was found.
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
    /// Largest over smallest number of pixels per metre at the points that frames see, by frame.
    pub footprint_ratio: f64,
    /// Largest angle between directions from which training cameras see the middle of the points, degrees.
    pub view_angle: f64,
    /// Training frames whose lens is removed.
    pub lenses: usize,
    /// Whether images carry alpha.
    pub has_alpha: bool,
}

impl Evidence {
    pub(super) fn of(dataset: &Dataset) -> Result<Self, TrainError> {
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
        let change = if dataset.times.len() > 1 && moving_cameras == 0 && !fixed.is_empty() {
            Some(largest_change(dataset, &fixed)?)
        } else {
            None
        };
        let masked: Vec<(usize, &Frame)> =
            training.iter().filter(|(_, frame)| frame.mask.is_some()).copied().collect();
        Ok(Self {
            times: dataset.times.len(),
            frames: training.len(),
            fixed_cameras: fixed.len(),
            moving_cameras,
            change,
            masked: masked.len(),
            instances: dataset.instances.len(),
            travelling: if dataset.times.len() > 1 { travelling(dataset, &masked)? } else { Vec::new() },
            footprint_ratio: footprint_ratio(dataset, &training),
            view_angle: view_angle(dataset, &training),
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
fn largest_change(dataset: &Dataset, cameras: &[&Vec<(usize, &Frame)>]) -> Result<f64, TrainError> {
    let mut largest = 0.0_f64;
    for frames in spread(cameras, CAMERAS) {
        let mut first: Option<cif_geometry::PixelGrid<[u8; 3]>> = None;
        for (index, _) in spread(frames, IMAGES) {
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

/// Labels of the instances that travel, by the centres of their masks.
fn travelling(dataset: &Dataset, masked: &[(usize, &Frame)]) -> Result<Vec<String>, TrainError> {
    let mut frames = Vec::new();
    for (index, frame) in spread(masked, MASKS) {
        let Some(mask) = dataset.load_mask(index)? else { continue };
        frames.push(observe(&mask, &frame.camera, frame.time_index));
    }
    // A wrong camera shows everything somewhere else, as if it travelled.
    for frame in misfits(&frames, f64::from(MotionConfig::default().misfit)).into_iter().rev() {
        frames.remove(frame);
    }
    let mut seen: BTreeMap<u16, Vec<Observation>> = BTreeMap::new();
    for (id, observation) in frames.into_iter().flatten() {
        seen.entry(id).or_default().push(observation);
    }
    Ok(dataset
        .instances
        .iter()
        .filter(|instance| seen.get(&instance.id).is_some_and(|observations| travels(observations)))
        .map(|instance| instance.label.clone())
        .collect())
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
