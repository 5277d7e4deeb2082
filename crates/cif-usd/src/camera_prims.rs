//! Cameras: one prim per recorded camera, sampled at its frames.

use cif_scene::{CameraTrack, PoseSample};
use pyo3::prelude::*;

use crate::author::transform_ops;
use crate::conventions::{UsdCamera, usd_camera};
use crate::pxr::{Pxr, set, set_default};
use crate::tokens;

/// A scalar of a camera.
type LensValue = fn(&UsdCamera) -> f64;

pub(crate) fn author(
    pxr: &Pxr<'_>,
    stage: &Bound<'_, PyAny>,
    track: &CameraTrack,
    meters_per_unit: f64,
) -> PyResult<()> {
    let path = format!("{}/{}", tokens::CAMERAS, track.name);
    let camera = pxr.define(&pxr.usd_geom, "Camera", stage, &path)?;
    let prim = camera.call_method0("GetPrim")?;
    prim.call_method1("SetDisplayName", (&track.label,))?;
    let views: Vec<(f64, UsdCamera)> = track
        .samples
        .iter()
        .map(|sample| (sample.time_code, usd_camera(&sample.camera, meters_per_unit)))
        .collect();
    let Some((first, last)) = views.first().zip(track.samples.last()) else { return Ok(()) };
    let mut poses: Vec<PoseSample> = Vec::with_capacity(views.len());
    for (time_code, view) in &views {
        let turned = poses.last().is_some_and(|before| before.rotation.dot(view.rotation) < 0.0);
        let rotation = if turned { -view.rotation } else { view.rotation };
        poses.push(PoseSample { time_code: *time_code, translation: view.translation, rotation });
    }
    // A camera that never moves needs no samples.
    let moves = poses
        .iter()
        .any(|pose| pose.translation != poses[0].translation || pose.rotation != poses[0].rotation);
    transform_ops(pxr, &camera, &poses[0], if moves { &poses } else { &[] })?;
    let lens: [(&str, LensValue); 5] = [
        ("CreateFocalLengthAttr", |view| view.focal_length),
        ("CreateHorizontalApertureAttr", |view| view.aperture.x),
        ("CreateVerticalApertureAttr", |view| view.aperture.y),
        ("CreateHorizontalApertureOffsetAttr", |view| view.aperture_offset.x),
        ("CreateVerticalApertureOffsetAttr", |view| view.aperture_offset.y),
    ];
    for (create, value) in lens {
        let attribute = set_default(&camera, create, value(&first.1))?;
        if views.iter().any(|(_, view)| value(view) != value(&first.1)) {
            for (time_code, view) in &views {
                set(&attribute, value(view), Some(*time_code))?;
            }
        }
    }
    let clipping = first.1.clipping_range;
    let clipping = pxr.gf.call_method1("Vec2f", (clipping.x, clipping.y))?;
    set_default(&camera, "CreateClippingRangeAttr", clipping)?;
    // Apertures give no resolution: the captured one stands beside them.
    let int = pxr.value_type("Int")?;
    for (name, pixels) in [("imageWidth", last.camera.width), ("imageHeight", last.camera.height)] {
        let name = format!("userProperties:{name}");
        let attribute = prim.call_method1("CreateAttribute", (name, &int, true))?;
        set(&attribute, i32::try_from(pixels).unwrap_or(i32::MAX), None)?;
    }
    Ok(())
}
