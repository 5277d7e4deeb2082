//! Densification, pruning and opacity resets with the rows staying on the device. The host decides as it does for
//! itself, from geometry and statistics, 64 bytes of each Gaussian; harmonics and moments, 672 bytes, are moved there.

use cif_render::wgpu::gaussians::{gaussians, geometry};
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuVec};

use super::super::Trainer;
use super::resident::{Resident, statistic_rows, statistics_of};
use crate::densify::Rearrangement;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::schedule::falls_on;
use crate::wgpu::rearrange::{GpuRearranger, RowRule, compose};

/// Float of the opacity logit in the geometry of a Gaussian.
const OPACITY_COLUMN: u32 = 3;

impl Trainer {
    /// What [`Trainer::densify`] does, on the device.
    pub(super) fn densify_on_device(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let received = self.receive(&mut device, true);
        let read = received.and_then(|()| {
            let Some(resident) = &device.resident else { return Ok(None) };
            let geometry = resident.canonical.geometry.read(&device.gpu)?;
            Ok(Some((geometry, resident.statistics.read(&device.gpu)?)))
        });
        if let (Ok(Some((rows, statistics))), Some(fetched)) = (&read, &mut device.fetched) {
            // Should the device be lost, the host stands where it was fetched last.
            if fetched.kept.is_none() {
                fetched.kept = Some(self.keep());
            }
            // Colours stay those that were fetched last, until the next fetch.
            let colors = std::mem::take(&mut self.field.gaussians.sh_coefficients);
            self.field.gaussians = gaussians(rows, colors);
            self.statistics = statistics_of(statistics);
            device.origins = Some((0..rows.len() as u32).collect());
        }
        self.device = Some(device);
        if read?.is_none() {
            return Ok(());
        }
        let densified = self.densify(stage, iteration, events);
        let Some(mut device) = self.device.take() else { return densified };
        let origins = device.origins.take();
        let resets = falls_on(iteration, self.config.densify.opacity_reset_every);
        let followed = match (&densified, origins, &mut device.resident) {
            (Ok(()), Some(origins), Some(resident)) => {
                let moved = resident.rearrange(&device.gpu, &device.rearranger, &origins, resets);
                moved.and_then(|()| {
                    resident.births.replace(&device.gpu, &self.optimiser.births())?;
                    let rows = geometry(&self.field.gaussians);
                    resident.canonical.geometry.replace(&device.gpu, &rows)?;
                    resident.statistics.replace(&device.gpu, &statistic_rows(&self.statistics))?;
                    if let (Some(resident), Some(deformation)) =
                        (&mut resident.deformation, &self.field.deformation)
                    {
                        resident.parameters.set_still(&device.gpu, &deformation.still)?;
                    }
                    device.motion.send(&device.gpu, self.guide_of())
                })
            }
            _ => Ok(()),
        };
        let followed = followed.and_then(|()| device.make_room(self.field.gaussians.len()));
        self.device = Some(device);
        densified.and(followed.map_err(TrainError::from))
    }

    /// Notes a change of the set that happens on the device too; says whether it does. The host's moments are then
    /// of no value until they are fetched.
    pub(in crate::trainer) fn follows_on_device(&mut self, change: &Rearrangement) -> bool {
        let Some(origins) = self.device.as_mut().and_then(|device| device.origins.as_mut()) else {
            return false;
        };
        *origins = compose(origins, &change.origins, &change.parents);
        true
    }
}

impl Resident {
    /// Moves what has a row per Gaussian; geometry and statistics are sent by the caller.
    fn rearrange(
        &mut self,
        gpu: &Gpu,
        rearranger: &GpuRearranger,
        origins: &[u32],
        resets_opacities: bool,
    ) -> Result<(), GpuError> {
        let n = origins.len();
        let is_same = self.canonical.len() == n && origins.iter().enumerate().all(|(k, o)| k as u32 == *o);
        if is_same && !resets_opacities {
            return Ok(());
        }
        let origins = GpuVec::from_slice(gpu, "origins of the Gaussians", origins)?;
        let mut commands = Commands::new(gpu, None);
        let copies = RowRule::default();
        rearranger.record(gpu, &mut commands, &origins, &mut self.canonical.sh, copies)?;
        let of_sh = RowRule { fresh_are_zero: true, zero_column: None };
        let of_geometry = RowRule { zero_column: resets_opacities.then_some(OPACITY_COLUMN), ..of_sh };
        for moments in &mut self.moments {
            rearranger.record(gpu, &mut commands, &origins, &mut moments.geometry, of_geometry)?;
            rearranger.record(gpu, &mut commands, &origins, &mut moments.sh, of_sh)?;
        }
        commands.submit();
        self.resize_rows(gpu, n)
    }

    /// Arrays of every step, for another number of Gaussians.
    pub(super) fn resize_rows(&mut self, gpu: &Gpu, n: usize) -> Result<(), GpuError> {
        self.gradients = GpuGaussians::zeros(gpu, n)?;
        self.posed.geometry.resize(gpu, n)?;
        let moves_sh = self.deformation.as_ref().is_some_and(|d| d.parameters.moves_sh());
        self.posed.sh.resize(gpu, if moves_sh { n } else { 0 })?;
        self.screen = GpuVec::zeros(gpu, "screen gradients", n)?;
        Ok(())
    }
}
