//! Moves the canonical Gaussians to one time, and carries gradients back. Source: methods reference 2.2, 2.3
//! and 11 (ideas 3 and 4).
//!
//! All Gaussians of a view share its time, so the three time planes of each level are first interpolated to
//! lines. Rows go through the network in blocks. The backward pass visits only rows with a gradient and
//! recomputes their activations, which is cheaper than keeping everyone's.

use cif_field::deformation::{HeadKind, LinearLayout, MlpLayout, PLANES, PlaneLayout, is_time_plane};
use cif_field::{Deformation, Gaussians};
use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch};
use fearless_simd_macros::simd;
use rayon::prelude::*;

use super::channels::{add_scaled, blend, running_product, slope};
use super::matrix::{Left, Shape, Start, multiply, padded, transpose};

/// Rows that go through the network together; sized so that activations stay in the second-level cache.
const BLOCK: usize = 256;

/// Rows that one task takes, in blocks: those whose weight gradients it sums, and those among which it looks for
/// rows that move.
const CHUNK: usize = 1024;

/// The deformation at one time: shapes, and time planes interpolated to lines.
pub(super) struct DeformationAtTime<'a> {
    deformation: &'a Deformation,
    levels: Vec<[PlaneLayout; PLANES]>,
    mlp: MlpLayout,
    channels: usize,
    /// `[levels][3]` maps from positions to node coordinates.
    axes: Vec<[AxisScale; 3]>,
    /// `[levels][3]` lines of the xt, yt and zt planes, each `[columns, channels]`.
    lines: Vec<[Vec<f32>; 3]>,
    /// Weights in the form that the forward pass multiplies by.
    trunk: ForwardLayer,
    /// Per head: hidden and output layer.
    heads: Vec<[ForwardLayer; 2]>,
    /// Stored row below the time, and the fraction above it.
    time_row: usize,
    time_fraction: f32,
}

/// Transposed weights `[inputs, outputs]` and biases `[outputs]`; outputs may be padded with zeros.
struct ForwardLayer {
    inputs: usize,
    outputs: usize,
    weights: Vec<f32>,
    biases: Vec<f32>,
}

impl ForwardLayer {
    /// `outputs`: at least those of the layout.
    fn new(layout: &LinearLayout, parameters: &[f32], outputs: usize) -> Self {
        let weights = transpose(&parameters[layout.weights.clone()], layout.outputs, layout.inputs, outputs);
        let mut biases = parameters[layout.biases.clone()].to_vec();
        biases.resize(outputs, 0.0);
        Self { inputs: layout.inputs, outputs, weights, biases }
    }

    fn apply(&self, level: Level, input: &[f32], rows: usize, rectify: bool, output: &mut Vec<f32>) {
        output.resize(rows * self.outputs, 0.0);
        let shape = Shape { rows, inner: self.inputs, columns: self.outputs };
        multiply(level, shape, Left::Rows(input), &self.weights, Start::Bias(&self.biases), rectify, output);
    }
}

/// `coordinate = (position - low) * slope`, in [0, last].
struct AxisScale {
    low: f64,
    slope: f64,
    last: f64,
}

/// Position of a Gaussian along one axis of one level.
#[derive(Clone, Copy, Default)]
struct AxisTap {
    node: usize,
    fraction: f32,
    /// d coordinate / d position; 0 where clamped.
    slope: f32,
}

/// Spatial planes as (plane, column axis, row axis), and time planes as (plane, axis).
const SPATIAL: [(usize, usize, usize); 3] = [(0, 0, 1), (1, 0, 2), (3, 1, 2)];
const TEMPORAL: [(usize, usize); 3] = [(2, 0), (4, 1), (5, 2)];

/// Activations of a block of rows.
#[derive(Default)]
struct Activations {
    /// `[rows, levels, 6, channels]`; the backward pass turns it into the gradient by these values.
    values: Vec<f32>,
    /// `[rows, levels * channels]`.
    features: Vec<f32>,
    /// ReLU of the trunk, `[rows, width]`.
    trunk: Vec<f32>,
    /// ReLU of each head's hidden layer, `[heads][rows, width]`.
    hidden: Vec<Vec<f32>>,
    /// `[heads][rows, padded outputs]`.
    outputs: Vec<Vec<f32>>,
    // Backward only.
    v_output: Vec<f32>,
    v_hidden: Vec<f32>,
    v_trunk: Vec<f32>,
    v_features: Vec<f32>,
}

