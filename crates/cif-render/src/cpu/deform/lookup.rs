//! Features of positions: the values of six planes per level multiplied, and their gradients. All Gaussians of a view
//! share its time, so the three time planes of each level are first interpolated to lines.
//!
//! Vectors run over the feature channels.

use cif_field::Deformation;
use cif_field::deformation::{PLANES, PlaneLayout};
use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x8};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Channels per vector.
const LANES: usize = 8;

/// Spatial planes as (plane, column axis, row axis), and time planes as (plane, axis).
const SPATIAL: [(usize, usize, usize); 3] = [(0, 0, 1), (1, 0, 2), (3, 1, 2)];
const TEMPORAL: [(usize, usize); 3] = [(2, 0), (4, 1), (5, 2)];

/// The planes at one time.
pub(super) struct PlanesAtTime<'a> {
    planes: &'a [f32],
    levels: Vec<LevelAtTime>,
    channels: usize,
    /// Stored row below the time, and the fraction above it.
    time_row: usize,
    time_fraction: f32,
}

struct LevelAtTime {
    layouts: [PlaneLayout; PLANES],
    /// Maps from positions to node coordinates.
    axes: [AxisScale; 3],
    /// Lines of the xt, yt and zt planes, each `[columns, channels]`.
    lines: [Vec<f32>; 3],
    /// First float of each line among the lines of all levels.
    line_offsets: [usize; 3],
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

impl AxisScale {
    #[inline(always)]
    fn tap(&self, position: f32) -> AxisTap {
        // In double precision, so that a far-off-centre box costs no accuracy.
        let coordinate = (f64::from(position) - self.low) * self.slope;
        let inside = coordinate > 0.0 && coordinate < self.last;
        let coordinate = coordinate.clamp(0.0, self.last);
        let node = (coordinate as usize).min(self.last as usize - 1);
        AxisTap {
            node,
            fraction: (coordinate - node as f64) as f32,
            slope: if inside { self.slope as f32 } else { 0.0 },
        }
    }
}

impl LevelAtTime {
    #[inline(always)]
    fn taps(&self, position: [f32; 3]) -> [AxisTap; 3] {
        [0, 1, 2].map(|axis| self.axes[axis].tap(position[axis]))
    }

    /// The four nodes of a spatial plane around two taps, each `[channels]`: along the lower row, then along the upper.
    #[inline(always)]
    fn nodes<'a>(
        &self,
        planes: &'a [f32],
        channels: usize,
        plane: usize,
        [column, row]: [AxisTap; 2],
    ) -> [&'a [f32]; 4] {
        let layout = &self.layouts[plane];
        let node = layout.offset + (row.node * layout.columns + column.node) * channels;
        let next_row = node + layout.columns * channels;
        let (lower, upper) = (&planes[node..node + 2 * channels], &planes[next_row..next_row + 2 * channels]);
        [&lower[..channels], &lower[channels..], &upper[..channels], &upper[channels..]]
    }

    /// The two nodes of a time line around a tap.
    #[inline(always)]
    fn line_nodes(&self, line: usize, tap: AxisTap, channels: usize) -> [&[f32]; 2] {
        let nodes = &self.lines[line][tap.node * channels..(tap.node + 2) * channels];
        [&nodes[..channels], &nodes[channels..]]
    }
}

/// Gradients by what a chunk of positions reads, before they are summed over chunks.
pub(super) struct ChunkGradients<'a> {
    /// By the values of spatial planes, `[levels, 3, positions, channels]`.
    pub(super) spatial: &'a mut [f32],
    /// By the nodes of the time lines of all levels.
    pub(super) lines: &'a mut [f32],
    /// By the positions.
    pub(super) positions: &'a mut [[f32; 3]],
}

impl<'a> PlanesAtTime<'a> {
    pub(super) fn new(deformation: &'a Deformation, time: f64) -> Self {
        let config = &deformation.config;
        let (layouts, _) = config.plane_layout();
        let channels = config.channels as usize;
        let stored_rows = layouts[0][2].rows;
        let row = config.time_row(time).clamp(0.0, stored_rows as f64 - 1.0);
        let time_row = (row.floor() as usize).min(stored_rows - 2);
        let time_fraction = (row - time_row as f64) as f32;
        let bounds = &deformation.bounds;
        let mut line_offset = 0;
        let levels = layouts
            .into_iter()
            .enumerate()
            .map(|(level, layouts)| {
                let axes = [0, 1, 2].map(|axis| {
                    let last = (config.nodes(level, axis) - 1) as f64;
                    let slope = last / (bounds.high[axis] - bounds.low[axis]);
                    AxisScale { low: bounds.low[axis], slope, last }
                });
                let lines = TEMPORAL.map(|(plane, _)| {
                    let row_len = layouts[plane].columns * channels;
                    let start = layouts[plane].offset + time_row * row_len;
                    let (below, above) = deformation.planes[start..start + 2 * row_len].split_at(row_len);
                    below
                        .iter()
                        .zip(above)
                        .map(|(b, a)| (1.0 - time_fraction) * b + time_fraction * a)
                        .collect()
                });
                let line_offsets = lines.each_ref().map(|line: &Vec<f32>| {
                    line_offset += line.len();
                    line_offset - line.len()
                });
                LevelAtTime { layouts, axes, lines, line_offsets }
            })
            .collect();
        Self { planes: &deformation.planes, levels, channels, time_row, time_fraction }
    }

