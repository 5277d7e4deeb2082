//! Moves the canonical Gaussians to one time, and carries gradients back. Source: methods reference 2.2, 2.3
//! and 11 (ideas 3 and 4).
//!
//! | module | idea |
//! |---|---|
//! | `lookup` | planes to features of positions |
//! | `network` | features to what is added to a Gaussian |
//!
//! The backward pass visits only rows with a gradient and recomputes their activations, which is cheaper than keeping
//! everyone's.

mod lookup;
mod network;

use cif_field::deformation::HeadKind;
use cif_field::{Deformation, Gaussians};
use fearless_simd::Level;
use rayon::prelude::*;

use self::lookup::{ChunkGradients, PlanesAtTime};
use self::network::{Activations, Network};

/// Rows that go through the network together; sized so that activations stay in the second-level cache.
const BLOCK: usize = 256;

/// Rows of a task of the forward pass, at least; up to [`BLOCK`].
const FEWEST_ROWS: usize = 64;

/// Rows whose weight gradients a task of the backward pass sums, in blocks, at least and at most: a task has an array of all
/// weights.
const SUMMED_ROWS: [usize; 2] = [128, 1024];

/// Tasks that a pass is split into where there are enough rows, two for each of sixteen threads: by the rows alone, so that
/// sums do not depend on the number of threads.
const TASKS: usize = 32;

/// Weights whose gradients a task adds up over the tasks before: 4 KB, which stay in the first-level cache.
const SUMMED_WEIGHTS: usize = 1024;

/// The deformation at one time.
pub(super) struct DeformationAtTime<'a> {
    deformation: &'a Deformation,
    planes: PlanesAtTime<'a>,
    network: Network<'a>,
}

/// Memory of the backward pass, kept between calls.
#[derive(Default)]
pub(super) struct DeformScratch {
    /// `[active]` positions, and gradients by them.
    positions: Vec<[f32; 3]>,
    v_positions: Vec<[f32; 3]>,
    /// `[active]` gradients by the values of spatial planes, and `[chunks]` by the nodes of time lines and by the weights
    /// of the network.
    v_spatial: Vec<f32>,
    v_lines: Vec<f32>,
    v_weights: Vec<f32>,
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
        let planes = PlanesAtTime::new(deformation, time);
        let network = Network::new(deformation.config.mlp_layout(), &deformation.mlp);
        Self { deformation, planes, network }
    }

    /// True when the network moves a row.
    pub(super) fn moves(&self, row: usize) -> bool {
        !self.deformation.is_still(row)
    }

    /// Features and outputs of a block of positions.
    fn forward_block(&self, level: Level, positions: &[[f32; 3]], block: &mut Activations) {
        self.planes.look_up(level, positions, &mut block.features);
        self.network.forward(level, positions.len(), block);
    }

    /// Fills `posed` with raw parameters at the time, deltas added to the rows that do not stand still.
    pub(super) fn forward(&self, level: Level, gaussians: &Gaussians, posed: &mut Gaussians) {
        begin(gaussians, self.network.has(HeadKind::Sh), posed);
        let moving: Vec<usize> = (0..gaussians.len()).filter(|row| self.moves(*row)).collect();
        let task_rows = moving.len().div_ceil(TASKS).clamp(FEWEST_ROWS, BLOCK);
        // Each task has the rows of `posed` from behind those of the task before it.
        let (mut tasks, mut rest, mut first) = (Vec::new(), posed.rows_mut(), 0);
        for rows in moving.chunks(task_rows) {
            let end = rows[rows.len() - 1] + 1;
            let (own, others) = rest.split_at(end - first);
            tasks.push((rows, first, own));
            (rest, first) = (others, end);
        }
        tasks.into_par_iter().for_each_init(Activations::default, |block, (rows, first, mut posed)| {
            let positions: Vec<[f32; 3]> = rows.iter().map(|row| gaussians.means[*row]).collect();
            self.forward_block(level, &positions, block);
            for (kind, padded, output) in block.outputs(&self.network) {
                let target = posed.reborrow().into_tensor(&kind.parameter());
                let outputs = kind.outputs();
                for (row, output) in rows.iter().zip(output.chunks_exact(padded)) {
                    let target = &mut target[(row - first) * outputs..][..outputs];
                    for (value, delta) in target.iter_mut().zip(output) {
                        *value += delta;
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
        scratch: &mut DeformScratch,
        v_planes: &mut [f32],
        v_mlp: &mut [f32],
        v_means: &mut [[f32; 3]],
    ) {
        if active.is_empty() {
            return;
        }
        let DeformScratch { positions, v_positions, v_spatial, v_lines, v_weights } = scratch;
        positions.clear();
        positions.extend(active.iter().map(|row| gaussians.means[*row as usize]));
        v_positions.resize(active.len(), [0.0; 3]);
        let [fewest, most] = SUMMED_ROWS;
        let chunk_rows = active.len().div_ceil(TASKS).clamp(fewest, most);
        let chunks = active.len().div_ceil(chunk_rows);
        let (values, lines, weights) =
            (self.planes.spatial_values(), self.planes.line_values(), self.network.layout.len);
        v_spatial.resize(active.len() * values, 0.0);
        v_lines.resize(chunks * lines, 0.0);
        v_weights.resize(chunks * weights, 0.0);
        active
            .par_chunks(chunk_rows)
            .zip(positions.par_chunks(chunk_rows))
            .zip(v_positions.par_chunks_mut(chunk_rows))
            .zip(v_spatial.par_chunks_mut(chunk_rows * values))
            .zip(v_lines.par_chunks_mut(lines))
            .zip(v_weights.par_chunks_mut(weights))
            .for_each_init(
                Activations::default,
                |block, (((((active, positions), v_positions), spatial), lines), weights)| {
                    lines.fill(0.0);
                    weights.fill(0.0);
                    let mut chunk = ChunkGradients { spatial, lines, positions: v_positions };
                    for (index, (rows, positions)) in
                        active.chunks(BLOCK).zip(positions.chunks(BLOCK)).enumerate()
                    {
                        self.forward_block(level, positions, block);
                        self.network.backward(level, rows, v, block, weights);
                        let v_features = &block.v_features;
                        self.planes.look_up_backward(level, positions, v_features, &mut chunk, index * BLOCK);
                    }
                },
            );
        v_mlp.par_chunks_mut(SUMMED_WEIGHTS).enumerate().for_each(|(part, totals)| {
            for gradient in v_weights.chunks_exact(weights) {
                let values = &gradient[part * SUMMED_WEIGHTS..];
                totals.iter_mut().zip(values).for_each(|(total, value)| *total += value);
            }
        });
        for (row, v_position) in active.iter().zip(&*v_positions) {
            for axis in 0..3 {
                v_means[*row as usize][axis] += v_position[axis];
            }
        }
        let chunks: Vec<&[[f32; 3]]> = positions.chunks(chunk_rows).collect();
        self.planes.scatter(level, &chunks, v_spatial, v_lines, v_planes);
    }
}
