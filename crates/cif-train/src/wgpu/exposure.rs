//! Exposures of cameras on the device.

use cif_render::wgpu::{BindGroup, Commands, Gpu, GpuError, GpuVec, Kernel, Uniform, workgroups};

use super::kernels::{ADAM_EXPOSURES, EXPOSURE, ExposureRates, ExposureSettings, entries};
use super::optimiser::{GpuMoments, GroupStep};
use crate::exposure::Exposures;

/// Pixels of a workgroup.
const WORKGROUP: usize = 256;

/// Exposures learnt per camera, on the device: logarithms of gains and offsets, `[cameras, 6]`.
#[derive(Debug)]
pub(crate) struct CameraExposures {
    values: GpuVec<f32>,
    gradients: GpuVec<f32>,
    moments: GpuMoments,
    cameras: usize,
}

impl CameraExposures {
    /// A copy, with no gradients.
    ///
    /// # Errors
    /// When the device is out of memory.
    pub(crate) fn upload(gpu: &Gpu, exposures: &Exposures) -> Result<Self, GpuError> {
        let Exposures { values, first, second, .. } = exposures;
        Ok(Self {
            values: GpuVec::from_slice(gpu, "exposures", values)?,
            gradients: GpuVec::zeros(gpu, "gradients of the exposures", values.len())?,
            moments: GpuMoments::upload(gpu, "moments of the exposures", first, second)?,
            cameras: exposures.cameras.len(),
        })
    }

    /// Values, first and second moments, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost.
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<[Vec<f32>; 3], GpuError> {
        Ok([self.values.read(gpu)?, self.moments.first.read(gpu)?, self.moments.second.read(gpu)?])
    }

    /// Gradients of the step under way.
    #[cfg(test)]
    pub(crate) fn gradients(&self) -> &GpuVec<f32> {
        &self.gradients
    }
}

/// A view that a camera records with its exposure.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ExposedView<'a> {
    /// Exposures of all cameras.
    pub(crate) cameras: &'a CameraExposures,
    /// Row of the camera among them.
    pub(crate) camera: u32,
    /// Colours as the renderer leaves them, `[pixels]`.
    pub(crate) colors: &'a GpuVec<[f32; 4]>,
    /// Pixels of the view.
    pub(crate) pixels: usize,
}

/// Recorded around the losses of a view, and after the last view of a step.
#[derive(Debug)]
pub(crate) struct GpuExposure {
    /// Colours of the view as the camera records them, `[pixels]`.
    pub(crate) recorded: GpuVec<[f32; 4]>,
    partial_sums: GpuVec<[f32; 4]>,
    settings: Uniform<ExposureSettings>,
    rates: Uniform<ExposureRates>,
    expose: Kernel,
    pull_back: Kernel,
    add_gradient: Kernel,
    step: Kernel,
}

impl GpuExposure {
    /// Ready for views of any size.
    ///
    /// # Errors
    /// When the driver rejects a kernel.
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [expose, pull_back, add_gradient] = entries(gpu, &EXPOSURE)?;
        let [step] = entries(gpu, &ADAM_EXPOSURES)?;
        Ok(Self {
            recorded: GpuVec::zeros(gpu, "recorded colours", 0)?,
            partial_sums: GpuVec::zeros(gpu, "sums of the exposure", 0)?,
            settings: Uniform::new(gpu, "exposure settings", &ExposureSettings::default()),
            rates: Uniform::new(gpu, "rates of the exposures", &ExposureRates::default()),
            expose,
            pull_back,
            add_gradient,
            step,
        })
    }

    /// Records what the camera makes of the colours: [`Self::recorded`]. One view per submission: its
    /// settings are written at once.
    ///
    /// # Errors
    /// When the view exceeds what the device binds.
    pub(crate) fn expose(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        view: ExposedView<'_>,
        v_colors: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) -> Result<(), GpuError> {
        let ExposedView { camera, pixels, .. } = view;
        self.recorded.resize(gpu, pixels)?;
        self.partial_sums.resize(gpu, 2 * pixels.div_ceil(WORKGROUP))?;
        self.settings.write(gpu, &ExposureSettings { pixels: pixels as u32, camera, ..Default::default() });
        let group = self.bind(gpu, &self.expose, view, v_colors, faults);
        commands.stage("exposure", |stage| {
            stage.dispatch(&self.expose, &group, workgroups(pixels, WORKGROUP));
        });
        Ok(())
    }

    /// Records the backward pass: `v_colors`, by the recorded colours, become those by the colours of the view, and the camera gets its
    /// gradient. To be recorded after [`Self::expose`] of the same view.
    pub(crate) fn pull_back(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        view: ExposedView<'_>,
        v_colors: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) {
        let pull_back = self.bind(gpu, &self.pull_back, view, v_colors, faults);
        let add_gradient = self.bind(gpu, &self.add_gradient, view, v_colors, faults);
        commands.stage("exposure", |stage| {
            stage.dispatch(&self.pull_back, &pull_back, workgroups(self.recorded.len(), WORKGROUP));
            stage.dispatch(&self.add_gradient, &add_gradient, [1, 1, 1]);
        });
    }

    /// Records the step of all cameras; gradients become zero. Nothing moves while the second word of `faults` makes
    /// steps wait.
    pub(crate) fn step(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        step: GroupStep,
        cameras: &CameraExposures,
        faults: &GpuVec<u32>,
    ) {
        let (rate, second) = step.corrected();
        self.rates.write(
            gpu,
            &ExposureRates { cameras: cameras.cameras as u32, rate, second, ..Default::default() },
        );
        let group = self.step.bind(
            gpu,
            &[
                self.rates.binding(),
                cameras.values.binding(),
                cameras.gradients.binding(),
                cameras.moments.first.binding(),
                cameras.moments.second.binding(),
                faults.binding(),
            ],
        );
        commands.stage("exposure", |stage| stage.dispatch(&self.step, &group, [1, 1, 1]));
    }

    fn bind(
        &self,
        gpu: &Gpu,
        kernel: &Kernel,
        view: ExposedView<'_>,
        v_colors: &GpuVec<[f32; 4]>,
        faults: &GpuVec<u32>,
    ) -> BindGroup {
        kernel.bind(
            gpu,
            &[
                self.settings.binding(),
                view.cameras.values.binding(),
                view.colors.binding(),
                self.recorded.binding(),
                v_colors.binding(),
                self.partial_sums.binding(),
                view.cameras.gradients.binding(),
                faults.binding(),
            ],
        )
    }
}