    /// Features of a position.
    pub(super) fn features(&self) -> usize {
        self.levels.len() * self.channels
    }

    /// Values of spatial planes at a position.
    pub(super) fn spatial_values(&self) -> usize {
        SPATIAL.len() * self.features()
    }

    /// Floats of the time lines of all levels.
    pub(super) fn line_values(&self) -> usize {
        self.levels.iter().flat_map(|level| &level.lines).map(Vec::len).sum()
    }

    /// Features of positions, `[positions, levels * channels]`.
    pub(super) fn look_up(&self, level: Level, positions: &[[f32; 3]], features: &mut Vec<f32>) {
        features.resize(positions.len() * self.features(), 0.0);
        dispatch!(level, simd => look_up_rows(simd, self, positions, features));
    }

    /// Gradients of some positions of a chunk, the first of which is `first`, by those of their features.
    pub(super) fn look_up_backward(
        &self,
        level: Level,
        positions: &[[f32; 3]],
        v_features: &[f32],
        chunk: &mut ChunkGradients<'_>,
        first: usize,
    ) {
        dispatch!(level, simd => look_up_rows_backward(simd, self, positions, v_features, chunk, first));
    }

    /// Adds the gradients of chunks of `rows` to the planes: those by spatial values, `spatial_values()` for every
    /// position, and those by lines, `line_values()` for every chunk. One task per plane, or per band of its rows where there
    /// are many threads, visits the positions in order, so sums do not depend on their number.
    pub(super) fn scatter(
        &self,
        simd_level: Level,
        chunks: &[&[[f32; 3]]],
        spatial: &[f32],
        lines: &[f32],
        v_planes: &mut [f32],
    ) {
        let channels = self.channels;
        let mut rest = v_planes;
        let mut tasks = Vec::new();
        let planes = SPATIAL.len() * self.levels.len();
        let bands = (2 * rayon::current_num_threads()).div_ceil(planes);
        for (index, level) in self.levels.iter().enumerate() {
            for (plane, layout) in level.layouts.iter().enumerate() {
                let (v_plane, tail) = rest.split_at_mut(layout.rows * layout.columns * channels);
                rest = tail;
                if let Some(line) = TEMPORAL.iter().position(|(temporal, _)| *temporal == plane) {
                    self.scatter_line(&level.lines[line], level.line_offsets[line], lines, v_plane);
                } else {
                    let slot = SPATIAL.iter().position(|(spatial, ..)| *spatial == plane);
                    let slot = slot.expect("planes are spatial or temporal");
                    let rows = layout.rows.div_ceil(bands);
                    let v_bands = v_plane.chunks_mut(rows * layout.columns * channels).enumerate();
                    tasks.extend(v_bands.map(|(band, v_band)| (index, slot, band * rows, v_band)));
                }
            }
        }
        tasks.into_par_iter().for_each(|(index, slot, first_row, v_band)| {
            let mut rest = spatial;
            for positions in chunks {
                let len = positions.len() * channels;
                let (values, tail) = rest.split_at(positions.len() * self.spatial_values());
                rest = tail;
                let values = &values[(index * SPATIAL.len() + slot) * len..][..len];
                dispatch!(simd_level, simd => scatter_plane(
                    simd, self, [index, slot], first_row, positions, values, v_band));
            }
        });
    }

    /// Sums a line over all chunks, and adds it to the two stored rows around the time.
    fn scatter_line(&self, line: &[f32], offset: usize, lines: &[f32], v_plane: &mut [f32]) {
        let mut total = vec![0.0_f32; line.len()];
        for chunk in lines.chunks_exact(self.line_values()) {
            total.iter_mut().zip(&chunk[offset..]).for_each(|(total, value)| *total += value);
        }
        let start = self.time_row * line.len();
        let (below, above) = v_plane[start..start + 2 * line.len()].split_at_mut(line.len());
        for (rows, weight) in [(below, 1.0 - self.time_fraction), (above, self.time_fraction)] {
            rows.iter_mut().zip(&total).for_each(|(value, v)| *value += weight * v);
        }
    }
}

