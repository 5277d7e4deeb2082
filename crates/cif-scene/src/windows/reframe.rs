//! Splats of a node in another frame of it, during one window.

use cif_geometry::spherical_harmonics::HarmonicsRotation;
use cif_geometry::{Bounds, RigidTransform};

use crate::appearance;
use crate::graph::{
    Appearance, AppearanceSample, ConvexHull, DenseMotion, DenseSample, Motion, Node, raise_degree,
};
use crate::placement::PlacedSplats;
use crate::shape::extent;
use crate::vectors::{dot, quaternion_of, vector};

use super::span::Span;

/// A node as it is while a window lasts, its splats taken along by `object_from_local`: static in its frame, or with a path
/// for every splat, as parts and their joints differ from window to window. Spherical harmonics are filled up to `degree`.
pub(super) fn reframed(node: &Node, object_from_local: &RigidTransform, span: &Span, degree: u8) -> Node {
    let mut moved = node.clone();
    moved.splats.raise_degree(degree);
    let harmonics = HarmonicsRotation::from_quaternion(
        quaternion_of(&object_from_local.rotation).map(|component| component as f32),
    );
    harmonics.rotate_all(&mut moved.splats.sh_coefficients, degree);
    moved.appearance = Appearance {
        opacities: during(&node.appearance.opacities, span),
        colors: during(&node.appearance.colors, span),
    };
    for sample in &mut moved.appearance.colors {
        raise_degree(&mut sample.values, node.splats.sh_degree, degree);
        harmonics.rotate_all(&mut sample.values, degree);
    }
    // Where one time is read, the first: that of the window.
    if let Some(first) = moved.appearance.opacities.first() {
        moved.splats.opacities.clone_from(&first.values);
    }
    if let Some(first) = moved.appearance.colors.first() {
        moved.splats.sh_coefficients.clone_from(&first.values);
    }
    let codes = codes_of(node, span);
    let mut samples: Vec<DenseSample> = Vec::with_capacity(codes.len());
    let scales_change = matches!(&node.motion, Motion::Dense(dense) if dense.samples.iter().any(|sample| sample.scales.is_some()));
    for code in codes {
        let placed = node.local_splats_at(code).turned(object_from_local);
        samples.push(sample_of(&placed, code, scales_change, samples.last()));
    }
    let shown = match samples.first() {
        Some(first) => (first.means.clone(), first.orientations.clone(), first.scales.clone()),
        None => {
            let placed = node.local_splats_at(span.start).turned(object_from_local);
            let first = sample_of(&placed, span.start, false, None);
            (first.means, first.orientations, None)
        }
    };
    (moved.splats.means, moved.splats.orientations) = (shown.0, shown.1);
    if let Some(scales) = shown.2 {
        moved.splats.scales = scales;
    }
    moved.motion = match samples.is_empty() {
        true => Motion::Static,
        false => Motion::Dense(DenseMotion { track: Vec::new(), samples }),
    };
    let hulls = node.colliders.iter().map(|hull| carried_hull(node, hull, object_from_local, span.start));
    moved.colliders = hulls.collect();
    moved.extent = extent::splat_bounds(&RigidTransform::IDENTITY, &moved.splats, 0..moved.splats.len());
    moved
}

/// Times at which splats are sampled in their frame; none where they stay in it.
fn codes_of(node: &Node, span: &Span) -> Vec<f64> {
    let keys: Vec<f64> = match &node.motion {
        Motion::Static | Motion::Rigid(_) => return Vec::new(),
        // Splats on arcs: between keys they leave the straight line.
        Motion::Parts(_) => span.seen.clone(),
        Motion::Dense(dense) => dense.samples.iter().map(|sample| sample.time_code).collect(),
    };
    span.codes(keys)
}

fn sample_of(
    placed: &PlacedSplats,
    code: f64,
    with_scales: bool,
    before: Option<&DenseSample>,
) -> DenseSample {
    let means: Vec<[f32; 3]> = placed.means.iter().map(|mean| mean.as_vec3().to_array()).collect();
    let mut orientations: Vec<[f32; 4]> =
        placed.orientations.iter().map(|q| q.map(|component| component as f32)).collect();
    if let Some(before) = before {
        for (now, before) in orientations.iter_mut().zip(&before.orientations) {
            if dot(now.map(f64::from), before.map(f64::from)) < 0.0 {
                *now = now.map(|component| -component);
            }
        }
    }
    let extent = extent::ellipsoid_bounds(&RigidTransform::IDENTITY, &means, &orientations, &placed.scales);
    let scales = with_scales.then(|| placed.scales.clone());
    DenseSample { time_code: code, means, orientations, scales, extent }
}

/// Samples while a window lasts, and at its ends; none where there were none.
fn during(samples: &[AppearanceSample], span: &Span) -> Vec<AppearanceSample> {
    if samples.is_empty() {
        return Vec::new();
    }
    let codes = span.codes(samples.iter().map(|sample| sample.time_code));
    let at = |time_code| Some(AppearanceSample { time_code, values: appearance::at(samples, time_code)? });
    codes.into_iter().filter_map(at).collect()
}

/// A hull in the frame of the object, that of a part as the part lies at the start.
fn carried_hull(
    node: &Node,
    hull: &ConvexHull,
    object_from_local: &RigidTransform,
    start: f64,
) -> ConvexHull {
    let part = hull.part.and_then(|part| node.motion.parts()?.parts.get(part));
    let object_from_hull = match part {
        Some(part) => object_from_local.compose(&part.node_transform(start)),
        None => *object_from_local,
    };
    let points = hull.points.iter().map(|point| object_from_hull.apply(vector(*point)).as_vec3().to_array());
    ConvexHull { points: points.collect(), triangles: hull.triangles.clone(), part: None }
}

/// Box over all windows.
pub(super) fn extent_over<'a>(nodes: impl Iterator<Item = &'a Node>) -> Bounds {
    nodes.map(|node| node.extent).fold(Bounds::EMPTY, Bounds::union)
}
