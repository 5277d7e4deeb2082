//! Cameras: recorded ones and those of others.

use cif_geometry::PinholeCamera;
use cif_scene::assemble::{Decomposed, Track};
use cif_scene::{CameraSample, CameraTrack};
use glam::{DVec2, DVec3};
use pyo3::prelude::*;

use super::values::{attribute, plain, samples, text, value, vector};
use super::{labels, reading::Reading};
use crate::conventions::{self, UsdCamera};
use crate::tokens;

/// Picture width of cameras that do not say theirs, pixels.
const WIDTH: i64 = 1280;
/// Attributes of the lens, and what they are where nobody says.
const LENS: [(&str, f64); 5] = [
    ("focalLength", 50.0),
    ("horizontalAperture", 20.955),
    ("verticalAperture", 15.2908),
    ("horizontalApertureOffset", 0.0),
    ("verticalApertureOffset", 0.0),
];

/// How much brighter than the scene is the camera records colours, stops.
const EXPOSURE: &str = "exposure";

/// The camera; `None` where it is no perspective camera or its lens makes no sense.
pub(super) fn read<'py>(
    reading: &Reading<'_, 'py>,
    prim: &Bound<'py, PyAny>,
) -> PyResult<Option<CameraTrack>> {
    let earliest = reading.pxr.earliest()?;
    let path = super::values::path(prim)?;
    let projection: Option<String> = plain(prim, "projection", &earliest)?;
    if projection.is_some_and(|projection| projection != "perspective") {
        reading.warn(format!("{path}: only perspective cameras are read"));
        return Ok(None);
    }
    let pixels = |name: &str| plain::<i64>(prim, name, &earliest);
    let width = pixels(tokens::IMAGE_WIDTH)?.filter(|width| (1..=1 << 16).contains(width));
    let height = pixels(tokens::IMAGE_HEIGHT)?.filter(|height| (1..=1 << 16).contains(height));
    let Some((track, _)) = reading.frames.node(prim)? else { return Ok(None) };
    let mut times: Vec<f64> = match value(prim, tokens::CAMERA_CODES, &earliest)? {
        Some(codes) => codes.try_iter()?.map(|code| code?.extract()).collect::<PyResult<_>>()?,
        None => track.samples.iter().map(|sample| sample.time_code).collect(),
    };
    for name in LENS.iter().map(|(name, _)| *name).chain([EXPOSURE]) {
        if let Some(attribute) = attribute(prim, name)? {
            times.extend(samples(&attribute)?);
        }
    }
    times.sort_by(f64::total_cmp);
    times.dedup();
    if times.is_empty() {
        times.push(reading.start);
    }
    let mut views = Vec::with_capacity(times.len());
    for time_code in times {
        let at = reading.pxr.time_code(Some(time_code))?;
        let mut lens = LENS.map(|(_, fallback)| fallback);
        for ((name, _), lens) in LENS.iter().zip(&mut lens) {
            *lens = plain(prim, name, &at)?.unwrap_or(*lens);
        }
        let [focal_length, wide, high, right, up] = lens;
        let sensible =
            focal_length > 0.0 && wide > 0.0 && high > 0.0 && lens.iter().all(|value| value.is_finite());
        if !sensible {
            reading.warn(format!("{path}: a camera without focal length or aperture was left out"));
            return Ok(None);
        }
        let clipping = value(prim, "clippingRange", &at)?.map(|range| vector::<2>(&range)).transpose()?;
        let (translation, rotation) = pose(reading, prim, &track, time_code)?;
        let usd = UsdCamera {
            translation,
            rotation,
            focal_length,
            aperture: DVec2::new(wide, high),
            aperture_offset: DVec2::new(right, up),
            clipping_range: clipping.map_or(DVec2::new(1.0, 1e6), DVec2::from_array),
        };
        let camera = camera(&usd, width.unwrap_or(WIDTH) as u32, height.map(|height| height as u32));
        let exposure = plain::<f64>(prim, EXPOSURE, &at)?.filter(|stops| stops.is_finite()).unwrap_or(0.0);
        views.push(CameraSample { time_code, camera, exposure });
    }
    let label = text(&prim.call_method0("GetDisplayName")?)?;
    let name = labels::node_name(prim)?;
    Ok(Some(CameraTrack { name, label, samples: views }))
}

fn pose<'py>(
    reading: &Reading<'_, 'py>,
    prim: &Bound<'py, PyAny>,
    track: &Track,
    time_code: f64,
) -> PyResult<(DVec3, glam::DQuat)> {
    if track.samples.is_empty() {
        return Ok((track.rest.translation, track.rest.rotation.normalize()));
    }
    let exact = track.samples.iter().find(|sample| sample.time_code == time_code);
    if let Some(sample) = exact {
        return Ok((sample.translation, sample.rotation.normalize()));
    }
    // `Frames::node` has seen that it collapses nowhere.
    let pose = Decomposed::of(&reading.frames.world(prim, Some(time_code))?);
    Ok(pose.map_or((track.rest.translation, track.rest.rotation), |pose| (pose.translation, pose.rotation)))
}

/// The pinhole camera, with the recorded height where there is one: apertures give it only to rounding.
fn camera(usd: &UsdCamera, width: u32, height: Option<u32>) -> PinholeCamera {
    let camera = conventions::pinhole_camera(usd, width);
    let Some(height) = height.filter(|&height| height != camera.height) else { return camera };
    let per_pixel = usd.aperture / DVec2::new(f64::from(width), f64::from(height));
    let shift = DVec2::new(usd.aperture_offset.x, -usd.aperture_offset.y) / per_pixel;
    PinholeCamera {
        height,
        focal_px: DVec2::splat(usd.focal_length) / per_pixel,
        principal_px: DVec2::new(f64::from(width), f64::from(height)) / 2.0 - shift,
        ..camera
    }
}