/// Channels from `c` on; those beyond the last are 0.
#[inline(always)]
fn load<S: Simd>(simd: S, values: &[f32], c: usize) -> f32x8<S> {
    let values = &values[c..];
    if values.len() >= LANES {
        return f32x8::from_slice(simd, &values[..LANES]);
    }
    let mut padded = [0.0; LANES];
    padded[..values.len()].copy_from_slice(values);
    f32x8::from_slice(simd, &padded)
}

/// Stores the channels from `c` on, up to the last.
#[inline(always)]
fn store<S: Simd>(vector: f32x8<S>, values: &mut [f32], c: usize) {
    let values = &mut values[c..];
    if values.len() >= LANES {
        vector.store_slice(&mut values[..LANES]);
    } else {
        values.copy_from_slice(&vector.to_array()[..values.len()]);
    }
}

/// Sum of the lanes in a fixed order, the same for every instruction set.
#[inline(always)]
fn sum<S: Simd>(vector: f32x8<S>) -> f32 {
    let l = vector.to_array();
    ((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7]))
}

/// `target += weight values` of the channels from `c` on.
#[inline(always)]
fn add_scaled<S: Simd>(simd: S, weight: f32, values: f32x8<S>, target: &mut [f32], c: usize) {
    store(values.mul_add(f32x8::splat(simd, weight), load(simd, target, c)), target, c);
}

#[simd]
fn look_up_rows<S: Simd>(simd: S, at: &PlanesAtTime<'_>, positions: &[[f32; 3]], features: &mut [f32]) {
    let channels = at.channels;
    for (position, features) in positions.iter().zip(features.chunks_exact_mut(at.features())) {
        for (level, features) in at.levels.iter().zip(features.chunks_exact_mut(channels)) {
            let taps = level.taps(*position);
            let spatial = SPATIAL.map(|(plane, column, row)| {
                let (f, g) = (taps[column].fraction, taps[row].fraction);
                let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
                (level.nodes(at.planes, channels, plane, [taps[column], taps[row]]), weights)
            });
            let lines: [_; 3] = std::array::from_fn(|line| {
                let tap = taps[TEMPORAL[line].1];
                (level.line_nodes(line, tap, channels), [1.0 - tap.fraction, tap.fraction])
            });
            for c in (0..channels).step_by(LANES) {
                let mut feature = f32x8::splat(simd, 1.0);
                for (nodes, weights) in spatial {
                    feature *= blend(simd, nodes, weights, c);
                }
                for (nodes, weights) in lines {
                    feature *= blend(simd, nodes, weights, c);
                }
                store(feature, features, c);
            }
        }
    }
}

/// `sum_k weights[k] nodes[k]`.
#[inline(always)]
fn blend<S: Simd, const K: usize>(simd: S, nodes: [&[f32]; K], weights: [f32; K], c: usize) -> f32x8<S> {
    let mut value = load(simd, nodes[0], c) * f32x8::splat(simd, weights[0]);
    for k in 1..K {
        value = load(simd, nodes[k], c).mul_add(f32x8::splat(simd, weights[k]), value);
    }
    value
}

