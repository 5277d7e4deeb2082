//! Displacements of patches blended into a dense field. Source: Kroeger et al. 2016, equation 3.

use super::field::Flow;
use super::patches::{Patches, SIDE};
use super::pyramid::Level;
use crate::plane::Plane;

/// The mean of the displacements of all patches over a pixel, weighted by 1 / max(1, |difference of brightness|) of the
/// pixel under each; pixels without a patch keep `start`.
pub(super) fn blend(first: &Level, second: &Plane, patches: &Patches, start: Flow) -> Flow {
    let (width, height) = (first.brightness.width, first.brightness.height);
    let mut sums = vec![[0.0_f32; 3]; width * height];
    for (row, top) in patches.tops.iter().enumerate() {
        for (column, left) in patches.lefts.iter().enumerate() {
            let [u, v] = patches.moved[row * patches.lefts.len() + column];
            // One fraction for the whole patch.
            let (floor_u, floor_v) = (u.floor(), v.floor());
            let (fx, fy) = (u - floor_u, v - floor_v);
            let weight = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
            let (du, dv) = (floor_u as isize, floor_v as isize);
            let right = (left + SIDE).min(width);
            for y in *top..(top + SIDE).min(height) {
                let own = &first.brightness.data[y * width + left..y * width + right];
                let out = &mut sums[y * width + left..y * width + right];
                let (above, below) = (second.row(y as isize + dv), second.row(y as isize + dv + 1));
                let from = *left as isize + du;
                let inside = from >= 0 && from as usize + (right - left) < width;
                for (i, (own, out)) in own.iter().zip(out).enumerate() {
                    let x = from + i as isize;
                    let (x0, x1) = if inside {
                        (x as usize, x as usize + 1)
                    } else {
                        let clamp = |x: isize| x.clamp(0, width as isize - 1) as usize;
                        (clamp(x), clamp(x + 1))
                    };
                    let there = weight[0] * above[x0]
                        + weight[1] * above[x1]
                        + weight[2] * below[x0]
                        + weight[3] * below[x1];
                    let share = 1.0 / (there - own).abs().max(1.0);
                    out[0] += share * u;
                    out[1] += share * v;
                    out[2] += share;
                }
            }
        }
    }
    let mut field = start;
    for (k, [u, v, sum]) in sums.into_iter().enumerate() {
        if sum > 0.0 {
            field.u.data[k] = u / sum;
            field.v.data[k] = v / sum;
        }
    }
    field
}
