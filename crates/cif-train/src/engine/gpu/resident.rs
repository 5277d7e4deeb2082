//! Training data on the device: the field, its moments and gradients.

use cif_field::parameters::{LOG_CALIBRATIONS, MLP, PLANES, Parameter, Rows};
use cif_field::{Field, Gaussians, Identities};
use cif_render::wgpu::deform::DeformationGradients;
use cif_render::wgpu::gaussians::{gaussians, geometry};
use cif_render::wgpu::poses;
use cif_render::wgpu::{
    Commands, DeviceIdentities, Gpu, GpuDeformation, GpuError, GpuGaussians, GpuPoses, GpuVec, PosedInput,
};

use crate::adam::Moments;
use crate::density::DensifyStatistics;
use crate::error::TrainError;
use crate::optimiser::Optimiser;
use crate::state::State;
use crate::wgpu::exposure::CameraExposures;
use crate::wgpu::optimiser::GpuMoments;
use crate::wgpu::poses::GpuPoseOptimiser;

/// Parts that the host has changed since they were sent to the device.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Stale {
    pub(super) gaussians: bool,
    pub(super) identities: bool,
    pub(super) deformation: bool,
    pub(super) exposures: bool,
    pub(super) poses: bool,
}

impl Stale {
    pub(super) const EVERYTHING: Self =
        Self { gaussians: true, identities: true, deformation: true, exposures: true, poses: true };
}

/// The deformation with its moments (planes, network) and gradients.
pub(super) struct ResidentDeformation {
    pub(super) parameters: GpuDeformation,
    pub(super) gradients: DeformationGradients,
    pub(super) moments: [GpuMoments; 2],
}

/// Identity rows with their calibrations.
pub(super) struct ResidentIdentities {
    pub(super) rows: DeviceIdentities,
    pub(super) log_estimates: GpuVec<f32>,
    pub(super) log_calibrations: GpuVec<f32>,
    pub(super) gradients: GpuVec<f32>,
    pub(super) moments: GpuMoments,
}

/// Groups that move as a whole, with the moments of their poses.
pub(super) struct ResidentPoses {
    pub(super) groups: GpuPoses,
    pub(super) optimiser: GpuPoseOptimiser,
}

/// Everything of a run that stays on the device.
pub(super) struct Resident {
    pub(super) canonical: GpuGaussians,
    /// First and second moments, in the layout of the parameters.
    pub(super) moments: [GpuGaussians; 2],
    pub(super) gradients: GpuGaussians,
    /// At the time of a view.
    pub(super) posed: GpuGaussians,
    /// Screen gradients of the step, `[N]`: along x and y, radius, whether visible.
    pub(super) screen: GpuVec<[f32; 4]>,
    /// Summed norms, steps and largest radius since the last densification, `[N]`.
    pub(super) statistics: GpuVec<[f32; 4]>,
    pub(super) deformation: Option<ResidentDeformation>,
    pub(super) identities: Option<ResidentIdentities>,
    pub(super) exposures: Option<CameraExposures>,
    pub(super) poses: Option<ResidentPoses>,
}

/// Moments of a parameter of the table.
fn moments_of<'a>(optimiser: &'a Optimiser, parameter: &Parameter) -> &'a Moments {
    let mut groups = optimiser.groups().iter();
    &groups.find(|(other, _)| other == parameter).expect("a parameter of the table").1
}

/// First or `second` moments of the Gaussians.
fn moment_rows(optimiser: &Optimiser, second: bool, gaussians: usize) -> Gaussians {
    let mut rows = Gaussians::zeros(gaussians);
    for (parameter, values) in rows.tensors_mut() {
        let moments = moments_of(optimiser, &parameter);
        values.copy_from_slice(if second { &moments.second } else { &moments.first });
    }
    rows
}

/// The other way.
fn set_moment_rows(optimiser: &mut Optimiser, second: bool, rows: &Gaussians) {
    for (parameter, values) in rows.tensors() {
        let moments = optimiser.of(&parameter);
        *(if second { &mut moments.second } else { &mut moments.first }) = values.to_vec();
    }
}

/// Replaces both moments of a parameter.
pub(super) fn set_moments(optimiser: &mut Optimiser, parameter: &Parameter, [first, second]: [Vec<f32>; 2]) {
    let moments = optimiser.of(parameter);
    (moments.first, moments.second) = (first, second);
}

