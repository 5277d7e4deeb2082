//! Levels of detail: which splats a level keeps.
//!
//! The coarser levels keep the more important splats and fewer spherical-harmonics coefficients, so that all of
//! them together add about a quarter to the bytes of a static or rigid instance. A level that is not selected is
//! not read.

use std::borrow::Cow;
use std::ops::Range;

use cif_scene::{Appearance, DenseSample, Motion, Node, Splats};

use crate::tokens::variants;

/// A level of detail.
#[derive(Clone, Copy, Debug)]
pub(super) struct Level {
    /// Its variant.
    pub(super) name: &'static str,
    /// Its prim in a payload.
    pub(super) prim: &'static str,
    /// Share of the splats that it keeps.
    share: f64,
    /// Highest degree of spherical harmonics that it keeps.
    degree: u8,
}

/// Finest first.
pub(super) const LEVELS: [Level; 3] = [
    Level { name: variants::FULL, prim: "/Full", share: 1.0, degree: u8::MAX },
    Level { name: variants::HALF, prim: "/Half", share: 0.5, degree: 1 },
    Level { name: variants::QUARTER, prim: "/Quarter", share: 0.25, degree: 0 },
];

/// Some splats of a node, all in one prim.
pub(super) struct Selection<'a> {
    node: &'a Node,
    picked: Picked,
    degree: u8,
}

enum Picked {
    Range(Range<usize>),
    Indices(Vec<u32>),
}

/// The splats of a node that a level keeps, ascending; `None` for all.
pub(super) fn kept(node: &Node, level: &Level) -> Option<Vec<u32>> {
    (level.share < 1.0).then(|| cif_scene::level_of_detail(node, level.share))
}

/// Those of a node, or of one of its parts, among the splats that a level keeps.
pub(super) fn selection<'a>(
    node: &'a Node,
    part: Option<usize>,
    level: &Level,
    kept: Option<&[u32]>,
) -> Selection<'a> {
    let range = match (node.motion.parts(), part) {
        (Some(motion), Some(part)) => motion.parts[part].splats.clone(),
        _ => 0..node.splats.len(),
    };
    let picked = match kept {
        None => Picked::Range(range),
        Some(kept) => {
            let place = |splat: usize| kept.partition_point(|&index| (index as usize) < splat);
            Picked::Indices(kept[place(range.start)..place(range.end)].to_vec())
        }
    };
    Selection { node, picked, degree: level.degree.min(node.splats.sh_degree) }
}

impl<'a> Selection<'a> {
    /// Degree of the spherical harmonics that are kept.
    pub(super) fn degree(&self) -> u8 {
        self.degree
    }

    /// All splats of the node.
    pub(super) fn all(&self) -> &'a Splats {
        &self.node.splats
    }

    /// Samples of the node where every splat has its own path.
    pub(super) fn samples(&self) -> &'a [DenseSample] {
        match &self.node.motion {
            Motion::Dense(dense) => &dense.samples,
            Motion::Static | Motion::Rigid(_) | Motion::Parts(_) => &[],
        }
    }

    /// True when all splats are selected in order.
    pub(super) fn is_whole(&self) -> bool {
        matches!(&self.picked, Picked::Range(range) if range.len() == self.node.splats.len())
    }

    /// The selected of values per splat of the node.
    pub(super) fn of<'v, T: Copy>(&self, values: &'v [T]) -> Cow<'v, [T]> {
        match &self.picked {
            Picked::Range(range) => Cow::Borrowed(&values[range.clone()]),
            Picked::Indices(indices) => {
                Cow::Owned(indices.iter().map(|&index| values[index as usize]).collect())
            }
        }
    }

    /// Changes of opacities and colours of the node over time.
    pub(super) fn appearance(&self) -> &'a Appearance {
        &self.node.appearance
    }

    /// The selected of coefficients of the node, cut to the degree.
    pub(super) fn coefficients<'v>(&self, of: &'v [f32]) -> Cow<'v, [f32]> {
        let floats = |degree| 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
        let (stored, kept) = (floats(self.all().sh_degree), floats(self.degree));
        match &self.picked {
            Picked::Range(range) if stored == kept => {
                Cow::Borrowed(&of[range.start * stored..range.end * stored])
            }
            Picked::Range(range) => Cow::Owned(cut(of, range.clone(), stored, kept)),
            Picked::Indices(indices) => {
                Cow::Owned(cut(of, indices.iter().map(|&index| index as usize), stored, kept))
            }
        }
    }
}

fn cut(of: &[f32], indices: impl ExactSizeIterator<Item = usize>, stored: usize, kept: usize) -> Vec<f32> {
    let mut coefficients = Vec::with_capacity(indices.len() * kept);
    for index in indices {
        let start = index * stored;
        coefficients.extend_from_slice(&of[start..start + kept]);
    }
    coefficients
}
