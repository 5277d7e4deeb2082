//! Recognises points that a program drew at random: uniform in a box, with colours that have nothing to do with places.
//!
//! Code of 3D Gaussian splatting starts captures without points from such a cube and leaves it next to them as
//! `points3d.ply`, `fused.ply` or `sparse_pc.ply`, where it reads like a reconstruction. Three statistics have a known
//! distribution for such points, whatever the box and their number, and a bound is passed by chance about once in a
//! million clouds:
//! - the distance of each coordinate's distribution from the uniform one between its ends (Kolmogorov and Smirnov:
//!   `P(D > x / sqrt(n)) <= 2 exp(-2 x^2)`);
//! - the counts in the cells of a grid (chi-squared of `cells - 1` degrees of freedom, here nearly normal);
//! - the share of the variance of colours that lies between cells (F of `cells - 1` and `n - cells`, with mean 1).
//!
//! A surface leaves cells empty from four cells along each side on, and cells need points: clouds of fewer than 512 are
//! taken as measured.

use crate::files::points::RawPoints;

/// Points looked at, spread evenly over the cloud; more add nothing.
const MOST: usize = 20_000;

/// Points per cell on average, from which on counts are nearly normal.
const PER_CELL: usize = 8;

/// Fewest cells along a side that distinguish a surface from a volume.
const FEWEST_CELLS: usize = 4;

/// `x` of the distance's bound, for a chance of 1e-6: `sqrt(ln(2 / 1e-6) / 2)`.
const DISTANCE: f64 = 2.69;

/// Standard deviations of the other two bounds: beyond five of a normal distribution lie 6e-7, and a chi-squared or F
/// distribution of 63 degrees of freedom has as much beyond seven.
const DEVIATIONS: f64 = 7.0;

/// True when points are indistinguishable from ones drawn uniformly in a box, with colours drawn regardless of places
/// or one for all.
pub(crate) fn are_made_up(points: &RawPoints) -> bool {
    let step = points.positions.len().div_ceil(MOST).max(1);
    let positions: Vec<[f64; 3]> = points.positions.iter().step_by(step).copied().collect();
    let per_side = ((positions.len() / PER_CELL) as f64).cbrt().floor() as usize;
    if per_side < FEWEST_CELLS {
        return false;
    }
    // The ends of each axis are two of the points, the others uniform between them.
    let mut along = [const { Vec::new() }; 3];
    for (axis, values) in along.iter_mut().enumerate() {
        values.extend(positions.iter().map(|position| position[axis]));
        values.sort_unstable_by(f64::total_cmp);
        if !is_uniform(values) {
            return false;
        }
    }
    let cell = |position: &[f64; 3]| {
        (0..3).fold(0, |cell, axis| {
            let (low, high) = (along[axis][0], along[axis][positions.len() - 1]);
            let at = (position[axis] - low) / (high - low) * per_side as f64;
            cell * per_side + (at as usize).min(per_side - 1)
        })
    };
    let cells: Vec<usize> = positions.iter().map(cell).collect();
    let count = per_side.pow(3);
    fill_evenly(&cells, count)
        && points.colors.as_ref().is_none_or(|colors| {
            let colors: Vec<[u8; 3]> = colors.iter().step_by(step).copied().collect();
            (0..3).all(|channel| {
                let values: Vec<f64> = colors.iter().map(|color| f64::from(color[channel])).collect();
                are_regardless_of(&values, &cells, count)
            })
        })
}

/// True when ascending values are as near to a uniform distribution between the first and the last as drawn ones are.
fn is_uniform(values: &[f64]) -> bool {
    let n = values.len() as f64;
    let (low, high) = (values[0], values[values.len() - 1]);
    if high <= low {
        return false;
    }
    let distance = values
        .iter()
        .enumerate()
        .map(|(k, value)| {
            let share = (value - low) / (high - low);
            (share - k as f64 / n).abs().max(((k + 1) as f64 / n - share).abs())
        })
        .fold(0.0, f64::max);
    distance <= DISTANCE / n.sqrt()
}

/// True when cells hold as many points as drawn ones would: neither clumps and gaps, nor a regular grid.
fn fill_evenly(cells: &[usize], count: usize) -> bool {
    let mut counts = vec![0_u32; count];
    for cell in cells {
        counts[*cell] += 1;
    }
    let expected = cells.len() as f64 / count as f64;
    let chi_squared: f64 = counts.iter().map(|count| (f64::from(*count) - expected).powi(2) / expected).sum();
    let freedom = (count - 1) as f64;
    (chi_squared - freedom).abs() <= DEVIATIONS * (2.0 * freedom).sqrt()
}

