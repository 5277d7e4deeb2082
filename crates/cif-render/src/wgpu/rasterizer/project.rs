//! Projection, depth order and tile counts, and the gradients of the posed Gaussians.

use super::Rasterizer;
use super::inputs::{Coefficients, PosedGaussians, PosedInput, ViewInput};
use crate::wgpu::buffers::GpuVec;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::identities::DeviceIdentities;
use crate::wgpu::kernel::{Commands, workgroups};
use crate::wgpu::sort::Count;
use crate::wgpu::stages::{PROJECT_BACKWARD_TURNED, PROJECT_PACKED, PROJECT_TURNED, entries};
use crate::wgpu::view::View;

impl Rasterizer {
    /// Records projection, depth order and tile counts of a view. Views of one rasterizer go into submissions of
    /// their own, as they share their constants.
    ///
    /// # Errors
    /// When arrays exceed what the device binds, with the arithmetic.
    ///
    /// # Panics
    /// When labels and camera differ in size, or identities and Gaussians in number.
    pub fn project(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedInput<'_>,
        identities: Option<&DeviceIdentities>,
        input: &ViewInput<'_>,
    ) -> Result<(), GpuError> {
        let posed = PosedGaussians { geometry: gaussians.geometry, sh: gaussians.coefficients() };
        self.project_rows(gpu, commands, posed, identities, input, None)
    }

    /// As [`Self::project`], of so many `rows` of tiles from the first on where they are given. For pictures:
    /// [`Self::backward`] reads whole views and full spherical harmonics.
    ///
    /// # Errors
    /// As [`Self::project`].
    ///
    /// # Panics
    /// As [`Self::project`].
    pub(crate) fn project_rows(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedGaussians<'_>,
        identities: Option<&DeviceIdentities>,
        input: &ViewInput<'_>,
        rows: Option<[u32; 2]>,
    ) -> Result<(), GpuError> {
        self.begin_view(gpu, gaussians.geometry.len(), identities, input, rows)?;
        commands.clear(&self.arrays.work);
        self.project_splats(gpu, commands, gaussians)?;
        self.sort_by_depth(gpu, commands)?;
        self.count_tiles(gpu, commands, identities)
    }

    /// Sets the constants of a view, and makes room for what it gets per Gaussian, tile and pixel.
    fn begin_view(
        &mut self,
        gpu: &Gpu,
        n: usize,
        identities: Option<&DeviceIdentities>,
        input: &ViewInput<'_>,
        rows: Option<[u32; 2]>,
    ) -> Result<(), GpuError> {
        let mut view = View::new(input.camera, input.settings, n);
        if let Some([first, count]) = rows {
            (view.first_row, view.tiles[1]) = (first, count);
        }
        if let Some(identities) = identities {
            assert_eq!(identities.row_offsets.len(), n + 1, "a row of identities per Gaussian");
            view.instances = identities.instances as u32;
        }
        if let Some(labels) =
            input.labels.filter(|_| input.settings.instances.is_some() && identities.is_some())
        {
            assert_eq!(labels.labels.len(), view.pixels(), "label map size");
            view.label_pixels = u32::from(labels.labelled_pixels > 0);
            view.label_slots = u32::from(labels.labelled_pixels > 0 && labels.weight != 0.0);
            view.pixel_weight = labels.weight / labels.labelled_pixels.max(1) as f32;
        }
        let arrays = &mut self.arrays;
        arrays.splats.resize(gpu, n)?;
        arrays.depth.resize(gpu, n)?;
        arrays.tile_counts.resize(gpu, n)?;
        arrays.pair_offsets.resize(gpu, n + 1)?;
        arrays.slot_offsets.resize(gpu, n + 1)?;
        arrays.tile_ranges.resize(gpu, view.tile_count())?;
        arrays.colors.resize(gpu, view.pixels())?;
        arrays.blended.resize(gpu, view.pixels())?;
        view.pair_capacity = arrays.entries.len() as u32;
        view.slot_capacity = arrays.label_mass.len() as u32;
        self.view = view;
        self.uniform.write(gpu, &view);
        Ok(())
    }

