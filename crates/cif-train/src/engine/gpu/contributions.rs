//! Contributions of Gaussians to a training view, from what lies on the device: nothing but the picture and two numbers of
//! every Gaussian is fetched.

use cif_geometry::PixelGrid;
use cif_render::wgpu::{Commands, GpuVec, ViewInput};
use cif_render::{BlendRequest, Blending};

use super::gpu_engine::GpuEngine;
use crate::density::contributions::ones_and_errors;
use crate::error::TrainError;
use crate::state::State;

/// Numbers of every Gaussian: weight and error.
const CHANNELS: usize = 2;

impl GpuEngine {
    /// See [`crate::engine::Engine::sums_of_view`].
    pub(super) fn contributions_to(&mut self, state: &State, view: usize) -> Result<Vec<f32>, TrainError> {
        self.send(state)?;
        let Self { gpu, rasterizer, resident, .. } = self;
        let Some(resident) = resident else { return Ok(vec![0.0; CHANNELS * state.field.len()]) };
        let data = state.frames.get(&state.dataset, view)?;
        let index = state.frames.index(view);
        let (frame, settings) = (&state.dataset.frames[index], state.color_settings());
        let input = ViewInput { camera: &frame.camera, settings: &settings, labels: None };
        let mut commands = Commands::new(gpu, None);
        let posed = resident.pose(gpu, &mut commands, frame.time);
        rasterizer.project(gpu, &mut commands, posed, None, &input)?;
        rasterizer.measure(gpu, commands)?;
        let mut commands = Commands::new(gpu, None);
        rasterizer.rasterize(gpu, &mut commands, None, None)?;
        commands.submit();
        let pixels = rasterizer.colors().read(gpu)?.into_iter().map(|[r, g, b, _]| [r, g, b]);
        let (width, height) = (frame.camera.width, frame.camera.height);
        let mut color = PixelGrid { width, height, pixels: pixels.collect() };
        state.record_color(index, &mut color);
        let cotangents = GpuVec::from_slice(gpu, "ones and errors", &ones_and_errors(&color, &data.image))?;
        // Any values do: their gradients are sums of the weights.
        let numbers = CHANNELS * resident.canonical.len();
        let values = GpuVec::zeros(gpu, "values of contributions", numbers)?;
        let sums = GpuVec::zeros(gpu, "contributions", numbers)?;
        let request = BlendRequest { values: &values, channels: CHANNELS, blending: Blending::Color };
        let mut commands = Commands::new(gpu, None);
        rasterizer.blend_backward(gpu, &mut commands, &request, &cotangents, &sums, None)?;
        commands.submit();
        let sums = sums.read(gpu)?;
        gpu.check()?;
        Ok(sums)
    }
}
