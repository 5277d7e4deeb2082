//! The optimiser on the device.

use cif_field::DeformationConfig;
use cif_field::gaussians::SH_FLOATS;
use cif_field::parameters::{LOG_CALIBRATIONS, MLP, PLANES, Parameter, SH_COEFFICIENTS};
use cif_render::wgpu::deform::{DeformationGradients, SPLITS};
use cif_render::wgpu::gaussians::COLUMNS;
use cif_render::wgpu::{
    Commands, Gpu, GpuDeformation, GpuError, GpuGaussians, GpuVec, Kernel, Uniform, workgroups,
};

use super::kernels::{
    ACCUMULATE, ADAM_GAUSSIANS, ADAM_NETWORK, ADAM_PLANES, Accumulation, BAND, GaussianRates, GroupRates,
    IDENTITY, PlaneRates, entries, fault,
};
use crate::adam::planes::factors;
use crate::adam::{BiasCorrection, PlaneWeights, RowRates};

/// Learning rates of a parameter, and the steps that it has done with this one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupStep {
    /// Learning rates; 0 keeps still.
    pub rates: RowRates,
    /// Steps done, this one included.
    pub steps: u32,
}

impl Default for GroupStep {
    fn default() -> Self {
        Self::uniform(0.0, 0)
    }
}

impl GroupStep {
    /// One rate for all floats.
    #[must_use]
    pub fn uniform(rate: f32, steps: u32) -> Self {
        Self { rates: RowRates::Uniform(rate), steps }
    }

    /// Rate of the first floats with the correction of the first moment, and correction of the second.
    pub(super) fn corrected(self) -> (f32, f32) {
        let bias = BiasCorrection::after(self.steps.max(1));
        let (RowRates::Uniform(rate) | RowRates::Split { base: rate, .. }) = self.rates;
        (rate * bias.first, bias.second)
    }
}

/// The step of every parameter that moves.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroupSteps(pub Vec<(Parameter, GroupStep)>);

impl GroupSteps {
    /// Step of a parameter; it keeps still where it is not listed.
    #[must_use]
    pub fn of(&self, parameter: &Parameter) -> GroupStep {
        let listed = self.0.iter().find(|(other, _)| other == parameter);
        listed.map(|(_, step)| *step).unwrap_or_default()
    }

    /// Counts one step less of the parameters whose bits of the fault word are set.
    pub fn uncount(&mut self, bits: u32) {
        for (parameter, step) in &mut self.0 {
            step.steps -= u32::from(bits & fault::bit(parameter) != 0);
        }
    }
}

/// Step of the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianStep<'a> {
    /// Steps of their parameters.
    pub groups: &'a GroupSteps,
    /// Only visible rows move.
    pub visible_only: bool,
    /// Raw quaternions become unit ones.
    pub renormalise: bool,
    /// Limits of the occupancy logit.
    pub occupancy_limits: Option<[f32; 2]>,
}

impl GaussianStep<'_> {
    fn rates(&self, gaussians: usize) -> GaussianRates {
        let mut rates = GaussianRates::default();
        for (parameter, first) in COLUMNS {
            let (rate, second) = self.groups.of(&parameter).corrected();
            for k in first..first + parameter.width() {
                rates.geometry[k / 4][k % 4] = rate;
                rates.geometry_second[k / 4][k % 4] = second;
            }
        }
        let sh = self.groups.of(&SH_COEFFICIENTS);
        let (sh_base, sh_second) = sh.corrected();
        let (rest, sh_active) = match sh.rates {
            RowRates::Uniform(rate) => (rate, SH_FLOATS),
            RowRates::Split { rest, active, .. } => (rest, active),
        };
        let [low, high] = self.occupancy_limits.unwrap_or([f32::MIN, f32::MAX]);
        GaussianRates {
            gaussians: gaussians as u32,
            visible_only: u32::from(self.visible_only),
            renormalise: u32::from(self.renormalise),
            sh_active: sh_active as u32,
            sh_base,
            sh_rest: GroupStep { rates: RowRates::Uniform(rest), ..sh }.corrected().0,
            sh_second,
            lowest_occupancy: low,
            highest_occupancy: high,
            ..rates
        }
    }
}

