//! Physics of an instance for simulators: the variant set `physics`, and gravity.
//!
//! Bodies, masses and recorded tracks live inside the variants: an opinion on the prim itself would win over them.

use cif_scene::{Motion, Node, PoseSample};
use pyo3::prelude::*;

use super::instance::parts;
use super::{Scene, VARYING, joints, transforms};
use crate::layer::{Layer, Prim};
use crate::pxr::Pxr;
use crate::tokens::{self, variants};

/// Density that bodies are given, kg/m^3: water, which is what simulators assume where none is given.
const DENSITY: f64 = 1000.0;
/// Standard gravity, m/s^2.
const GRAVITY: f64 = 9.81;

/// Gravity of the stage.
pub(super) fn gravity(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>) -> PyResult<()> {
    let down = match scene.graph.up_axis {
        cif_scene::UpAxis::Y => (0.0, -1.0, 0.0),
        cif_scene::UpAxis::Z => (0.0, 0.0, -1.0),
    };
    let prim = layer.define(tokens::PHYSICS_SCENE, "PhysicsScene")?;
    let down = scene.pxr.gf.call_method1("Vec3f", down)?;
    prim.set("physics:gravityDirection", "Vector3f", VARYING, down)?;
    prim.set("physics:gravityMagnitude", "Float", VARYING, GRAVITY / scene.graph.meters_per_unit)?;
    Ok(())
}

/// Transforms of an instance and its parts, and the variants that simulate it where it has colliders.
pub(super) fn author(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    node: &Node,
) -> PyResult<()> {
    let pxr = scene.pxr;
    if node.colliders.is_empty() {
        joints::author(scene, layer, prim, node, false)?;
        return poses(pxr, prim, node, true);
    }
    let part_tracks = parts(node).into_iter().flat_map(|motion| &motion.parts).map(|part| &part.track);
    let moves = !node.track().is_empty() || part_tracks.into_iter().any(|track| !track.is_empty());
    if !moves {
        poses(pxr, prim, node, true)?;
    }
    for variant in [variants::NONE, variants::KINEMATIC, variants::DYNAMIC] {
        let inside = prim.variant(variants::PHYSICS, variant)?;
        if moves {
            poses(pxr, &inside, node, variant != variants::DYNAMIC)?;
        }
        match variant {
            variants::KINEMATIC => kinematic(scene, &inside, node)?,
            variants::DYNAMIC => dynamic(scene, &inside, node)?,
            _ => continue,
        }
        joints::author(scene, layer, &inside, node, variant == variants::DYNAMIC)?;
    }
    let moving = !matches!(node.motion, Motion::Static);
    prim.select(variants::PHYSICS, if moving { variants::KINEMATIC } else { variants::NONE })
}

/// Poses of a node and its parts, along their tracks or only the first.
fn poses(pxr: &Pxr<'_>, prim: &Prim<'_, '_, '_>, node: &Node, sampled: bool) -> PyResult<()> {
    let track = |track: &[PoseSample]| if sampled { track.to_vec() } else { Vec::new() };
    transforms::values(pxr, prim, &transforms::rest(node.track(), node.pivot), &track(node.track()))?;
    for part in parts(node).map_or(&[][..], |motion| &motion.parts) {
        let rest = transforms::rest(&part.track, part.pivot);
        transforms::values(pxr, &prim.child(&part.name)?, &rest, &track(&part.track))?;
    }
    Ok(())
}

/// A body on its track; parts that have colliders of their own are bodies of their own.
fn kinematic(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    bodies(prim, node)?.iter().try_for_each(|prim| body(scene, prim, true))
}

/// The parts that have colliders of their own, where all colliders are theirs; else the whole.
fn bodies<'l, 'p, 'py>(prim: &Prim<'l, 'p, 'py>, node: &Node) -> PyResult<Vec<Prim<'l, 'p, 'py>>> {
    let motion = parts(node).filter(|_| node.colliders.iter().all(|hull| hull.part.is_some()));
    let Some(motion) = motion else { return Ok(vec![prim.same()]) };
    let has_collider = |index: usize| node.colliders.iter().any(|hull| hull.part == Some(index));
    let with = motion.parts.iter().enumerate().filter(|(index, _)| has_collider(*index));
    with.map(|(_, part)| prim.child(&part.name)).collect()
}

/// A body with the initial velocity; parts on joints are bodies of their own, which the joints hold.
fn dynamic(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    if joints::has_joints(node) {
        prim.apply(&["PhysicsArticulationRootAPI"])?;
        return bodies(prim, node)?.iter().try_for_each(|prim| body(scene, prim, false));
    }
    body(scene, prim, false)?;
    let codes = &scene.graph.time_codes;
    let velocity = node.initial_velocity(codes.start(), codes.frames_per_second);
    let degrees = velocity.angular * 180.0 / std::f64::consts::PI;
    for (name, value) in [("physics:velocity", velocity.linear), ("physics:angularVelocity", degrees)] {
        let value = scene.pxr.gf.call_method1("Vec3f", (value.x, value.y, value.z))?;
        prim.set(name, "Vector3f", VARYING, value)?;
    }
    Ok(())
}

fn body(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, kinematic: bool) -> PyResult<()> {
    prim.apply(&["PhysicsRigidBodyAPI", "PhysicsMassAPI"])?;
    prim.set("physics:kinematicEnabled", "Bool", VARYING, kinematic)?;
    let density = DENSITY * scene.graph.meters_per_unit.powi(3);
    prim.set("physics:density", "Float", VARYING, density)?;
    Ok(())
}
