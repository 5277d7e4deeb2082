//! Densification, pruning, opacity resets and relocations with the rows staying on the device. The host decides as it
//! does for itself, from geometry and statistics, 64 bytes of each Gaussian, and for relocations from the deformation and
//! the calibrations, too; harmonics and moments, 672 bytes, are moved there.

use cif_field::parameters::{LOG_CALIBRATIONS, OPACITY_LOGITS, OnCopy};
use cif_render::wgpu::gaussians::{COLUMNS, gaussians, geometry, geometry_column};
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuVec};

use super::super::Trainer;
use super::resident::{Resident, ResidentIdentities, statistic_rows, statistics_of};
use crate::densify::Rearrangement;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::resample::Pair;
use crate::schedule::Due;
use crate::wgpu::kernels::{FRESH, RESTARTED};
use crate::wgpu::rearrange::{GpuRearranger, RowRule, compose};

/// What the host decides from.
struct Basis {
    geometry: Vec<[f32; 12]>,
    statistics: Vec<[f32; 4]>,
    /// Planes and network.
    deformation: Option<[Vec<f32>; 2]>,
    /// Calibrations, first and second moments.
    calibrations: Option<[Vec<f32>; 3]>,
}

impl Trainer {
    /// Changes of the set of Gaussians with their rows staying on the device.
    pub(in crate::trainer) fn change_gaussians_on_device(
        &mut self,
        stage: Stage,
        iteration: u32,
        due: &Due,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let received = self.receive(&mut device, true);
        let relocates = stage == Stage::Instance;
        let read = received.and_then(|()| match &device.resident {
            Some(resident) => Ok(Some(resident.basis(&device.gpu, relocates)?)),
            None => Ok(None),
        });
        let basis = match read {
            Ok(Some(basis)) => basis,
            other => {
                self.device = Some(device);
                return other.map(drop);
            }
        };
        if let Some(fetched) = &mut device.fetched
            && fetched.kept.is_none()
        {
            // Should the device be lost, the host stands where it was fetched last.
            fetched.kept = Some(self.keep());
        }
        device.origins = Some((0..basis.geometry.len() as u32).collect());
        self.device = Some(device);
        self.take_basis(basis);
        let densified = self.change_gaussians_here(stage, iteration, due, events);
        let Some(mut device) = self.device.take() else { return densified };
        let origins = device.origins.take();
        let followed = match (&densified, origins, &mut device.resident) {
            (Ok(()), Some(origins), Some(resident)) => {
                let moved =
                    resident.rearrange(&device.gpu, &device.rearranger, &origins, due.resets_opacities);
                moved.and_then(|()| {
                    let rows = geometry(&self.field.gaussians);
                    resident.canonical.geometry.replace(&device.gpu, &rows)?;
                    resident.statistics.replace(&device.gpu, &statistic_rows(&self.statistics))?;
                    if let (Some(resident), Some(deformation)) =
                        (&mut resident.deformation, &self.field.deformation)
                    {
                        resident.parameters.set_still(&device.gpu, &deformation.still)?;
                    }
                    if relocates && let Some(rows) = &self.field.identities {
                        let instances = self.field.instances.len();
                        let optimiser = &mut self.optimiser;
                        let sent = ResidentIdentities::send(&device.gpu, rows, instances, optimiser)?;
                        resident.identities = Some(sent);
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

    /// Takes over what the device has; colours stay those that were fetched last, until the next fetch.
    fn take_basis(&mut self, basis: Basis) {
        let colors = std::mem::take(&mut self.field.gaussians.sh_coefficients);
        self.field.gaussians = gaussians(&basis.geometry, colors);
        self.statistics = statistics_of(&basis.statistics);
        if let (Some(target), Some([planes, mlp])) = (&mut self.field.deformation, basis.deformation) {
            (target.planes, target.mlp) = (planes, mlp);
        }
        if let (Some(target), Some([values, first, second])) =
            (&mut self.field.identities, basis.calibrations)
        {
            target.log_calibrations = values;
            self.optimiser.of(&LOG_CALIBRATIONS).set(first, second);
        }
    }

    /// Notes relocations that happen on the device too: `weak` rows become copies of `sources`, whose opacity and occupancy
    /// start afresh.
    pub(in crate::trainer) fn relocates_on_device(&mut self, pairs: &[Pair]) {
        if let Some(origins) = self.device.as_mut().and_then(|device| device.origins.as_mut()) {
            for pair in pairs {
                origins[pair.weak as usize] = pair.source | FRESH;
                origins[pair.source as usize] = pair.source | RESTARTED;
            }
        }
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
