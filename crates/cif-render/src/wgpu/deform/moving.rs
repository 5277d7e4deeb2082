//! Gaussians that the network moves, where others stand still.

use cif_field::gaussians::SH_FLOATS;

use crate::wgpu::gaussians::GEOMETRY_FLOATS;
use crate::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuVec, Kernel, Uniform, workgroups};

crate::shared_struct! {
    /// Parameters of the kernels that gather and scatter moving rows.
    pub struct Moving {
        /// Rows that move.
        pub rows: u32,
        /// Gaussians N.
        pub gaussians: u32,
        /// Floats of a row.
        pub width: u32,
        /// Pads to 16 bytes.
        pub unused: u32,
    }
}

/// Threads of a workgroup.
const THREADS: usize = 256;

/// The rows that move and arrays of them, without gaps.
#[derive(Debug)]
pub(super) struct MovingRows {
    rows: GpuVec<u32>,
    places: GpuVec<u32>,
    geometry: Uniform<Moving>,
    sh: Uniform<Moving>,
    pub(super) canonical: GpuGaussians,
    pub(super) posed: GpuGaussians,
    pub(super) v_posed: GpuGaussians,
    pub(super) v_canonical: GpuGaussians,
    take: Kernel,
    put: Kernel,
    put_gradients: Kernel,
    no_faults: GpuVec<u32>,
    moves_sh: bool,
}

/// Buffers between which rows are copied.
struct CopiedRows<'a> {
    source: &'a wgpu::Buffer,
    target: &'a wgpu::Buffer,
    /// Gradients that `put_gradients` reads; any buffer for the others.
    v_posed: &'a wgpu::Buffer,
    /// Fault words; see [`crate::wgpu::faults`].
    faults: &'a wgpu::Buffer,
}

impl MovingRows {
    /// `kernels` are those of the file.
    pub(super) fn new(
        gpu: &Gpu,
        [take, put, put_gradients]: [Kernel; 3],
        still: &[bool],
        moves_sh: bool,
    ) -> Result<Self, GpuError> {
        let moving: Vec<u32> = (0..still.len() as u32).filter(|row| !still[*row as usize]).collect();
        let mut places = vec![0; still.len()];
        for (place, row) in moving.iter().enumerate() {
            places[*row as usize] = place as u32 + 1;
        }
        let m = moving.len();
        let uniform = |width: usize| {
            let value =
                Moving { rows: m as u32, gaussians: still.len() as u32, width: width as u32, unused: 0 };
            Uniform::new(gpu, "moving rows", &value)
        };
        let arrays = || -> Result<GpuGaussians, GpuError> {
            Ok(GpuGaussians {
                geometry: GpuVec::zeros(gpu, "geometry of the moving Gaussians", m)?,
                sh: GpuVec::zeros(
                    gpu,
                    "spherical harmonics of the moving Gaussians",
                    if moves_sh { m } else { 0 },
                )?,
            })
        };
        Ok(Self {
            rows: GpuVec::from_slice(gpu, "moving rows", &moving)?,
            places: GpuVec::from_slice(gpu, "places of the moving rows", &places)?,
            geometry: uniform(GEOMETRY_FLOATS),
            sh: uniform(SH_FLOATS),
            canonical: arrays()?,
            posed: arrays()?,
            v_posed: arrays()?,
            v_canonical: arrays()?,
            take,
            put,
            put_gradients,
            no_faults: GpuVec::zeros(gpu, "no faults", super::super::faults::WORDS)?,
            moves_sh,
        })
    }

    /// Number of Gaussians that move.
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    fn bind(
        &self,
        gpu: &Gpu,
        kernel: &Kernel,
        uniform: &Uniform<Moving>,
        copied: &CopiedRows<'_>,
    ) -> wgpu::BindGroup {
        kernel.bind(
            gpu,
            &[
                uniform.binding(),
                self.rows.binding(),
                self.places.binding(),
                copied.source.as_entire_binding(),
                copied.target.as_entire_binding(),
                copied.v_posed.as_entire_binding(),
                copied.faults.as_entire_binding(),
            ],
        )
    }

    /// Moves rows between an array of all Gaussians and one without gaps.
    fn copy(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        kernel: &Kernel,
        source: &GpuGaussians,
        target: &GpuGaussians,
    ) {
        let nothing = self.places.buffer();
        let pairs = [
            (&self.geometry, source.geometry.buffer(), target.geometry.buffer(), GEOMETRY_FLOATS, true),
            (&self.sh, source.sh.buffer(), target.sh.buffer(), SH_FLOATS, !self.canonical.sh.is_empty()),
        ];
        for (uniform, source, target, width, needed) in pairs {
            if needed {
                let faults = self.no_faults.buffer();
                let copied = CopiedRows { source, target, v_posed: nothing, faults };
                let group = self.bind(gpu, kernel, uniform, &copied);
                commands.stage("deform", |stage| {
                    stage.dispatch(kernel, &group, workgroups(self.len() * width, THREADS));
                });
            }
        }
    }

    /// Canonical rows, before the forward pass.
    pub(super) fn take_canonical(&self, gpu: &Gpu, commands: &mut Commands<'_>, all: &GpuGaussians) {
        self.copy(gpu, commands, &self.take, all, &self.canonical);
    }

    /// Posed Gaussians after it: what stands still is posed as it is.
    pub(super) fn put_posed(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        canonical: &GpuGaussians,
        posed: &GpuGaussians,
    ) {
        commands.copy(&canonical.geometry, &posed.geometry);
        if self.moves_sh {
            commands.copy(&canonical.sh, &posed.sh);
        }
        self.copy(gpu, commands, &self.put, &self.posed, posed);
    }

    /// Gradients before the backward pass.
    pub(super) fn take_gradients(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        v_posed: &GpuGaussians,
        v_canonical: &GpuGaussians,
    ) {
        self.copy(gpu, commands, &self.take, v_posed, &self.v_posed);
        let copied = CopiedRows {
            source: v_canonical.geometry.buffer(),
            target: self.v_canonical.geometry.buffer(),
            v_posed: self.places.buffer(),
            faults: self.no_faults.buffer(),
        };
        let group = self.bind(gpu, &self.take, &self.geometry, &copied);
        commands.stage("deform", |stage| {
            stage.dispatch(&self.take, &group, workgroups(self.len() * GEOMETRY_FLOATS, THREADS));
        });
    }

    /// Gradients of the canonical geometry after it.
    pub(super) fn put_gradients(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        v_posed: &GpuGaussians,
        v_canonical: &GpuGaussians,
        faults: &GpuVec<u32>,
    ) {
        let copied = CopiedRows {
            source: self.v_canonical.geometry.buffer(),
            target: v_canonical.geometry.buffer(),
            v_posed: v_posed.geometry.buffer(),
            faults: faults.buffer(),
        };
        let group = self.bind(gpu, &self.put_gradients, &self.geometry, &copied);
        let floats = v_canonical.len() * GEOMETRY_FLOATS;
        commands.stage("deform backward: planes", |stage| {
            stage.dispatch(&self.put_gradients, &group, workgroups(floats, THREADS));
        });
    }
}
