//! The body of an object: its splats without those that stray, and its box.
//!
//! Training leaves a few faint or lonely splats far from what an object shows. They weigh nothing in a picture, but a box
//! around all splats is as large as they are far away. A body leaves out what sticks out of the bulk of the splats, the
//! furthest first, as long as that takes at most [`STRAYS`] of the opacity and of what is seen (see
//! [`Splats::importance`]); of opaque splats it holds one standard deviation along each axis, as far as that stays in the
//! bulk.

use std::ops::Range;

use cif_geometry::{Bounds, quaternion};
use glam::DVec3;

use crate::Splats;
use cif_geometry::stats::weighted_quantile;

/// Share of the opacity, and of what is seen, that may be left out as straying.
pub(super) const STRAYS: f64 = 0.04;
/// Fainter splats count with their centres only, unless the node has little else.
const OPAQUE: f32 = 0.5;
/// Standard deviations that a body reaches around a centre.
const SIGMAS: f64 = 1.0;
/// Weight that may stick out of the bulk in every direction.
const TRIM: f64 = 0.01;
/// Share of the bulk's width; splats that stick out further stray.
const TRIM_MARGIN: f64 = 0.1;
/// Splats at most that a body is made of: of larger nodes every second, third, ..., which changes the shares
/// above by a few thousandths.
const SAMPLED: usize = 20_000;

/// A splat: its centre, the ends of its axes where it is opaque, its opacity, and how much it is seen.
#[derive(Clone, Debug)]
pub(super) struct Blob {
    pub(super) centre: DVec3,
    pub(super) ends: Vec<DVec3>,
    pub(super) opacity: f64,
    pub(super) seen: f64,
}

/// Splats that a body is sought in; arrays parallel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cloud<'a> {
    /// Centres.
    pub(crate) means: &'a [[f32; 3]],
    /// Unit quaternions (w, x, y, z).
    pub(crate) orientations: &'a [[f32; 4]],
    /// Standard deviations.
    pub(crate) scales: &'a [[f32; 3]],
    /// Opacities.
    pub(crate) opacities: &'a [f32],
    /// How much each is seen, as [`Splats::importance`] has it.
    pub(crate) importance: &'a [f64],
}

impl<'a> Cloud<'a> {
    /// A range of the splats of a node.
    pub(crate) fn of(splats: &'a Splats, importance: &'a [f64], range: Range<usize>) -> Self {
        Self {
            means: &splats.means[range.clone()],
            orientations: &splats.orientations[range.clone()],
            scales: &splats.scales[range.clone()],
            opacities: &splats.opacities[range.clone()],
            importance: &importance[range],
        }
    }

    /// The splats that do not stray.
    pub(super) fn body(&self) -> Vec<Blob> {
        enclosed(self.blobs())
    }

    /// Box of the body, in the frame of the splats; empty without splats.
    pub(crate) fn body_box(&self) -> Bounds {
        Bounds::around(self.body().into_iter().flat_map(|blob| blob.ends.into_iter().chain([blob.centre])))
    }

    fn blobs(&self) -> Vec<Blob> {
        let opacities: Vec<f64> = self.opacities.iter().map(|o| f64::from(*o)).collect();
        // A glass has no opaque splats: then those of the better half are its body.
        let half = weighted_quantile(&opacities, self.importance, 0.5) as f32;
        let opaque = OPAQUE.min(half);
        let stride = self.means.len().div_ceil(SAMPLED).max(1);
        (0..self.means.len())
            .step_by(stride)
            .map(|index| {
                let centre = DVec3::from_array(self.means[index].map(f64::from));
                let end = |end: usize, rotation: &[[f64; 3]; 3]| {
                    let axis = end / 2;
                    let length = SIGMAS * f64::from(self.scales[index][axis]);
                    let direction = DVec3::new(rotation[0][axis], rotation[1][axis], rotation[2][axis]);
                    centre + if end.is_multiple_of(2) { length } else { -length } * direction
                };
                let ends = if self.opacities[index] >= opaque {
                    let rotation = quaternion::to_rotation(self.orientations[index].map(f64::from));
                    (0..6).map(|k| end(k, &rotation)).collect()
                } else {
                    Vec::new()
                };
                Blob { centre, ends, opacity: opacities[index], seen: self.importance[index] }
            })
            .collect()
    }
}

/// A pair of planes that the bulk lies between.
struct Slab {
    axis: DVec3,
    low: f64,
    high: f64,
}

impl Slab {
    /// Distance of a point from the slab; 0 or less inside.
    fn excess(&self, point: DVec3) -> f64 {
        let along = self.axis.dot(point);
        (self.low - along).max(along - self.high)
    }
}