/// Moments of a flat group.
#[derive(Debug)]
pub struct GpuMoments {
    /// Decaying mean of the gradient.
    pub first: GpuVec<f32>,
    /// Decaying mean of the squared gradient.
    pub second: GpuVec<f32>,
}

impl GpuMoments {
    /// A copy.
    ///
    /// # Errors
    /// When it exceeds what the device binds.
    pub fn upload(gpu: &Gpu, label: &'static str, first: &[f32], second: &[f32]) -> Result<Self, GpuError> {
        Ok(Self {
            first: GpuVec::from_slice(gpu, label, first)?,
            second: GpuVec::from_slice(gpu, label, second)?,
        })
    }
}

/// Parameters that a step moves, with the sums of their gradients and their moments, each in a layout of the group.
#[derive(Debug)]
pub struct Optimised<'a, P, G, M> {
    /// Values.
    pub parameters: &'a P,
    /// Gradients of the step, which become zero.
    pub gradients: &'a G,
    /// First and second moments.
    pub moments: &'a M,
}

/// The optimiser's kernels, and those that add up a step.
#[derive(Debug)]
pub struct GpuOptimiser {
    gaussian_rates: Uniform<GaussianRates>,
    network_rates: Uniform<GroupRates>,
    calibration_rates: Uniform<GroupRates>,
    plane_rates: Uniform<PlaneRates>,
    plane_places: GpuVec<[u32; 4]>,
    counts: [Uniform<Accumulation>; 6],
    geometry: Kernel,
    sh: Kernel,
    network: Kernel,
    planes: [Kernel; 2],
    add: Kernel,
    add_screen: Kernel,
    add_statistics: Kernel,
    identity: Kernel,
}

/// Which count of [`GpuOptimiser`] a kernel reads: every kind has its own, as several are recorded together.
#[derive(Clone, Copy)]
enum Count {
    Geometry,
    Sh,
    Calibrations,
    Screen,
    Statistics,
    Rows,
}

