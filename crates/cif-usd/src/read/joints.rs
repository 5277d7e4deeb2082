//! Joints between the parts of an object.

use cif_field::JointKind;
use cif_scene::PartJoint;
use glam::{DQuat, DVec3};
use pyo3::prelude::*;

use super::owner::Owner;
use super::values::{path, quaternion, text, value, vec3};
use crate::pxr::Pxr;
use crate::tokens;

/// Joint of every part of an object, in the order of its splat prims, whose carriers are the bodies; joints with
/// anything else are passed over.
pub(super) fn joints<'py>(pxr: &Pxr<'py>, owner: &Owner<'py>) -> PyResult<Vec<Option<PartJoint>>> {
    let mut bodies = Vec::with_capacity(owner.splats.len());
    for prim in &owner.splats {
        bodies.push(path(&prim.carrier(&owner.prim)?)?);
    }
    let mut found = vec![None; bodies.len()];
    for prim in owner.prim.call_method0("GetChildren")?.try_iter()? {
        let prim = prim?;
        let kind = match text(&prim.call_method0("GetTypeName")?)?.as_str() {
            tokens::REVOLUTE_JOINT => JointKind::Revolute,
            tokens::PRISMATIC_JOINT => JointKind::Prismatic,
            _ => continue,
        };
        let body = |name: &str| -> PyResult<Option<usize>> {
            let targets = prim.call_method1("GetRelationship", (name,))?.call_method0("GetTargets")?;
            let Ok(target) = targets.get_item(0) else { return Ok(None) };
            let target = text(&target)?;
            Ok(bodies.iter().position(|body| *body == target))
        };
        let (Some(base), Some(part)) = (body("physics:body0")?, body("physics:body1")?) else { continue };
        let at = pxr.earliest()?;
        let axis = match value(&prim, "physics:axis", &at)? {
            Some(axis) => text(&axis)?,
            None => "X".to_owned(),
        };
        let axis = match axis.as_str() {
            "Y" => DVec3::Y,
            "Z" => DVec3::Z,
            _ => DVec3::X,
        };
        let turn = match value(&prim, "physics:localRot1", &at)? {
            Some(turn) => quaternion(&turn)?,
            None => DQuat::IDENTITY,
        };
        let anchor = match value(&prim, "physics:localPos1", &at)? {
            Some(point) => vec3(&point)?,
            None => DVec3::ZERO,
        };
        let axis = (turn * axis).try_normalize();
        if let Some(axis) = axis.filter(|_| base != part && anchor.is_finite()) {
            found[part] = Some(PartJoint { base, kind, axis, anchor });
        }
    }
    Ok(found)
}
