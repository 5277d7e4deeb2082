//! Strings the stages together, forward and backward, on one device.
//!
//! A view goes through [`Rasterizer::project`] and [`Rasterizer::rasterize`], then
//! [`Rasterizer::render_instances`] or [`Rasterizer::backward`]; other values per Gaussian through
//! [`Rasterizer::list_tiles`], which rasterizing begins with, [`Rasterizer::blend`] and
//! [`Rasterizer::blend_backward`]. Each records commands; nothing waits but [`Rasterizer::measure`], which makes room
//! for the pairs of a view. A trainer does not wait: it reads [`Rasterizer::counts`] when they arrive, and draws a
//! view again whose pairs did not fit, for it drew nothing.
//!
//! Memory grows with need: per Gaussian 64 + 4 x 9 bytes for a view and 48 + 48 + 192 + 16 for gradients, per pair 40
//! and 48, per label slot 4, per pixel 32 and 48.

use cif_field::gaussians::SH_FLOATS;
use cif_geometry::PinholeCamera;

use super::blend::BlendKernels;
use super::buffers::{GpuVec, Recorded, Uniform};
use super::cache::BindCache;
use super::device::Gpu;
use super::error::GpuError;
use super::gaussians::{GEOMETRY_FLOATS, GpuGaussians, PACKED_SH_WORDS};
use super::identities::DeviceIdentities;
use super::kernel::{Commands, workgroups};
use super::sort::{Count, RadixSort, Scan, SortArrays};
use super::stages::{Kernels, PROJECT_BACKWARD_TURNED, PROJECT_PACKED, PROJECT_TURNED, entries};
use super::view::{PAIR_SUMS, Splat, View, work};
use crate::RenderSettings;

/// Labels of a view on the device.
#[derive(Clone, Copy, Debug)]
pub struct LabelInput<'a> {
    /// Dense instance index + 1 per pixel, 0 = unlabelled.
    pub labels: &'a GpuVec<u32>,
    /// Number of labelled pixels.
    pub labelled_pixels: usize,
    /// Weight of the view's mean instance loss; 0 differentiates nothing.
    pub weight: f32,
}

/// Gaussians at the time of a view.
#[derive(Clone, Copy, Debug)]
pub struct PosedInput<'a> {
    /// As in [`GpuGaussians::geometry`].
    pub geometry: &'a GpuVec<[f32; GEOMETRY_FLOATS]>,
    /// As in [`GpuGaussians::sh`].
    pub sh: &'a GpuVec<[f32; SH_FLOATS]>,
    /// Turns of the frames that the spherical harmonics are in, unit quaternions (w, x, y, z); `None` where all are
    /// in that of the world.
    pub turns: Option<&'a GpuVec<[f32; 4]>>,
}

impl<'a> From<&'a GpuGaussians> for PosedInput<'a> {
    fn from(gaussians: &'a GpuGaussians) -> Self {
        Self { geometry: &gaussians.geometry, sh: &gaussians.sh, turns: None }
    }
}

impl<'a> PosedInput<'a> {
    pub(super) fn coefficients(self) -> Coefficients<'a> {
        self.turns.map_or(Coefficients::Full(self.sh), |turns| Coefficients::Turned(self.sh, turns))
    }
}

/// Spherical harmonics at the time of a view.
#[derive(Clone, Copy, Debug)]
pub(super) enum Coefficients<'a> {
    /// As in [`GpuGaussians::sh`].
    Full(&'a GpuVec<[f32; SH_FLOATS]>),
    /// As [`super::gaussians::packed_sh`] makes them.
    Packed(&'a GpuVec<[u32; PACKED_SH_WORDS]>),
    /// As in [`GpuGaussians::sh`], in frames that are turned as in [`PosedInput::turns`].
    Turned(&'a GpuVec<[f32; SH_FLOATS]>, &'a GpuVec<[f32; 4]>),
}

/// A view to be drawn.
#[derive(Clone, Copy, Debug)]
pub struct ViewInput<'a> {
    /// Camera.
    pub camera: &'a PinholeCamera,
    /// Settings; `deform` is not read, Gaussians are posed already.
    pub settings: &'a RenderSettings,
    /// Labels, for the instance pass of training.
    pub labels: Option<LabelInput<'a>>,
}

