//! Losses of a view on the device.

use cif_geometry::PixelGrid;
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuVec, Kernel, Uniform, workgroups};

use super::kernels::{LEAVE_OUT, LOSSES, LossSettings, SSIM, entries};
use crate::losses::ColorLoss;
use crate::losses::ssim::window;

/// Results that are kept on the device until they are read.
pub const SLOTS: usize = 64;

/// Pixels of a workgroup.
const WORKGROUP: usize = 256;

/// Target image and labels that a view is compared with.
#[derive(Debug)]
pub struct GpuTarget {
    /// Red, green and blue bytes from the lowest, `[pixels]`.
    pub colors: GpuVec<u32>,
    /// Dense instance index + 1, or 0, `[pixels]`; empty without a mask.
    pub labels: GpuVec<u32>,
    /// Width and height, pixels.
    pub size: [u32; 2],
}

impl GpuTarget {
    /// A copy of a frame.
    ///
    /// # Errors
    /// When it exceeds what the device binds.
    pub fn new(
        gpu: &Gpu,
        image: &PixelGrid<[u8; 3]>,
        labels: Option<&PixelGrid<u16>>,
    ) -> Result<Self, GpuError> {
        let colors: Vec<u32> =
            image.pixels.iter().map(|[r, g, b]| u32::from_le_bytes([*r, *g, *b, 255])).collect();
        let labels: Vec<u32> =
            labels.map_or_else(Vec::new, |grid| grid.pixels.iter().map(|label| u32::from(*label)).collect());
        Ok(Self {
            colors: GpuVec::from_slice(gpu, "target colours", &colors)?,
            labels: GpuVec::from_slice(gpu, "target labels", &labels)?,
            size: [image.width, image.height],
        })
    }

    /// Bytes on the device.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        4 * (self.colors.len() + self.labels.len()) as u64
    }
}

/// Pixels of a view that was drawn, `[pixels]` each.
#[derive(Clone, Copy, Debug)]
pub struct DrawnPixels<'a> {
    /// Colours, as the renderer leaves them or as the camera records them.
    pub colors: &'a GpuVec<[f32; 4]>,
    /// Blended values of the instance pass, as the renderer leaves them.
    pub blended: &'a GpuVec<[f32; 4]>,
}

/// Weights and switches of the losses of a view.
#[derive(Clone, Copy, Debug, Default)]
pub struct LossWeights {
    /// Share of the structural dissimilarity.
    pub lambda_dssim: f32,
    /// Of the view in the step.
    pub view: f32,
    /// True when the view was drawn with labels.
    pub with_instances: bool,
    /// Coverage normalisation of the instance loss.
    pub by_coverage: bool,
    /// True when labels are left out, see [`GpuLosses::leave_out`].
    pub leaves_out: bool,
    /// True when the pixels that effects are judged by are left out of the gradient.
    pub leaves_judged: bool,
}

/// Losses on the device.
#[derive(Debug)]
pub struct GpuLosses {
    /// Gradient by the colours of the view, `[pixels]`.
    pub v_colors: GpuVec<[f32; 4]>,
    /// `[SLOTS, 2]`.
    results: GpuVec<[f32; 4]>,
    partial_sums: GpuVec<[f32; 4]>,
    rows: GpuVec<[f32; 4]>,
    maps: GpuVec<[f32; 4]>,
    settings: Uniform<LossSettings>,
    left_out: GpuVec<u32>,
    losses: Kernel,
    total: Kernel,
    leave_out: Kernel,
    similarity: [Kernel; 4],
}

