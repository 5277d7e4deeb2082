//! Convex colliders of nodes.
//!
//! Colliders enclose their splats: those of a node (of every part, where it has some) hold at least [`ENCLOSED`] of
//! the opacity of its splats, and of what is seen of them (see [`Splats::importance`]), counted by their centres. The
//! two measures differ where many small or faint splats lie around few broad ones; a simulation that shows an object
//! outside its collider is wrong by either. Splats that stick out of the bulk are left out as far as that allows
//! (see `body`).
//!
//! A collider is the hull of these centres and of the ends of the axes of the opaque ones. A concave node can have several hulls: its splats are cut by planes, each
//! time where that takes most off the summed volume.

use glam::DVec3;
use nalgebra::Matrix3;

use crate::shape::body::{Blob, Cloud, STRAYS};
use crate::shape::convex_hull::{self, HullMesh};
use crate::{ConvexHull, Motion, Node};
use cif_geometry::stats::weighted_quantile;

/// Share of the opacity, and of what is seen, that colliders hold at least: what strays and what few corners cut off
/// share the rest.
pub const ENCLOSED: f64 = (1.0 - STRAYS) * HELD;
/// Share of the rest that every hull holds.
const HELD: f64 = 0.99;
/// Splats at most that cuts are judged by.
const JUDGED: usize = 400;
/// A cut that takes less than this share off a piece's volume is not made: cutting a cloud in two always
/// loses a little.
const MIN_GAIN: f64 = 0.15;
/// Places where a cut is tried: quantiles of the weight along each principal axis.
const CUTS: [f64; 7] = [0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9];

/// Hulls of a node, `hulls` at most (every part has one at least), in its local frame or its parts' frames.
#[must_use]
pub fn colliders(node: &Node, hulls: usize) -> Vec<ConvexHull> {
    if hulls == 0 {
        return Vec::new();
    }
    let ranges: Vec<(Option<usize>, std::ops::Range<usize>)> = match &node.motion {
        Motion::Parts(motion) => {
            motion.parts.iter().enumerate().map(|(part, p)| (Some(part), p.splats.clone())).collect()
        }
        _ => vec![(None, 0..node.splats.len())],
    };
    let each = (hulls / ranges.len()).max(1);
    let importance = node.splats.importance();
    ranges
        .into_iter()
        .flat_map(|(part, range)| {
            let blobs = Cloud::of(&node.splats, &importance, range).body();
            decompose(blobs, each).into_iter().filter_map(move |blobs| {
                let mesh = hull(&blobs)?;
                Some(ConvexHull {
                    points: mesh.points.iter().map(|p| p.to_array().map(|v| v as f32)).collect(),
                    triangles: mesh.triangles,
                    part,
                })
            })
        })
        .collect()
}

fn hull(blobs: &[Blob]) -> Option<HullMesh> {
    let points: Vec<DVec3> =
        blobs.iter().flat_map(|blob| blob.ends.iter().copied().chain([blob.centre])).collect();
    let mut mesh = convex_hull::convex_hull(&points)?;
    let centres: Vec<DVec3> = blobs.iter().map(|blob| blob.centre).collect();
    for weight in [|blob: &Blob| blob.opacity, |blob: &Blob| blob.seen] {
        let weights: Vec<f64> = blobs.iter().map(weight).collect();
        mesh.grow_to_hold(&centres, &weights, HELD);
    }
    Some(mesh)
}

/// A piece, and the best cut of it.
struct Piece {
    blobs: Vec<Blob>,
    cut: Option<Cut>,
}

struct Cut {
    axis: DVec3,
    offset: f64,
    /// Volume that it saves.
    gain: f64,
}

/// Cuts splats into at most `count` groups with convex hulls of little summed volume.
fn decompose(blobs: Vec<Blob>, count: usize) -> Vec<Vec<Blob>> {
    if count == 1 || blobs.len() < 2 {
        return vec![blobs];
    }
    let mut pieces = vec![piece(blobs)];
    while pieces.len() < count {
        let best = (0..pieces.len())
            .filter_map(|index| Some((index, pieces[index].cut.as_ref()?.gain)))
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
        let Some((index, _)) = best else { break };
        let Piece { blobs, cut, .. } = pieces.swap_remove(index);
        let Some(Cut { axis, offset, .. }) = cut else { break };
        let (low, high): (Vec<Blob>, Vec<Blob>) =
            blobs.into_iter().partition(|blob| axis.dot(blob.centre) <= offset);
        pieces.push(piece(low));
        pieces.push(piece(high));
    }
    pieces.into_iter().map(|piece| piece.blobs).collect()
}

fn piece(blobs: Vec<Blob>) -> Piece {
    let judged: Vec<&Blob> = {
        let step = blobs.len().div_ceil(JUDGED).max(1);
        blobs.iter().step_by(step).collect()
    };
    let volume_of = |blobs: &mut dyn Iterator<Item = &&Blob>| {
        let points: Vec<DVec3> =
            blobs.flat_map(|blob| blob.ends.iter().copied().chain([blob.centre])).collect();
        convex_hull::convex_hull(&points).map_or(0.0, |mesh| mesh.volume())
    };
    let volume = volume_of(&mut judged.iter());
    let weights: Vec<f64> = judged.iter().map(|blob| blob.seen).collect();
    let mut cut: Option<Cut> = None;
    for axis in principal_axes(&judged) {
        let along: Vec<f64> = judged.iter().map(|blob| axis.dot(blob.centre)).collect();
        for quantile in CUTS {
            let offset = weighted_quantile(&along, &weights, quantile);
            let below = along.iter().filter(|value| **value <= offset).count();
            if below == 0 || below == judged.len() {
                continue;
            }
            let low = volume_of(&mut judged.iter().filter(|blob| axis.dot(blob.centre) <= offset));
            let high = volume_of(&mut judged.iter().filter(|blob| axis.dot(blob.centre) > offset));
            let gain = volume - low - high;
            if gain > cut.as_ref().map_or(MIN_GAIN * volume, |cut| cut.gain) {
                cut = Some(Cut { axis, offset, gain });
            }
        }
    }
    Piece { blobs, cut }
}

fn principal_axes(blobs: &[&Blob]) -> [DVec3; 3] {
    let total: f64 = blobs.iter().map(|blob| blob.seen).sum();
    let mean = blobs.iter().map(|blob| blob.seen * blob.centre).sum::<DVec3>() / total;
    let mut covariance = Matrix3::zeros();
    for blob in blobs {
        let d = nalgebra::Vector3::from((blob.centre - mean).to_array());
        covariance += d * d.transpose() * (blob.seen / total);
    }
    if !covariance.iter().all(|value| value.is_finite()) {
        return [DVec3::X, DVec3::Y, DVec3::Z];
    }
    let axes = covariance.symmetric_eigen().eigenvectors;
    std::array::from_fn(|k| DVec3::new(axes[(0, k)], axes[(1, k)], axes[(2, k)]))
}