/// True when the means of cells differ no more than values regardless of the cells would make them.
fn are_regardless_of(values: &[f64], cells: &[usize], count: usize) -> bool {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let mut sums = vec![(0.0, 0.0); count];
    for (value, cell) in values.iter().zip(cells) {
        sums[*cell].0 += value - mean;
        sums[*cell].1 += 1.0;
    }
    let total: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let between: f64 = sums.iter().filter(|(_, n)| *n > 0.0).map(|(sum, n)| sum * sum / n).sum();
    let occupied = sums.iter().filter(|(_, n)| *n > 0.0).count() as f64;
    let (of_cells, of_points) = (occupied - 1.0, n - occupied);
    let deviation = (2.0 / of_cells + 2.0 / of_points).sqrt();
    // One colour for all has no variance to share out.
    between / of_cells
        <= (1.0 + DEVIATIONS * deviation) * (total - between).max(0.0) / of_points + f64::EPSILON * n
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    /// Points in a box, and their colours, from four uniform numbers each.
    fn drawn(
        count: usize,
        seed: u64,
        position: impl Fn([f32; 3]) -> [f32; 3],
        color: impl Fn([f32; 3], [f32; 3]) -> [u8; 3],
    ) -> RawPoints {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let (positions, colors) = (0..count)
            .map(|_| {
                let (place, hue): ([f32; 3], [f32; 3]) = (random.random(), random.random());
                (position(place), color(place, hue))
            })
            .unzip();
        let positions: Vec<[f32; 3]> = positions;
        RawPoints {
            positions: positions.into_iter().map(|position| position.map(f64::from)).collect(),
            colors: Some(colors),
            note: None,
        }
    }

    fn cube(unit: [f32; 3]) -> [f32; 3] {
        unit.map(|v| 2.6 * v - 1.3)
    }

    fn random_color(_: [f32; 3], hue: [f32; 3]) -> [u8; 3] {
        hue.map(|v| (v * 255.0) as u8)
    }

    #[test]
    fn drawn_cubes_are_recognised_whatever_their_number_box_and_colours() {
        for seed in 0..20 {
            for count in [600, 2_000, 10_000] {
                assert!(are_made_up(&drawn(count, seed, cube, random_color)), "{count}, seed {seed}");
            }
        }
        assert!(are_made_up(&drawn(100_000, 1, cube, random_color)));
        // As 3DGS writes them: every colour is a grey of 127.
        assert!(are_made_up(&drawn(2_000, 2, cube, |_, _| [127; 3])));
        let oblong = |[x, y, z]: [f32; 3]| [900.0 * x + 3e3, 0.01 * y, 7.0 * z];
        assert!(are_made_up(&drawn(2_000, 3, oblong, random_color)));
        let mut without = drawn(2_000, 4, cube, random_color);
        without.colors = None;
        assert!(are_made_up(&without));
    }

    #[test]
    fn what_is_measured_is_not_taken_for_drawn() {
        let by_place = |place: [f32; 3], _: [f32; 3]| place.map(|v| (v * 255.0) as u8);
        assert!(!are_made_up(&drawn(2_000, 5, cube, by_place)), "colours that follow the place");
        let faint = |place: [f32; 3], hue: [f32; 3]| {
            std::array::from_fn(|k| ((0.3 * place[k] + 0.7 * hue[k]) * 255.0) as u8)
        };
        assert!(!are_made_up(&drawn(2_000, 6, cube, faint)), "colours that follow it a little");
        // The walls of a room, every coordinate of which is spread evenly but for its ends.
        let room = |[x, y, z]: [f32; 3]| match (z * 6.0) as u32 {
            side @ 0..=1 => [side as f32, x, y],
            side @ 2..=3 => [x, (side - 2) as f32, y],
            side => [x, y, side.min(5) as f32 - 4.0],
        };
        assert!(!are_made_up(&drawn(2_000, 7, room, random_color)), "walls");
        // A slanted plane: all three coordinates are uniform, the cells off it are empty.
        let slanted = |[x, y, _]: [f32; 3]| [x, y, if x + y < 1.0 { x + y } else { x + y - 1.0 }];
        assert!(!are_made_up(&drawn(2_000, 8, slanted, random_color)), "planes");
        let ball = |unit: [f32; 3]| {
            let [x, y, z] = unit.map(|v| 2.0 * v - 1.0);
            let scale = (x * x + y * y + z * z).sqrt().max(1.0);
            [x / scale, y / scale, z / scale]
        };
        assert!(!are_made_up(&drawn(2_000, 9, ball, random_color)), "a ball");
        let grid = RawPoints {
            positions: (0..4_096_u32).map(|k| [k % 16, k / 16 % 16, k / 256].map(f64::from)).collect(),
            colors: None,
            note: None,
        };
        assert!(!are_made_up(&grid), "a regular grid");
        assert!(!are_made_up(&drawn(300, 10, cube, random_color)), "too few to tell");
        let flat = |[x, y, _]: [f32; 3]| [x, y, 0.0];
        assert!(!are_made_up(&drawn(2_000, 11, flat, random_color)), "flat");
    }
}
