//! Deformation of many Gaussians at one time: the formulas of [`super::evaluate`] in f32, sixteen Gaussians
//! side by side so that the inner loops vectorise. No gradients; training has its own path.

use rayon::prelude::*;

use super::evaluate::Deltas;
use super::{Deformation, LinearLayout, MlpLayout, PLANES, PlaneLayout};
use crate::Gaussians;

/// Gaussians evaluated together.
const LANES: usize = 16;

type Lanes = [f32; LANES];

impl Deformation {
    /// The Gaussians at a time in [0, 1]: deltas added to the raw parameters, everything else as it was.
    #[must_use]
    pub fn apply(&self, canonical: &Gaussians, time: f64) -> Gaussians {
        let mut deformed = canonical.clone();
        let rows: Vec<usize> = self.moving_rows(canonical.len()).map(|row| row as usize).collect();
        let positions: Vec<[f32; 3]> = rows.iter().map(|row| canonical.means[*row]).collect();
        for (row, deltas) in rows.into_iter().zip(&self.deltas_at(&positions, time)) {
            deltas.add_to(&mut deformed, row, 1.0);
        }
        deformed
    }

    /// Deltas at canonical positions (world, metres) and a time in [0, 1], one per position.
    #[must_use]
    pub fn deltas_at(&self, positions: &[[f32; 3]], time: f64) -> Vec<Deltas<f32>> {
        let (levels, _) = self.config.plane_layout();
        let mlp = self.config.mlp_layout();
        positions
            .par_chunks(LANES)
            .flat_map_iter(|chunk| {
                let mut lanes = self.evaluate_lanes(&levels, &mlp, chunk, time);
                lanes.truncate(chunk.len());
                lanes
            })
            .collect()
    }

    fn evaluate_lanes(
        &self,
        levels: &[[PlaneLayout; PLANES]],
        mlp: &MlpLayout,
        positions: &[[f32; 3]],
        time: f64,
    ) -> Vec<Deltas<f32>> {
        let channels = self.config.channels as usize;
        let mut features = vec![[1.0; LANES]; self.config.features()];
        for (lane, position) in positions.iter().enumerate() {
            // Coordinates in f64 cost little compared with the layers and keep fine cells exact.
            let position = position.map(f64::from);
            for (level, layouts) in levels.iter().enumerate() {
                let features = &mut features[level * channels..(level + 1) * channels];
                for (plane, layout) in layouts.iter().enumerate() {
                    let tap = self.plane_tap(level, plane, layout, position, time);
                    let (f, g) = (tap.column_fraction as f32, tap.row_fraction as f32);
                    let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
                    let [a, b, c, d] = tap.nodes.map(|node| &self.planes[node..node + channels]);
                    for k in 0..channels {
                        features[k][lane] *=
                            weights[0] * a[k] + weights[1] * b[k] + weights[2] * c[k] + weights[3] * d[k];
                    }
                }
            }
        }
        let mut trunk = linear(&mlp.trunk, &self.mlp, &features);
        rectify(&mut trunk);
        let mut deltas = vec![Deltas::zero(); LANES];
        for head in &mlp.heads {
            let mut hidden = linear(&head.hidden, &self.mlp, &trunk);
            rectify(&mut hidden);
            for (output, values) in linear(&head.output, &self.mlp, &hidden).iter().enumerate() {
                for (deltas, value) in deltas.iter_mut().zip(values) {
                    deltas.output_mut(head.kind)[output] = *value;
                }
            }
        }
        deltas
    }
}

fn linear(layout: &LinearLayout, parameters: &[f32], input: &[Lanes]) -> Vec<Lanes> {
    let weights = parameters[layout.weights.clone()].chunks_exact(layout.inputs);
    let biases = &parameters[layout.biases.clone()];
    weights
        .zip(biases)
        .map(|(weights, bias)| {
            let mut sum = [*bias; LANES];
            for (weight, values) in weights.iter().zip(input) {
                for lane in 0..LANES {
                    sum[lane] += weight * values[lane];
                }
            }
            sum
        })
        .collect()
}

fn rectify(values: &mut [Lanes]) {
    for value in values.as_flattened_mut() {
        *value = value.max(0.0);
    }
}
