//! The field that a run starts from. Source: methods reference 1.1.

use cif_dataset::{Dataset, Split};
use cif_field::parameters::{Rows, TABLE};
use cif_field::{Deformation, DeformationConfig, Field, Gaussians, Instance, RecordedCamera, Timeline};
use cif_geometry::scalar::logit;
use cif_system::memory::Need;
use glam::DVec3;

use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::random::{Purpose, derive};

/// Frames per second where the capture does not say.
const DEFAULT_FRAMES_PER_SECOND: f64 = 24.0;

/// Largest angle that a fresh Gaussian far outside the scene is seen under by the nearest camera, standard
/// deviation, radians: some pixels of a small image.
const OUTLIER_ANGLE: f64 = 0.03;

/// Fewest and most time nodes chosen automatically, and the fewest where the times are enough for them.
const TIME_NODES: (usize, usize) = (8, 150);
const TYPICAL_TIME_NODES: usize = 25;

/// Training images for each time node. Times use the upper half of the nodes, so that twelve images lie between two: with
/// fewer, every image moves the Gaussians as it alone likes.
const IMAGES_PER_TIME_NODE: usize = 6;

/// Field without deformation, from the capture's points.
pub(super) fn initial_field(dataset: &Dataset, config: &TrainConfig) -> Result<Field, TrainError> {
    let (positions, colors) = initial_points(dataset, config);
    if positions.is_empty() {
        return Err(TrainError::NoPoints { root: dataset.root.clone() });
    }
    if dataset.times.len() > 1 && config.effects.motion && config.stages.fine > 0 {
        // The fine stage will make it: settings that cannot work are refused before the first step.
        deformation_shape(dataset, config)?;
    }
    let mut gaussians = Gaussians::from_points(&positions, &colors)?;
    shrink_outliers(&mut gaussians, dataset);
    gaussians.opacity_logits.fill(logit(config.model.initial_opacity));
    gaussians.occupancy_logits.fill(logit(config.instance.occupancy));
    let camera = |frame: &cif_dataset::Frame| RecordedCamera {
        name: frame.camera_name.clone(),
        time_index: frame.time_index,
        trained: frame.split == Split::Train,
        camera: frame.camera,
    };
    Ok(Field {
        gaussians,
        deformation: None,
        tracks: None,
        identities: None,
        instances: instances(dataset),
        timeline: Timeline {
            times: dataset.times.clone(),
            frames_per_second: dataset.frames_per_second.unwrap_or(DEFAULT_FRAMES_PER_SECOND),
        },
        cameras: dataset.frames.iter().map(camera).collect(),
        sh_degree: 0,
        background: config.laid_over(),
        sort_metric: config.sort_metric,
        extent: dataset.extent() as f32,
        record: Default::default(),
    })
}

/// Bounds the fresh scales of Gaussians outside the box that holds the scene. What lies that far has neighbours
/// as far again, so that each would fill every image, and what densification may add.
fn shrink_outliers(gaussians: &mut Gaussians, dataset: &Dataset) {
    let core = dataset.points.core_bounds();
    let centres: Vec<DVec3> =
        dataset.train_frames().into_iter().map(|index| dataset.frames[index].camera.centre()).collect();
    for (mean, log_scale) in gaussians.means.iter().zip(&mut gaussians.log_scales) {
        let mean = DVec3::from(mean.map(f64::from));
        let is_inside = mean.cmpge(core.low).all() && mean.cmple(core.high).all();
        let distance = centres.iter().map(|centre| centre.distance(mean)).fold(f64::INFINITY, f64::min);
        if !is_inside && distance.is_finite() {
            let largest = (OUTLIER_ANGLE * distance).ln() as f32;
            *log_scale = log_scale.map(|s| s.min(largest));
        }
    }
}

/// The table of instances of a capture.
pub(super) fn instances(dataset: &Dataset) -> Vec<Instance> {
    let instance = |label: &cif_dataset::InstanceLabel| Instance {
        id: label.id,
        label: label.label.clone(),
        category: label.category.clone(),
        taxonomies: label.taxonomies.clone(),
    };
    dataset.instances.iter().map(instance).collect()
}

/// A fresh deformation in the box of the initial points.
pub(super) fn initial_deformation(
    dataset: &Dataset,
    config: &TrainConfig,
) -> Result<Deformation, TrainError> {
    let shape = deformation_shape(dataset, config)?;
    // Outliers are moved as the nearest face of the box is; a box around them would leave the planes no resolution.
    let bounds = dataset.points.thinned(config.model.max_initial_points as usize).core_bounds();
    let seed = derive(config.seed, Purpose::Deformation, 0);
    Ok(Deformation::new(shape, bounds, dataset.extent(), seed, config.model.zero_initial_heads)?)
}