/// Gradients by every plane value (prefix and suffix products, never a division) and by the positions. Plane values and
/// their slopes are read anew, which costs less than keeping them since the forward pass.
#[simd]
fn look_up_rows_backward<S: Simd>(
    simd: S,
    at: &PlanesAtTime<'_>,
    positions: &[[f32; 3]],
    v_features: &[f32],
    chunk: &mut ChunkGradients<'_>,
    first: usize,
) {
    let channels = at.channels;
    let plane_len = chunk.positions.len() * channels;
    let zero = f32x8::splat(simd, 0.0);
    for (index, (position, v_features)) in
        positions.iter().zip(v_features.chunks_exact(at.features())).enumerate()
    {
        let row = first + index;
        let mut v_position = [zero; 3];
        for (index, level) in at.levels.iter().enumerate() {
            let v_features = &v_features[index * channels..(index + 1) * channels];
            let taps = level.taps(*position);
            let nodes = SPATIAL.map(|(plane, column, row)| {
                level.nodes(at.planes, channels, plane, [taps[column], taps[row]])
            });
            let lines: [_; 3] =
                std::array::from_fn(|line| level.line_nodes(line, taps[TEMPORAL[line].1], channels));
            for c in (0..channels).step_by(LANES) {
                let mut values = [zero; PLANES];
                let mut slopes = [[zero; 2]; SPATIAL.len()];
                for (slot, (_, column, row)) in SPATIAL.into_iter().enumerate() {
                    let (f, g) = (taps[column].fraction, taps[row].fraction);
                    let q = nodes[slot].map(|node| load(simd, node, c));
                    let (along_lower, along_upper) = (q[1] - q[0], q[3] - q[2]);
                    let lower = along_lower.mul_add(f32x8::splat(simd, f), q[0]);
                    let upper = along_upper.mul_add(f32x8::splat(simd, f), q[2]);
                    let along = (along_upper - along_lower).mul_add(f32x8::splat(simd, g), along_lower);
                    slopes[slot] = [along, upper - lower];
                    values[slot] = (upper - lower).mul_add(f32x8::splat(simd, g), lower);
                }
                let mut line_slopes = [zero; TEMPORAL.len()];
                for (line, (_, axis)) in TEMPORAL.into_iter().enumerate() {
                    let [below, above] = lines[line].map(|node| load(simd, node, c));
                    line_slopes[line] = above - below;
                    let fraction = f32x8::splat(simd, taps[axis].fraction);
                    values[SPATIAL.len() + line] = line_slopes[line].mul_add(fraction, below);
                }
                let mut v_values = [zero; PLANES];
                let mut running = load(simd, v_features, c);
                for plane in 0..PLANES {
                    v_values[plane] = running;
                    running *= values[plane];
                }
                let mut running = f32x8::splat(simd, 1.0);
                for plane in (0..PLANES).rev() {
                    v_values[plane] *= running;
                    running *= values[plane];
                }
                for (slot, (_, column, row_axis)) in SPATIAL.into_iter().enumerate() {
                    let v = v_values[slot];
                    for (axis, slope) in [column, row_axis].into_iter().zip(slopes[slot]) {
                        let scale = f32x8::splat(simd, taps[axis].slope);
                        v_position[axis] = (slope * scale).mul_add(v, v_position[axis]);
                    }
                    let start = (index * SPATIAL.len() + slot) * plane_len + row * channels;
                    store(v, &mut chunk.spatial[start..start + channels], c);
                }
                for (line, (_, axis)) in TEMPORAL.into_iter().enumerate() {
                    let (v, tap) = (v_values[SPATIAL.len() + line], taps[axis]);
                    let scale = f32x8::splat(simd, tap.slope);
                    v_position[axis] = (line_slopes[line] * scale).mul_add(v, v_position[axis]);
                    let start = level.line_offsets[line] + tap.node * channels;
                    let (below, above) = chunk.lines[start..start + 2 * channels].split_at_mut(channels);
                    add_scaled(simd, 1.0 - tap.fraction, v, below, c);
                    add_scaled(simd, tap.fraction, v, above, c);
                }
            }
        }
        chunk.positions[row] = v_position.map(sum);
    }
}

/// Adds gradients by the values of one spatial plane, `[positions, channels]`, to the nodes of a band of its rows, the first
/// of which is `first_row`. The plane is that of a level in a slot.
#[simd]
fn scatter_plane<S: Simd>(
    simd: S,
    at: &PlanesAtTime<'_>,
    [level, slot]: [usize; 2],
    first_row: usize,
    positions: &[[f32; 3]],
    values: &[f32],
    v_band: &mut [f32],
) {
    let channels = at.channels;
    let (plane, column_axis, row_axis) = SPATIAL[slot];
    let level = &at.levels[level];
    let next_row = level.layouts[plane].columns * channels;
    let rows = v_band.len() / next_row;
    for (position, v) in positions.iter().zip(values.chunks_exact(channels)) {
        let row = level.axes[row_axis].tap(position[row_axis]);
        // Both rows of nodes, each where it is of the band.
        if row.node + 1 < first_row || row.node >= first_row + rows {
            continue;
        }
        let column = level.axes[column_axis].tap(position[column_axis]);
        for (node, share) in [(row.node, 1.0 - row.fraction), (row.node + 1, row.fraction)] {
            if node < first_row || node >= first_row + rows {
                continue;
            }
            let start = (node - first_row) * next_row + column.node * channels;
            let (left, right) = v_band[start..start + 2 * channels].split_at_mut(channels);
            for c in (0..channels).step_by(LANES) {
                let v = load(simd, v, c);
                add_scaled(simd, (1.0 - column.fraction) * share, v, left, c);
                add_scaled(simd, column.fraction * share, v, right, c);
            }
        }
    }
}
