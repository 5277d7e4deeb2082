//! The deformation on the device: the stages of `cpu/deform` as kernels.
//!
//! | file | stage |
//! |---|---|
//! | `deform_prepare.wgsl` | lines from time planes, weights in the layers' orders |
//! | `deform.wgsl` | canonical Gaussians to the time of a view |
//! | `deform_backward.wgsl` | gradients of the network's activations |
//! | `deform_backward_weights.wgsl` | gradients of its weights and biases |
//! | `deform_planes_backward.wgsl` | gradients of planes, lines and canonical centres |
//! | `deform_lines_backward.wgsl` | gradients of lines to the time planes |
//! | `deform_moving.wgsl`, `moving` | Gaussians that stand still, which the network leaves alone |
//! | `hexplane.wgsl`, `network.wgsl`, `fixed_point.wgsl` | what they share |
//! | `shape` | constants and tables that follow from a configuration |
//!
//! Results are the same on every run: weights are summed in fixed parts and order, planes in 64-bit fixed point.

mod moving;
mod shape;

use cif_field::Deformation as FieldDeformation;

use self::moving::MovingRows;
use super::faults::FAULTS;
use super::gaussians::GpuGaussians;
use super::rasterizer::PosedInput;
use super::{
    Commands, Gpu, GpuError, GpuVec, Kernel, Layout, Module, Shared, Snippet, Uniform, structures, workgroups,
};
pub use moving::Moving;
pub use shape::{Deformation, Layers, Moment, SPLITS, Shape};

const DEFORMATION: Snippet = Snippet { name: "deformation", text: || structures(&[Deformation::layout()]) };
const MOMENT: Snippet = Snippet { name: "moment", text: || structures(&[Moment::layout()]) };
const MOVING: Snippet = Snippet { name: "moving", text: || structures(&[Moving::layout()]) };
const LAYERS: Snippet = Snippet { name: "layers", text: || structures(&[Layers::layout()]) };
const HEXPLANE: Snippet = Snippet { name: "hexplane", text: || include_str!("hexplane.wgsl").to_owned() };
const NETWORK: Snippet = Snippet { name: "network", text: || include_str!("network.wgsl").to_owned() };
/// Sums in 64-bit fixed point, for kernels that add to or take those of [`DeformationGradients`].
pub const FIXED_POINT: Snippet =
    Snippet { name: "fixed_point", text: || include_str!("fixed_point.wgsl").to_owned() };

const PREPARE: Module = Module {
    name: "deform_prepare",
    text: include_str!("deform_prepare.wgsl"),
    imports: &[MOMENT],
    entries: &["main"],
};

const FORWARD: Module = Module {
    name: "deform",
    text: include_str!("deform.wgsl"),
    imports: &[DEFORMATION, MOMENT, HEXPLANE, NETWORK],
    entries: &["main"],
};

const BACKWARD: Module = Module {
    name: "deform_backward",
    text: include_str!("deform_backward.wgsl"),
    imports: &[DEFORMATION, MOMENT, HEXPLANE, NETWORK],
    entries: &["main"],
};

const BACKWARD_WEIGHTS: Module = Module {
    name: "deform_backward_weights",
    text: include_str!("deform_backward_weights.wgsl"),
    imports: &[LAYERS, MOMENT, FAULTS],
    entries: &["main"],
};

const PLANES_BACKWARD: Module = Module {
    name: "deform_planes_backward",
    text: include_str!("deform_planes_backward.wgsl"),
    imports: &[DEFORMATION, MOMENT, HEXPLANE, FIXED_POINT, FAULTS],
    entries: &["main"],
};

const LINES_BACKWARD: Module = Module {
    name: "deform_lines_backward",
    text: include_str!("deform_lines_backward.wgsl"),
    imports: &[MOMENT, FIXED_POINT],
    entries: &["main"],
};

const MOVING_ROWS: Module = Module {
    name: "deform_moving",
    text: include_str!("deform_moving.wgsl"),
    imports: &[MOVING, FAULTS],
    entries: &["take", "put", "put_gradients"],
};

/// Files of this stage; they are compiled with the declarations of [`Shape`] before them.
pub const MODULES: &[&Module] =
    &[&PREPARE, &FORWARD, &BACKWARD, &BACKWARD_WEIGHTS, &PLANES_BACKWARD, &LINES_BACKWARD, &MOVING_ROWS];

/// Structures of this stage.
pub const LAYOUTS: &[fn() -> Layout] = &[Deformation::layout, Moment::layout, Layers::layout, Moving::layout];