/// Fills `posed` with the canonical Gaussians: colours only where something `moves_sh`, occupancies not at all.
pub(super) fn begin(canonical: &Gaussians, moves_sh: bool, posed: &mut Gaussians) {
    posed.means.clone_from(&canonical.means);
    posed.log_scales.clone_from(&canonical.log_scales);
    posed.quaternions.clone_from(&canonical.quaternions);
    posed.opacity_logits.clone_from(&canonical.opacity_logits);
    posed.occupancy_logits.clear();
    if moves_sh {
        posed.sh_coefficients.clone_from(&canonical.sh_coefficients);
    } else {
        posed.sh_coefficients.clear();
    }
}

impl<'a> DeformationAtTime<'a> {
    pub(super) fn new(deformation: &'a Deformation, time: f64) -> Self {
        let config = &deformation.config;
        let (levels, _) = config.plane_layout();
        let channels = config.channels as usize;
        let stored_rows = levels[0][2].rows;
        let row = config.time_row(time).clamp(0.0, stored_rows as f64 - 1.0);
        let time_row = (row.floor() as usize).min(stored_rows - 2);
        let time_fraction = (row - time_row as f64) as f32;
        let lines = levels
            .iter()
            .map(|planes| {
                TEMPORAL.map(|(plane, _)| {
                    let layout = &planes[plane];
                    let row_len = layout.columns * channels;
                    let start = layout.offset + time_row * row_len;
                    let (below, above) = deformation.planes[start..start + 2 * row_len].split_at(row_len);
                    below
                        .iter()
                        .zip(above)
                        .map(|(b, a)| (1.0 - time_fraction) * b + time_fraction * a)
                        .collect()
                })
            })
            .collect();
        let bounds = &deformation.bounds;
        let axes = (0..levels.len())
            .map(|level| {
                [0, 1, 2].map(|axis| {
                    let last = (config.nodes(level, axis) - 1) as f64;
                    let slope = last / (bounds.high[axis] - bounds.low[axis]);
                    AxisScale { low: bounds.low[axis], slope, last }
                })
            })
            .collect();
        let mlp = config.mlp_layout();
        let width = mlp.trunk.outputs;
        let trunk = ForwardLayer::new(&mlp.trunk, &deformation.mlp, width);
        let heads = mlp
            .heads
            .iter()
            .map(|head| {
                // Only what leaves the network is padded: the next layer reads a hidden one as it is.
                [(&head.hidden, width), (&head.output, padded(head.output.outputs))]
                    .map(|(layer, outputs)| ForwardLayer::new(layer, &deformation.mlp, outputs))
            })
            .collect();
        Self { deformation, axes, mlp, trunk, heads, levels, channels, lines, time_row, time_fraction }
    }

    /// True when the network moves a row.
    pub(super) fn moves(&self, row: usize) -> bool {
        !self.deformation.is_still(row)
    }

    #[inline(always)]
    fn axis_tap(&self, level: usize, axis: usize, position: f32) -> AxisTap {
        let scale = &self.axes[level][axis];
        // In double precision, so that a far-off-centre box costs no accuracy.
        let coordinate = (f64::from(position) - scale.low) * scale.slope;
        let inside = coordinate > 0.0 && coordinate < scale.last;
        let coordinate = coordinate.clamp(0.0, scale.last);
        let node = (coordinate as usize).min(scale.last as usize - 1);
        AxisTap {
            node,
            fraction: (coordinate - node as f64) as f32,
            slope: if inside { scale.slope as f32 } else { 0.0 },
        }
    }

    /// The two nodes of a time line around a tap.
    #[inline(always)]
    fn line_nodes(&self, level: usize, line: usize, tap: AxisTap) -> (&[f32], &[f32]) {
        let start = tap.node * self.channels;
        self.lines[level][line][start..start + 2 * self.channels].split_at(self.channels)
    }

