//! Patches on a grid, aligned by inverse compositional Gauss-Newton. Source: Kroeger et al. 2016, section 2.1.

use super::field::Flow;
use super::pyramid::Level;
use crate::plane::Plane;

/// Side of a patch, pixels.
pub(super) const SIDE: usize = 8;

/// Pixels between the corners of neighbouring patches.
const STRIDE: usize = 4;

/// Gauss-Newton steps per patch at most.
const STEPS: usize = 12;

/// A patch is aligned once a step is shorter than this, pixels.
const SHORT_STEP: f32 = 0.02;

/// Columns and rows by which the second image is continued, so that patches may leave it.
const BORDER: usize = SIDE + 8;

/// Displacements of the patches of a level.
pub(super) struct Patches {
    /// Top left corner of every patch along x, and along y, pixels.
    pub(super) lefts: Vec<usize>,
    pub(super) tops: Vec<usize>,
    /// `[tops][lefts]`.
    pub(super) moved: Vec<[f32; 2]>,
}

/// Corners that cover `0..size` with patches.
fn corners(size: usize) -> Vec<usize> {
    let last = size.saturating_sub(SIDE);
    let mut corners: Vec<usize> = (0..last).step_by(STRIDE).collect();
    corners.push(last);
    corners
}

/// The second image with its border continued.
struct Padded {
    width: usize,
    height: usize,
    stride: usize,
    data: Vec<f32>,
}

impl Padded {
    fn new(plane: &Plane) -> Self {
        let stride = plane.width + 2 * BORDER + 1;
        let mut data = Vec::with_capacity(stride * (plane.height + 2 * BORDER + 1));
        for y in -(BORDER as isize)..(plane.height + BORDER + 1) as isize {
            let row = plane.row(y);
            data.extend(std::iter::repeat_n(row[0], BORDER));
            data.extend_from_slice(row);
            data.extend(std::iter::repeat_n(row[row.len() - 1], BORDER + 1));
        }
        Self { width: plane.width, height: plane.height, stride, data }
    }

    /// The patch whose corner is at (x, y), interpolated, and its mean.
    fn patch(&self, x: f32, y: f32) -> ([[f32; SIDE]; SIDE], f32) {
        let border = BORDER as f32;
        let x = (x + border).max(0.0).min((self.width + 2 * BORDER - SIDE) as f32);
        let y = (y + border).max(0.0).min((self.height + 2 * BORDER - SIDE) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let weight = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let mut patch = [[0.0; SIDE]; SIDE];
        let mut sums = [0.0; SIDE];
        for (j, out) in patch.iter_mut().enumerate() {
            let start = (y0 + j) * self.stride + x0;
            let above: &[f32; SIDE + 1] =
                self.data[start..start + SIDE + 1].try_into().expect("a row of a patch");
            let start = start + self.stride;
            let below: &[f32; SIDE + 1] =
                self.data[start..start + SIDE + 1].try_into().expect("a row of a patch");
            for i in 0..SIDE {
                out[i] = weight[0] * above[i]
                    + weight[1] * above[i + 1]
                    + weight[2] * below[i]
                    + weight[3] * below[i + 1];
                sums[i] += out[i];
            }
        }
        (patch, sums.iter().sum::<f32>() / (SIDE * SIDE) as f32)
    }
}

/// Facts that a patch of the first image brings to every alignment: brightness without its mean, gradients without theirs,
/// and the inverse of the matrix of Gauss-Newton.
struct Template {
    brightness: [[f32; SIDE]; SIDE],
    dx: [[f32; SIDE]; SIDE],
    dy: [[f32; SIDE]; SIDE],
    /// xx, xy, yy.
    inverse: [f32; 3],
}

fn cut(plane: &Plane, left: usize, top: usize) -> [[f32; SIDE]; SIDE] {
    let mut patch = [[0.0; SIDE]; SIDE];
    let mut sum = 0.0;
    for (j, out) in patch.iter_mut().enumerate() {
        let row = plane.row((top + j) as isize);
        for (i, value) in out.iter_mut().enumerate() {
            *value = row[(left + i).min(row.len() - 1)];
            sum += *value;
        }
    }
    let mean = sum / (SIDE * SIDE) as f32;
    patch.iter_mut().flatten().for_each(|value| *value -= mean);
    patch
}

impl Template {
    fn new(level: &Level, left: usize, top: usize) -> Self {
        let brightness = cut(&level.brightness, left, top);
        let (dx, dy) = (cut(&level.dx, left, top), cut(&level.dy, left, top));
        let (mut xx, mut xy, mut yy) = ([0.0; SIDE], [0.0; SIDE], [0.0; SIDE]);
        for j in 0..SIDE {
            for i in 0..SIDE {
                xx[i] += dx[j][i] * dx[j][i];
                xy[i] += dx[j][i] * dy[j][i];
                yy[i] += dy[j][i] * dy[j][i];
            }
        }
        let sum = |values: [f32; SIDE]| values.iter().sum::<f32>();
        // A flat patch has no preferred place: the small addition keeps it where it is.
        let (xx, xy, yy) = (sum(xx) + 1.0, sum(xy), sum(yy) + 1.0);
        let determinant = xx * yy - xy * xy;
        let inverse = [yy / determinant, -xy / determinant, xx / determinant];
        Self { brightness, dx, dy, inverse }
    }