/// Counts of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GpuStatistics {
    /// Gaussians with a non-empty footprint in the view.
    pub visible: u32,
    /// (tile, Gaussian) pairs that there are; 2^32 - 1 stands for that many or more.
    pub wanted_pairs: u32,
    /// Label slots that there are, likewise.
    pub wanted_slots: u32,
    /// Pairs that were drawn: all, or none when they did not fit.
    pub pairs: u32,
}

impl GpuStatistics {
    /// Words of the counts.
    pub const WORDS: usize = work::LEN;
    /// Word of the pairs that there are.
    pub const WANTED_PAIRS: usize = work::WANTED_PAIRS;
    /// Word of those that were drawn.
    pub const PAIRS: usize = work::PAIRS;

    /// From the first elements of the work counts.
    #[must_use]
    pub fn of(counts: &[u32]) -> Self {
        Self {
            visible: counts[work::VISIBLE],
            wanted_pairs: counts[work::WANTED_PAIRS],
            wanted_slots: counts[work::WANTED_SLOTS],
            pairs: counts[work::PAIRS],
        }
    }

    /// True when the view was drawn.
    #[must_use]
    pub fn fits(&self) -> bool {
        self.pairs == self.wanted_pairs
    }
}

/// Gradients of the last backward pass, written over each time.
#[derive(Debug)]
pub struct PosedGradients {
    /// By the posed Gaussians, same layout.
    pub gaussians: GpuGaussians,
    /// `[N]`: gradient by the projected centre in normalised device coordinates (W / 2 v_x, H / 2 v_y), screen radius
    /// in pixels, 1 where visible.
    pub screen: GpuVec<[f32; 4]>,
    /// By the calibration of every identity entry; not written without instance loss.
    pub calibrations: GpuVec<f32>,
}

/// Arrays of a view.
#[derive(Debug)]
pub(super) struct Arrays {
    pub(super) splats: GpuVec<Splat>,
    /// Keys are depths, values Gaussians.
    pub(super) depth: SortArrays,
    tile_counts: GpuVec<u32>,
    pub(super) pair_offsets: GpuVec<u32>,
    slot_offsets: GpuVec<u32>,
    pub(super) work: GpuVec<u32>,
    /// Keys are tiles, values pairs.
    tiles: SortArrays,
    pub(super) pairs: GpuVec<[u32; 2]>,
    pub(super) entries: GpuVec<[u32; 4]>,
    pub(super) tile_ranges: GpuVec<[u32; 2]>,
    colors: GpuVec<[f32; 4]>,
    blended: GpuVec<[f32; 4]>,
    instance_images: GpuVec<[f32; 4]>,
    foregrounds: GpuVec<f32>,
    cotangents: GpuVec<[f32; 4]>,
    pub(super) pair_sums: GpuVec<f32>,
    label_mass: GpuVec<f32>,
    pub(super) splat_gradients: GpuVec<[f32; 4]>,
    /// Stand in where a view has no labels or no identities.
    no_labels: GpuVec<u32>,
    no_entries: GpuVec<[u32; 2]>,
}

