//! A step that trains a head which blends values of its own: blended and differentiated on the device, with its loss and
//! its optimiser on the host, which waits. The field stays as it is, but for opacities of the head's own.

use std::sync::Arc;

use cif_field::parameters::OCCUPANCY_LOGITS;
use cif_render::wgpu::{BlendWeightGradients, Commands, DeviceIdentities, GpuVec, ViewInput};
use cif_render::{BlendRequest, BlendedImage, GeometryPath};

use super::super::{Changed, Engine};
use super::gpu_engine::GpuEngine;
use crate::error::TrainError;
use crate::guard::{Fault, loss_fault};
use crate::heads::{ValueHead, step_tensors};
use crate::state::State;
use crate::step::{StepPlan, StepReport, ViewReport};

impl GpuEngine {
    /// Trains the head of a step; everything is as it was before where that fails.
    pub(super) fn head_step(&mut self, state: &mut State, plan: StepPlan) -> Result<StepReport, TrainError> {
        let head = Arc::clone(&state.head);
        let Some(head) = plan.head(&head, &state.config) else {
            return Ok(StepReport { plan, views: Vec::new(), fault: None });
        };
        let before = state.head_tensors.clone();
        match self.head_views(state, head, &plan) {
            Ok(Ok(views)) => Ok(StepReport { plan, views, fault: None }),
            Ok(Err(fault)) => {
                state.head_tensors = before;
                Ok(StepReport { plan, views: Vec::new(), fault: Some(fault) })
            }
            Err(error) => {
                state.head_tensors = before;
                Err(error)
            }
        }
    }

    fn head_views(
        &mut self,
        state: &mut State,
        head: &dyn ValueHead,
        plan: &StepPlan,
    ) -> Result<Result<Vec<ViewReport>, Fault>, TrainError> {
        let mut reports = Vec::with_capacity(plan.head_targets.len());
        let mut v_opacity = vec![0.0; if head.own_opacity().is_some() { state.field.len() } else { 0 }];
        for (position, target) in plan.head_targets.iter().enumerate() {
            let State { head_tensors: tensors, field, config, .. } = &mut *state;
            let Self { gpu, rasterizer, resident, .. } = &mut *self;
            let Some(resident) = resident else { break };
            let (channels, blending) = (head.channels(field), head.blending());
            let pairs = plan.compared(head, config, position, &|| field.deformed(target.time).means);
            let every: Vec<u32> = (0..field.len() as u32).collect();
            let values = head.values_of(tensors, field, target.time, &every);
            let on_device = GpuVec::from_slice(gpu, "values of the head", &values.values)?;
            let request = BlendRequest { values: &on_device, channels, blending };
            let input = ViewInput { camera: &target.camera, settings: &plan.settings, labels: None };
            let identities = match &field.identities {
                Some(rows) if plan.settings.instances.is_some() => {
                    Some(DeviceIdentities::from_identities(gpu, rows, field.instances.len())?)
                }
                _ => None,
            };
            let mut commands = Commands::new(gpu, None);
            let posed = resident.pose(gpu, &mut commands, target.time);
            rasterizer.project(gpu, &mut commands, posed, identities.as_ref(), &input)?;
            rasterizer.measure(gpu, commands)?;
            let mut commands = Commands::new(gpu, None);
            rasterizer.list_tiles(gpu, &mut commands, identities.as_ref())?;
            let mut blended = GpuVec::zeros(gpu, "blended values", 0)?;
            rasterizer.blend(gpu, &mut commands, &request, &mut blended)?;
            commands.submit();
            let image = BlendedImage {
                width: target.camera.width,
                height: target.camera.height,
                channels,
                values: blended.read(gpu)?,
            };
            let mut v_blended = vec![0.0; image.values.len()];
            let seed = plan.head_seed(config, position);
            let loss = target.loss(head, tensors, &image, seed, plan.view_weight(), &mut v_blended);
            reports.push(ViewReport::of_head(loss));
            let v_blended = GpuVec::from_slice(gpu, "gradients of blended values", &v_blended)?;
            let v_values = GpuVec::zeros(gpu, "gradients of values", values.values.len())?;
            let mut commands = Commands::new(gpu, None);
            let weights = head.own_opacity().map(|_| BlendWeightGradients {
                gaussians: posed,
                blended: &blended,
                geometry: GeometryPath::Off,
            });
            rasterizer.blend_backward(gpu, &mut commands, &request, &v_blended, &v_values, weights)?;
            commands.submit();
            let mut v_values = v_values.read(gpu)?;
            head.regularise(tensors, &pairs, &values.values, &mut v_values);
            head.values_backward(tensors, field, &values, &v_values);
            if !v_opacity.is_empty() {
                let of_view = rasterizer.gradients().gaussians.download(gpu)?.occupancy_logits;
                v_opacity.iter_mut().zip(of_view).for_each(|(sum, v)| *sum += v);
            }
        }
        let loss = reports.iter().map(|report| report.instance_loss).sum();
        let fault = loss_fault("instance loss", loss).or_else(|| state.head_tensors.fault());
        if let Some(fault) = fault {
            return Ok(Err(fault));
        }
        if !v_opacity.is_empty() {
            let State { field, optimiser, .. } = &mut *state;
            let logits = &mut field.gaussians.occupancy_logits;
            let rates = plan.rates.of(&OCCUPANCY_LOGITS);
            if optimiser.of(&OCCUPANCY_LOGITS).step(logits, &mut v_opacity, rates, None).is_err() {
                let (stage, iteration, tensor) = (plan.stage, plan.iteration, OCCUPANCY_LOGITS.name);
                return Err(TrainError::NotFinite { stage, iteration, tensor });
            }
            self.changed(Changed::Gaussians);
        }
        step_tensors(head, &mut state.head_tensors, plan.iteration, state.config.stages.instance);
        Ok(Ok(reports))
    }
}
