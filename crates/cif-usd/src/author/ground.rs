//! The plane that simulators let things fall on.

use cif_scene::format::Ground;
use cif_scene::{PoseSample, SceneGraph, UpAxis, ground_height};
use glam::{DQuat, DVec3};
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use super::transforms;
use crate::layer::Layer;
use crate::tokens;

/// Sides of the plane as it is drawn, over its distance from the origin or 1, whichever is larger; simulators take it
/// as endless.
const SIDES: f64 = 10.0;

/// Height of the ground that is asked for, along the up axis; `None` where none is, or nothing stands on any.
pub(super) fn height(graph: &SceneGraph, asked: Ground) -> Option<f64> {
    match asked {
        Ground::None => None,
        Ground::Auto => ground_height(graph),
        Ground::At(height) => Some(height),
    }
}

/// A plane with normal z, which is all that MuJoCo takes, turned to the up axis.
pub(super) fn author(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, height: f64) -> PyResult<()> {
    let pxr = scene.pxr;
    let (up, rotation) = match scene.graph.up_axis {
        UpAxis::Z => (DVec3::Z, DQuat::IDENTITY),
        UpAxis::Y => (DVec3::Y, DQuat::from_rotation_arc(DVec3::Z, DVec3::Y)),
    };
    let prim = layer.define(tokens::GROUND, "Plane")?;
    prim.apply(&["PhysicsCollisionAPI"])?;
    prim.set("purpose", "Token", UNIFORM, tokens::PURPOSE_GUIDE)?;
    prim.set("axis", "Token", UNIFORM, "Z")?;
    let side = SIDES * height.abs().max(1.0);
    for name in ["width", "length"] {
        prim.set(name, "Double", VARYING, side)?;
    }
    let half = (side / 2.0) as f32;
    let extent = pxr.vec3f_array(&[[-half, -half, 0.0], [half, half, 0.0]])?;
    prim.set("extent", "Float3Array", VARYING, extent)?;
    transforms::order(pxr, &prim)?;
    transforms::values(pxr, &prim, &PoseSample { time_code: 0.0, translation: height * up, rotation }, &[])
}