/// A deformation on the device.
#[derive(Debug)]
pub struct GpuDeformation {
    /// Nodes of all planes, as in the field.
    pub planes: GpuVec<f32>,
    /// Weights and biases, as in the field.
    pub mlp: GpuVec<f32>,
    config: cif_field::DeformationConfig,
    shape: Shape,
    block: Uniform<Deformation>,
    moment: Uniform<Moment>,
    line_sources: GpuVec<[u32; 2]>,
    weight_sources: GpuVec<u32>,
    lines: GpuVec<f32>,
    weights: GpuVec<u32>,
    prepare: Kernel,
    forward: Kernel,
    /// Where some Gaussians stand still.
    moving: Option<MovingRows>,
    /// Compiled when the first of them does.
    moving_kernels: Option<[Kernel; 3]>,
}

/// The one entry point of a module.
fn compile(gpu: &Gpu, module: &Module, declarations: &str) -> Result<Kernel, GpuError> {
    let mut kernels = Kernel::compile_with(gpu, module, declarations)?;
    Ok(kernels.remove(0))
}

impl GpuDeformation {
    /// A copy of a deformation, ready to move Gaussians.
    ///
    /// # Errors
    /// When it does not fit the device, with the arithmetic.
    pub fn new(gpu: &Gpu, deformation: &FieldDeformation) -> Result<Self, GpuError> {
        let shape = Shape::new(deformation, gpu.largest_binding())?;
        let declarations = shape.forward_declarations();
        let mut deformed = Self {
            planes: GpuVec::from_slice(gpu, "nodes of the hexplanes", &deformation.planes)?,
            mlp: GpuVec::from_slice(gpu, "weights of the deformation network", &deformation.mlp)?,
            config: deformation.config.clone(),
            block: Uniform::new(gpu, "deformation", &shape.block),
            moment: Uniform::new(gpu, "moment", &Moment::default()),
            line_sources: GpuVec::from_slice(gpu, "sources of the time lines", &shape.line_sources)?,
            weight_sources: GpuVec::from_slice(gpu, "sources of the weights", &shape.weight_sources)?,
            lines: GpuVec::zeros(gpu, "time lines", shape.line_sources.len())?,
            weights: GpuVec::zeros(gpu, "prepared weights", shape.weight_sources.len())?,
            prepare: compile(gpu, &PREPARE, &declarations)?,
            forward: compile(gpu, &FORWARD, &declarations)?,
            shape,
            moving: None,
            moving_kernels: None,
        };
        deformed.set_still(gpu, &deformation.still)?;
        Ok(deformed)
    }

    /// Says which Gaussians stand still, `[N]`, or none at all when empty.
    ///
    /// # Errors
    /// When the arrays of those that move do not fit the device.
    pub fn set_still(&mut self, gpu: &Gpu, still: &[bool]) -> Result<(), GpuError> {
        self.moving = if still.contains(&true) {
            let kernels = match &self.moving_kernels {
                Some(kernels) => kernels.clone(),
                None => self.moving_kernels.insert(super::stages::entries(gpu, &MOVING_ROWS)?).clone(),
            };
            Some(MovingRows::new(gpu, kernels, still, self.shape.moves_sh)?)
        } else {
            None
        };
        Ok(())
    }

    /// Constants and tables.
    #[must_use]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Shape of the deformation.
    #[must_use]
    pub fn config(&self) -> &cif_field::DeformationConfig {
        &self.config
    }

    fn moment_at(&self, time: f64, gaussians: usize) -> Moment {
        // As on the CPU: in double precision up to the fraction.
        let stored_rows = self.config.plane_layout().0[0][2].rows;
        let row = self.config.time_row(time).clamp(0.0, stored_rows as f64 - 1.0);
        let time_row = (row.floor() as usize).min(stored_rows - 2);
        Moment {
            time_row: time_row as u32,
            time_fraction: (row - time_row as f64) as f32,
            gaussians: gaussians as u32,
            first: 0,
        }
    }