impl Arrays {
    fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            splats: GpuVec::zeros(gpu, "splats", 0)?,
            depth: SortArrays::new(gpu, "depth order")?,
            tile_counts: GpuVec::zeros(gpu, "tile counts", 0)?,
            pair_offsets: GpuVec::zeros(gpu, "pair offsets", 0)?,
            slot_offsets: GpuVec::zeros(gpu, "label slot offsets", 0)?,
            work: GpuVec::zeros(gpu, "work counts", work::LEN)?,
            tiles: SortArrays::new(gpu, "pairs of tiles and Gaussians")?,
            pairs: GpuVec::zeros(gpu, "pairs of tiles and Gaussians", 0)?,
            entries: GpuVec::zeros(gpu, "tile lists", 0)?,
            tile_ranges: GpuVec::zeros(gpu, "tile ranges", 0)?,
            colors: GpuVec::zeros(gpu, "colour image", 0)?,
            blended: GpuVec::zeros(gpu, "depth and label image", 0)?,
            instance_images: GpuVec::zeros(gpu, "instance image", 0)?,
            foregrounds: GpuVec::zeros(gpu, "foreground image", 0)?,
            cotangents: GpuVec::zeros(gpu, "pixel gradients", 0)?,
            pair_sums: GpuVec::zeros(gpu, "gradients of pairs", 0)?,
            label_mass: GpuVec::zeros(gpu, "label mass of pairs", 0)?,
            splat_gradients: GpuVec::zeros(gpu, "gradients of splats", 0)?,
            no_labels: GpuVec::zeros(gpu, "no labels", 2)?,
            no_entries: GpuVec::zeros(gpu, "no identities", 1)?,
        })
    }

    /// Buffers that `bin.wgsl` binds, for its passes before pairs have room and after.
    fn bin_bindings<'a>(
        &'a self,
        uniform: &'a wgpu::Buffer,
        depth_result: usize,
        rows: &'a GpuVec<u32>,
    ) -> [&'a wgpu::Buffer; 8] {
        [
            uniform,
            self.splats.buffer(),
            self.depth.values[depth_result].buffer(),
            rows.buffer(),
            self.tile_counts.buffer(),
            self.pair_offsets.buffer(),
            self.slot_offsets.buffer(),
            self.work.buffer(),
        ]
    }
}

/// Arrays of a rasterized view.
pub(crate) struct CountingArrays<'a> {
    pub(crate) view: &'a wgpu::Buffer,
    pub(crate) splats: &'a wgpu::Buffer,
    pub(crate) depth_order: &'a wgpu::Buffer,
    pub(crate) pair_offsets: &'a wgpu::Buffer,
    pub(crate) pairs: &'a wgpu::Buffer,
    pub(crate) entries: &'a wgpu::Buffer,
    pub(crate) tile_ranges: &'a wgpu::Buffer,
    pub(crate) colors: &'a wgpu::Buffer,
    pub(crate) work: &'a wgpu::Buffer,
    pub(crate) pair_sums: &'a wgpu::Buffer,
}

/// Renders posed Gaussians on a device; keeps memory between views.
#[derive(Debug)]
pub struct Rasterizer {
    kernels: Kernels,
    scan: Scan,
    sort: RadixSort,
    pub(super) cache: BindCache,
    pub(super) uniform: Uniform<View>,
    pub(super) view: View,
    /// Which of the two depth arrays and pair arrays holds the sorted ones.
    pub(super) depth_result: usize,
    pub(super) arrays: Arrays,
    /// Compiled when values are blended first.
    pub(super) blend: Option<BlendKernels>,
    gradients: PosedGradients,
}