    fn axis_taps(&self, level: usize, position: [f32; 3]) -> [AxisTap; 3] {
        [0, 1, 2].map(|axis| self.axis_tap(level, axis, position[axis]))
    }

    /// First floats of the four nodes of a spatial plane, relative to all planes.
    fn nodes(&self, layout: &PlaneLayout, column: AxisTap, row: AxisTap) -> [usize; 4] {
        let node = layout.offset + (row.node * layout.columns + column.node) * self.channels;
        let next_row = layout.columns * self.channels;
        [node, node + self.channels, node + next_row, node + next_row + self.channels]
    }

    /// Plane values and features of a block of positions.
    fn look_up(&self, level: Level, positions: &[[f32; 3]], block: &mut Activations) {
        let (levels, channels) = (self.levels.len(), self.channels);
        block.values.resize(positions.len() * levels * PLANES * channels, 0.0);
        block.features.resize(positions.len() * levels * channels, 0.0);
        dispatch!(level, simd => look_up_rows(simd, self, positions, &mut block.values, &mut block.features));
    }

    /// Whole network on a block of positions.
    fn forward_block(&self, level: Level, positions: &[[f32; 3]], block: &mut Activations) {
        self.look_up(level, positions, block);
        let rows = positions.len();
        self.trunk.apply(level, &block.features, rows, true, &mut block.trunk);
        block.hidden.resize_with(self.heads.len(), Vec::new);
        block.outputs.resize_with(self.heads.len(), Vec::new);
        for (index, [hidden, output]) in self.heads.iter().enumerate() {
            hidden.apply(level, &block.trunk, rows, true, &mut block.hidden[index]);
            output.apply(level, &block.hidden[index], rows, false, &mut block.outputs[index]);
        }
    }

    /// Fills `posed` with raw parameters at the time, deltas added to the rows that do not stand still.
    pub(super) fn forward(&self, level: Level, gaussians: &Gaussians, posed: &mut Gaussians) {
        begin(gaussians, self.mlp.heads.iter().any(|head| head.kind == HeadKind::Sh), posed);
        let n = gaussians.len();
        // Fewer rows of a chunk go through the network where many stand still.
        let stands = self.deformation.still.contains(&true);
        let chunk_rows = if stands { CHUNK } else { BLOCK };
        gaussians
            .means
            .par_chunks(chunk_rows)
            .zip(posed.rows_mut().chunks(chunk_rows, n))
            .enumerate()
            .for_each_init(Activations::default, |block, (chunk, (positions, mut posed))| {
                let first = chunk * chunk_rows;
                let rows: Vec<usize> =
                    (0..positions.len()).filter(|row| !self.deformation.is_still(first + row)).collect();
                let mut moving = Vec::with_capacity(BLOCK);
                for rows in rows.chunks(BLOCK) {
                    moving.clear();
                    moving.extend(rows.iter().map(|row| positions[*row]));
                    self.forward_block(level, &moving, block);
                    for (head, output) in self.mlp.heads.iter().zip(&block.outputs) {
                        let target = posed.reborrow().into_tensor(&head.kind.parameter());
                        let outputs = head.kind.outputs();
                        for (row, output) in rows.iter().zip(output.chunks_exact(padded(outputs))) {
                            let target = &mut target[row * outputs..(row + 1) * outputs];
                            for (value, delta) in target.iter_mut().zip(output) {
                                *value += delta;
                            }
                        }
                    }
                }
            });
    }