/// The bulk between two planes along each of 13 axes: faces, edges and corners of a cube.
fn bulk(blobs: &[Blob]) -> Vec<Slab> {
    let seen: Vec<f64> = blobs.iter().map(|blob| blob.seen).collect();
    (14..27)
        .map(|code| {
            let axis =
                DVec3::new(f64::from(code % 3 - 1), f64::from(code / 3 % 3 - 1), f64::from(code / 9 - 1))
                    .normalize();
            let along: Vec<f64> = blobs.iter().map(|blob| axis.dot(blob.centre)).collect();
            let low = weighted_quantile(&along, &seen, TRIM);
            let high = weighted_quantile(&along, &seen, 1.0 - TRIM);
            let sigmas: Vec<f64> = blobs
                .iter()
                .map(|blob| blob.ends.iter().map(|end| axis.dot(*end - blob.centre)).fold(0.0, f64::max))
                .collect();
            let reach = weighted_quantile(&sigmas, &seen, 0.5);
            let margin = TRIM_MARGIN * (high - low) + reach;
            Slab { axis, low: low - margin, high: high + margin }
        })
        .collect()
}

/// The body: leaves out those that stick out of the bulk, the furthest first, as far as
/// [`STRAYS`] allows, and pulls in ends that do.
fn enclosed(mut blobs: Vec<Blob>) -> Vec<Blob> {
    let slabs = bulk(&blobs);
    let excess = |point: DVec3| slabs.iter().map(|slab| slab.excess(point)).fold(f64::NEG_INFINITY, f64::max);
    let mut straying: Vec<(usize, f64)> = blobs
        .iter()
        .enumerate()
        .map(|(index, blob)| (index, excess(blob.centre)))
        .filter(|(_, excess)| *excess > 0.0)
        .collect();
    straying.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let sum = |weight: fn(&Blob) -> f64| blobs.iter().map(weight).sum::<f64>();
    let (mut opacity, mut seen) = (STRAYS * sum(|blob| blob.opacity), STRAYS * sum(|blob| blob.seen));
    let mut keep = vec![true; blobs.len()];
    for (index, _) in straying {
        let blob = &blobs[index];
        if blob.opacity <= opacity && blob.seen <= seen {
            opacity -= blob.opacity;
            seen -= blob.seen;
            keep[index] = false;
        }
    }
    let mut kept = keep.into_iter();
    blobs.retain(|_| kept.next().unwrap_or(true));
    for blob in &mut blobs {
        let centre = blob.centre;
        blob.ends.retain_mut(|end| {
            let mut shorter = 1.0;
            while shorter > 0.1 && excess(centre + shorter * (*end - centre)) > 0.0 {
                shorter *= 0.7;
            }
            *end = centre + shorter * (*end - centre);
            shorter > 0.1
        });
    }
    blobs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box of `size` full of opaque splats, and strays of which each has so many times the opacity of one of them.
    fn cloud_box(size: [f32; 3], strays: usize, opacity: f32) -> Bounds {
        let side = 10_u16;
        let at = |k: u16, axis: usize| (f32::from(k) / f32::from(side - 1) - 0.5) * size[axis];
        let mut means: Vec<[f32; 3]> = (0..side.pow(3))
            .map(|k| [at(k % side, 0), at(k / side % side, 1), at(k / side.pow(2), 2)])
            .collect();
        let own = means.len();
        means.extend((0..strays).map(|k| [3.0 + 0.1 * k as f32, 0.0, 0.5]));
        let opacities: Vec<f32> = (0..means.len()).map(|k| if k < own { 0.9 } else { opacity }).collect();
        let importance: Vec<f64> = opacities.iter().map(|opacity| f64::from(*opacity)).collect();
        let orientations = vec![[1.0, 0.0, 0.0, 0.0]; means.len()];
        let scales = vec![[0.001; 3]; means.len()];
        let cloud = Cloud {
            means: &means,
            orientations: &orientations,
            scales: &scales,
            opacities: &opacities,
            importance: &importance,
        };
        cloud.body_box()
    }

    #[test]
    fn strays_do_not_widen_a_box_and_what_is_seen_is_held() {
        for strays in [0, 8] {
            let size = cloud_box([0.2, 0.1, 0.3], strays, 0.1).size();
            assert!((size - DVec3::new(0.202, 0.102, 0.302)).abs().max_element() < 1e-6, "{strays}: {size}");
        }
        // A tenth of all that is seen is no stray.
        assert!(cloud_box([0.2, 0.1, 0.3], 100, 0.9).high.x > 3.0);
    }
}
