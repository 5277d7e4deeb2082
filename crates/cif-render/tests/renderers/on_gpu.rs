//! Views on a GPU, forward and backward, with everything that comes back.

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use cif_field::Deformation;
use cif_field::parameters::{
    LOG_CALIBRATIONS, LOG_SCALES, MEANS, MLP, OCCUPANCY_LOGITS, OPACITY_LOGITS, PLANES, Parameter,
    QUATERNIONS, SH_COEFFICIENTS,
};
use cif_render::synthetic::SyntheticScene;
use cif_render::wgpu::deform::{DeformedGaussians, fixed_sum};
use cif_render::wgpu::poses::pose;
use cif_render::wgpu::{
    Commands, DeformationGradients, DeviceIdentities, Gpu, GpuDeformation, GpuError, GpuGaussians, GpuPoses,
    GpuStatistics, GpuVec, LabelInput, Rasterizer, Splat, ViewInput, testing,
};
use cif_render::{PoseGradient, RenderSettings};
use glam::DVec3;

use crate::support::Cotangents;

/// The device and its kernels, compiled once; tests take turns, and each view meets the memory of the one before.
pub(crate) fn device() -> Option<MutexGuard<'static, (Gpu, Rasterizer)>> {
    static DEVICE: OnceLock<Option<Mutex<(Gpu, Rasterizer)>>> = OnceLock::new();
    let device = DEVICE.get_or_init(|| {
        let gpu = testing::gpu()?;
        let rasterizer = Rasterizer::new(&gpu).expect("the kernels compile");
        Some(Mutex::new((gpu, rasterizer)))
    });
    if device.is_none() {
        eprintln!("skipped: no GPU");
    }
    device.as_ref().map(|device| device.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Everything that comes back of a view.
pub(crate) struct Outcome {
    pub(crate) colors: Vec<[f32; 4]>,
    pub(crate) blended: Vec<[f32; 4]>,
    pub(crate) splats: Vec<Splat>,
    pub(crate) order: Vec<u32>,
    pub(crate) geometry: Vec<[f32; 12]>,
    pub(crate) sh: Vec<[f32; 48]>,
    pub(crate) screen: Vec<[f32; 4]>,
    pub(crate) calibrations: Vec<f32>,
    /// By the nodes of the planes and the weights of the network; empty without deformation.
    pub(crate) deformation: [Vec<f64>; 2],
    /// By the poses of groups, with the views that each was a key of; empty without groups.
    pub(crate) poses: Vec<(PoseGradient, u32)>,
    pub(crate) statistics: GpuStatistics,
    pub(crate) tile_ranges: Vec<[u32; 2]>,
    pub(crate) entries: Vec<[u32; 4]>,
}

/// Renders a view forward and backward; `edit` may change the splats before they are blended.
pub(crate) fn run(
    device: &mut (Gpu, Rasterizer),
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
    edit: impl FnOnce(&mut Vec<Splat>),
) -> Result<Outcome, GpuError> {
    let (gpu, rasterizer) = (&device.0, &mut device.1);
    let gaussians = GpuGaussians::upload(gpu, &scene.field.gaussians)?;
    let k = scene.field.instances.len();
    let identities = scene.field.identities.as_ref().filter(|_| settings.instances.is_some());
    let identities = identities.map(|rows| DeviceIdentities::from_identities(gpu, rows, k)).transpose()?;
    let label_map: Vec<u32> = scene.labels.pixels.iter().map(|label| u32::from(*label)).collect();
    let labelled_pixels = label_map.iter().filter(|label| **label != 0).count();
    let label_map = GpuVec::from_slice(gpu, "labels", &label_map)?;
    let labels = identities.is_some().then_some(LabelInput {
        labels: &label_map,
        labelled_pixels,
        weight: cotangents.instance_weight as f32,
    });
    let n = gaussians.len();
    let mut deformation = match scene.field.deformation.as_ref().filter(|_| settings.deform) {
        Some(deformation) => {
            let mut deformation = GpuDeformation::new(gpu, deformation)?;
            deformation.set_still(gpu, &scene.field.left_alone())?;
            let gradients = DeformationGradients::zeros(gpu, &deformation)?;
            Some((deformation, gradients))
        }
        None => None,
    };
    let groups = scene.field.tracks.as_ref().map(|tracks| GpuPoses::new(gpu, tracks)).transpose()?;
    let [posed, v_canonical] = [GpuGaussians::zeros(gpu, n)?, GpuGaussians::zeros(gpu, n)?];
    let faults = GpuVec::<u32>::zeros(gpu, "faults", 4)?;
    let input = ViewInput { camera: &scene.camera, settings, labels };
    let mut commands = Commands::new(gpu, None);
    let moving = deformation.as_ref().map(|(deformation, _)| deformation);
    let moved = pose(gpu, &mut commands, scene.time, moving, groups.as_ref(), &gaussians, &posed);
    rasterizer.project(gpu, &mut commands, moved, identities.as_ref(), &input)?;
    rasterizer.measure(gpu, commands)?;
    let mut splats = rasterizer.splats().read(gpu)?;
    edit(&mut splats);
    rasterizer.splats().write(gpu, 0, &splats);
    let v_colors: Vec<[f32; 4]> =
        cotangents.color.pixels.iter().map(|v| [v[0] as f32, v[1] as f32, v[2] as f32, f32::NAN]).collect();
    let v_colors = GpuVec::from_slice(gpu, "cotangents", &v_colors)?;
    let mut commands = Commands::new(gpu, None);
    rasterizer.rasterize(gpu, &mut commands, identities.as_ref(), labels)?;
    rasterizer.backward(gpu, &mut commands, moved, identities.as_ref(), labels, &v_colors)?;
    if let Some(groups) = &groups {
        groups.backward(gpu, &mut commands, &gaussians, rasterizer, &faults);
    }
    if let Some((deformation, gradients)) = &mut deformation {
        let v_posed = &rasterizer.gradients().gaussians;
        let both = DeformedGaussians { canonical: &gaussians, v_posed, v_canonical: &v_canonical };
        gradients.backward(gpu, &mut commands, deformation, scene.time, both, &faults);
    }
    let counts = rasterizer.read_statistics(gpu, &mut commands);
    commands.submit();
    let statistics = GpuStatistics::of(&counts.start().wait(gpu)?);
    assert_eq!(faults.read(gpu)?[0], 0, "faults of deformation and poses");
    let gradients = rasterizer.gradients();
    let v_geometry = if deformation.is_some() { &v_canonical } else { &gradients.gaussians };
    let deformation = match (&deformation, &scene.field.deformation) {
        (Some((_, gradients)), Some(Deformation { config, .. })) => {
            let mut planes: Vec<f64> = gradients.sums.read(gpu)?.into_iter().map(fixed_sum).collect();
            planes.truncate(config.plane_layout().1);
            let (parts, floats) = (gradients.parts.read(gpu)?, config.mlp_layout().len);
            let weight = |k| parts.iter().skip(k).step_by(floats).map(|part| f64::from(*part)).sum();
            [planes, (0..floats).map(weight).collect()]
        }
        _ => Default::default(),
    };
    let vector = |v: [f32; 4]| DVec3::from_slice(&v.map(f64::from));
    let by_poses = groups.map(|groups| groups.gradients.read(gpu)).transpose()?.unwrap_or_default();
    Ok(Outcome {
        poses: by_poses
            .iter()
            .map(|sum| {
                let gradient = PoseGradient { turn: vector(sum.turn), translation: vector(sum.translation) };
                (gradient, sum.turn[3] as u32)
            })
            .collect(),
        colors: rasterizer.colors().read(gpu)?,
        blended: rasterizer.blended().read(gpu)?,
        splats,
        order: rasterizer.depth_order().read(gpu)?,
        geometry: v_geometry.geometry.read(gpu)?,
        sh: gradients.gaussians.sh.read(gpu)?,
        screen: gradients.screen.read(gpu)?,
        calibrations: if labels.is_some() && labelled_pixels > 0 && cotangents.instance_weight != 0.0 {
            gradients.calibrations.read(gpu)?
        } else {
            vec![0.0; identities.map_or(0, |rows| rows.entries.len())]
        },
        deformation,
        statistics,
        tile_ranges: rasterizer.tile_ranges().read(gpu)?,
        entries: rasterizer.entries().read_range(gpu, 0, statistics.pairs as usize)?,
    })
}

impl Outcome {
    /// Gradient by scalar `index` of a parameter; 0 where nothing has moved it.
    pub(crate) fn gradient(&self, parameter: Parameter, index: usize) -> f64 {
        let [planes, network] = &self.deformation;
        f64::from(match parameter {
            MEANS => self.geometry[index / 3][index % 3],
            LOG_SCALES => self.geometry[index / 3][4 + index % 3],
            QUATERNIONS => self.geometry[index / 4][8 + index % 4],
            OPACITY_LOGITS => self.geometry[index][3],
            OCCUPANCY_LOGITS => self.geometry[index][7],
            SH_COEFFICIENTS => self.sh.as_flattened()[index],
            LOG_CALIBRATIONS => self.calibrations.get(index).copied().unwrap_or(0.0),
            PLANES => return planes.get(index).copied().unwrap_or(0.0),
            MLP => return network.get(index).copied().unwrap_or(0.0),
            _ => panic!("no gradient of {}", parameter.name),
        })
    }
}
