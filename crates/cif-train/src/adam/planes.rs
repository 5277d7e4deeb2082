//! The planes' step: regulariser gradient and Adam in one sweep, so that the planes pass through memory once.
//! Source: methods reference 1.4 and 11 (idea 13).

use cif_field::deformation::{DeformationConfig, PlaneLayout, is_time_plane};
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::{BiasCorrection, EPSILON, Moments, NotFinite, all_finite, update};

/// Weights of the plane regularisers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlaneWeights {
    /// Second difference of the spatial planes.
    pub smoothness: f32,
    /// Second difference of the time planes, along time.
    pub time_smoothness: f32,
    /// Mean absolute distance of the time planes from 1.
    pub time_sparsity: f32,
}

/// Rows that one task sweeps.
const BAND_ROWS: usize = 16;

/// Rows next to a band that its second differences read.
const HALO_ROWS: usize = 4;

/// Gradient factors of one plane: of the second difference, and of the distance from 1.
pub(crate) fn factors(
    layout: &PlaneLayout,
    plane: usize,
    channels: usize,
    weights: &PlaneWeights,
) -> (f32, f32) {
    let floats_per_row = (layout.columns * channels) as f64;
    let over = |weight: f32, rows: usize| {
        if rows == 0 { 0.0 } else { (f64::from(weight) / (rows as f64 * floats_per_row)) as f32 }
    };
    let differences = layout.counted_rows.saturating_sub(2);
    if is_time_plane(plane) {
        (2.0 * over(weights.time_smoothness, differences), over(weights.time_sparsity, layout.counted_rows))
    } else {
        (2.0 * over(weights.smoothness, differences), 0.0)
    }
}

/// A band of rows of one plane, with everything its update needs.
struct Band<'a> {
    parameters: &'a mut [f32],
    gradients: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    /// Old values of the two rows before and the two after, where they exist.
    halo: &'a [f32],
    first_row: usize,
    rows: usize,
    row_len: usize,
    factors: (f32, f32),
}

/// One step of all planes; `halo` is scratch kept between steps. Gradients become zero.
///
/// # Errors
/// When a gradient is not finite.
///
/// # Panics
/// When the lengths differ from the layout's.
pub fn step_planes(
    moments: &mut Moments,
    planes: &mut [f32],
    gradients: &mut [f32],
    config: &DeformationConfig,
    weights: &PlaneWeights,
    rate: f32,
    halo: &mut Vec<f32>,
) -> Result<(), NotFinite> {
    let (levels, floats) = config.plane_layout();
    assert_eq!(planes.len(), floats, "planes differ from their layout in length");
    assert_eq!(gradients.len(), floats, "gradients and planes differ in length");
    moments.steps += 1;
    let bias = BiasCorrection::after(moments.steps);
    let channels = config.channels as usize;

    halo.clear();
    for layout in levels.iter().flatten() {
        let row_len = layout.columns * channels;
        let plane = &planes[layout.offset..layout.offset + layout.rows * row_len];
        for first_row in (0..layout.rows).step_by(BAND_ROWS) {
            let last = (first_row + BAND_ROWS).min(layout.rows);
            for row in [first_row.checked_sub(2), first_row.checked_sub(1), Some(last), Some(last + 1)] {
                match row.filter(|row| *row < layout.rows) {
                    Some(row) => halo.extend_from_slice(&plane[row * row_len..(row + 1) * row_len]),
                    None => halo.resize(halo.len() + row_len, 0.0),
                }
            }
        }
    }

    let mut bands = Vec::new();
    let mut left = (planes, gradients, &mut moments.first[..], &mut moments.second[..]);
    let mut halo_left = &halo[..];
    for level in &levels {
        for (plane, layout) in level.iter().enumerate() {
            let row_len = layout.columns * channels;
            let factors = factors(layout, plane, channels, weights);
            for first_row in (0..layout.rows).step_by(BAND_ROWS) {
                let len = BAND_ROWS.min(layout.rows - first_row) * row_len;
                let (parameters, planes_left) = left.0.split_at_mut(len);
                let (gradients, gradients_left) = left.1.split_at_mut(len);
                let (first, first_left) = left.2.split_at_mut(len);
                let (second, second_left) = left.3.split_at_mut(len);
                left = (planes_left, gradients_left, first_left, second_left);
                let (halo, rest) = halo_left.split_at(HALO_ROWS * row_len);
                halo_left = rest;
                bands.push(Band {
                    parameters,
                    gradients,
                    first,
                    second,
                    halo,
                    first_row,
                    rows: layout.rows,
                    row_len,
                    factors,
                });
            }
        }
    }
    let level = Level::new();
    let sweep = |band| dispatch!(level, _simd => sweep(band, rate, bias));
    bands.into_par_iter().map(sweep).reduce(|| Ok(()), Result::and)
}

/// Updates a band row by row; old values of the two rows above are kept aside.
#[inline(always)]
fn sweep(band: Band<'_>, rate: f32, bias: BiasCorrection) -> Result<(), NotFinite> {
    if !all_finite(band.gradients) {
        return Err(NotFinite);
    }
    let n = band.row_len;
    let band_rows = band.parameters.len() / n;
    let mut above_2 = band.halo[..n].to_vec();
    let mut above_1 = band.halo[n..2 * n].to_vec();
    for local in 0..band_rows {
        let row = band.first_row + local;
        let (head, below) = band.parameters.split_at_mut((local + 1) * n);
        let current = &mut head[local * n..];
        let below_row = |distance: usize| {
            if local + distance < band_rows {
                &below[(distance - 1) * n..distance * n]
            } else {
                let outside = local + distance - band_rows;
                &band.halo[(2 + outside) * n..(3 + outside) * n]
            }
        };
        let below_1 = if row + 1 < band.rows { below_row(1) } else { &above_1[..] };
        let below_2 = if row + 2 < band.rows { below_row(2) } else { &above_1[..] };
        let range = local * n..(local + 1) * n;
        let gradient = &mut band.gradients[range.clone()];
        let (smooth, sparse) = band.factors;
        if smooth != 0.0 {
            // Whether the second difference starting at this row, one above, two above exists.
            let here = if row + 2 < band.rows { smooth } else { 0.0 };
            let one_up = if row >= 1 && row + 1 < band.rows { -2.0 * smooth } else { 0.0 };
            let two_up = if row >= 2 { smooth } else { 0.0 };
            let gradient = &mut gradient[..n];
            let (above_2, above_1, current) = (&above_2[..n], &above_1[..n], &current[..n]);
            let (below_1, below_2) = (&below_1[..n], &below_2[..n]);
            for k in 0..n {
                let (a2, a1, c, b1, b2) = (above_2[k], above_1[k], current[k], below_1[k], below_2[k]);
                gradient[k] +=
                    here * (b2 - 2.0 * b1 + c) + one_up * (b1 - 2.0 * c + a1) + two_up * (c - 2.0 * a1 + a2);
            }
        }
        if sparse != 0.0 {
            for (g, p) in gradient.iter_mut().zip(current.iter()) {
                *g += sparse * (f32::from(*p > 1.0) - f32::from(*p < 1.0));
            }
        }
        std::mem::swap(&mut above_2, &mut above_1);
        above_1.copy_from_slice(current);
        update(
            current,
            gradient,
            &mut band.first[range.clone()],
            &mut band.second[range.clone()],
            rate,
            bias,
            EPSILON,
        );
        gradient.fill(0.0);
    }
    Ok(())
}
