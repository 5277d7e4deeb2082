//! The network that turns the features of a position into what moves a Gaussian: one hidden layer for all, and heads of
//! two layers. Rows go through it in blocks.

use cif_field::Gaussians;
use cif_field::deformation::{HeadKind, LinearLayout, MlpLayout};
use fearless_simd::Level;

use super::super::matrix::{Left, Shape, Start, multiply, padded, transpose};

/// The network, in the form that both passes multiply by.
pub(super) struct Network<'a> {
    pub(super) layout: MlpLayout,
    parameters: &'a [f32],
    trunk: ForwardLayer,
    /// Per head: hidden and output layer.
    heads: Vec<[ForwardLayer; 2]>,
}

/// Transposed weights `[inputs, outputs]` and biases `[outputs]`; outputs may be padded with zeros.
struct ForwardLayer {
    inputs: usize,
    outputs: usize,
    weights: Vec<f32>,
    biases: Vec<f32>,
}

/// Activations of a block of rows.
#[derive(Default)]
pub(super) struct Activations {
    /// `[rows, features]`, set by whoever looks them up.
    pub(super) features: Vec<f32>,
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
    /// Gradient by the features, `[rows, features]`.
    pub(super) v_features: Vec<f32>,
}

impl Activations {
    /// Of each head: its kind, the floats of a row, which may be padded, and the rows.
    pub(super) fn outputs(&self, network: &Network<'_>) -> impl Iterator<Item = (HeadKind, usize, &[f32])> {
        let heads = network.layout.heads.iter().zip(&self.outputs);
        heads.map(|(head, outputs)| (head.kind, padded(head.output.outputs), outputs.as_slice()))
    }
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

impl<'a> Network<'a> {
    pub(super) fn new(layout: MlpLayout, parameters: &'a [f32]) -> Self {
        let width = layout.trunk.outputs;
        let trunk = ForwardLayer::new(&layout.trunk, parameters, width);
        let heads = layout
            .heads
            .iter()
            .map(|head| {
                // Only what leaves the network is padded: the next layer reads a hidden one as it is.
                [(&head.hidden, width), (&head.output, padded(head.output.outputs))]
                    .map(|(layer, outputs)| ForwardLayer::new(layer, parameters, outputs))
            })
            .collect();
        Self { layout, parameters, trunk, heads }
    }

    /// True when a head of this kind is there.
    pub(super) fn has(&self, kind: HeadKind) -> bool {
        self.layout.heads.iter().any(|head| head.kind == kind)
    }

    /// Outputs of a block whose features are there.
    pub(super) fn forward(&self, level: Level, rows: usize, block: &mut Activations) {
        self.trunk.apply(level, &block.features, rows, true, &mut block.trunk);
        block.hidden.resize_with(self.heads.len(), Vec::new);
        block.outputs.resize_with(self.heads.len(), Vec::new);
        for (index, [hidden, output]) in self.heads.iter().enumerate() {
            hidden.apply(level, &block.trunk, rows, true, &mut block.hidden[index]);
            output.apply(level, &block.hidden[index], rows, false, &mut block.outputs[index]);
        }
    }

    /// Adds gradients of a block's weights and biases, by those of the posed parameters; leaves `v_features` in the
    /// block.
    pub(super) fn backward(
        &self,
        level: Level,
        rows: &[u32],
        v: &Gaussians,
        block: &mut Activations,
        v_mlp: &mut [f32],
    ) {
        let count = rows.len();
        let Activations { features, trunk, hidden, v_output, v_hidden, v_trunk, v_features, .. } = block;
        v_trunk.resize(count * self.layout.trunk.outputs, 0.0);
        v_hidden.resize(count * self.layout.trunk.outputs, 0.0);
        v_features.resize(count * self.layout.trunk.inputs, 0.0);
        v_trunk.fill(0.0);
        for (head, hidden) in self.layout.heads.iter().zip(hidden) {
            v_output.clear();
            let (v, outputs) = (v.tensor(&head.kind.parameter()), head.output.outputs);
            for row in rows.iter().map(|row| *row as usize) {
                v_output.extend_from_slice(&v[row * outputs..(row + 1) * outputs]);
            }
            v_hidden.fill(0.0);
            self.layer_backward(level, &head.output, hidden, v_output, v_hidden, v_mlp);
            gate(v_hidden, hidden);
            self.layer_backward(level, &head.hidden, trunk, v_hidden, v_trunk, v_mlp);
        }
        gate(v_trunk, trunk);
        v_features.fill(0.0);
        self.layer_backward(level, &self.layout.trunk, features, v_trunk, v_features, v_mlp);
    }

    /// Adds gradients of one linear layer: those of weights and biases, and those of its input.
    fn layer_backward(
        &self,
        level: Level,
        layout: &LinearLayout,
        input: &[f32],
        v_output: &[f32],
        v_input: &mut [f32],
        v_mlp: &mut [f32],
    ) {
        let rows = v_output.len() / layout.outputs;
        let shape = Shape { rows: layout.outputs, inner: rows, columns: layout.inputs };
        let v_weights = &mut v_mlp[layout.weights.clone()];
        multiply(level, shape, Left::Columns(v_output), input, Start::Out, false, v_weights);
        add_columns(v_output, &mut v_mlp[layout.biases.clone()]);
        let weights = &self.parameters[layout.weights.clone()];
        let shape = Shape { rows, inner: layout.outputs, columns: layout.inputs };
        multiply(level, shape, Left::Rows(v_output), weights, Start::Out, false, v_input);
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
