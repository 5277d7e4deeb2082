//! Joints between the bodies of parts.

use cif_field::JointKind;
use cif_scene::graph::pose_at;
use cif_scene::world::world_from_graph;
use cif_scene::{Node, Part, PartJoint, PoseSample};
use glam::{DQuat, DVec3};
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use crate::layer::{Layer, Prim, child};
use crate::tokens;

/// True where parts of a node are tied by joints.
pub(super) fn has_joints(node: &Node) -> bool {
    node.motion.parts().is_some_and(|motion| motion.parts.iter().any(|part| part.joint.is_some()))
}

/// True of a part that others are tied to and that is tied to none: the root of an articulation.
pub(super) fn is_root(node: &Node, part: usize) -> bool {
    node.motion.parts().is_some_and(|motion| {
        let joint = |part: &Part| part.joint;
        motion.parts[part].joint.is_none()
            && motion.parts.iter().filter_map(joint).any(|joint| joint.base == part)
    })
}

/// Defines the joints of a node in `place`: the prim itself, or one of its variants. Their limits are the range that
/// was recorded, from the first pose on. They are enabled where bodies are moved by forces: simulators solve them, and
/// Newton refuses those that belong to no articulation.
pub(super) fn author(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    place: &Prim<'_, '_, '_>,
    node: &Node,
    enabled: bool,
) -> PyResult<()> {
    let Some(motion) = node.motion.parts() else { return Ok(()) };
    let pxr = scene.pxr;
    let body = |name: &str| child(&child(tokens::WORLD, &node.name), name);
    for (index, part) in motion.parts.iter().enumerate() {
        let Some(PartJoint { base, kind, axis, anchor }) = part.joint else { continue };
        let (Some(first), Some(base)) = (motion.at_first(index), motion.parts.get(base)) else { continue };
        let (prim_type, scale) = match kind {
            JointKind::Revolute => (tokens::REVOLUTE_JOINT, 180.0 / std::f64::consts::PI),
            JointKind::Prismatic => (tokens::PRISMATIC_JOINT, 1.0),
        };
        let name = format!("{}_{}", tokens::JOINT, part.name);
        let prim = layer.define(&child(place.path(), &name), prim_type)?;
        if !enabled {
            prim.set("physics:jointEnabled", "Bool", VARYING, false)?;
            // MuJoCo goes by this alone.
            prim.set("physics:excludeFromArticulation", "Bool", UNIFORM, true)?;
        }
        prim.relate("physics:body0", &body(&base.name))?;
        prim.relate("physics:body1", &body(&part.name))?;
        let turn = DQuat::from_rotation_arc(DVec3::X, axis);
        let point = |v: DVec3| pxr.gf.call_method1("Vec3f", (v.x, v.y, v.z));
        let at_base = first.rotation * anchor + first.translation;
        prim.set("physics:localPos0", "Point3f", VARYING, point(at_base)?)?;
        prim.set("physics:localRot0", "Quatf", VARYING, pxr.quatf((first.rotation * turn).normalize())?)?;
        prim.set("physics:localPos1", "Point3f", VARYING, point(anchor)?)?;
        prim.set("physics:localRot1", "Quatf", VARYING, pxr.quatf(turn)?)?;
        prim.set("physics:axis", "Token", UNIFORM, "X")?;
        if let Some([low, high]) = motion.joint_range(index) {
            prim.set("physics:lowerLimit", "Float", VARYING, scale * low)?;
            prim.set("physics:upperLimit", "Float", VARYING, scale * high)?;
        }
    }
    Ok(())
}

/// Fixes the body of a node, or of one of its parts, to the world where it is first, for simulators that make every
/// body one that falls. `place` is its prim in a variant.
pub(super) fn weld(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    place: &Prim<'_, '_, '_>,
    node: &Node,
    part: Option<(usize, &Part)>,
) -> PyResult<()> {
    let pxr = scene.pxr;
    let prim = layer.define(&child(place.path(), tokens::HOLD), tokens::FIXED_JOINT)?;
    let whole = child(tokens::WORLD, &node.name);
    prim.relate("physics:body1", &part.map_or_else(|| whole.clone(), |(_, part)| child(&whole, &part.name)))?;
    let first = |track: &[PoseSample]| track.first().map_or(0.0, |sample| sample.time_code);
    let mut pose = pose_at(node.track(), node.pivot, first(node.track())).transform();
    if let Some((_, part)) = part {
        pose = pose.compose(&pose_at(&part.track, part.pivot, first(&part.track)).transform());
    }
    let at = world_from_graph(&scene.graph.frame).transform_point3(pose.translation);
    let turn = DQuat::from_mat3(&pose.rotation).normalize();
    prim.set("physics:localPos0", "Point3f", VARYING, pxr.gf.call_method1("Vec3f", (at.x, at.y, at.z))?)?;
    prim.set("physics:localRot0", "Quatf", VARYING, pxr.quatf(turn)?)?;
    Ok(())
}