    /// Adds gradients of planes, MLP and canonical centres (through the lookup) from the gradients of the
    /// posed parameters of the `active` rows. The direct paths are not added here.
    pub(super) fn backward(
        &self,
        level: Level,
        gaussians: &Gaussians,
        active: &[u32],
        v: &Gaussians,
        v_planes: &mut [f32],
        v_mlp: &mut [f32],
        v_means: &mut [[f32; 3]],
    ) {
        if active.is_empty() {
            return;
        }
        let value_len = self.levels.len() * PLANES * self.channels;
        let mut v_values = vec![0.0_f32; active.len() * value_len];
        let mut v_positions = vec![[0.0_f32; 3]; active.len()];
        let weight_gradients: Vec<Vec<f32>> = active
            .par_chunks(CHUNK)
            .zip(v_values.par_chunks_mut(CHUNK * value_len))
            .zip(v_positions.par_chunks_mut(CHUNK))
            .map_init(Activations::default, |block, ((rows, v_values), v_positions)| {
                let mut v_mlp = vec![0.0; self.mlp.len];
                for ((rows, v_values), v_positions) in rows
                    .chunks(BLOCK)
                    .zip(v_values.chunks_mut(BLOCK * value_len))
                    .zip(v_positions.chunks_mut(BLOCK))
                {
                    let positions: Vec<[f32; 3]> =
                        rows.iter().map(|row| gaussians.means[*row as usize]).collect();
                    self.forward_block(level, &positions, block);
                    self.backward_block(level, rows, v, block, &mut v_mlp);
                    dispatch!(level, simd => look_up_rows_backward(
                        simd, self, &positions, &block.values, &block.v_features, v_values, v_positions));
                }
                v_mlp
            })
            .collect();
        for gradient in &weight_gradients {
            for (total, value) in v_mlp.iter_mut().zip(gradient) {
                *total += value;
            }
        }
        for (row, v_position) in active.iter().zip(&v_positions) {
            for axis in 0..3 {
                v_means[*row as usize][axis] += v_position[axis];
            }
        }
        self.scatter(level, gaussians, active, &v_values, v_planes);
    }

    /// Network gradients of a block; leaves `v_features` in the block.
    fn backward_block(
        &self,
        level: Level,
        rows: &[u32],
        v: &Gaussians,
        block: &mut Activations,
        v_mlp: &mut [f32],
    ) {
        let count = rows.len();
        let width = self.mlp.trunk.outputs;
        block.v_trunk.clear();
        block.v_trunk.resize(count * width, 0.0);
        block.v_hidden.resize(count * width, 0.0);
        for (index, head) in self.mlp.heads.iter().enumerate() {
            block.v_output.clear();
            let (v, outputs) = (v.tensor(&head.kind.parameter()), head.output.outputs);
            for row in rows.iter().map(|row| *row as usize) {
                block.v_output.extend_from_slice(&v[row * outputs..(row + 1) * outputs]);
            }
            let hidden = &block.hidden[index];
            self.layer_backward(
                level,
                &head.output,
                hidden,
                &block.v_output,
                false,
                &mut block.v_hidden,
                v_mlp,
            );
            gate(&mut block.v_hidden, hidden);
            self.layer_backward(
                level,
                &head.hidden,
                &block.trunk,
                &block.v_hidden,
                true,
                &mut block.v_trunk,
                v_mlp,
            );
        }
        gate(&mut block.v_trunk, &block.trunk);
        block.v_features.resize(count * self.mlp.trunk.inputs, 0.0);
        self.layer_backward(
            level,
            &self.mlp.trunk,
            &block.features,
            &block.v_trunk,
            false,
            &mut block.v_features,
            v_mlp,
        );
    }

    /// Gradients of one linear layer: adds those of weights and biases, and sets (or adds, when
    /// `accumulates`) those of its input.
    fn layer_backward(
        &self,
        level: Level,
        layout: &LinearLayout,
        input: &[f32],
        v_output: &[f32],
        accumulates: bool,
        v_input: &mut [f32],
        v_mlp: &mut [f32],
    ) {
        let rows = v_output.len() / layout.outputs;
        let weights = &self.deformation.mlp[layout.weights.clone()];
        let shape = Shape { rows: layout.outputs, inner: rows, columns: layout.inputs };
        multiply(
            level,
            shape,
            Left::Columns(v_output),
            input,
            Start::Out,
            false,
            &mut v_mlp[layout.weights.clone()],
        );
        add_columns(v_output, &mut v_mlp[layout.biases.clone()]);
        if !accumulates {
            v_input.fill(0.0);
        }
        let shape = Shape { rows, inner: layout.outputs, columns: layout.inputs };
        multiply(level, shape, Left::Rows(v_output), weights, Start::Out, false, v_input);
    }

