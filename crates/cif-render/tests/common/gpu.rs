//! Views on a GPU, forward and backward, with everything that comes back.
#![allow(dead_code, unreachable_pub, reason = "compiled into every test binary, which uses its own part")]

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use cif_render::RenderSettings;
use cif_render::reference::ParameterGroup;
use cif_render::synthetic::SyntheticScene;
use cif_render::wgpu::{
    Commands, DeviceIdentities, Gpu, GpuError, GpuGaussians, GpuStatistics, GpuVec, LabelInput, Rasterizer,
    Splat, ViewInput, testing,
};

use super::common::Cotangents;

/// The device and its kernels, compiled once; tests take turns, and each view meets the memory of the one before.
pub fn device() -> Option<MutexGuard<'static, (Gpu, Rasterizer)>> {
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
pub struct Outcome {
    pub colors: Vec<[f32; 4]>,
    pub blended: Vec<[f32; 4]>,
    pub splats: Vec<Splat>,
    pub order: Vec<u32>,
    pub posed: Vec<[f32; 12]>,
    pub sh: Vec<[f32; 48]>,
    pub screen: Vec<[f32; 4]>,
    pub calibrations: Vec<f32>,
    pub statistics: GpuStatistics,
    pub tile_ranges: Vec<[u32; 2]>,
    pub entries: Vec<[u32; 4]>,
}

/// Renders a view forward and backward; `edit` may change the splats before they are blended.
pub fn run(
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
    let input = ViewInput { camera: &scene.camera, settings, labels };
    let mut commands = Commands::new(gpu, None);
    rasterizer.project(gpu, &mut commands, (&gaussians).into(), identities.as_ref(), &input)?;
    rasterizer.measure(gpu, commands)?;
    let mut splats = rasterizer.splats().read(gpu)?;
    edit(&mut splats);
    rasterizer.splats().write(gpu, 0, &splats);
    let v_colors: Vec<[f32; 4]> =
        cotangents.color.pixels.iter().map(|v| [v[0] as f32, v[1] as f32, v[2] as f32, f32::NAN]).collect();
    let v_colors = GpuVec::from_slice(gpu, "cotangents", &v_colors)?;
    let mut commands = Commands::new(gpu, None);
    rasterizer.rasterize(gpu, &mut commands, identities.as_ref(), labels)?;
    rasterizer.backward(gpu, &mut commands, (&gaussians).into(), identities.as_ref(), labels, &v_colors)?;
    let counts = rasterizer.read_statistics(gpu, &mut commands);
    commands.submit();
    let statistics = GpuStatistics::of(&counts.start().wait(gpu)?);
    let gradients = rasterizer.gradients();
    Ok(Outcome {
        colors: rasterizer.colors().read(gpu)?,
        blended: rasterizer.blended().read(gpu)?,
        splats,
        order: rasterizer.depth_order().read(gpu)?,
        posed: gradients.gaussians.geometry.read(gpu)?,
        sh: gradients.gaussians.sh.read(gpu)?,
        screen: gradients.screen.read(gpu)?,
        calibrations: if labels.is_some() && labelled_pixels > 0 && cotangents.instance_weight != 0.0 {
            gradients.calibrations.read(gpu)?
        } else {
            vec![0.0; identities.map_or(0, |rows| rows.entries.len())]
        },
        statistics,
        tile_ranges: rasterizer.tile_ranges().read(gpu)?,
        entries: rasterizer.entries().read_range(gpu, 0, statistics.pairs as usize)?,
    })
}

/// Scalar `index` of a group of gradients.
pub fn gradient(outcome: &Outcome, group: ParameterGroup, index: usize) -> f64 {
    f64::from(match group {
        ParameterGroup::Means => outcome.posed[index / 3][index % 3],
        ParameterGroup::LogScales => outcome.posed[index / 3][4 + index % 3],
        ParameterGroup::Quaternions => outcome.posed[index / 4][8 + index % 4],
        ParameterGroup::OpacityLogits => outcome.posed[index][3],
        ParameterGroup::OccupancyLogits => outcome.posed[index][7],
        ParameterGroup::ShCoefficients => outcome.sh.as_flattened()[index],
        ParameterGroup::LogCalibrations => *outcome.calibrations.get(index).unwrap_or(&0.0),
        ParameterGroup::Planes | ParameterGroup::Mlp => unreachable!("posed Gaussians have no deformation"),
    })
}