    /// Records the splats of the Gaussians, with the kernel for the form that their spherical harmonics have.
    fn project_splats(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedGaussians<'_>,
    ) -> Result<(), GpuError> {
        let PosedGaussians { geometry, sh } = gaussians;
        let (sh, turns, variant) = match sh {
            Coefficients::Full(sh) => (sh.buffer(), None, 0),
            Coefficients::Packed(sh) => (sh.buffer(), None, 1),
            Coefficients::Turned(sh, turns) => (sh.buffer(), Some(turns.buffer()), 2),
        };
        if variant == 1 && self.kernels.project_packed.is_none() {
            let [kernel] = entries(gpu, &PROJECT_PACKED)?;
            self.kernels.project_packed = Some(kernel);
        }
        if variant == 2 && self.kernels.turned.is_none() {
            let [[forward], [backward]] =
                [entries(gpu, &PROJECT_TURNED)?, entries(gpu, &PROJECT_BACKWARD_TURNED)?];
            self.kernels.turned = Some([forward, backward]);
        }
        let kernel = match (variant, &self.kernels.project_packed, &self.kernels.turned) {
            (1, Some(packed), _) => packed,
            (2, _, Some([turned, _])) => turned,
            _ => &self.kernels.project,
        };
        let arrays = &self.arrays;
        let mut buffers = vec![
            self.uniform.buffer(),
            geometry.buffer(),
            sh,
            arrays.splats.buffer(),
            arrays.depth.keys[0].buffer(),
            arrays.depth.values[0].buffer(),
        ];
        buffers.extend(turns);
        let project = self.cache.get(gpu, ("project", variant), kernel, &buffers);
        commands.stage("project", |stage| stage.dispatch(kernel, &project, workgroups(geometry.len(), 64)));
        Ok(())
    }

    fn sort_by_depth(&mut self, gpu: &Gpu, commands: &mut Commands<'_>) -> Result<(), GpuError> {
        let n = self.view.gaussians as usize;
        let mut sorted = Ok(0);
        commands.stage("sort by depth", |stage| {
            sorted = self.sort.record(
                gpu,
                &mut self.cache,
                stage,
                &mut self.scan,
                "depth",
                &self.arrays.depth,
                Count::Host(n),
                32,
                &self.arrays.work,
            );
        });
        self.depth_result = sorted?;
        Ok(())
    }

    /// Records how many tiles and label slots each splat has, and where in their lists it begins.
    fn count_tiles(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
    ) -> Result<(), GpuError> {
        let (arrays, n) = (&self.arrays, self.view.gaussians as usize);
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let bindings = arrays.bin_bindings(self.uniform.buffer(), self.depth_result, rows);
        let bin = self.cache.get(gpu, ("bin", 0), &self.kernels.count, &bindings);
        let mut scanned = Ok(());
        commands.stage("bin", |stage| {
            stage.dispatch(&self.kernels.count, &bin, workgroups(n, 64));
            stage.dispatch(&self.kernels.gather, &bin, workgroups(n + 1, 64));
            for (index, offsets) in [&arrays.pair_offsets, &arrays.slot_offsets].into_iter().enumerate() {
                if scanned.is_ok() {
                    scanned = self.scan.record(
                        gpu,
                        &mut self.cache,
                        stage,
                        ("offsets", index as u32),
                        offsets,
                        Count::Host(n + 1),
                        n + 1,
                        &arrays.work,
                    );
                }
            }
        });
        scanned
    }

    /// Records the gradients of the posed Gaussians, from those of their splats.
    pub(crate) fn project_backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedInput<'_>,
    ) {
        let (arrays, gradients) = (&self.arrays, &self.gradients);
        let (variant, kernel) = match (gaussians.turns, &self.kernels.turned) {
            (Some(_), Some([_, turned])) => (1, turned),
            _ => (0, &self.kernels.project_backward),
        };
        let mut buffers = vec![
            self.uniform.buffer(),
            gaussians.geometry.buffer(),
            gaussians.sh.buffer(),
            arrays.splats.buffer(),
            arrays.splat_gradients.buffer(),
            gradients.gaussians.geometry.buffer(),
            gradients.gaussians.sh.buffer(),
            gradients.screen.buffer(),
        ];
        buffers.extend(gaussians.turns.map(GpuVec::buffer));
        let project = self.cache.get(gpu, ("project_backward", variant), kernel, &buffers);
        commands.stage("project backward", |stage| {
            stage.dispatch(kernel, &project, workgroups(self.view.gaussians as usize, 64));
        });
    }
}