impl GpuLosses {
    /// Ready for views of any size.
    ///
    /// # Errors
    /// When the driver rejects a kernel.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [losses, total] = entries(gpu, &LOSSES)?;
        let [leave_out] = entries(gpu, &LEAVE_OUT)?;
        Ok(Self {
            v_colors: GpuVec::zeros(gpu, "gradient of the colours", 0)?,
            results: GpuVec::zeros(gpu, "losses", 2 * SLOTS)?,
            partial_sums: GpuVec::zeros(gpu, "sums of the losses", 0)?,
            rows: GpuVec::zeros(gpu, "images blurred along rows", 0)?,
            maps: GpuVec::zeros(gpu, "maps of the similarity", 0)?,
            settings: Uniform::new(gpu, "loss settings", &LossSettings::default()),
            left_out: GpuVec::zeros(gpu, "labels left out", 0)?,
            losses,
            total,
            leave_out,
            similarity: entries(gpu, &SSIM)?,
        })
    }

    /// Says which labels (dense index + 1) are left out where a view asks for it.
    ///
    /// # Errors
    /// When they exceed what the device binds.
    pub fn leave_out(&mut self, gpu: &Gpu, labels: &[bool]) -> Result<(), GpuError> {
        let flags: Vec<u32> = labels.iter().map(|left_out| u32::from(*left_out)).collect();
        self.left_out.replace(gpu, &flags)?;
        Ok(())
    }

    /// Results of all slots, to be read.
    #[must_use]
    pub fn results(&self) -> &GpuVec<[f32; 4]> {
        &self.results
    }

    /// Records the losses of a view; results go to `slot`. One view per submission: its settings are written at once.
    ///
    /// # Errors
    /// When the view exceeds what the device binds.
    ///
    /// # Panics
    /// When the slot is not below [`SLOTS`].
    pub fn record(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        drawn: DrawnPixels<'_>,
        target: &GpuTarget,
        weights: &LossWeights,
        slot: usize,
    ) -> Result<(), GpuError> {
        assert!(slot < SLOTS, "{slot} is no slot");
        let [width, height] = target.size;
        let pixels = width as usize * height as usize;
        let groups = pixels.div_ceil(WORKGROUP);
        let with_similarity = weights.lambda_dssim > 0.0;
        let leaves_labels = weights.leaves_out && !target.labels.is_empty();
        let leaves_out = u32::from(leaves_labels) | u32::from(weights.leaves_judged) << 1;
        self.v_colors.resize(gpu, pixels)?;
        self.partial_sums.resize(gpu, 2 * groups)?;
        self.rows.resize(gpu, if with_similarity { 5 * pixels } else { 0 })?;
        self.maps.resize(gpu, if with_similarity { 3 * pixels } else { 0 })?;
        // As on the CPU: in double precision up to the weight of a value.
        let values = (pixels * 3).max(1) as f64;
        let share = |weight: f64| (weight * f64::from(weights.view) / values) as f32;
        let taps = window();
        self.settings.write(
            gpu,
            &LossSettings {
                pixels: pixels as u32,
                width,
                slot: slot as u32,
                with_instances: u32::from(weights.with_instances && !target.labels.is_empty()),
                by_coverage: u32::from(weights.by_coverage),
                absolute_weight: share(f64::from(1.0 - weights.lambda_dssim)),
                similarity_weight: share(-f64::from(weights.lambda_dssim)),
                leaves_out,
                height,
                unused: 0,
                unused_too: [0; 2],
                window: [[taps[0], taps[1], taps[2], taps[3]], [taps[4], taps[5], 0.0, 0.0]],
            },
        );
        // Kernels of one file share its bindings.
        let bindings = [
            self.settings.binding(),
            drawn.colors.binding(),
            drawn.blended.binding(),
            target.colors.binding(),
            target.labels.binding(),
            self.v_colors.binding(),
            self.partial_sums.binding(),
            self.results.binding(),
        ];
        let losses = self.losses.bind(gpu, &bindings);
        let similarity = with_similarity.then(|| {
            let [first, ..] = &self.similarity;
            first.bind(
                gpu,
                &[
                    self.settings.binding(),
                    drawn.colors.binding(),
                    target.colors.binding(),
                    self.rows.binding(),
                    self.maps.binding(),
                    self.v_colors.binding(),
                    self.partial_sums.binding(),
                ],
            )
        });
        let leave_out = (leaves_out != 0).then(|| {
            self.leave_out.bind(
                gpu,
                &[
                    self.settings.binding(),
                    target.labels.binding(),
                    self.left_out.binding(),
                    self.v_colors.binding(),
                ],
            )
        });
        commands.stage("losses", |stage| {
            stage.dispatch(&self.losses, &losses, workgroups(pixels, WORKGROUP));
            if let Some(bind_group) = &similarity {
                for kernel in &self.similarity {
                    stage.dispatch(kernel, bind_group, workgroups(pixels, WORKGROUP));
                }
            }
            if let Some(bind_group) = &leave_out {
                stage.dispatch(&self.leave_out, bind_group, workgroups(pixels, WORKGROUP));
            }
            stage.dispatch(&self.total, &losses, [1, 1, 1]);
        });
        Ok(())
    }
}

/// Losses of a view, read from its slot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewLoss {
    /// Colour loss and mean squared error.
    pub color: ColorLoss,
    /// Summed instance loss over the labelled pixels.
    pub instance_sum: f64,
    /// Labelled pixels that no covering Gaussian supports.
    pub unsupported: f64,
}

impl ViewLoss {
    /// From the two vectors of a slot.
    #[must_use]
    pub fn new([sums, similarity]: [[f32; 4]; 2], pixels: usize, lambda_dssim: f32) -> Self {
        let values = (pixels * 3).max(1) as f64;
        let share = f64::from(lambda_dssim);
        let [absolute, squared, instance, unsupported] = sums.map(f64::from);
        let mut loss = (1.0 - share) * absolute / values;
        if lambda_dssim > 0.0 {
            loss += share * (1.0 - f64::from(similarity[0]) / values);
        }
        Self {
            color: ColorLoss { loss, mean_squared_error: squared / values },
            instance_sum: instance,
            unsupported,
        }
    }
}
