//! Which splats of a node differ.

use std::collections::BTreeMap;

use cif_geometry::spherical_harmonics::coefficient_count;
use serde::Serialize;

use crate::graph::{DenseMotion, Motion};
use crate::{Node, Splats};

/// Differences below these are none.
const SAME_COLOR: f32 = 1e-4;
const SAME_OPACITY: f32 = 1e-4;
/// Relative.
const SAME_SCALE: f32 = 1e-4;
/// Part of `1 + |mean|`, world units.
const SAME_MEAN: f32 = 1e-5;
/// 1 minus the dot product of unit quaternions: a fifth of a degree.
const SAME_ORIENTATION: f32 = 2e-6;

/// Number of splats of an object that differ, by kind of difference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SplatChanges {
    /// Only in the second graph.
    pub added: usize,
    /// Only in the first.
    pub removed: usize,
    /// Of another colour.
    pub recoloured: usize,
    /// Of another opacity or occupancy.
    pub faded: usize,
    /// Of another size.
    pub resized: usize,
    /// At another place in the object's frame, or turned in it, at some time.
    pub reshaped: usize,
}

impl SplatChanges {
    /// True when none differs.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// In words, one each.
    #[must_use]
    pub fn describe(&self) -> Vec<String> {
        let counts = [
            (self.added, "added"),
            (self.removed, "removed"),
            (self.recoloured, "recoloured"),
            (self.faded, "of another opacity"),
            (self.resized, "resized"),
            (self.reshaped, "moved within the object"),
        ];
        counts
            .into_iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, what)| format!("{count} splats {what}"))
            .collect()
    }
}

/// Splats of two nodes that correspond, and what differs.
#[derive(Clone, Debug, Default)]
pub(crate) struct SplatPairs {
    /// Pairs of positions that are there in both and keep their shape, apart from size.
    pub(crate) kept: Vec<(usize, usize)>,
    /// Those of another shape.
    pub(crate) reshaped: Vec<(usize, usize)>,
    /// Positions only in the first node.
    pub(crate) removed: Vec<usize>,
    /// Positions only in the second node.
    pub(crate) added: Vec<usize>,
}

/// Pairs splats by row, or by position where rows say nothing.
pub(crate) fn pair(first: &Node, second: &Node, same_rows: bool) -> SplatPairs {
    let mut result = SplatPairs::default();
    let (a, b) = (&first.splats, &second.splats);
    let mut pairs: Vec<(usize, usize)> = Vec::with_capacity(b.len());
    if same_rows && a.rows.len() == a.len() && b.rows.len() == b.len() {
        let mut positions: BTreeMap<u32, usize> =
            a.rows.iter().enumerate().map(|(position, row)| (*row, position)).collect();
        for (position, row) in b.rows.iter().enumerate() {
            match positions.remove(row).filter(|_| *row != Splats::NO_ROW) {
                Some(other) => pairs.push((other, position)),
                None => result.added.push(position),
            }
        }
        result.removed = positions.into_values().collect();
        result.removed.sort_unstable();
    } else {
        let common = if a.len() == b.len() { a.len() } else { 0 };
        pairs.extend((0..common).map(|position| (position, position)));
        result.removed = (common..a.len()).collect();
        result.added = (common..b.len()).collect();
    }
    let shapes = Shapes::of(first, second);
    for (i, j) in pairs {
        if shapes.as_ref().is_some_and(|shapes| shapes.same(i, j)) {
            result.kept.push((i, j));
        } else {
            result.reshaped.push((i, j));
        }
    }
    result
}

/// Numbers of splats that differ between two nodes.
pub(crate) fn compare(first: &Node, second: &Node, same_rows: bool) -> SplatChanges {
    let pairs = pair(first, second, same_rows);
    let (a, b) = (&first.splats, &second.splats);
    let all = || pairs.kept.iter().chain(&pairs.reshaped);
    let count = |differs: &dyn Fn(usize, usize) -> bool| all().filter(|(i, j)| differs(*i, *j)).count();
    SplatChanges {
        added: pairs.added.len(),
        removed: pairs.removed.len(),
        recoloured: count(&|i, j| is_recoloured(a, i, b, j)),
        faded: count(&|i, j| is_faded(a, i, b, j)),
        resized: pairs.kept.iter().filter(|(i, j)| is_resized(a, *i, b, *j)).count(),
        reshaped: pairs.reshaped.len(),
    }
}