/// Takes the shape of another set of Gaussians whose moments are on the device; they are zero here.
pub(super) fn resize_moments(optimiser: &mut Optimiser, rows: usize) {
    let groups = optimiser.groups_mut().iter_mut();
    for (parameter, moments) in groups.filter(|(parameter, _)| parameter.rows == Rows::Gaussians) {
        *moments = Moments { steps: moments.steps, ..Moments::zeros(rows, parameter.width()) };
    }
}

/// Statistics in the layout of the device.
pub(super) fn statistic_rows(statistics: &DensifyStatistics) -> Vec<[f32; 4]> {
    let (gradient, count, radius) = (&statistics.gradient, &statistics.count, &statistics.radius);
    (0..gradient.len()).map(|row| [gradient[row], count[row] as f32, radius[row], 0.0]).collect()
}

/// The other way.
pub(super) fn statistics_of(rows: &[[f32; 4]]) -> DensifyStatistics {
    DensifyStatistics {
        gradient: rows.iter().map(|row| row[0]).collect(),
        count: rows.iter().map(|row| row[1] as u32).collect(),
        radius: rows.iter().map(|row| row[2]).collect(),
    }
}

impl ResidentIdentities {
    pub(super) fn send(
        gpu: &Gpu,
        rows: &Identities,
        instances: usize,
        optimiser: &Optimiser,
    ) -> Result<Self, GpuError> {
        let moments = moments_of(optimiser, &LOG_CALIBRATIONS);
        Ok(Self {
            rows: DeviceIdentities::from_identities(gpu, rows, instances)?,
            log_estimates: GpuVec::from_slice(gpu, "identity estimates", &rows.log_estimates)?,
            log_calibrations: GpuVec::from_slice(gpu, "calibrations", &rows.log_calibrations)?,
            gradients: GpuVec::zeros(gpu, "gradients of the calibrations", rows.labels.len())?,
            moments: GpuMoments::upload(gpu, "moments of the calibrations", &moments.first, &moments.second)?,
        })
    }
}

impl Resident {
    /// The Gaussians at a time in 0..=1, deformed if the field moves, and where their groups are.
    pub(super) fn pose(&self, gpu: &Gpu, commands: &mut Commands<'_>, time: f64) -> PosedInput<'_> {
        let deformation = self.deformation.as_ref().map(|resident| &resident.parameters);
        let groups = self.poses.as_ref().map(|resident| &resident.groups);
        poses::pose(gpu, commands, time, deformation, groups, &self.canonical, &self.posed)
    }

    /// Nothing yet.
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let none = || GpuGaussians::zeros(gpu, 0);
        Ok(Self {
            canonical: none()?,
            moments: [none()?, none()?],
            gradients: none()?,
            posed: none()?,
            screen: GpuVec::zeros(gpu, "screen gradients", 0)?,
            statistics: GpuVec::zeros(gpu, "statistics of densification", 0)?,
            deformation: None,
            identities: None,
            exposures: None,
            poses: None,
        })
    }

    /// Sends what is stale.
    pub(super) fn send(&mut self, gpu: &Gpu, stale: Stale, state: &State) -> Result<(), GpuError> {
        let State { field, optimiser, statistics, .. } = state;
        if stale.gaussians {
            let n = field.gaussians.len();
            self.canonical.replace(gpu, &field.gaussians)?;
            for (second, moments) in [false, true].into_iter().zip(&mut self.moments) {
                moments.replace(gpu, &moment_rows(optimiser, second, n))?;
            }
            self.gradients = GpuGaussians::zeros(gpu, n)?;
            self.posed.geometry.resize(gpu, n)?;
            let moves_sh = field.deformation.as_ref().is_some_and(|d| d.config.heads.sh);
            self.posed.sh.resize(gpu, if moves_sh { n } else { 0 })?;
            self.screen = GpuVec::zeros(gpu, "screen gradients", n)?;
            self.statistics.replace(gpu, &statistic_rows(statistics))?;
        }
        if stale.deformation {
            self.deformation = match &field.deformation {
                None => None,
                Some(deformation) => {
                    let parameters = GpuDeformation::new(gpu, deformation)?;
                    let moments = |label, parameter| {
                        let moments = moments_of(optimiser, parameter);
                        GpuMoments::upload(gpu, label, &moments.first, &moments.second)
                    };
                    Some(ResidentDeformation {
                        gradients: DeformationGradients::zeros(gpu, &parameters)?,
                        moments: [
                            moments("moments of the hexplanes", &PLANES)?,
                            moments("moments of the network", &MLP)?,
                        ],
                        parameters,
                    })
                }
            };
        }
        if let Some(resident) = self.deformation.as_mut().filter(|_| stale.gaussians) {
            resident.parameters.set_still(gpu, &field.left_alone())?;
        }
        if stale.poses {
            self.poses = match &field.tracks {
                None => None,
                Some(tracks) => Some(ResidentPoses {
                    groups: GpuPoses::new(gpu, tracks)?,
                    optimiser: GpuPoseOptimiser::new(gpu, &state.pose_moments)?,
                }),
            };
        } else if stale.gaussians {
            self.set_members(gpu, field)?;
        }
        if stale.exposures {
            let exposures = state.progress.exposures.as_ref();
            self.exposures =
                exposures.map(|exposures| CameraExposures::upload(gpu, exposures)).transpose()?;
        }
        if stale.identities {
            self.identities = match &field.identities {
                None => None,
                Some(rows) => Some(ResidentIdentities::send(gpu, rows, field.instances.len(), optimiser)?),
            };
        }
        Ok(())
    }

