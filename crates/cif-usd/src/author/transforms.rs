//! `translate` and `orient`, default values always, samples where there is a track.

use cif_scene::{CaptureFrame, PoseSample};
use glam::{DQuat, DVec3};
use pyo3::prelude::*;

use super::context::{UNIFORM, VARYING};
use crate::layer::Prim;
use crate::pxr::Pxr;

/// Order of the operations; stands on the prim itself.
pub(super) fn order(pxr: &Pxr<'_>, prim: &Prim<'_, '_, '_>) -> PyResult<()> {
    let order = pxr.vt.call_method1("TokenArray", (vec!["xformOp:translate", "xformOp:orient"],))?;
    prim.set("xformOpOrder", "TokenArray", UNIFORM, order)?;
    Ok(())
}

/// Places the whole scene in the world of its capture, in double precision; nothing for ordinary captures.
pub(super) fn world(pxr: &Pxr<'_>, prim: &Prim<'_, '_, '_>, frame: &CaptureFrame) -> PyResult<()> {
    if frame.is_identity() {
        return Ok(());
    }
    prim.set("xformOp:translate", "Double3", VARYING, pxr.vec3d(frame.offset.into())?)?;
    let mut order = vec!["xformOp:translate"];
    if frame.scale != 1.0 {
        prim.set("xformOp:scale", "Double3", VARYING, pxr.vec3d(DVec3::splat(1.0 / frame.scale))?)?;
        order.push("xformOp:scale");
    }
    let order = pxr.vt.call_method1("TokenArray", (order,))?;
    prim.set("xformOpOrder", "TokenArray", UNIFORM, order)?;
    Ok(())
}

/// The pose where nothing is sampled.
pub(super) fn rest(track: &[PoseSample], pivot: DVec3) -> PoseSample {
    track.first().copied().unwrap_or(PoseSample {
        time_code: 0.0,
        translation: pivot,
        rotation: DQuat::IDENTITY,
    })
}

/// Values of the operations; may stand in a variant.
pub(super) fn values(
    pxr: &Pxr<'_>,
    prim: &Prim<'_, '_, '_>,
    default: &PoseSample,
    track: &[PoseSample],
) -> PyResult<()> {
    let translate = prim.set("xformOp:translate", "Double3", VARYING, pxr.vec3d(default.translation)?)?;
    let orient = prim.set("xformOp:orient", "Quatf", VARYING, pxr.quatf(default.rotation)?)?;
    for sample in track {
        translate.sample(sample.time_code, pxr.vec3d(sample.translation)?)?;
        orient.sample(sample.time_code, pxr.quatf(sample.rotation)?)?;
    }
    Ok(())
}