/// Coefficients of a splat.
pub(crate) fn coefficients(splats: &Splats, position: usize) -> &[f32] {
    let stride = 3 * coefficient_count(splats.sh_degree);
    &splats.sh_coefficients[position * stride..(position + 1) * stride]
}

pub(crate) fn is_recoloured(a: &Splats, i: usize, b: &Splats, j: usize) -> bool {
    let (x, y) = (coefficients(a, i), coefficients(b, j));
    let common = x.len().min(y.len());
    let differs = |(x, y): (&f32, &f32)| (x - y).abs() > SAME_COLOR;
    x.iter().zip(y).any(differs) || x[common..].iter().chain(&y[common..]).any(|v| v.abs() > SAME_COLOR)
}

pub(crate) fn is_faded(a: &Splats, i: usize, b: &Splats, j: usize) -> bool {
    let differs =
        |x: &[f32], y: &[f32]| x.get(i).zip(y.get(j)).is_some_and(|(x, y)| (x - y).abs() > SAME_OPACITY);
    differs(&a.opacities, &b.opacities) || differs(&a.occupancies, &b.occupancies)
}

pub(crate) fn is_resized(a: &Splats, i: usize, b: &Splats, j: usize) -> bool {
    !same_scale(a.scales[i], b.scales[j])
}

fn same_scale(a: [f32; 3], b: [f32; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() <= SAME_SCALE * a.abs())
}

fn same_mean(a: [f32; 3], b: [f32; 3]) -> bool {
    let size = a.iter().map(|v| v * v).sum::<f32>().sqrt();
    a.iter().zip(b).all(|(a, b)| (a - b).abs() <= SAME_MEAN * (1.0 + size))
}

fn same_orientation(a: [f32; 4], b: [f32; 4]) -> bool {
    a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>().abs() >= 1.0 - SAME_ORIENTATION
}

/// Shapes of two nodes over all their samples; none where their motions cannot be compared sample by sample.
enum Shapes<'a> {
    Fixed(&'a Node, &'a Node),
    Dense(&'a Node, &'a DenseMotion, &'a Node, &'a DenseMotion),
}

impl<'a> Shapes<'a> {
    fn of(first: &'a Node, second: &'a Node) -> Option<Self> {
        match (&first.motion, &second.motion) {
            (Motion::Dense(a), Motion::Dense(b)) => {
                let codes = |dense: &DenseMotion| -> Vec<f64> {
                    dense.samples.iter().map(|sample| sample.time_code).collect()
                };
                (codes(a) == codes(b)).then_some(Self::Dense(first, a, second, b))
            }
            (Motion::Dense(_), _) | (_, Motion::Dense(_)) => None,
            (Motion::Parts(_), _) | (_, Motion::Parts(_)) => {
                super::units::matching(first, second).map(|_| Self::Fixed(first, second))
            }
            _ => Some(Self::Fixed(first, second)),
        }
    }

    fn same(&self, i: usize, j: usize) -> bool {
        match self {
            Self::Fixed(first, second) => {
                let (a, b) = (&first.splats, &second.splats);
                same_mean(a.means[i], b.means[j])
                    && same_orientation(a.orientations[i], b.orientations[j])
                    && part_name(first, i) == part_name(second, j)
            }
            Self::Dense(first, a, second, b) => a.samples.iter().zip(&b.samples).all(|(s, t)| {
                let scale = |sample: &crate::DenseSample, node: &Node, at: usize| {
                    sample.scales.as_ref().map_or(node.splats.scales[at], |scales| scales[at])
                };
                same_mean(s.means[i], t.means[j])
                    && same_orientation(s.orientations[i], t.orientations[j])
                    && same_scale(scale(s, first, i), scale(t, second, j))
            }),
        }
    }
}

/// Part that a splat is in; empty for a whole node.
fn part_name(node: &Node, splat: usize) -> &str {
    match &node.motion {
        Motion::Parts(parts) => {
            parts.parts.iter().find(|part| part.splats.contains(&splat)).map_or("", |part| &part.name)
        }
        _ => "",
    }
}
