//! Cameras: one prim per recorded camera, sampled at its frames.

use cif_scene::{CameraTrack, PoseSample};
use pyo3::prelude::*;

use super::context::VARYING;
use super::transforms;
use crate::conventions::{UsdCamera, usd_camera};
use crate::layer::Layer;
use crate::pxr::Pxr;
use crate::tokens;

/// A scalar of a camera.
type LensValue = fn(&UsdCamera) -> f64;

pub(super) fn author(
    pxr: &Pxr<'_>,
    layer: &Layer<'_, '_>,
    track: &CameraTrack,
    meters_per_unit: f64,
) -> PyResult<()> {
    let views: Vec<(f64, UsdCamera)> = track
        .samples
        .iter()
        .map(|sample| (sample.time_code, usd_camera(&sample.camera, meters_per_unit)))
        .collect();
    let Some((first, last)) = views.first().zip(track.samples.last()) else { return Ok(()) };
    let prim = layer.define(&format!("{}/{}", tokens::CAMERAS, track.name), "Camera")?;
    prim.info("displayName", &track.label)?;
    let mut poses: Vec<PoseSample> = Vec::with_capacity(views.len());
    for (time_code, view) in &views {
        let turned = poses.last().is_some_and(|before| before.rotation.dot(view.rotation) < 0.0);
        let rotation = if turned { -view.rotation } else { view.rotation };
        poses.push(PoseSample { time_code: *time_code, translation: view.translation, rotation });
    }
    transforms::order(pxr, &prim)?;
    // A camera that never moves needs no samples; the time of its recording is an attribute of its own.
    let moves = poses
        .iter()
        .any(|pose| pose.translation != poses[0].translation || pose.rotation != poses[0].rotation);
    transforms::values(pxr, &prim, &poses[0], if moves { &poses } else { &[] })?;
    let codes: Vec<f64> = poses.iter().map(|pose| pose.time_code).collect();
    let codes = pxr.vt.call_method1("DoubleArray", (codes,))?;
    prim.set_custom(tokens::CAMERA_CODES, "DoubleArray", codes)?;
    let lens: [(&str, LensValue); 5] = [
        ("focalLength", |view| view.focal_length),
        ("horizontalAperture", |view| view.aperture.x),
        ("verticalAperture", |view| view.aperture.y),
        ("horizontalApertureOffset", |view| view.aperture_offset.x),
        ("verticalApertureOffset", |view| view.aperture_offset.y),
    ];
    for (name, value) in lens {
        let attribute = prim.set(name, "Float", VARYING, value(&first.1))?;
        if views.iter().any(|(_, view)| value(view) != value(&first.1)) {
            for (time_code, view) in &views {
                attribute.sample(*time_code, value(view))?;
            }
        }
    }
    // Of the colours that the scene has.
    let exposures: Vec<f64> = track.samples.iter().map(|sample| sample.exposure).collect();
    if exposures.iter().any(|stops| *stops != 0.0) {
        let attribute = prim.set("exposure", "Float", VARYING, exposures[0])?;
        for (sample, stops) in track.samples.iter().zip(&exposures).filter(|_| exposures.len() > 1) {
            attribute.sample(sample.time_code, *stops)?;
        }
    }
    let clipping = first.1.clipping_range;
    let clipping = pxr.gf.call_method1("Vec2f", (clipping.x, clipping.y))?;
    prim.set("clippingRange", "Float2", VARYING, clipping)?;
    // Apertures give no resolution: the captured one is an attribute of its own.
    for (name, pixels) in
        [(tokens::IMAGE_WIDTH, last.camera.width), (tokens::IMAGE_HEIGHT, last.camera.height)]
    {
        prim.set_custom(name, "Int", i32::try_from(pixels).unwrap_or(i32::MAX))?;
    }
    Ok(())
}