impl Rasterizer {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the driver rejects them.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            kernels: Kernels::compile(gpu)?,
            scan: Scan::new(gpu)?,
            sort: RadixSort::new(gpu)?,
            cache: BindCache::default(),
            uniform: Uniform::new(gpu, "view", &View::default()),
            view: View::default(),
            depth_result: 0,
            arrays: Arrays::new(gpu)?,
            blend: None,
            gradients: PosedGradients {
                gaussians: GpuGaussians::zeros(gpu, 0)?,
                screen: GpuVec::zeros(gpu, "screen gradients", 0)?,
                calibrations: GpuVec::zeros(gpu, "gradients of calibrations", 0)?,
            },
        })
    }

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
        let posed = (gaussians.geometry, gaussians.coefficients());
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
    pub(super) fn project_rows(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: (&GpuVec<[f32; GEOMETRY_FLOATS]>, Coefficients<'_>),
        identities: Option<&DeviceIdentities>,
        input: &ViewInput<'_>,
        rows: Option<[u32; 2]>,
    ) -> Result<(), GpuError> {
        let (geometry, sh) = gaussians;
        let (sh, turns, variant) = match sh {
            Coefficients::Full(sh) => (sh.buffer(), None, 0),
            Coefficients::Packed(sh) => (sh.buffer(), None, 1),
            Coefficients::Turned(sh, turns) => (sh.buffer(), Some(turns.buffer()), 2),
        };
        let n = geometry.len();
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

        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        commands.clear(&arrays.work);
        let uniform = self.uniform.buffer();
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
        let mut buffers = vec![
            uniform,
            geometry.buffer(),
            sh,
            arrays.splats.buffer(),
            arrays.depth.keys[0].buffer(),
            arrays.depth.values[0].buffer(),
        ];
        buffers.extend(turns);
        let project = self.cache.get(gpu, ("project", variant), kernel, &buffers);
        commands.stage("project", |stage| stage.dispatch(kernel, &project, workgroups(n, 64)));

        let mut sorted = Ok(0);
        commands.stage("sort by depth", |stage| {
            sorted = self.sort.record(
                gpu,
                &mut self.cache,
                stage,
                &mut self.scan,
                "depth",
                &arrays.depth,
                Count::Host(n),
                32,
                &arrays.work,
            );
        });
        self.depth_result = sorted?;
        let bin = self.cache.get(
            gpu,
            ("bin", 0),
            &self.kernels.count,
            &arrays.bin_bindings(uniform, self.depth_result, rows),
        );
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

    /// Submits what was recorded by [`Self::project`], waits for it, and makes room for the pairs of the view.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic; when the device is lost.
    pub fn measure(&mut self, gpu: &Gpu, commands: Commands<'_>) -> Result<(), GpuError> {
        commands.submit();
        let n = self.view.gaussians as usize;
        let pairs = self.arrays.pair_offsets.read_range(gpu, n, 1)?[0];
        let slots = self.arrays.slot_offsets.read_range(gpu, n, 1)?[0];
        if pairs == u32::MAX || slots == u32::MAX {
            // The sums on the device stop at 2^32 - 1: count again here, in 64 bits.
            let counts = self.arrays.tile_counts.read(gpu)?;
            let total: u64 = counts.iter().map(|count| u64::from(*count)).sum();
            let per_pair = (PAIR_SUMS * size_of::<f32>()) as u64;
            return Err(too_many_pairs(total, per_pair, gpu.largest_binding()));
        }
        self.reserve(gpu, pairs as usize, slots as usize)
    }

    /// Most pairs of a view that the device holds.
    #[must_use]
    pub fn most_pairs(gpu: &Gpu) -> usize {
        (gpu.largest_binding() / (PAIR_SUMS * size_of::<f32>()) as u64) as usize
    }

    /// Makes room for pairs and label slots; more room than asked stays.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic.
    pub fn reserve(&mut self, gpu: &Gpu, pairs: usize, slots: usize) -> Result<(), GpuError> {
        let arrays = &mut self.arrays;
        if pairs > arrays.entries.len() {
            // Half as much room on top, where the device allows, so that the next views fit too.
            let largest = Self::most_pairs(gpu);
            if pairs > largest {
                let per_pair = (PAIR_SUMS * size_of::<f32>()) as u64;
                return Err(too_many_pairs(pairs as u64, per_pair, gpu.largest_binding()));
            }
            let roomy = (pairs + pairs / 2).min(largest).max(pairs);
            arrays.entries.resize(gpu, roomy)?;
            arrays.pairs.resize(gpu, roomy)?;
            arrays.tiles.resize(gpu, roomy)?;
        }
        if slots > arrays.label_mass.len() {
            arrays.label_mass.resize(gpu, slots + slots / 2)?;
        }
        let changed = self.view.pair_capacity as usize != arrays.entries.len()
            || self.view.slot_capacity as usize != arrays.label_mass.len();
        if changed {
            self.view.pair_capacity = arrays.entries.len() as u32;
            self.view.slot_capacity = arrays.label_mass.len() as u32;
            self.uniform.write(gpu, &self.view);
        }
        Ok(())
    }

    /// Records tile lists of the projected view, without drawing colour: all that [`Self::blend`] and
    /// [`Self::blend_backward`] need, for losses that do not look at colour.
    ///
    /// # Errors
    /// When scratch memory exceeds what the device binds.
    pub fn list_tiles(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
    ) -> Result<(), GpuError> {
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let view = self.view;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let order = &arrays.depth.values[self.depth_result];
        commands.clear(&arrays.tile_ranges);
        let bin = self.cache.get(
            gpu,
            ("bin", 0),
            &kernels.count,
            &arrays.bin_bindings(uniform, self.depth_result, rows),
        );
        let emit = self.cache.get(
            gpu,
            ("emit", 0),
            &kernels.emit,
            &[
                uniform,
                arrays.splats.buffer(),
                order.buffer(),
                arrays.pair_offsets.buffer(),
                arrays.slot_offsets.buffer(),
                arrays.tiles.keys[0].buffer(),
                arrays.tiles.values[0].buffer(),
                arrays.pairs.buffer(),
            ],
        );
        // One more than there are tiles: pairs of no tile go last.
        let bits = (u32::BITS - (view.tile_count() as u32).leading_zeros()).max(1);
        let mut sorted = Ok(0);
        commands.stage("emit", |stage| {
            stage.dispatch(&kernels.plan, &bin, [1, 1, 1]);
            stage.dispatch_indirect(&kernels.emit, &emit, &arrays.work, work::BY_RANK);
        });
        commands.stage("sort by tile", |stage| {
            sorted = self.sort.record(
                gpu,
                &mut self.cache,
                stage,
                &mut self.scan,
                "tiles",
                &arrays.tiles,
                Count::Pairs,
                bits,
                &arrays.work,
            );
        });
        let sorted = sorted?;
        let ranges = self.cache.get(
            gpu,
            ("ranges", 0),
            &kernels.ranges,
            &[
                uniform,
                arrays.work.buffer(),
                arrays.tiles.keys[sorted].buffer(),
                arrays.tiles.values[sorted].buffer(),
                arrays.pairs.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
            ],
        );
        commands.stage("ranges", |stage| {
            stage.dispatch_indirect(&kernels.ranges, &ranges, &arrays.work, work::BY_PAIR);
        });
        Ok(())
    }

    /// Records tile lists and blending of the projected view.
    ///
    /// # Errors
    /// As [`Self::list_tiles`].
    pub fn rasterize(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
        labels: Option<LabelInput<'_>>,
    ) -> Result<(), GpuError> {
        self.list_tiles(gpu, commands, identities)?;
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let view = self.view;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let identity_entries = identities.map_or(&arrays.no_entries, |identities| &identities.entries);
        let label_map = labels.map_or(&arrays.no_labels, |labels| labels.labels);
        let (variant, kernel) = match view.label_pixels {
            0 => (0, &kernels.rasterize_color),
            _ => (1, &kernels.rasterize),
        };
        let rasterize = self.cache.get(
            gpu,
            ("rasterize", variant),
            kernel,
            &[
                uniform,
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                label_map.buffer(),
                rows.buffer(),
                identity_entries.buffer(),
                arrays.colors.buffer(),
                arrays.blended.buffer(),
            ],
        );
        commands.stage("rasterize", |stage| {
            stage.dispatch(kernel, &rasterize, [view.tiles[0], view.tiles[1], 1]);
        });
        Ok(())
    }

    /// Records the instance images of the rasterized view.
    ///
    /// # Errors
    /// When they exceed what the device binds.
    pub fn render_instances(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: &DeviceIdentities,
    ) -> Result<(), GpuError> {
        let view = self.view;
        self.arrays.instance_images.resize(gpu, view.pixels())?;
        self.arrays.foregrounds.resize(gpu, view.pixels())?;
        let arrays = &self.arrays;
        let dense = self.cache.get(
            gpu,
            ("dense", 0),
            &self.kernels.dense,
            &[
                self.uniform.buffer(),
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                identities.row_offsets.buffer(),
                identities.entries.buffer(),
                identities.labelled_shares.buffer(),
                arrays.instance_images.buffer(),
                arrays.foregrounds.buffer(),
            ],
        );
        commands.stage("dense", |stage| {
            stage.dispatch(&self.kernels.dense, &dense, [2 * view.tiles[0], 2 * view.tiles[1], 1]);
        });
        Ok(())
    }

    /// Records the gradients of the rasterized view: `v_colors` is dL/dcolour per pixel (the fourth number is not
    /// read), and the instance loss counts as the view's labels said.
    ///
    /// # Errors
    /// When arrays exceed what the device binds, with the arithmetic.
    ///
    /// # Panics
    /// When `v_colors` and the view differ in size.
    pub fn backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedInput<'_>,
        identities: Option<&DeviceIdentities>,
        labels: Option<LabelInput<'_>>,
        v_colors: &GpuVec<[f32; 4]>,
    ) -> Result<(), GpuError> {
        let view = self.view;
        let n = view.gaussians as usize;
        assert_eq!(v_colors.len(), view.pixels(), "cotangent size");
        let arrays = &mut self.arrays;
        arrays.cotangents.resize(gpu, 2 * view.pixels())?;
        self.reserve_sums(gpu)?;
        self.reserve_gradients(gpu)?;
        if let Some(identities) = identities {
            self.gradients.calibrations.resize(gpu, identities.entries.len())?;
        }
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let identity_entries = identities.map_or(&arrays.no_entries, |identities| &identities.entries);
        let label_map = labels.map_or(&arrays.no_labels, |labels| labels.labels);
        let order = &arrays.depth.values[self.depth_result];

        let cotangents = self.cache.get(
            gpu,
            ("cotangents", 0),
            &kernels.cotangents,
            &[
                uniform,
                arrays.colors.buffer(),
                arrays.blended.buffer(),
                label_map.buffer(),
                v_colors.buffer(),
                arrays.cotangents.buffer(),
            ],
        );
        commands.stage("cotangents", |stage| {
            stage.dispatch(&kernels.cotangents, &cotangents, workgroups(view.pixels(), 64));
        });
        let (variant, kernel) = match view.label_slots {
            0 => (0, &kernels.rasterize_backward_color),
            _ => (1, &kernels.rasterize_backward),
        };
        let backward = self.cache.get(
            gpu,
            ("rasterize_backward", variant),
            kernel,
            &[
                uniform,
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                rows.buffer(),
                identity_entries.buffer(),
                arrays.cotangents.buffer(),
                arrays.pair_sums.buffer(),
                arrays.label_mass.buffer(),
            ],
        );
        commands.stage("rasterize backward", |stage| {
            stage.dispatch(kernel, &backward, [view.tiles[0], view.tiles[1], 1]);
        });
        let gather = self.cache.get(
            gpu,
            ("gather_gradients", 0),
            &kernels.gather_gradients,
            &[
                uniform,
                arrays.splats.buffer(),
                order.buffer(),
                arrays.pair_offsets.buffer(),
                arrays.pairs.buffer(),
                arrays.pair_sums.buffer(),
                arrays.work.buffer(),
                arrays.splat_gradients.buffer(),
            ],
        );
        commands.stage("gather gradients", |stage| {
            stage.dispatch(&kernels.gather_gradients, &gather, workgroups(n, 64));
        });
        self.project_backward(gpu, commands, gaussians);
        let (arrays, kernels, gradients) = (&self.arrays, &self.kernels, &self.gradients);
        let (uniform, order) = (self.uniform.buffer(), &arrays.depth.values[self.depth_result]);
        if let Some(identities) = identities.filter(|_| view.label_slots != 0) {
            let identity = self.cache.get(
                gpu,
                ("identity_backward", 0),
                &kernels.identity_backward,
                &[
                    uniform,
                    order.buffer(),
                    arrays.slot_offsets.buffer(),
                    identities.row_offsets.buffer(),
                    identities.entries.buffer(),
                    arrays.label_mass.buffer(),
                    arrays.work.buffer(),
                    gradients.calibrations.buffer(),
                ],
            );
            commands.stage("identity backward", |stage| {
                stage.dispatch(&kernels.identity_backward, &identity, workgroups(n, 64));
            });
        }
        Ok(())
    }

    /// Makes room for gradients of splats and Gaussians.
    pub(super) fn reserve_gradients(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let n = self.view.gaussians as usize;
        self.arrays.splat_gradients.resize(gpu, 3 * n)?;
        self.gradients.gaussians.geometry.resize(gpu, n)?;
        self.gradients.gaussians.sh.resize(gpu, n)?;
        self.gradients.screen.resize(gpu, n)?;
        Ok(())
    }

    /// Records the gradients of the posed Gaussians, from those of their splats.
    pub(super) fn project_backward(
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

    /// Records a read-back of the counts of the view, for [`GpuStatistics::of`].
    pub fn read_statistics(&self, gpu: &Gpu, commands: &mut Commands<'_>) -> Recorded<u32> {
        self.arrays.work.read_later(gpu, commands.encoder(), 0, work::LEN)
    }

    /// Counts of the view, for [`GpuStatistics::of`].
    #[must_use]
    pub fn counts(&self) -> &GpuVec<u32> {
        &self.arrays.work
    }

    /// Constants of the view, its splats, tile lists and pairs, as [`super::GpuIdentityCounts`] reads them.
    pub(crate) fn for_counting(&self) -> CountingArrays<'_> {
        let arrays = &self.arrays;
        CountingArrays {
            view: self.uniform.buffer(),
            splats: arrays.splats.buffer(),
            depth_order: arrays.depth.values[self.depth_result].buffer(),
            pair_offsets: arrays.pair_offsets.buffer(),
            pairs: arrays.pairs.buffer(),
            entries: arrays.entries.buffer(),
            tile_ranges: arrays.tile_ranges.buffer(),
            colors: arrays.colors.buffer(),
            work: arrays.work.buffer(),
            pair_sums: arrays.pair_sums.buffer(),
        }
    }

    /// Makes room for the sums of pairs.
    pub(crate) fn reserve_sums(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.arrays.pair_sums.resize(gpu, PAIR_SUMS * self.arrays.entries.len())?;
        Ok(())
    }

    /// Constants of the view.
    #[must_use]
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Splats of the view, by Gaussian.
    #[must_use]
    pub fn splats(&self) -> &GpuVec<Splat> {
        &self.arrays.splats
    }

    /// Per pixel: colour composited on the background, and final transmittance.
    #[must_use]
    pub fn colors(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.colors
    }

    /// Per pixel: blended depth D, probability M_y of the pixel's label, final instance transmittance, and the
    /// position in the list of the tile after the last splat that supports the label.
    #[must_use]
    pub fn blended(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.blended
    }

    /// Per pixel: most probable label (dense index + 1, 0 = none), its probability, coverage, entropy in nats.
    #[must_use]
    pub fn instance_images(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.instance_images
    }

    /// Per pixel: labelled shares, blended like colour.
    #[must_use]
    pub fn foregrounds(&self) -> &GpuVec<f32> {
        &self.arrays.foregrounds
    }

    /// Gradients of the splats, three rows each; of Gaussians whose harmonics are in turned frames, the first of them
    /// holds the gradient by the turn that comes through the colour, once the backward pass is done.
    pub(super) fn splat_gradients(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.splat_gradients
    }

    /// Gradients of the last backward pass.
    #[must_use]
    pub fn gradients(&self) -> &PosedGradients {
        &self.gradients
    }

    /// Order of Gaussians, nearest first, those that draw nothing last.
    #[must_use]
    pub fn depth_order(&self) -> &GpuVec<u32> {
        &self.arrays.depth.values[self.depth_result]
    }

    /// Range of every tile in [`Self::entries`].
    #[must_use]
    pub fn tile_ranges(&self) -> &GpuVec<[u32; 2]> {
        &self.arrays.tile_ranges
    }

    /// Pairs by tile and depth: pair, splat with passes in the two highest bits, first label slot, 0.
    #[must_use]
    pub fn entries(&self) -> &GpuVec<[u32; 4]> {
        &self.arrays.entries
    }
}

/// The refusal of more pairs than the device can hold.
fn too_many_pairs(count: u64, item_bytes: u64, limit: u64) -> GpuError {
    GpuError::TooLarge {
        what: "pairs of tiles and Gaussians of one view".to_owned(),
        count,
        item_bytes,
        bytes: u128::from(count) * u128::from(item_bytes),
        limit,
        advice: "a smaller image or fewer, smaller Gaussians".to_owned(),
    }
}
