//! Views rendered on the device between steps.

use cif_field::Field;
use cif_render::RenderedImage;
use cif_render::wgpu::poses;
use cif_render::wgpu::{
    Commands, DeviceIdentities, Gpu, GpuDeformation, GpuError, GpuGaussians, GpuPoses, PosedInput, ViewInput,
};

use super::super::Views;
use super::gpu_engine::GpuEngine;
use super::resident::ResidentDeformation;
use crate::error::TrainError;
use crate::state::State;

impl GpuEngine {
    /// Draws views of the field, or of a `trial` in its stead.
    pub(super) fn draw_views(
        &mut self,
        state: &State,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        self.send(state)?;
        let Self { gpu, rasterizer, resident, stale, .. } = self;
        let Some(resident) = resident else { return Ok(()) };
        let stand_in = match trial {
            Some(trial) => {
                // What the network leaves alone is put right before the next step.
                stale.gaussians = true;
                Some(StandIn::new(gpu, trial, resident.deformation.as_mut())?)
            }
            None => None,
        };
        let field = trial.unwrap_or(&state.field);
        let identities = match &field.identities {
            Some(rows) if views.channels.instances => {
                Some(DeviceIdentities::from_identities(gpu, rows, field.instances.len())?)
            }
            _ => None,
        };
        let settings = cif_render::RenderSettings {
            instances: views.settings.instances.filter(|_| identities.is_some()),
            ..*views.settings
        };
        for index in views.frames {
            let frame = &views.dataset(state).frames[*index];
            let input = ViewInput { camera: &frame.camera, settings: &settings, labels: None };
            let mut commands = Commands::new(gpu, None);
            let posed = match &stand_in {
                Some(stand_in) => {
                    let of_field = resident.deformation.as_ref().map(|resident| &resident.parameters);
                    stand_in.pose(gpu, &mut commands, frame.time, of_field)
                }
                None => resident.pose(gpu, &mut commands, frame.time),
            };
            let drawn =
                rasterizer.draw(gpu, commands, posed, identities.as_ref(), &input, views.channels.depth)?;
            gpu.check()?;
            each(state.recorded(*index, drawn));
        }
        Ok(())
    }
}

/// Gaussians of a trial. The field's own planes and network move them where the trial has those, too.
struct StandIn {
    canonical: GpuGaussians,
    posed: GpuGaussians,
    deformation: Option<GpuDeformation>,
    moves: bool,
    groups: Option<GpuPoses>,
}

impl StandIn {
    fn new(gpu: &Gpu, trial: &Field, of_field: Option<&mut ResidentDeformation>) -> Result<Self, GpuError> {
        let n = trial.len();
        let mut posed = GpuGaussians::zeros(gpu, 0)?;
        let mut own = None;
        if trial.deformation.is_some() || trial.tracks.is_some() {
            posed.geometry.resize(gpu, n)?;
        }
        if let Some(deformation) = &trial.deformation {
            posed.sh.resize(gpu, if deformation.config.heads.sh { n } else { 0 })?;
            match of_field.filter(|resident| *resident.parameters.config() == deformation.config) {
                Some(resident) => resident.parameters.set_still(gpu, &trial.left_alone())?,
                None => {
                    own.insert(GpuDeformation::new(gpu, deformation)?).set_still(gpu, &trial.left_alone())?
                }
            }
        }
        Ok(Self {
            canonical: GpuGaussians::upload(gpu, &trial.gaussians)?,
            posed,
            deformation: own,
            moves: trial.deformation.is_some(),
            groups: trial.tracks.as_ref().map(|tracks| GpuPoses::new(gpu, tracks)).transpose()?,
        })
    }

    fn pose<'a>(
        &'a self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        of_field: Option<&GpuDeformation>,
    ) -> PosedInput<'a> {
        let deformation = self.deformation.as_ref().or(of_field).filter(|_| self.moves);
        poses::pose(gpu, commands, time, deformation, self.groups.as_ref(), &self.canonical, &self.posed)
    }
}
