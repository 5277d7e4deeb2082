//! One node from the pieces of a prim.

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_geometry::{Bounds, RigidTransform};
use glam::DAffine3;

use super::{Bake, Piece, Placement, Prim, Shape, Track};
use crate::graph::MotionReport;
use crate::graph::{
    Appearance, AppearanceSample, DenseMotion, DenseSample, Motion, Node, NodeKind, Part, PartsMotion, Splats,
};
use crate::naming;
use crate::shape::extent;

/// The node; its frames are still to be set.
pub(super) fn node(mut prim: Prim, kind: NodeKind, name: String) -> Node {
    let appearance = appearance(&mut prim);
    let poses = prim.track.clone().poses(prim.keeps_pose);
    let pivot = prim.track.pivot(prim.pivot, &poses);
    let (motion, splats) = if !prim.shape_codes.is_empty() {
        let (samples, splats) = dense(&prim.shape_codes, prim.scales_change, prim.pieces);
        (Motion::Dense(DenseMotion { track: poses, samples }), splats)
    } else if prim.in_parts {
        let (parts, splats) = parts(prim.pieces);
        (Motion::Parts(PartsMotion { track: poses, parts }), splats)
    } else {
        let splats = joined(prim.pieces, |placement| placement.at(0.0));
        (if poses.is_empty() { Motion::Static } else { Motion::Rigid(poses) }, splats)
    };
    let report = prim.report.filter(|report| report.model == motion.model());
    Node {
        kind,
        name,
        label: prim.label,
        category: prim.category,
        taxonomies: prim.taxonomies,
        embedding: prim.embedding,
        pivot,
        extent: extent::node_bounds(&RigidTransform::IDENTITY, &splats, &motion, Part::at_first),
        mean_occupancy: prim.mean_occupancy.unwrap_or_else(|| splats.mean_occupancy()),
        report: report.unwrap_or_else(|| MotionReport::unfitted(&splats, &motion)),
        motion,
        splats,
        appearance,
        proxy: prim.proxy,
        colliders: prim.colliders,
        visibility: prim.visibility,
        source_frames: (0, 0),
    }
}

/// Splats moved by an affine map; those that do not move stay exact.
fn baked(mut splats: Splats, map: DAffine3) -> Splats {
    if map != DAffine3::IDENTITY {
        Bake::new(map).splats(&mut splats);
    }
    splats
}

/// All pieces as one, in the frame of the object.
fn joined(pieces: Vec<Piece>, map: impl Fn(&Placement) -> DAffine3) -> Splats {
    let mut all = Splats::default();
    for piece in pieces {
        let map = map(&piece.placement);
        all.append(baked(piece.splats, map));
    }
    all
}

/// Opacities and colours of all pieces over time, these in the frame of the node or of its parts.
fn appearance(prim: &mut Prim) -> Appearance {
    let mut appearance = Appearance::default();
    for (at, &time_code) in prim.opacity_codes.iter().enumerate() {
        let values = prim.pieces.iter().flat_map(|piece| piece.opacities[at].iter().copied()).collect();
        appearance.opacities.push(AppearanceSample { time_code, values });
    }
    let degree = prim.pieces.iter().map(|piece| piece.splats.sh_degree).max().unwrap_or(0);
    let floats = |degree| 3 * coefficient_count(degree);
    let in_parts = prim.in_parts && prim.shape_codes.is_empty();
    for (at, &time_code) in prim.color_codes.iter().enumerate() {
        let mut values = Vec::new();
        for piece in &mut prim.pieces {
            let own = piece.splats.sh_degree;
            let map = match &piece.placement {
                Placement::Rigid { baked, .. } if in_parts => baked.unwrap_or(DAffine3::IDENTITY),
                placement => placement.at(time_code),
            };
            let coefficients = &mut piece.colors[at];
            if map != DAffine3::IDENTITY {
                Bake::new(map).harmonics(coefficients, own);
            }
            for sh in coefficients.chunks_exact(floats(own)) {
                values.extend_from_slice(sh);
                values.resize(values.len() + floats(degree) - sh.len(), 0.0);
            }
        }
        appearance.colors.push(AppearanceSample { time_code, values });
    }
    appearance
}

/// Every piece a part with its own track.
fn parts(pieces: Vec<Piece>) -> (Vec<Part>, Splats) {
    let (mut parts, mut all) = (Vec::with_capacity(pieces.len()), Splats::default());
    let mut names = naming::Names::default();
    for piece in pieces {
        let (track, map) = match piece.placement {
            Placement::Rigid { track, baked } => (track, baked.unwrap_or(DAffine3::IDENTITY)),
            // What changes its shape is sampled as such, and no part.
            sampled @ Placement::Sampled(_) => (Track::still(), sampled.at(0.0)),
        };
        let is_plain = map == DAffine3::IDENTITY;
        let splats = baked(piece.splats, map);
        let poses = track.clone().poses(false);
        parts.push(Part {
            name: names.take(piece.name),
            splats: all.len()..all.len() + splats.len(),
            pivot: track.pivot(piece.pivot, &poses),
            extent: extent::splat_bounds(&RigidTransform::IDENTITY, &splats, 0..splats.len()),
            track: poses,
            // What is baked into the splats is no frame that the joint knows.
            joint: piece.joint.filter(|_| is_plain),
        });
        all.append(splats);
    }
    (parts, all)
}

/// Samples of everything that deforms, in the frame of the object, and the splats at the first.
fn dense(codes: &[f64], scales_change: bool, mut pieces: Vec<Piece>) -> (Vec<DenseSample>, Splats) {
    let mut samples: Vec<DenseSample> = Vec::with_capacity(codes.len());
    for (at, &time_code) in codes.iter().enumerate() {
        let mut whole = Shape::default();
        for piece in &mut pieces {
            let mut shape = std::mem::take(&mut piece.shapes[at]);
            let map = piece.placement.at(time_code);
            if map != DAffine3::IDENTITY {
                let bake = Bake::new(map);
                bake.means(&mut shape.means);
                bake.shapes(&mut shape.orientations, &mut shape.scales);
            }
            whole.means.append(&mut shape.means);
            whole.orientations.append(&mut shape.orientations);
            whole.scales.append(&mut shape.scales);
        }
        if let Some(before) = samples.last() {
            for (q, before) in whole.orientations.iter_mut().zip(&before.orientations) {
                if q.iter().zip(before).map(|(a, b)| a * b).sum::<f32>() < 0.0 {
                    *q = q.map(|component| -component);
                }
            }
        }
        let Shape { means, orientations, scales } = whole;
        let extent: Bounds =
            extent::ellipsoid_bounds(&RigidTransform::IDENTITY, &means, &orientations, &scales);
        let scales = scales_change.then_some(scales);
        samples.push(DenseSample { time_code, means, orientations, scales, extent });
    }
    let splats = joined(pieces, |placement| placement.at(codes[0]));
    (samples, splats)
}
