//! Moves a canonical Gaussian to a time, and carries gradients back. Source: methods reference 2.2, 2.3.

use cif_field::Deformation;
use cif_field::deformation::evaluate::DeformationTape;
use cif_field::deformation::{HeadKind, LinearLayout, PLANE_AXES};
use cif_geometry::Real;

use super::scene::{Gaussian, Parameters, Scene};

/// A Gaussian at a time.
#[derive(Clone, Debug)]
pub struct Deformed<R> {
    /// Raw parameters with the deltas added; log-scales are not clamped yet.
    pub gaussian: Gaussian<R>,
    /// Intermediate values of the network; `None` for a static Gaussian.
    pub tape: Option<DeformationTape<R>>,
}

/// Gaussian `index` at `time` in [0, 1]; canonical when `active` is off or the scene is static.
#[must_use]
pub fn deform<R: Real>(scene: &Scene<R>, index: usize, time: f64, active: bool) -> Deformed<R> {
    let parameters = &scene.parameters;
    let mut gaussian = parameters.gaussians[index].clone();
    let Some(deformation) = scene.deformation.as_ref().filter(|d| active && !d.is_still(index)) else {
        return Deformed { gaussian, tape: None };
    };
    let tape = deformation.evaluate(&parameters.planes, &parameters.mlp, gaussian.mean, R::of(time));
    let deltas = deformation.deltas(&tape);
    add(&mut gaussian.mean, &deltas.position);
    add(&mut gaussian.log_scale, &deltas.scale);
    add(&mut gaussian.quaternion, &deltas.rotation);
    gaussian.opacity_logit += deltas.opacity;
    add(&mut gaussian.sh, &deltas.sh);
    Deformed { gaussian, tape: Some(tape) }
}

/// Adds to `gradients` what follows from the gradient `v` of Gaussian `index` at the time of `deformed`.
pub fn deform_backward<R: Real>(
    scene: &Scene<R>,
    index: usize,
    deformed: &Deformed<R>,
    v: &Gaussian<R>,
    gradients: &mut Parameters<R>,
) {
    // The deltas are added to raw parameters, so every canonical parameter has a direct path.
    let canonical = &mut gradients.gaussians[index];
    add(&mut canonical.mean, &v.mean);
    add(&mut canonical.log_scale, &v.log_scale);
    add(&mut canonical.quaternion, &v.quaternion);
    canonical.opacity_logit += v.opacity_logit;
    canonical.occupancy_logit += v.occupancy_logit;
    add(&mut canonical.sh, &v.sh);
    if let (Some(deformation), Some(tape)) = (&scene.deformation, &deformed.tape) {
        let v_features = mlp_backward(deformation, &scene.parameters.mlp, tape, v, &mut gradients.mlp);
        let v_mean =
            planes_backward(deformation, &scene.parameters.planes, tape, &v_features, &mut gradients.planes);
        add(&mut gradients.gaussians[index].mean, &v_mean);
    }
}

/// Gradient of the features; adds to the gradient of weights and biases.
fn mlp_backward<R: Real>(
    deformation: &Deformation,
    mlp: &[R],
    tape: &DeformationTape<R>,
    v: &Gaussian<R>,
    v_mlp: &mut [R],
) -> Vec<R> {
    let layout = deformation.config.mlp_layout();
    let rectified = rectify(&tape.trunk);
    let mut v_rectified = vec![R::zero(); rectified.len()];
    for (head, hidden) in layout.heads.iter().zip(&tape.hidden) {
        let v_output: &[R] = match head.kind {
            HeadKind::Position => &v.mean,
            HeadKind::Scale => &v.log_scale,
            HeadKind::Rotation => &v.quaternion,
            HeadKind::Opacity => std::slice::from_ref(&v.opacity_logit),
            HeadKind::Sh => &v.sh,
        };
        let v_activation = linear_backward(&head.output, mlp, &rectify(hidden), v_output, v_mlp);
        let v_hidden = rectify_backward(hidden, &v_activation);
        add(&mut v_rectified, &linear_backward(&head.hidden, mlp, &rectified, &v_hidden, v_mlp));
    }
    let v_trunk = rectify_backward(&tape.trunk, &v_rectified);
    linear_backward(&layout.trunk, mlp, &tape.features, &v_trunk, v_mlp)
}

/// Gradient of the canonical centre; adds to the gradient of the plane nodes.
fn planes_backward<R: Real>(
    deformation: &Deformation,
    planes: &[R],
    tape: &DeformationTape<R>,
    v_features: &[R],
    v_planes: &mut [R],
) -> [R; 3] {
    let (one, channels) = (R::one(), deformation.config.channels as usize);
    let mut v_mean = [R::zero(); 3];
    for (level, (taps, values)) in tape.taps.iter().zip(&tape.values).enumerate() {
        for (plane, tap) in taps.iter().enumerate() {
            let (f, g) = (tap.column_fraction, tap.row_fraction);
            let weights = [(one - f) * (one - g), f * (one - g), (one - f) * g, f * g];
            let (mut v_column, mut v_row) = (R::zero(), R::zero());
            for c in 0..channels {
                // The product of the other five values: never by division, a value may be 0.
                let others = (0..values.len())
                    .filter(|other| *other != plane)
                    .fold(one, |product, other| product * values[other][c]);
                let v_value = v_features[level * channels + c] * others;
                let node = tap.nodes.map(|first| planes[first + c]);
                for (first, weight) in tap.nodes.iter().zip(weights) {
                    v_planes[first + c] += weight * v_value;
                }
                v_column += v_value * ((one - g) * (node[1] - node[0]) + g * (node[3] - node[2]));
                v_row += v_value * ((one - f) * (node[2] - node[0]) + f * (node[3] - node[1]));
            }
            let (column_axis, row_axis) = PLANE_AXES[plane];
            // Nodes per metre: (R - 1) / (hi - lo).
            let density = |axis: usize| {
                let bounds = &deformation.bounds;
                let nodes = deformation.config.nodes(level, axis) as f64;
                R::of(nodes - 1.0) / (R::of(bounds.high[axis]) - R::of(bounds.low[axis]))
            };
            if !tap.column_clamped {
                v_mean[column_axis] += v_column * density(column_axis);
            }
            // Time rows are marked clamped: no gradient to time.
            if !tap.row_clamped {
                v_mean[row_axis] += v_row * density(row_axis);
            }
        }
    }
    v_mean
}

/// Gradient of a linear layer's input; adds to the gradient of its weights and biases.
fn linear_backward<R: Real>(
    layout: &LinearLayout,
    parameters: &[R],
    input: &[R],
    v_output: &[R],
    v_parameters: &mut [R],
) -> Vec<R> {
    let mut v_input = vec![R::zero(); layout.inputs];
    for (row, v) in v_output.iter().enumerate() {
        v_parameters[layout.biases.start + row] += *v;
        for column in 0..layout.inputs {
            let weight = layout.weights.start + row * layout.inputs + column;
            v_parameters[weight] += *v * input[column];
            v_input[column] += *v * parameters[weight];
        }
    }
    v_input
}

fn rectify<R: Real>(values: &[R]) -> Vec<R> {
    values.iter().map(|value| value.max(R::zero())).collect()
}

/// ReLU'(0) = 0.
fn rectify_backward<R: Real>(values: &[R], v: &[R]) -> Vec<R> {
    values.iter().zip(v).map(|(value, v)| if *value > R::zero() { *v } else { R::zero() }).collect()
}

fn add<R: Real>(sum: &mut [R], terms: &[R]) {
    for (sum, term) in sum.iter_mut().zip(terms) {
        *sum += *term;
    }
}