    /// Records what [`Self::forward`] does; what is to be drawn then.
    pub fn pose<'a>(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        canonical: &'a GpuGaussians,
        posed: &'a GpuGaussians,
    ) -> PosedInput<'a> {
        self.forward(gpu, commands, time, canonical, posed);
        let sh = if self.moves_sh() { &posed.sh } else { &canonical.sh };
        PosedInput { geometry: &posed.geometry, sh, turns: None }
    }

    /// Records the moving of `canonical` to `time` in [0, 1] into `posed`, which has as many rows; only a head that
    /// moves them writes the spherical harmonics of `posed`. One time per submission: the time is written at once.
    pub fn forward(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        canonical: &GpuGaussians,
        posed: &GpuGaussians,
    ) {
        let Some(moving) = &self.moving else {
            self.forward_all(gpu, commands, time, canonical, posed);
            return;
        };
        moving.take_canonical(gpu, commands, canonical);
        self.forward_all(gpu, commands, time, &moving.canonical, &moving.posed);
        moving.put_posed(gpu, commands, canonical, posed);
    }

    fn forward_all(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        canonical: &GpuGaussians,
        posed: &GpuGaussians,
    ) {
        self.moment.write(gpu, &self.moment_at(time, canonical.len()));
        let prepare = self.prepare.bind(
            gpu,
            &[
                self.moment.binding(),
                self.planes.binding(),
                self.mlp.binding(),
                self.line_sources.binding(),
                self.weight_sources.binding(),
                self.lines.binding(),
                self.weights.binding(),
            ],
        );
        let forward = self.forward.bind(
            gpu,
            &[
                self.block.binding(),
                self.moment.binding(),
                canonical.geometry.binding(),
                canonical.sh.binding(),
                self.planes.binding(),
                self.lines.binding(),
                self.weights.binding(),
                posed.geometry.binding(),
                posed.sh.binding(),
            ],
        );
        commands.stage("deform", |stage| {
            let items = self.lines.len().max(self.weights.len());
            stage.dispatch(&self.prepare, &prepare, workgroups(items, 256));
            stage.dispatch(
                &self.forward,
                &forward,
                workgroups(canonical.len(), self.shape.forward_rows as usize),
            );
        });
    }

    /// True when a head moves the spherical harmonics.
    #[must_use]
    pub fn moves_sh(&self) -> bool {
        self.shape.moves_sh
    }
}

/// Gradients of a deformation on the device, summed over the views of a step.
#[derive(Debug)]
pub struct DeformationGradients {
    /// Fixed-point sums of the planes' nodes and of the lines, two words each.
    pub sums: GpuVec<[u32; 2]>,
    /// Parts of the network's gradient, `[SPLITS, floats]`.
    pub parts: GpuVec<f32>,
    scratch: GpuVec<[f32; 4]>,
    layers: Uniform<Layers>,
    moments: Vec<Uniform<Moment>>,
    backward: Kernel,
    backward_weights: Kernel,
    planes_backward: Kernel,
    lines_backward: Kernel,
}

/// Gaussians on both sides of a deformation, with their gradients.
#[derive(Clone, Copy, Debug)]
pub struct DeformedGaussians<'a> {
    /// The canonical ones.
    pub canonical: &'a GpuGaussians,
    /// Gradients by the Gaussians at the time of the view.
    pub v_posed: &'a GpuGaussians,
    /// Gradients by the canonical ones.
    pub v_canonical: &'a GpuGaussians,
}

impl DeformationGradients {
    /// Zeros in the shape of a deformation.
    ///
    /// # Errors
    /// When they do not fit the device, with the arithmetic.
    pub fn zeros(gpu: &Gpu, deformation: &GpuDeformation) -> Result<Self, GpuError> {
        let shape = &deformation.shape;
        let declarations = shape.backward_declarations();
        let sums = shape.plane_floats as usize + shape.line_sources.len();
        let blocks = shape.chunk_rows / shape.backward_rows;
        Ok(Self {
            sums: GpuVec::from_slice(gpu, "gradients of the hexplanes", &vec![ZERO_SUM; sums])?,
            parts: GpuVec::zeros(
                gpu,
                "gradients of the deformation network",
                SPLITS as usize * shape.mlp_floats as usize,
            )?,
            scratch: GpuVec::zeros(
                gpu,
                "activations of the deformation network",
                blocks as usize * shape.block_quads as usize,
            )?,
            layers: Uniform::new(gpu, "layers", &shape.layers),
            moments: Vec::new(),
            backward: compile(gpu, &BACKWARD, &declarations)?,
            backward_weights: compile(gpu, &BACKWARD_WEIGHTS, &declarations)?,
            planes_backward: compile(gpu, &PLANES_BACKWARD, &declarations)?,
            lines_backward: compile(gpu, &LINES_BACKWARD, &declarations)?,
        })
    }

