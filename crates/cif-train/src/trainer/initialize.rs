//! The field that a run starts from. Source: methods reference 1.1.

use std::collections::HashMap;

use cif_dataset::{Dataset, Split};
use cif_field::{Deformation, DeformationConfig, Field, Gaussians, Instance, RecordedCamera, Timeline};
use cif_geometry::Bounds;
use cif_geometry::scalar::logit;
use glam::DVec3;

use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::random::{Purpose, derive};

/// Frames per second where the capture does not say.
const DEFAULT_FRAMES_PER_SECOND: f64 = 24.0;

/// Fewest and most time nodes chosen automatically.
const TIME_NODES: (usize, usize) = (8, 150);

/// Field without deformation, from the capture's points.
pub(super) fn initial_field(dataset: &Dataset, config: &TrainConfig) -> Result<Field, TrainError> {
    let (positions, colors) = initial_points(dataset, config);
    if positions.is_empty() {
        return Err(TrainError::NoPoints { root: dataset.root.clone() });
    }
    let mut gaussians = Gaussians::from_points(&positions, &colors)?;
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
        background: config.background,
        sort_metric: config.sort_metric,
        extent: dataset.extent() as f32,
        provenance: serde_json::json!({}),
    })
}

/// The table of instances of a capture.
pub(super) fn instances(dataset: &Dataset) -> Vec<Instance> {
    let instance = |label: &cif_dataset::InstanceLabel| Instance {
        id: label.id,
        label: label.label.clone(),
        category: label.category.clone(),
    };
    dataset.instances.iter().map(instance).collect()
}

/// A fresh deformation in the box of the initial points.
pub(super) fn initial_deformation(
    dataset: &Dataset,
    config: &TrainConfig,
) -> Result<Deformation, TrainError> {
    let model = &config.model;
    let time_resolution = match model.time_resolution {
        0 => dataset.times.len().clamp(TIME_NODES.0, TIME_NODES.1) as u32,
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
    let (positions, _) = initial_points(dataset, config);
    let bounds = Bounds::around(positions.iter().map(|p| DVec3::from_array(p.map(f64::from))));
    let seed = derive(config.seed, Purpose::Deformation, 0);
    Ok(Deformation::new(shape, bounds, dataset.extent(), seed, model.zero_initial_heads)?)
}

/// Points of the capture with colours in [0, 1], thinned to the wanted number.
fn initial_points(dataset: &Dataset, config: &TrainConfig) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let colors: Vec<[f32; 3]> =
        dataset.points.colors.iter().map(|color| color.map(|c| f32::from(c) / 255.0)).collect();
    thin(&dataset.points.positions, &colors, config.model.max_initial_points as usize)
}

/// Means of the points in each voxel; voxels grow until at most `most` are left.
fn thin(positions: &[[f32; 3]], colors: &[[f32; 3]], most: usize) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    if positions.len() <= most {
        return (positions.to_vec(), colors.to_vec());
    }
    let bounds = Bounds::around(positions.iter().map(|p| DVec3::from_array(p.map(f64::from))));
    // Of N points on a surface, a voxel of 1 / sqrt(N) of the box holds about one; start well below.
    let mut voxel = (bounds.size().max_element() / (most as f64).sqrt() / 8.0).max(1e-9);
    loop {
        let mut slots = HashMap::<[i64; 3], usize>::new();
        let mut sums: Vec<([f64; 6], f64)> = Vec::new();
        for (position, color) in positions.iter().zip(colors) {
            let cell = position.map(|v| (f64::from(v) / voxel).floor() as i64);
            let slot = *slots.entry(cell).or_insert(sums.len());
            if slot == sums.len() {
                sums.push(([0.0; 6], 0.0));
            }
            for k in 0..3 {
                sums[slot].0[k] += f64::from(position[k]);
                sums[slot].0[3 + k] += f64::from(color[k]);
            }
            sums[slot].1 += 1.0;
        }
        if sums.len() <= most {
            let mean = |first: usize| {
                sums.iter()
                    .map(|(sum, count)| std::array::from_fn(|k| (sum[first + k] / count) as f32))
                    .collect()
            };
            return (mean(0), mean(3));
        }
        voxel *= 1.2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_the_shape_and_the_limit() {
        let positions: Vec<[f32; 3]> =
            (0..40_000).map(|k| [(k % 200) as f32 * 0.01, (k / 200) as f32 * 0.01, 1.0]).collect();
        let colors: Vec<[f32; 3]> = positions.iter().map(|p| [p[0] / 2.0, p[1] / 2.0, 0.5]).collect();
        let (thinned, thinned_colors) = thin(&positions, &colors, 5_000);
        assert!(thinned.len() <= 5_000 && thinned.len() > 2_000, "{}", thinned.len());
        for (position, color) in thinned.iter().zip(&thinned_colors) {
            assert!((position[0] / 2.0 - color[0]).abs() < 1e-4 && (position[2] - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn few_points_are_kept_as_they_are() {
        let positions = vec![[1.0, 2.0, 3.0]; 7];
        assert_eq!(thin(&positions, &[[0.5; 3]; 7], 7).0, positions);
        assert_eq!(thin(&positions, &[[0.5; 3]; 7], 6).0, [[1.0, 2.0, 3.0]]);
    }
}
