//! Values per Gaussian blended over the view whose tiles were listed, and their gradients.

use super::Rasterizer;
use super::inputs::PosedInput;
use crate::wgpu::blend::BlendKernels;
use crate::wgpu::buffers::GpuVec;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::kernel::{Commands, workgroups};
use crate::wgpu::view::OCCUPANCY_NONE;
use crate::{BlendRequest, Blending, GeometryPath};

/// Inputs of gradients through blending weights, in addition to those of the values.
#[derive(Clone, Copy, Debug)]
pub struct BlendWeightGradients<'a> {
    /// The Gaussians of the view.
    pub gaussians: PosedInput<'a>,
    /// The same request blended over the view.
    pub blended: &'a GpuVec<f32>,
    /// Geometry that they reach; the opacity logit, or that of the occupancy, they always do.
    pub geometry: GeometryPath,
}

impl Rasterizer {
    /// Records the blending of values over the view whose tiles were listed last, into `[height, width, C]`.
    ///
    /// # Errors
    /// When the image exceeds what the device binds, with the arithmetic; when the driver rejects the kernels.
    ///
    /// # Panics
    /// When there are not C values of every Gaussian, or for [`Blending::Own`] when the view has no instances.
    pub fn blend(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        request: &BlendRequest<'_, GpuVec<f32>>,
        blended: &mut GpuVec<f32>,
    ) -> Result<(), GpuError> {
        blended.resize(gpu, self.view.pixels() * request.channels)?;
        let (kernels, chunks) = self.blend_kernels(gpu, request, GeometryPath::Off)?;
        for chunk in chunks {
            let bound = self.cache.get(
                gpu,
                ("blend", chunk as u32),
                &kernels.blend,
                &[
                    self.uniform.buffer(),
                    self.arrays.splats.buffer(),
                    self.arrays.entries.buffer(),
                    self.arrays.tile_ranges.buffer(),
                    kernels.chunks[chunk].1.buffer(),
                    request.values.buffer(),
                    blended.buffer(),
                ],
            );
            let [columns, rows] = self.view.tiles;
            commands.stage("blend", |stage| stage.dispatch(&kernels.blend, &bound, [columns, rows, 1]));
        }
        self.blend = Some(kernels);
        Ok(())
    }

    /// Records the gradients of values that were blended over the view whose tiles were listed last: `v_blended` is
    /// dL/dblended, `[height, width, C]`, and dL/dvalues is added to `v_values`, `[N, C]`. Gradients go through the
    /// blending weights only with `weights`, and cost nothing without; they replace [`Self::gradients`].
    ///
    /// # Errors
    /// When arrays exceed what the device binds, with the arithmetic; when the driver rejects the kernels.
    ///
    /// # Panics
    /// As [`Self::blend`], and when sizes differ from the view.
    pub fn blend_backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        request: &BlendRequest<'_, GpuVec<f32>>,
        v_blended: &GpuVec<f32>,
        v_values: &GpuVec<f32>,
        weights: Option<BlendWeightGradients<'_>>,
    ) -> Result<(), GpuError> {
        assert_eq!(v_blended.len(), self.view.pixels() * request.channels, "cotangent size");
        assert_eq!(v_values.len(), request.values.len(), "gradient size");
        self.reserve_sums(gpu)?;
        if let Some(weights) = &weights {
            assert_eq!(weights.blended.len(), v_blended.len(), "size of the blended image");
            self.reserve_gradients(gpu)?;
        }
        let variant = usize::from(weights.is_some());
        let geometry = weights.map_or(GeometryPath::Off, |weights| weights.geometry);
        let (kernels, chunks) = self.blend_kernels(gpu, request, geometry)?;
        let (backward, gather) = (&kernels.backward[variant], &kernels.gather[variant]);
        for chunk in chunks {
            let arrays = &self.arrays;
            let (view, constants) = (self.uniform.buffer(), kernels.chunks[chunk].1.buffer());
            let place = 2 * chunk as u32 + variant as u32;
            let of_tiles = self.cache.get(
                gpu,
                ("blend_backward", place),
                backward,
                &[
                    view,
                    arrays.splats.buffer(),
                    arrays.entries.buffer(),
                    arrays.tile_ranges.buffer(),
                    constants,
                    request.values.buffer(),
                    v_blended.buffer(),
                    weights.map_or(v_blended, |weights| weights.blended).buffer(),
                    arrays.pair_sums.buffer(),
                ],
            );
            let of_splats = self.cache.get(
                gpu,
                ("gather_values", place),
                gather,
                &[
                    view,
                    constants,
                    arrays.splats.buffer(),
                    arrays.depth.values[self.depth_result].buffer(),
                    arrays.pair_offsets.buffer(),
                    arrays.pairs.buffer(),
                    arrays.pair_sums.buffer(),
                    arrays.work.buffer(),
                    v_values.buffer(),
                    arrays.splat_gradients.buffer(),
                ],
            );
            let ([columns, rows], n) = (self.view.tiles, self.view.gaussians as usize);
            commands.stage("blend backward", |stage| {
                stage.dispatch(backward, &of_tiles, [columns, rows, 1]);
                stage.dispatch(gather, &of_splats, workgroups(n, 64));
            });
        }
        if let Some(weights) = weights {
            self.project_backward(gpu, commands, weights.gaussians);
        }
        self.blend = Some(kernels);
        Ok(())
    }

    /// The kernels, taken out until they are put back, and the chunks of a request.
    fn blend_kernels(
        &mut self,
        gpu: &Gpu,
        request: &BlendRequest<'_, GpuVec<f32>>,
        geometry: GeometryPath,
    ) -> Result<(BlendKernels, Vec<usize>), GpuError> {
        let n = self.view.gaussians as usize;
        assert!(request.channels > 0, "at least one channel");
        assert_eq!(request.values.len(), n * request.channels, "values of every Gaussian");
        assert!(
            request.blending == Blending::Color || self.view.occupancy != OCCUPANCY_NONE,
            "the view was projected with instances"
        );
        let mut kernels = match self.blend.take() {
            Some(kernels) => kernels,
            None => BlendKernels::compile(gpu)?,
        };
        let chunks = kernels.chunks(gpu, request, geometry);
        Ok((kernels, chunks))
    }
}