impl GpuOptimiser {
    /// # Errors
    /// When the driver rejects a kernel.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [geometry, sh] = entries(gpu, &ADAM_GAUSSIANS)?;
        let [network] = entries(gpu, &ADAM_NETWORK)?;
        let planes = entries(gpu, &ADAM_PLANES)?;
        let [add, add_screen, add_statistics] = entries(gpu, &ACCUMULATE)?;
        let [identity] = entries(gpu, &IDENTITY)?;
        Ok(Self {
            gaussian_rates: Uniform::new(gpu, "rates of the Gaussians", &GaussianRates::default()),
            network_rates: Uniform::new(gpu, "rates of the network", &GroupRates::default()),
            calibration_rates: Uniform::new(gpu, "rates of the calibrations", &GroupRates::default()),
            plane_rates: Uniform::new(gpu, "rates of the planes", &PlaneRates::default()),
            plane_places: GpuVec::zeros(gpu, "places of the planes", 0)?,
            counts: std::array::from_fn(|_| Uniform::new(gpu, "count", &Accumulation::default())),
            geometry,
            sh,
            network,
            planes,
            add,
            add_screen,
            add_statistics,
            identity,
        })
    }

    fn count(&self, gpu: &Gpu, count: Count, value: usize) -> &Uniform<Accumulation> {
        let uniform = &self.counts[count as usize];
        let fault = match count {
            Count::Sh => fault::bit(&SH_COEFFICIENTS),
            Count::Calibrations => fault::bit(&LOG_CALIBRATIONS),
            _ => 0,
        };
        let is_geometry = u32::from(matches!(count, Count::Geometry));
        uniform.write(gpu, &Accumulation { count: value as u32, fault, is_geometry, unused: 0 });
        uniform
    }

    /// Records `total += view` for gradients of Gaussians: the spherical harmonics, and the geometry too where asked.
    /// Sums that no optimiser may take are bits of the first word of `faults`.
    pub fn add_gaussians(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        view: &GpuGaussians,
        total: &GpuGaussians,
        with_geometry: bool,
        faults: &GpuVec<u32>,
    ) {
        if with_geometry {
            let floats = view.geometry.len() * 12;
            let count = self.count(gpu, Count::Geometry, floats);
            let bindings =
                [count.binding(), view.geometry.binding(), total.geometry.binding(), faults.binding()];
            let group = self.add.bind(gpu, &bindings);
            commands.stage("accumulate", |s| s.dispatch(&self.add, &group, workgroups(floats, 256)));
        }
        let floats = view.sh.len() * SH_FLOATS;
        let count = self.count(gpu, Count::Sh, floats);
        let bindings = [count.binding(), view.sh.binding(), total.sh.binding(), faults.binding()];
        let group = self.add.bind(gpu, &bindings);
        commands.stage("accumulate", |s| s.dispatch(&self.add, &group, workgroups(floats, 256)));
    }

    /// Records `total += view` for gradients of calibrations.
    pub fn add_calibrations(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        view: &GpuVec<f32>,
        total: &GpuVec<f32>,
        faults: &GpuVec<u32>,
    ) {
        let count = self.count(gpu, Count::Calibrations, total.len());
        let bindings = [count.binding(), view.binding(), total.binding(), faults.binding()];
        let group = self.add.bind(gpu, &bindings);
        commands.stage("accumulate", |s| s.dispatch(&self.add, &group, workgroups(total.len(), 256)));
    }

    /// Records the sum over views of the screen rows: gradient along x and y, radius, whether visible.
    pub fn add_screen(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        view: &GpuVec<[f32; 4]>,
        total: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) {
        let count = self.count(gpu, Count::Screen, 4 * total.len());
        let bindings = [count.binding(), view.binding(), total.binding(), faults.binding()];
        let group = self.add_screen.bind(gpu, &bindings);
        commands.stage("accumulate", |s| s.dispatch(&self.add_screen, &group, workgroups(total.len(), 256)));
    }

    /// Records the step's share of the statistics: summed norms, steps, largest radius. Nothing while steps wait.
    pub fn add_statistics(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        screen: &GpuVec<[f32; 4]>,
        statistics: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) {
        let count = self.count(gpu, Count::Statistics, 4 * statistics.len());
        let bindings = [count.binding(), screen.binding(), statistics.binding(), faults.binding()];
        let group = self.add_statistics.bind(gpu, &bindings);
        commands.stage("accumulate", |s| {
            s.dispatch(&self.add_statistics, &group, workgroups(statistics.len(), 256));
        });
    }

    /// Records the probabilities of the identity rows, which become the second word of `identities`.
    pub fn identities(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        row_offsets: &GpuVec<u32>,
        log_estimates: &GpuVec<f32>,
        log_calibrations: &GpuVec<f32>,
        identities: &GpuVec<[u32; 2]>,
    ) {
        let rows = row_offsets.len().saturating_sub(1);
        let count = self.count(gpu, Count::Rows, rows);
        let group = self.identity.bind(
            gpu,
            &[
                count.binding(),
                row_offsets.binding(),
                log_estimates.binding(),
                log_calibrations.binding(),
                identities.binding(),
            ],
        );
        commands.stage("identity", |s| s.dispatch(&self.identity, &group, workgroups(rows, 64)));
    }

    /// Records the step of all Gaussians; gradients become zero. While the second word of `faults` makes steps wait,
    /// nothing moves here and in the steps of the other groups. Moments are the first and the second.
    pub fn step_gaussians(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        step: &GaussianStep<'_>,
        gaussians: &Optimised<'_, GpuGaussians, GpuGaussians, [GpuGaussians; 2]>,
        screen: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) {
        let Optimised { parameters, gradients, moments: [first, second] } = *gaussians;
        let n = parameters.len();
        self.gaussian_rates.write(gpu, &step.rates(n));
        let geometry = self.geometry.bind(
            gpu,
            &[
                self.gaussian_rates.binding(),
                parameters.geometry.binding(),
                gradients.geometry.binding(),
                first.geometry.binding(),
                second.geometry.binding(),
                screen.binding(),
                faults.binding(),
            ],
        );
        let sh = self.sh.bind(
            gpu,
            &[
                self.gaussian_rates.binding(),
                parameters.sh.binding(),
                gradients.sh.binding(),
                first.sh.binding(),
                second.sh.binding(),
                screen.binding(),
                faults.binding(),
            ],
        );
        commands.stage("optimiser: Gaussians", |stage| {
            stage.dispatch(&self.geometry, &geometry, workgroups(n, 64));
            stage.dispatch(&self.sh, &sh, workgroups(n * SH_FLOATS / 4, 256));
        });
    }

    /// Records the step of the calibrations, which stay within plus and minus `limit`.
    pub fn step_calibrations(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        step: GroupStep,
        limit: f32,
        calibrations: &Optimised<'_, GpuVec<f32>, GpuVec<f32>, GpuMoments>,
        faults: &GpuVec<u32>,
    ) {
        let Optimised { parameters, gradients, moments } = *calibrations;
        let (rate, second) = step.corrected();
        let floats = parameters.len();
        self.calibration_rates.write(
            gpu,
            &GroupRates { floats: floats as u32, parts: 1, rate, second, limit, ..GroupRates::default() },
        );
        let group = self.network.bind(
            gpu,
            &[
                self.calibration_rates.binding(),
                parameters.binding(),
                gradients.binding(),
                moments.first.binding(),
                moments.second.binding(),
                faults.binding(),
            ],
        );
        commands.stage("optimiser: Gaussians", |s| s.dispatch(&self.network, &group, workgroups(floats, 64)));
    }

    /// Records the step of planes and network; moments are those of the planes and of the network.
    ///
    /// # Errors
    /// When the device cannot hold the table of planes.
    pub fn step_deformation(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        groups: &GroupSteps,
        weights: &PlaneWeights,
        deformation: &Optimised<'_, GpuDeformation, DeformationGradients, [GpuMoments; 2]>,
        faults: &GpuVec<u32>,
    ) -> Result<(), GpuError> {
        let Optimised { parameters: deformation, gradients, moments: [of_planes, of_network] } = *deformation;
        let (rates, bands, places) = plane_rates(deformation.config(), weights, groups.of(&PLANES));
        self.plane_rates.write(gpu, &rates);
        self.plane_places.replace(gpu, &places)?;
        let (rate, second) = groups.of(&MLP).corrected();
        let floats = deformation.mlp.len();
        self.network_rates.write(
            gpu,
            &GroupRates {
                floats: floats as u32,
                parts: SPLITS,
                rate,
                second,
                limit: f32::MAX,
                ..GroupRates::default()
            },
        );
        let planes = self.planes[0].bind(
            gpu,
            &[
                self.plane_rates.binding(),
                deformation.planes.binding(),
                gradients.sums.binding(),
                of_planes.first.binding(),
                of_planes.second.binding(),
                faults.binding(),
                self.plane_places.binding(),
            ],
        );
        let network = self.network.bind(
            gpu,
            &[
                self.network_rates.binding(),
                deformation.mlp.binding(),
                gradients.parts.binding(),
                of_network.first.binding(),
                of_network.second.binding(),
                faults.binding(),
            ],
        );
        commands.stage("optimiser: planes", |stage| {
            for kernel in &self.planes {
                stage.dispatch(kernel, &planes, workgroups(rates.columns as usize * bands, 64));
            }
        });
        commands.stage("optimiser: network", |stage| {
            stage.dispatch(&self.network, &network, workgroups(floats, 64));
        });
        Ok(())
    }
}

/// Rates, bands of the longest columns, and places and factors of all planes.
fn plane_rates(
    config: &DeformationConfig,
    weights: &PlaneWeights,
    step: GroupStep,
) -> (PlaneRates, usize, Vec<[u32; 4]>) {
    let (levels, _) = config.plane_layout();
    let channels = config.channels as usize;
    let (mut places, mut columns, mut rows) = (Vec::new(), 0, 0);
    for level in &levels {
        for (plane, layout) in level.iter().enumerate() {
            let row = (layout.columns * channels) as u32;
            places.push([layout.offset as u32, layout.rows as u32, row, columns]);
            let (smooth, sparse) = factors(layout, plane, channels, weights);
            places.push([smooth.to_bits(), sparse.to_bits(), 0, 0]);
            columns += row;
            rows = layout.rows.max(rows);
        }
    }
    let (rate, second) = step.corrected();
    let rates = PlaneRates { planes: places.len() as u32 / 2, columns, rate, second };
    (rates, rows.div_ceil(BAND), places)
}
