//! Poses of one object carried from window to window.
//!
//! Every window has a frame of its own for an object, whose place and turn in the object nobody else knows. Over the times
//! that two windows share, both say where the object is: the mean of what lies between their frames takes the splats of
//! the later one into the frame of the earlier one, and where poses differ beyond that they go over from one to the other.

use cif_geometry::RigidTransform;
use glam::{DMat3, DQuat, DVec3};

use crate::graph::{Node, PoseSample};
use crate::motion::keys;

use super::span::Span;

/// Poses that differ by less, in world units and radians, are the same.
const SAME: f64 = 1e-9;

/// An object over all windows.
pub(super) struct Carried {
    /// Path of its frame; empty where that stays.
    pub(super) track: Vec<PoseSample>,
    /// `object_from_local` of every window: takes the splats of its node there; `None` where it has none.
    pub(super) object_from_local: Vec<Option<RigidTransform>>,
    /// At the start of every window but the first: how far poses of both windows lie apart over the times that they share,
    /// RMS: world units, radians. `None` where one of them does not have the object.
    pub(super) gaps: Vec<Option<(f64, f64)>>,
}

/// Carries the poses of an object, given by its node in every window that has it.
pub(super) fn carried(nodes: &[Option<&Node>], spans: &[Span]) -> Carried {
    let mut poses: Vec<Option<Poses<'_>>> = Vec::with_capacity(nodes.len());
    let mut gaps = Vec::new();
    for (index, node) in nodes.iter().enumerate() {
        let before = index.checked_sub(1).and_then(|before| poses[before].as_ref());
        let Some(node) = *node else {
            poses.push(None);
            gaps.push(None);
            continue;
        };
        let shared: Vec<f64> =
            before.map_or_else(Vec::new, |before| shared(before.node, node, &spans[index]));
        let local_from_object =
            match before.filter(|_| !shared.is_empty()) {
                Some(before) => mean(shared.iter().map(|code| {
                    node.world_transform(*code).inverse().compose(&before.world_from_object(*code))
                })),
                None => RigidTransform::IDENTITY,
            };
        let now = Poses { node, local_from_object };
        gaps.push(before.filter(|_| !shared.is_empty()).map(|before| gap(before, &now, &shared)));
        poses.push(Some(now));
    }
    gaps.remove(0);
    let object_from_local =
        poses.iter().map(|poses| poses.as_ref().map(|poses| poses.local_from_object.inverse())).collect();
    Carried { track: track(&poses, spans), object_from_local, gaps }
}

/// Poses of an object as one window has them.
struct Poses<'a> {
    node: &'a Node,
    local_from_object: RigidTransform,
}

impl Poses<'_> {
    fn world_from_object(&self, code: f64) -> RigidTransform {
        self.node.world_transform(code).compose(&self.local_from_object)
    }
}

/// Times that both windows see, and show the object at if there are such.
fn shared(before: &Node, now: &Node, span: &Span) -> Vec<f64> {
    let all: Vec<f64> = span.shared_with_previous().collect();
    let seen: Vec<f64> =
        all.iter().copied().filter(|code| before.is_visible(*code) && now.is_visible(*code)).collect();
    if seen.is_empty() { all } else { seen }
}

/// Mean of transforms that are alike.
fn mean(transforms: impl Iterator<Item = RigidTransform>) -> RigidTransform {
    let (mut count, mut translation, mut rotation) = (0.0, DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0));
    for transform in transforms {
        let turn = DQuat::from_mat3(&transform.rotation).normalize();
        rotation = rotation + if rotation.dot(turn) < 0.0 { -turn } else { turn };
        translation += transform.translation;
        count += 1.0;
    }
    RigidTransform {
        rotation: DMat3::from_quat(rotation.normalize()),
        translation: translation / f64::max(count, 1.0),
    }
}

/// RMS distance and turn between the poses of two windows.
fn gap(before: &Poses<'_>, now: &Poses<'_>, codes: &[f64]) -> (f64, f64) {
    let mut squares = (0.0, 0.0);
    for code in codes {
        let (a, b) = (before.world_from_object(*code), now.world_from_object(*code));
        squares.0 += a.translation.distance_squared(b.translation);
        squares.1 += cif_geometry::transform::angle_between(&a.rotation, &b.rotation).powi(2);
    }
    let mean = |sum: f64| (sum / codes.len().max(1) as f64).sqrt();
    (mean(squares.0), mean(squares.1))
}

/// Keys of each window while it lasts, and every shared time, at which the poses of both are mixed.
fn track(poses: &[Option<Poses<'_>>], spans: &[Span]) -> Vec<PoseSample> {
    let mut track: Vec<PoseSample> = Vec::new();
    for (index, (now, span)) in poses.iter().zip(spans).enumerate() {
        let Some(now) = now else { continue };
        let before = index.checked_sub(1).and_then(|before| poses[before].as_ref());
        let after = poses.get(index + 1).and_then(Option::as_ref);
        let keys = now.node.track().iter().map(|key| key.time_code);
        for code in span.codes(keys.chain(span.shared())) {
            let own = now.world_from_object(code);
            let other = match span.share_of_neighbour(code) {
                Some((false, share)) => before.map(|before| (before, share)),
                Some((true, share)) => after.map(|after| (after, share)),
                None => None,
            };
            let own = PoseSample::new(code, &own);
            track.push(match other {
                Some((other, share)) => {
                    own.towards(&PoseSample::new(code, &other.world_from_object(code)), share, code)
                }
                None => own,
            });
        }
    }
    keys::one_hemisphere(&mut track);
    without_repetitions(track)
}

/// A track without samples between equal ones; none where all are equal and unturned.
fn without_repetitions(track: Vec<PoseSample>) -> Vec<PoseSample> {
    let same = |a: &PoseSample, b: &PoseSample| {
        a.translation.distance(b.translation) < SAME && a.rotation.angle_between(b.rotation) < SAME
    };
    let mut kept: Vec<PoseSample> = Vec::with_capacity(track.len());
    for (index, sample) in track.iter().enumerate() {
        let stays = kept.last().is_some_and(|last| same(last, sample))
            && track.get(index + 1).is_some_and(|next| same(sample, next));
        if !stays {
            kept.push(*sample);
        }
    }
    let is_at_rest = kept.iter().all(|sample| same(sample, &kept[0]) && sample.rotation.w.abs() > 1.0 - SAME);
    if is_at_rest { Vec::new() } else { kept }
}