    /// Records the gradients that follow from those by the Gaussians at the time of the forward pass recorded before:
    /// adds those of planes and network to `self`, and those of the canonical geometry, the direct path included, to
    /// `v_canonical`. Spherical harmonics are left to the caller: their gradient is that of the
    /// posed ones. Faults are bits of the first word of `faults`.
    pub fn backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        deformation: &GpuDeformation,
        time: f64,
        gaussians: DeformedGaussians<'_>,
        faults: &GpuVec<u32>,
    ) {
        let Some(moving) = &deformation.moving else {
            self.backward_all(gpu, commands, deformation, time, gaussians, faults);
            return;
        };
        let DeformedGaussians { v_posed, v_canonical, .. } = gaussians;
        moving.take_gradients(gpu, commands, v_posed, v_canonical);
        let of_moving = DeformedGaussians {
            canonical: &moving.canonical,
            v_posed: &moving.v_posed,
            v_canonical: &moving.v_canonical,
        };
        self.backward_all(gpu, commands, deformation, time, of_moving, faults);
        moving.put_gradients(gpu, commands, v_posed, v_canonical, faults);
    }

    fn backward_all(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        deformation: &GpuDeformation,
        time: f64,
        gaussians: DeformedGaussians<'_>,
        faults: &GpuVec<u32>,
    ) {
        let DeformedGaussians { canonical, v_posed, v_canonical } = gaussians;
        let shape = &deformation.shape;
        let n = canonical.len();
        let chunks = n.div_ceil(shape.chunk_rows as usize);
        while self.moments.len() < chunks {
            self.moments.push(Uniform::new(gpu, "moment", &Moment::default()));
        }
        let moment = deformation.moment_at(time, n);
        let block = &deformation.block;
        for (chunk, uniform) in self.moments.iter().enumerate().take(chunks) {
            let first = chunk * shape.chunk_rows as usize;
            let rows = (n - first).min(shape.chunk_rows as usize);
            uniform.write(gpu, &Moment { first: first as u32, ..moment });
            let backward = self.backward.bind(
                gpu,
                &[
                    block.binding(),
                    uniform.binding(),
                    canonical.geometry.binding(),
                    deformation.planes.binding(),
                    deformation.lines.binding(),
                    deformation.weights.binding(),
                    v_posed.geometry.binding(),
                    v_posed.sh.binding(),
                    self.scratch.binding(),
                ],
            );
            let weights = self.backward_weights.bind(
                gpu,
                &[
                    self.layers.binding(),
                    uniform.binding(),
                    self.scratch.binding(),
                    self.parts.binding(),
                    faults.binding(),
                ],
            );
            let planes = self.planes_backward.bind(
                gpu,
                &[
                    block.binding(),
                    uniform.binding(),
                    canonical.geometry.binding(),
                    deformation.planes.binding(),
                    deformation.lines.binding(),
                    self.scratch.binding(),
                    v_posed.geometry.binding(),
                    self.sums.binding(),
                    v_canonical.geometry.binding(),
                    faults.binding(),
                ],
            );
            commands.stage("deform backward: network", |stage| {
                let groups = workgroups(rows, shape.backward_rows as usize);
                stage.dispatch(&self.backward, &backward, groups);
                stage.dispatch(&self.backward_weights, &weights, [shape.tiles, SPLITS, 1]);
            });
            commands.stage("deform backward: planes", |stage| {
                stage.dispatch(&self.planes_backward, &planes, workgroups(rows, 4));
            });
        }
        let lines = self.lines_backward.bind(
            gpu,
            &[
                deformation.moment.binding(),
                deformation.line_sources.binding(),
                self.sums.binding(),
                faults.binding(),
            ],
        );
        commands.stage("deform backward: lines", |stage| {
            stage.dispatch(&self.lines_backward, &lines, workgroups(shape.line_sources.len(), 256));
        });
    }
}

/// A fixed-point sum of nothing; see `fixed_point.wgsl`.
pub const ZERO_SUM: [u32; 2] = [0x8000_0000, 0];

/// The value of a fixed-point sum.
#[must_use]
pub fn fixed_sum([low, high]: [u32; 2]) -> f64 {
    let units = (i64::from(high as i32) << 32) + i64::from(low) - i64::from(ZERO_SUM[0]);
    units as f64 / FIXED_UNITS
}

/// Units of a fixed-point sum in 1.
pub const FIXED_UNITS: f64 = (1_u64 << 50) as f64;

#[cfg(test)]
mod tests;
