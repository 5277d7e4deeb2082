//! Plain evaluation of the deformation at one Gaussian and time, generic over the scalar: the oracle of the
//! fast paths, and good enough for queries. Source: methods reference 2.1 to 2.3.

use cif_geometry::Real;

use super::{Deformation, HeadKind, LinearLayout, PLANE_AXES, PLANES, PlaneLayout};
use crate::Gaussians;

/// A bilinear tap: the four nodes around a position of one plane.
#[derive(Clone, Copy, Debug)]
pub struct PlaneTap<R> {
    /// First float of the nodes (row j, column i), (j, i + 1), (j + 1, i), (j + 1, i + 1).
    pub nodes: [usize; 4],
    /// Column fraction f.
    pub column_fraction: R,
    /// Row fraction g.
    pub row_fraction: R,
    /// True when the column coordinate was clamped, so that no gradient reaches the position.
    pub column_clamped: bool,
    /// True when the row coordinate was clamped.
    pub row_clamped: bool,
}

/// Everything computed on the way to the deltas of one Gaussian.
#[derive(Clone, Debug)]
pub struct DeformationTape<R> {
    /// Taps `[levels][6]`.
    pub taps: Vec<[PlaneTap<R>; PLANES]>,
    /// Plane values `[levels][6][channels]`.
    pub values: Vec<[Vec<R>; PLANES]>,
    /// Features F, `[levels * channels]`.
    pub features: Vec<R>,
    /// Trunk output before ReLU, `[width]`.
    pub trunk: Vec<R>,
    /// Hidden pre-activations per head, `[heads][width]`.
    pub hidden: Vec<Vec<R>>,
    /// Head outputs, `[heads][outputs]`, in the order of `MlpLayout::heads`.
    pub outputs: Vec<Vec<R>>,
}

/// Deltas added to the raw parameters of one Gaussian; zero where the head is absent.
#[derive(Clone, Debug, PartialEq)]
pub struct Deltas<R> {
    /// dx, metres.
    pub position: [R; 3],
    /// ds.
    pub scale: [R; 3],
    /// dr.
    pub rotation: [R; 4],
    /// do.
    pub opacity: R,
    /// dSH.
    pub sh: [R; 48],
}

impl<R: Real> Deltas<R> {
    /// No motion.
    #[must_use]
    pub fn zero() -> Self {
        let zero = R::zero();
        Self { position: [zero; 3], scale: [zero; 3], rotation: [zero; 4], opacity: zero, sh: [zero; 48] }
    }

    /// The floats that a head writes.
    #[must_use]
    pub fn output(&self, head: HeadKind) -> &[R] {
        match head {
            HeadKind::Position => &self.position,
            HeadKind::Scale => &self.scale,
            HeadKind::Rotation => &self.rotation,
            HeadKind::Opacity => std::slice::from_ref(&self.opacity),
            HeadKind::Sh => &self.sh,
        }
    }

    /// As [`Self::output`], to be changed.
    pub fn output_mut(&mut self, head: HeadKind) -> &mut [R] {
        match head {
            HeadKind::Position => &mut self.position,
            HeadKind::Scale => &mut self.scale,
            HeadKind::Rotation => &mut self.rotation,
            HeadKind::Opacity => std::slice::from_mut(&mut self.opacity),
            HeadKind::Sh => &mut self.sh,
        }
    }
}

impl Deltas<f32> {
    /// Adds the deltas, times `sign`, to the raw parameters of a row.
    ///
    /// # Panics
    /// When there is no such row.
    pub fn add_to(&self, gaussians: &mut Gaussians, row: usize, sign: f32) {
        for head in HeadKind::ALL {
            let width = head.outputs();
            let values = &mut gaussians.tensor_mut(&head.parameter())[row * width..(row + 1) * width];
            for (value, delta) in values.iter_mut().zip(self.output(head)) {
                *value += sign * delta;
            }
        }
    }
}

/// Coordinate of a position along an axis, in nodes, clamped; and whether it was clamped.
fn node_coordinate<R: Real>(position: R, low: R, high: R, nodes: usize) -> (R, bool) {
    let last = R::of(nodes as f64 - 1.0);
    let unclamped = (position - low) / (high - low) * last;
    if unclamped <= R::zero() {
        (R::zero(), true)
    } else if unclamped >= last {
        (last, true)
    } else {
        // A NaN position lands here; it stays NaN in the features and is caught by the caller's guards.
        (unclamped, false)
    }
}

fn split<R: Real>(coordinate: R, nodes: usize) -> (usize, R) {
    let cell = coordinate.floor().to_usize().unwrap_or(0).min(nodes - 2);
    (cell, coordinate - R::of(cell as f64))
}