    /// Adds `[active, levels, 6, channels]` gradients of plane values to the planes. One task per plane
    /// visits the rows in order, so sums do not depend on the number of threads.
    fn scatter(
        &self,
        level: Level,
        gaussians: &Gaussians,
        active: &[u32],
        v_values: &[f32],
        v_planes: &mut [f32],
    ) {
        let mut tasks = Vec::new();
        let mut rest = v_planes;
        for (index, planes) in self.levels.iter().enumerate() {
            for (plane, layout) in planes.iter().enumerate() {
                let (slice, tail) = rest.split_at_mut(layout.rows * layout.columns * self.channels);
                rest = tail;
                tasks.push((index, plane, slice));
            }
        }
        tasks.into_par_iter().for_each(|(index, plane, v_plane)| {
            dispatch!(level, simd => scatter_plane(
                simd, self, (index, plane), &gaussians.means, active, v_values, v_plane));
        });
    }
}

/// Zeroes gradients where the rectified activation is 0.
fn gate(gradients: &mut [f32], activations: &[f32]) {
    for (gradient, activation) in gradients.iter_mut().zip(activations) {
        *gradient = if *activation > 0.0 { *gradient } else { 0.0 };
    }
}

fn add_columns(rows: &[f32], totals: &mut [f32]) {
    for row in rows.chunks_exact(totals.len()) {
        for (total, value) in totals.iter_mut().zip(row) {
            *total += value;
        }
    }
}

#[simd]
fn look_up_rows<S: Simd>(
    simd: S,
    at: &DeformationAtTime<'_>,
    positions: &[[f32; 3]],
    values: &mut [f32],
    features: &mut [f32],
) {
    let channels = at.channels;
    let planes = &at.deformation.planes;
    let row_values = at.levels.len() * PLANES * channels;
    let row_features = at.levels.len() * channels;
    for ((position, values), features) in
        positions.iter().zip(values.chunks_exact_mut(row_values)).zip(features.chunks_exact_mut(row_features))
    {
        for (level, layouts) in at.levels.iter().enumerate() {
            let taps = at.axis_taps(level, *position);
            let values = &mut values[level * PLANES * channels..(level + 1) * PLANES * channels];
            let features = &mut features[level * channels..(level + 1) * channels];
            features.fill(1.0);
            for (plane, column, row) in SPATIAL {
                let (f, g) = (taps[column].fraction, taps[row].fraction);
                let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
                let nodes = at
                    .nodes(&layouts[plane], taps[column], taps[row])
                    .map(|node| &planes[node..node + channels]);
                let out = &mut values[plane * channels..(plane + 1) * channels];
                blend(simd, weights, nodes, out, features);
            }
            for (line, (plane, axis)) in TEMPORAL.into_iter().enumerate() {
                let tap = taps[axis];
                let (below, above) = at.line_nodes(level, line, tap);
                let out = &mut values[plane * channels..(plane + 1) * channels];
                blend(simd, [1.0 - tap.fraction, tap.fraction], [below, above], out, features);
            }
        }
    }
}