    /// Sum of squared differences to the second image, both without their means.
    fn cost(&self, second: &Padded, x: f32, y: f32) -> f32 {
        let (patch, mean) = second.patch(x, y);
        let mut sums = [0.0_f32; SIDE];
        for (row, own) in patch.iter().zip(&self.brightness) {
            for i in 0..SIDE {
                let difference = row[i] - mean - own[i];
                sums[i] += difference * difference;
            }
        }
        sums.iter().sum()
    }

    /// Aligns the patch at (left, top) from a displacement on; the displacement and its cost.
    fn align(&self, second: &Padded, left: f32, top: f32, start: [f32; 2]) -> ([f32; 2], f32) {
        let mut moved = start;
        let (mut best, mut least) = (start, f32::INFINITY);
        for _ in 0..STEPS {
            let (patch, mean) = second.patch(left + moved[0], top + moved[1]);
            let (mut cost, mut bx, mut by) = ([0.0_f32; SIDE], [0.0_f32; SIDE], [0.0_f32; SIDE]);
            for j in 0..SIDE {
                for i in 0..SIDE {
                    let difference = patch[j][i] - mean - self.brightness[j][i];
                    cost[i] += difference * difference;
                    bx[i] += difference * self.dx[j][i];
                    by[i] += difference * self.dy[j][i];
                }
            }
            let cost: f32 = cost.iter().sum();
            if cost >= least {
                break;
            }
            (best, least) = (moved, cost);
            let (bx, by) = (bx.iter().sum::<f32>(), by.iter().sum::<f32>());
            let [xx, xy, yy] = self.inverse;
            let step = [xx * bx + xy * by, xy * bx + yy * by];
            if step[0] * step[0] + step[1] * step[1] < SHORT_STEP * SHORT_STEP {
                break;
            }
            moved = [moved[0] - step[0], moved[1] - step[1]];
        }
        // A patch that ran away has lost its structure.
        let away = [best[0] - start[0], best[1] - start[1]];
        if away[0] * away[0] + away[1] * away[1] > (SIDE * SIDE) as f32 {
            return (start, self.cost(second, left + start[0], top + start[1]));
        }
        (best, least)
    }
}

/// Aligns all patches of a level. Each starts from the best of what the coarser level says and of what its
/// neighbours found: those to the left and above in a first sweep, those to the right and below in a second.
pub(super) fn search(first: &Level, second: &Plane, start: &Flow) -> Patches {
    let second = Padded::new(second);
    let (lefts, tops) = (corners(first.brightness.width), corners(first.brightness.height));
    let columns = lefts.len();
    let mut templates = Vec::with_capacity(columns * tops.len());
    for top in &tops {
        templates.extend(lefts.iter().map(|left| Template::new(first, *left, *top)));
    }
    let mut moved = Vec::with_capacity(templates.len());
    let mut costs = Vec::with_capacity(templates.len());
    for (row, top) in tops.iter().enumerate() {
        for (column, left) in lefts.iter().enumerate() {
            let (x, y) = (*left as f32, *top as f32);
            let template = &templates[row * columns + column];
            let middle = (top + SIDE / 2).min(first.brightness.height - 1) * first.brightness.width
                + (left + SIDE / 2).min(first.brightness.width - 1);
            let mut from = [start.u.data[middle], start.v.data[middle]];
            let mut least = template.cost(&second, x + from[0], y + from[1]);
            let neighbours = [
                (column > 0).then(|| row * columns + column - 1),
                (row > 0).then(|| (row - 1) * columns + column),
            ];
            for neighbour in neighbours.into_iter().flatten() {
                let candidate: [f32; 2] = moved[neighbour];
                let cost = template.cost(&second, x + candidate[0], y + candidate[1]);
                if cost < least {
                    (from, least) = (candidate, cost);
                }
            }
            let (found, cost) = template.align(&second, x, y, from);
            moved.push(found);
            costs.push(cost);
        }
    }
    for (row, top) in tops.iter().enumerate().rev() {
        for (column, left) in lefts.iter().enumerate().rev() {
            let (x, y) = (*left as f32, *top as f32);
            let at = row * columns + column;
            let neighbours =
                [(column + 1 < columns).then_some(at + 1), (row + 1 < tops.len()).then_some(at + columns)];
            let mut better = None;
            for neighbour in neighbours.into_iter().flatten() {
                let candidate = moved[neighbour];
                let cost = templates[at].cost(&second, x + candidate[0], y + candidate[1]);
                if cost < costs[at] {
                    costs[at] = cost;
                    better = Some(candidate);
                }
            }
            if let Some(from) = better {
                (moved[at], costs[at]) = templates[at].align(&second, x, y, from);
            }
        }
    }
    Patches { lefts, tops, moved }
}