    /// Takes the Gaussians of a field for the groups, which stay.
    pub(super) fn set_members(&mut self, gpu: &Gpu, field: &Field) -> Result<(), GpuError> {
        match (&mut self.poses, &field.tracks) {
            (Some(poses), Some(tracks)) => poses.groups.set_members(gpu, tracks),
            _ => Ok(()),
        }
    }

    /// Reads everything that steps change, waiting for the device.
    pub(super) fn fetch(&self, gpu: &Gpu, state: &mut State) -> Result<(), TrainError> {
        // Everything is read before anything is changed, so that a device lost on the way leaves the host whole.
        let parameters = (self.canonical.geometry.read(gpu)?, self.canonical.sh.read(gpu)?);
        let mut moments = Vec::new();
        for of in &self.moments {
            moments.push(gaussians(&of.geometry.read(gpu)?, of.sh.read(gpu)?));
        }
        let rows = self.statistics.read(gpu)?;
        let deformation = match &self.deformation {
            None => None,
            Some(resident) => {
                let [planes, mlp] = &resident.moments;
                Some((
                    [
                        resident.parameters.planes.read(gpu)?,
                        planes.first.read(gpu)?,
                        planes.second.read(gpu)?,
                    ],
                    [resident.parameters.mlp.read(gpu)?, mlp.first.read(gpu)?, mlp.second.read(gpu)?],
                ))
            }
        };
        let calibrations = match &self.identities {
            None => None,
            Some(resident) => Some([
                resident.log_calibrations.read(gpu)?,
                resident.moments.first.read(gpu)?,
                resident.moments.second.read(gpu)?,
            ]),
        };
        let of_cameras = self.exposures.as_ref().map(|resident| resident.read(gpu)).transpose()?;
        let poses = match &self.poses {
            None => None,
            Some(resident) => Some((resident.groups.read(gpu)?, resident.optimiser.read(gpu)?)),
        };
        let State { field, optimiser, statistics, progress, .. } = state;
        let exposures = progress.exposures.as_mut();
        debug_assert_eq!(geometry(&field.gaussians).len(), parameters.0.len(), "the set changes on the host");
        field.gaussians = gaussians(&parameters.0, parameters.1);
        for (second, rows) in [false, true].into_iter().zip(moments) {
            set_moment_rows(optimiser, second, &rows);
        }
        *statistics = statistics_of(&rows);
        if let (Some(target), Some(arrays)) = (exposures, of_cameras) {
            [target.values, target.first, target.second] = arrays;
        }
        if let (Some(tracks), Some((groups, moments))) = (&mut field.tracks, poses) {
            (tracks.groups, state.pose_moments) = (groups, moments);
        }
        if let (Some(target), Some(([planes, first, second], [mlp, mlp_first, mlp_second]))) =
            (&mut field.deformation, deformation)
        {
            (target.planes, target.mlp) = (planes, mlp);
            set_moments(optimiser, &PLANES, [first, second]);
            set_moments(optimiser, &MLP, [mlp_first, mlp_second]);
        }
        if let (Some(target), Some([values, first, second])) = (&mut field.identities, calibrations) {
            target.log_calibrations = values;
            set_moments(optimiser, &LOG_CALIBRATIONS, [first, second]);
        }
        Ok(())
    }
}