/// Gradient by each plane value (prefix and suffix products, never a division) and by the positions.
#[simd]
fn look_up_rows_backward<S: Simd>(
    simd: S,
    at: &DeformationAtTime<'_>,
    positions: &[[f32; 3]],
    values: &[f32],
    v_features: &[f32],
    v_values: &mut [f32],
    v_positions: &mut [[f32; 3]],
) {
    let channels = at.channels;
    let planes = &at.deformation.planes;
    let row_values = at.levels.len() * PLANES * channels;
    let mut running = vec![0.0_f32; channels];
    for (row, position) in positions.iter().enumerate() {
        let mut v_position = [0.0_f32; 3];
        for (level, layouts) in at.levels.iter().enumerate() {
            let start = row * row_values + level * PLANES * channels;
            let values = &values[start..start + PLANES * channels];
            let g = &mut v_values[start..start + PLANES * channels];
            let feature = (row * at.levels.len() + level) * channels;
            running.copy_from_slice(&v_features[feature..feature + channels]);
            let of = |plane: usize| plane * channels..(plane + 1) * channels;
            for plane in 0..PLANES {
                running_product(simd, false, &values[of(plane)], &mut running, &mut g[of(plane)]);
            }
            running.fill(1.0);
            for plane in (0..PLANES).rev() {
                running_product(simd, true, &values[of(plane)], &mut running, &mut g[of(plane)]);
            }
            let taps = at.axis_taps(level, *position);
            for (plane, column, row) in SPATIAL {
                let (f, h) = (taps[column].fraction, taps[row].fraction);
                let q = at
                    .nodes(&layouts[plane], taps[column], taps[row])
                    .map(|node| &planes[node..node + channels]);
                let g = &g[of(plane)];
                v_position[column] +=
                    slope(simd, g, [(q[1], q[0], 1.0 - h), (q[3], q[2], h)]) * taps[column].slope;
                v_position[row] += slope(simd, g, [(q[2], q[0], 1.0 - f), (q[3], q[1], f)]) * taps[row].slope;
            }
            for (line, (plane, axis)) in TEMPORAL.into_iter().enumerate() {
                let (below, above) = at.line_nodes(level, line, taps[axis]);
                v_position[axis] += slope(simd, &g[of(plane)], [(above, below, 1.0)]) * taps[axis].slope;
            }
        }
        v_positions[row] = v_position;
    }
}

/// Adds the value gradients of one plane to its nodes.
#[simd]
fn scatter_plane<S: Simd>(
    simd: S,
    at: &DeformationAtTime<'_>,
    (level, plane): (usize, usize),
    means: &[[f32; 3]],
    active: &[u32],
    v_values: &[f32],
    v_plane: &mut [f32],
) {
    let channels = at.channels;
    let layout = &at.levels[level][plane];
    let row_values = at.levels.len() * PLANES * channels;
    let offset = (level * PLANES + plane) * channels;
    if is_time_plane(plane) {
        let axis = TEMPORAL.iter().find(|(p, _)| *p == plane).expect("time planes are listed").1;
        let mut line = vec![0.0_f32; layout.columns * channels];
        for (row, v) in active.iter().zip(v_values.chunks_exact(row_values)) {
            let tap = at.axis_tap(level, axis, means[*row as usize][axis]);
            let v = &v[offset..offset + channels];
            let start = tap.node * channels;
            let (below, above) = line[start..start + 2 * channels].split_at_mut(channels);
            add_scaled(simd, 1.0 - tap.fraction, v, below);
            add_scaled(simd, tap.fraction, v, above);
        }
        let start = at.time_row * line.len();
        let (below, above) = v_plane[start..start + 2 * line.len()].split_at_mut(line.len());
        add_scaled(simd, 1.0 - at.time_fraction, &line, below);
        add_scaled(simd, at.time_fraction, &line, above);
    } else {
        let (_, column_axis, row_axis) =
            *SPATIAL.iter().find(|(p, ..)| *p == plane).expect("spatial planes are listed");
        for (row, v) in active.iter().zip(v_values.chunks_exact(row_values)) {
            let mean = means[*row as usize];
            let column = at.axis_tap(level, column_axis, mean[column_axis]);
            let row = at.axis_tap(level, row_axis, mean[row_axis]);
            let (f, g) = (column.fraction, row.fraction);
            let v = &v[offset..offset + channels];
            let node = (row.node * layout.columns + column.node) * channels;
            let next = layout.columns * channels;
            let (lower, upper) = v_plane[node..node + next + 2 * channels].split_at_mut(next);
            add_scaled(simd, (1.0 - f) * (1.0 - g), v, &mut lower[..channels]);
            add_scaled(simd, f * (1.0 - g), v, &mut lower[channels..2 * channels]);
            add_scaled(simd, (1.0 - f) * g, v, &mut upper[..channels]);
            add_scaled(simd, f * g, v, &mut upper[channels..]);
        }
    }
}
