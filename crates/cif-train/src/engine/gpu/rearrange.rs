//! Densification, pruning, opacity resets and relocations with the rows staying on the device. The host decides as it
//! does for itself, from geometry and statistics, 64 bytes of each Gaussian, from exposures, and for relocations from the
//! deformation and the calibrations, too; harmonics and moments, 672 bytes, are moved there.

use cif_field::parameters::{LOG_CALIBRATIONS, OPACITY_LOGITS, OnCopy};
use cif_render::wgpu::gaussians::{COLUMNS, gaussians, geometry, geometry_column};
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuVec};

use super::gpu_engine::GpuEngine;
use super::resident::{Resident, ResidentIdentities, set_moments, statistic_rows, statistics_of};
use crate::error::TrainError;
use crate::stage::Stage;
use crate::state::State;
use crate::wgpu::rearrange::{GpuRearranger, RowRule};

/// Arrays of the device from which the host decides changes.
struct Basis {
    geometry: Vec<[f32; 12]>,
    statistics: Vec<[f32; 4]>,
    /// Planes and network.
    deformation: Option<[Vec<f32>; 2]>,
    /// Calibrations, first and second moments.
    calibrations: Option<[Vec<f32>; 3]>,
    /// Exposures with their moments.
    exposures: Option<[Vec<f32>; 3]>,
}

impl GpuEngine {
    /// Brings the basis of changes to the state, where the device is ahead of it; colours stay those that were
    /// fetched last, until the next fetch.
    pub(super) fn take_basis(&mut self, state: &mut State, relocates: bool) -> Result<(), TrainError> {
        let Some(resident) = self.resident.as_ref().filter(|_| self.ahead) else { return Ok(()) };
        let Basis { geometry, statistics, deformation, calibrations, exposures } =
            resident.basis(&self.gpu, relocates)?;
        if let Some(fetched) = &mut self.fetched
            && fetched.kept.is_none()
        {
            // Should the device be lost, the host stands where it was fetched last.
            fetched.kept = Some(state.keep());
        }
        self.origins = Some((0..geometry.len() as u32).collect());
        let field = &mut state.field;
        let colors = std::mem::take(&mut field.gaussians.sh_coefficients);
        field.gaussians = gaussians(&geometry, colors);
        state.statistics = statistics_of(&statistics);
        if let (Some(target), Some([planes, mlp])) = (&mut field.deformation, deformation) {
            (target.planes, target.mlp) = (planes, mlp);
        }
        if let (Some(target), Some([values, first, second])) = (&mut field.identities, calibrations) {
            target.log_calibrations = values;
            set_moments(&mut state.optimiser, &LOG_CALIBRATIONS, [first, second]);
        }
        if let (Some(target), Some(arrays)) = (&mut state.progress.exposures, exposures) {
            [target.values, target.first, target.second] = arrays;
        }
        Ok(())
    }

    /// Moves rows on the device as the state's have moved.
    pub(super) fn rearrange_rows(
        &mut self,
        state: &State,
        origins: &[u32],
        resets_opacities: bool,
    ) -> Result<(), TrainError> {
        let Some(resident) = &mut self.resident else { return Ok(()) };
        resident.rearrange(&self.gpu, &self.rearranger, origins, resets_opacities)?;
        let State { field, optimiser, statistics, .. } = state;
        resident.canonical.geometry.replace(&self.gpu, &geometry(&field.gaussians))?;
        resident.statistics.replace(&self.gpu, &statistic_rows(statistics))?;
        if let Some(deformation) = &mut resident.deformation {
            deformation.parameters.set_still(&self.gpu, &field.left_alone())?;
        }
        resident.set_members(&self.gpu, field)?;
        if let Some(rows) = field.identities.as_ref().filter(|_| state.progress.stage == Stage::Instance) {
            let instances = field.instances.len();
            resident.identities = Some(ResidentIdentities::send(&self.gpu, rows, instances, optimiser)?);
        }
        self.motion.send(&self.gpu, &state.guidance.guide_of)?;
        Ok(self.make_room(field.gaussians.len())?)
    }
}

impl Resident {
    fn basis(&self, gpu: &Gpu, relocates: bool) -> Result<Basis, GpuError> {
        let deformation = match self.deformation.as_ref().filter(|_| relocates) {
            Some(of) => Some([of.parameters.planes.read(gpu)?, of.parameters.mlp.read(gpu)?]),
            None => None,
        };
        let calibrations = match self.identities.as_ref().filter(|_| relocates) {
            Some(of) => Some([
                of.log_calibrations.read(gpu)?,
                of.moments.first.read(gpu)?,
                of.moments.second.read(gpu)?,
            ]),
            None => None,
        };
        Ok(Basis {
            geometry: self.canonical.geometry.read(gpu)?,
            statistics: self.statistics.read(gpu)?,
            exposures: self.exposures.as_ref().map(|resident| resident.read(gpu)).transpose()?,
            deformation,
            calibrations,
        })
    }

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
        let of_sh = RowRule { fresh_are_zero: true, ..RowRule::default() };
        let divided = COLUMNS.iter().filter(|(parameter, _)| parameter.on_copy == OnCopy::Divided);
        let of_geometry = RowRule {
            zero_column: geometry_column(&OPACITY_LOGITS)
                .filter(|_| resets_opacities)
                .map(|column| column as u32),
            restarted_columns: divided.map(|(_, column)| 1 << column).sum(),
            ..of_sh
        };
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
