//! Physics of an instance for simulators: the variant set `physics`, and gravity.
//!
//! Bodies, masses and recorded tracks live inside the variants: an opinion on the prim itself would win over them.

use cif_scene::{ConvexHull, Motion, Node, Part, PoseSample};
use pyo3::prelude::*;

use super::context::{Scene, VARYING};
use super::{joints, transforms};
use crate::layer::{Layer, Prim};
use crate::pxr::Pxr;
use crate::tokens::{self, variants};

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
    let part_tracks =
        node.motion.parts().into_iter().flat_map(|motion| &motion.parts).map(|part| &part.track);
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
            variants::KINEMATIC => kinematic(scene, layer, &inside, node)?,
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
    for part in node.motion.parts().map_or(&[][..], |motion| &motion.parts) {
        let rest = transforms::rest(&part.track, part.pivot);
        transforms::values(pxr, &prim.child(&part.name)?, &rest, &track(&part.track))?;
    }
    Ok(())
}

/// Bodies on their tracks; parts that have colliders of their own are bodies of their own.
fn kinematic(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    node: &Node,
) -> PyResult<()> {
    for of in bodies(node) {
        let inside = of.prim(prim)?;
        body(scene, &inside, node, of, true)?;
        if scene.options.weld_kinematic {
            joints::weld(scene, layer, &inside, node, of.part)?;
        }
    }
    Ok(())
}

/// The part of a node that is a body: the whole, or one of its parts.
#[derive(Clone, Copy)]
struct Body<'a> {
    part: Option<(usize, &'a Part)>,
}

impl Body<'_> {
    /// Its prim, in that of the node or in a variant of it.
    fn prim<'l, 'p, 'py>(self, node: &Prim<'l, 'p, 'py>) -> PyResult<Prim<'l, 'p, 'py>> {
        self.part.map_or_else(|| Ok(node.same()), |(_, part)| node.child(&part.name))
    }
}

/// The parts that have colliders of their own, where all colliders are theirs; else the whole.
fn bodies(node: &Node) -> Vec<Body<'_>> {
    let motion = node.motion.parts().filter(|_| node.colliders.iter().all(|hull| hull.part.is_some()));
    let Some(motion) = motion else { return vec![Body { part: None }] };
    let has_collider = |index: usize| node.colliders.iter().any(|hull| hull.part == Some(index));
    let with = motion.parts.iter().enumerate().filter(|(index, _)| has_collider(*index));
    with.map(|part| Body { part: Some(part) }).collect()
}

/// A body with the initial velocity; parts on joints are bodies of their own, which the joints hold.
fn dynamic(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    if joints::has_joints(node) {
        return bodies(node).into_iter().try_for_each(|of| body(scene, &of.prim(prim)?, node, of, false));
    }
    body(scene, prim, node, Body { part: None }, false)?;
    let codes = &scene.graph.time_codes;
    let velocity = node.initial_velocity(codes.start(), codes.frames_per_second);
    let degrees = velocity.angular * 180.0 / std::f64::consts::PI;
    for (name, value) in [("physics:velocity", velocity.linear), ("physics:angularVelocity", degrees)] {
        let value = scene.pxr.gf.call_method1("Vec3f", (value.x, value.y, value.z))?;
        prim.set(name, "Vector3f", VARYING, value)?;
    }
    Ok(())
}

/// A body whose mass is that of its colliders.
fn body(
    scene: &Scene<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    node: &Node,
    of: Body<'_>,
    kinematic: bool,
) -> PyResult<()> {
    let mut schemas = vec!["PhysicsRigidBodyAPI", "PhysicsMassAPI"];
    // On the body itself: MuJoCo makes a body without mass of any other prim that is a root.
    if !kinematic && of.part.is_some_and(|(part, _)| joints::is_root(node, part)) {
        schemas.push("PhysicsArticulationRootAPI");
    }
    prim.apply(&schemas)?;
    prim.set("physics:kinematicEnabled", "Bool", VARYING, kinematic)?;
    let masses = cif_scene::masses(scene.graph, node, scene.options.density);
    let is_of = |hull: &ConvexHull| of.part.is_none_or(|(part, _)| hull.part == Some(part));
    let own = node.colliders.iter().zip(masses).filter(|(hull, _)| is_of(hull)).map(|(_, mass)| mass);
    prim.set("physics:mass", "Float", VARYING, own.sum::<f64>())?;
    Ok(())
}