/// The shape of a deformation by the settings.
///
/// # Errors
/// When there is no such deformation, or memory cannot hold it in training.
pub(crate) fn deformation_shape(
    dataset: &Dataset,
    config: &TrainConfig,
) -> Result<DeformationConfig, TrainError> {
    let model = &config.model;
    let time_resolution = match model.time_resolution {
        0 => automatic_time_nodes(dataset.times.len(), dataset.train_frames().len()),
        nodes => nodes,
    };
    let shape = DeformationConfig {
        spatial_resolution: model.spatial_resolution,
        time_resolution,
        multipliers: model.multipliers.clone(),
        channels: model.channels,
        width: model.width,
        heads: model.heads,
        time_encoding: model.time_encoding,
    };
    shape.validate()?;
    memory_of_planes(&shape).check()?;
    Ok(shape)
}

/// Copies of parameters in training: values, gradients and two moments.
const COPIES: u64 = 4;

/// Memory that so many Gaussians take in training.
pub(crate) fn memory_of_gaussians(count: u32) -> Need {
    let of_gaussians = TABLE.iter().filter(|parameter| parameter.rows == Rows::Gaussians);
    let floats: u64 = of_gaussians.map(|parameter| parameter.width() as u64).sum();
    Need {
        bytes: 4 * COPIES * floats * u64::from(count),
        arithmetic: format!(
            "{count} Gaussians x {floats} floats x {COPIES} copies (values, gradients, two moments) x 4 bytes"
        ),
    }
}

/// Memory that the planes of a deformation take in training.
pub(crate) fn memory_of_planes(shape: &DeformationConfig) -> Need {
    let floats = shape.plane_layout().1 as u64;
    let [x, y, z] = shape.spatial_resolution;
    Need {
        bytes: 4 * COPIES * floats,
        arithmetic: format!(
            "{floats} floats of planes of {x} x {y} x {z} nodes and {} in time, multiplied by {:?}, with {} channels, x \
             {COPIES} copies (values, gradients, two moments) x 4 bytes",
            shape.time_resolution, shape.multipliers, shape.channels
        ),
    }
}

/// Nodes of the time planes where the settings leave them to the capture: as many as its training images distinguish, and
/// no more than two for each of its times, one of which is used.
pub(crate) fn automatic_time_nodes(times: usize, images: usize) -> u32 {
    let distinguished = (images / IMAGES_PER_TIME_NODE).max(TYPICAL_TIME_NODES);
    distinguished.min(2 * times).clamp(TIME_NODES.0, TIME_NODES.1) as u32
}

/// Points of the capture with colours in [0, 1], thinned to the requested number.
fn initial_points(dataset: &Dataset, config: &TrainConfig) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let points = dataset.points.thinned(config.model.max_initial_points as usize);
    let colors = points.colors.iter().map(|color| color.map(|c| f32::from(c) / 255.0)).collect();
    (points.positions, colors)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_gaussians_counts_their_copies() {
        let need = memory_of_gaussians(1_000);
        // Centre, scales, rotation, opacity, occupancy, 16 coefficients of three colours.
        assert_eq!(need.bytes, 1_000 * (3 + 3 + 4 + 1 + 1 + 48) * 4 * 4);
        assert!(need.arithmetic.starts_with("1000 Gaussians x 60 floats x 4 copies"), "{need:?}");
    }

    #[test]
    fn memory_of_planes_counts_their_copies() {
        let shape = DeformationConfig {
            spatial_resolution: [1024; 3],
            time_resolution: 8,
            multipliers: vec![1, 2],
            channels: 128,
            width: 64,
            heads: TrainConfig::default().model.heads,
            time_encoding: Default::default(),
        };
        // Three planes in space at 1024 and 2048 nodes, and their three in time, of which 5 rows are stored.
        let floats = 128 * 3 * (1024 * 1024 + 2048 * 2048 + (1024 + 2048) * 5);
        let need = memory_of_planes(&shape);
        assert_eq!(need.bytes, 16 * floats);
        assert!(
            need.arithmetic.contains(&format!("{floats} floats of planes of 1024 x 1024 x 1024 nodes")),
            "{need:?}"
        );
    }

    #[test]
    fn time_nodes_are_as_many_as_images_tell_apart() {
        // One camera, whose images are of a time each: one that jumps, a walk, a short walk.
        assert_eq!(automatic_time_nodes(150, 150), 25);
        assert_eq!(automatic_time_nodes(600, 600), 100);
        assert_eq!(automatic_time_nodes(10, 10), 20);
        assert_eq!(automatic_time_nodes(2, 2), 8);
        // Rigs of 27 cameras and of 4, and a long one.
        assert_eq!(automatic_time_nodes(24, 648), 48);
        assert_eq!(automatic_time_nodes(60, 240), 40);
        assert_eq!(automatic_time_nodes(300, 6_000), 150);
    }
}