impl Deformation {
    /// Taps of one plane at a canonical position and time.
    pub fn plane_tap<R: Real>(
        &self,
        level: usize,
        plane: usize,
        layout: &PlaneLayout,
        position: [R; 3],
        time: R,
    ) -> PlaneTap<R> {
        let (column_axis, row_axis) = PLANE_AXES[plane];
        let along = |axis: usize| {
            let (low, high) = (R::of(self.bounds.low[axis]), R::of(self.bounds.high[axis]));
            node_coordinate(position[axis], low, high, self.config.nodes(level, axis))
        };
        let (column, column_clamped) = along(column_axis);
        let (row, row_clamped) = if row_axis == 3 {
            let last = R::of(layout.rows as f64 - 1.0);
            let first = R::of(self.config.first_time_row() as f64);
            let resolution = R::of(f64::from(self.config.time_resolution - 1));
            let row = (time + R::one()) / R::of(2.0) * resolution - first;
            (row.max(R::zero()).min(last), true)
        } else {
            along(row_axis)
        };
        let (i, column_fraction) = split(column, layout.columns);
        let (j, row_fraction) = split(row, layout.rows);
        let channels = self.config.channels as usize;
        let node = |j: usize, i: usize| layout.offset + (j * layout.columns + i) * channels;
        PlaneTap {
            nodes: [node(j, i), node(j, i + 1), node(j + 1, i), node(j + 1, i + 1)],
            column_fraction,
            row_fraction,
            column_clamped,
            row_clamped,
        }
    }

    /// Evaluates the network at a canonical position and a time in [0, 1]. `planes` and `mlp` are this
    /// deformation's parameters in the scalar of the evaluation.
    pub fn evaluate<R: Real>(
        &self,
        planes: &[R],
        mlp: &[R],
        position: [R; 3],
        time: R,
    ) -> DeformationTape<R> {
        let (levels, _) = self.config.plane_layout();
        let layout = self.config.mlp_layout();
        let channels = self.config.channels as usize;
        let mut tape = DeformationTape {
            taps: Vec::new(),
            values: Vec::new(),
            features: Vec::new(),
            trunk: Vec::new(),
            hidden: Vec::new(),
            outputs: Vec::new(),
        };
        for (level, plane_layouts) in levels.iter().enumerate() {
            let taps: [PlaneTap<R>; PLANES] = std::array::from_fn(|plane| {
                self.plane_tap(level, plane, &plane_layouts[plane], position, time)
            });
            let values: [Vec<R>; PLANES] = std::array::from_fn(|plane| {
                let tap = &taps[plane];
                let (f, g) = (tap.column_fraction, tap.row_fraction);
                let weights =
                    [(R::one() - f) * (R::one() - g), f * (R::one() - g), (R::one() - f) * g, f * g];
                (0..channels)
                    .map(|c| (0..4).map(|corner| weights[corner] * planes[tap.nodes[corner] + c]).sum())
                    .collect()
            });
            for c in 0..channels {
                tape.features.push(values.iter().fold(R::one(), |product, value| product * value[c]));
            }
            tape.taps.push(taps);
            tape.values.push(values);
        }
        tape.trunk = linear(&layout.trunk, mlp, &tape.features);
        let rectified = rectify(&tape.trunk);
        for head in &layout.heads {
            let hidden = linear(&head.hidden, mlp, &rectified);
            tape.outputs.push(linear(&head.output, mlp, &rectify(&hidden)));
            tape.hidden.push(hidden);
        }
        tape
    }

    /// Deltas of a tape.
    pub fn deltas<R: Real>(&self, tape: &DeformationTape<R>) -> Deltas<R> {
        let mut deltas = Deltas::zero();
        for (head, output) in self.config.mlp_layout().heads.iter().zip(&tape.outputs) {
            deltas.output_mut(head.kind).copy_from_slice(output);
        }
        deltas
    }
}

fn linear<R: Real>(layout: &LinearLayout, parameters: &[R], input: &[R]) -> Vec<R> {
    let weights = &parameters[layout.weights.clone()];
    let biases = &parameters[layout.biases.clone()];
    (0..layout.outputs)
        .map(|row| {
            let weights = &weights[row * layout.inputs..(row + 1) * layout.inputs];
            biases[row] + weights.iter().zip(input).map(|(w, x)| *w * *x).sum::<R>()
        })
        .collect()
}

fn rectify<R: Real>(values: &[R]) -> Vec<R> {
    values.iter().map(|v| v.max(R::zero())).collect()
}
