//! The pass of a head that blends values of its own: blended and differentiated on the device, with its loss and its
//! optimiser on the host, which waits.

use std::sync::Arc;

use cif_render::wgpu::{Commands, DeviceIdentities, GpuVec, ViewInput};
use cif_render::{BlendRequest, BlendedImage};

use super::GpuEngine;
use crate::error::TrainError;
use crate::guard::{Fault, loss_fault};
use crate::heads::{HeadLoss, HeadTensors};
use crate::state::State;
use crate::step::StepPlan;

/// The pass of a head in a step.
pub(super) struct HeadPass {
    /// By view.
    pub(super) losses: Vec<HeadLoss>,
    /// Tensors before the step, where it is not taken after all.
    pub(super) before: HeadTensors,
}

impl GpuEngine {
    /// Trains the head of a step, where it blends values of its own; tells a fault that keeps the step from being
    /// taken.
    pub(super) fn head_pass(
        &mut self,
        state: &mut State,
        plan: &StepPlan,
    ) -> Result<Result<Option<HeadPass>, Fault>, TrainError> {
        let head = Arc::clone(&state.head);
        let Some(head) = plan.head(&head, &state.config) else { return Ok(Ok(None)) };
        let before = state.head_tensors.clone();
        let weight = plan.head_weight(&state.config);
        let mut losses = Vec::with_capacity(plan.views.len());
        let State { head_tensors: tensors, field, dataset, .. } = state;
        let Self { gpu, rasterizer, resident, .. } = self;
        let Some(resident) = resident else { return Ok(Ok(None)) };
        let (channels, blending) = (head.channels(field), head.blending());
        for view in &plan.views {
            let Some(labels) = &view.frame.labels else {
                losses.push(HeadLoss::default());
                continue;
            };
            let frame = &dataset.frames[view.index];
            let values =
                GpuVec::from_slice(gpu, "values of the head", &head.values(tensors, field, frame.time))?;
            let request = BlendRequest { values: &values, channels, blending };
            let input = ViewInput { camera: &frame.camera, settings: &plan.settings, labels: None };
            let identities = match &field.identities {
                Some(rows) if plan.settings.instances.is_some() => {
                    Some(DeviceIdentities::from_identities(gpu, rows, field.instances.len())?)
                }
                _ => None,
            };
            let mut commands = Commands::new(gpu, None);
            let posed = resident.pose(gpu, &mut commands, frame.time);
            rasterizer.project(gpu, &mut commands, posed, identities.as_ref(), &input)?;
            rasterizer.measure(gpu, commands)?;
            let mut commands = Commands::new(gpu, None);
            rasterizer.list_tiles(gpu, &mut commands, identities.as_ref())?;
            let mut blended = GpuVec::zeros(gpu, "blended values", 0)?;
            rasterizer.blend(gpu, &mut commands, &request, &mut blended)?;
            commands.submit();
            let image = BlendedImage {
                width: frame.camera.width,
                height: frame.camera.height,
                channels,
                values: blended.read(gpu)?,
            };
            let mut v_blended = vec![0.0; image.values.len()];
            losses.push(head.loss(tensors, &image, labels, weight, &mut v_blended));
            let v_blended = GpuVec::from_slice(gpu, "gradients of blended values", &v_blended)?;
            let v_values = GpuVec::zeros(gpu, "gradients of values", values.len())?;
            let mut commands = Commands::new(gpu, None);
            rasterizer.blend_backward(gpu, &mut commands, &request, &v_blended, &v_values, None)?;
            commands.submit();
            head.values_backward(tensors, field, frame.time, &v_values.read(gpu)?);
        }
        let loss: f64 = losses.iter().map(|loss| loss.sum).sum();
        head.regularise(tensors, field, state.config.seed ^ u64::from(plan.iteration));
        if let Some(fault) = loss_fault("instance loss", loss).or_else(|| tensors.fault()) {
            *tensors = before;
            return Ok(Err(fault));
        }
        tensors.step(head, plan.iteration, state.config.stages.instance);
        Ok(Ok(Some(HeadPass { losses, before })))
    }
}
