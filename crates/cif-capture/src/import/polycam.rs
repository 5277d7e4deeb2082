//! Polycam: `keyframes/corrected_cameras/` (or `cameras/`) with one JSON file per image. ARKit's world has
//! metres and y up; its axes are cycled so that z is up, as nerfstudio's importer does.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec3};
use serde::Deserialize;

use super::imported::{Imported, add};
use crate::Error;
use crate::poses::{Lens, Poses};

#[derive(Deserialize)]
struct CameraJson {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    width: u32,
    height: u32,
    timestamp: Option<f64>,
    #[serde(flatten)]
    rest: BTreeMap<String, serde_json::Value>,
}

/// Folder of the cameras of an export.
pub(super) fn folder(path: &Path) -> Option<PathBuf> {
    let inner = ["keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras"];
    inner.iter().map(|name| path.join(name)).find(|folder| folder.is_dir())
}

pub(super) fn read(folder: &Path) -> Result<Imported, Error> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io("read", folder))? {
        let path = entry.map_err(Error::io("read", folder))?.path();
        if path.extension().is_some_and(|ending| ending == "json") {
            files.push(path);
        }
    }
    files.sort();
    let (mut poses, mut times) = (Poses::default(), BTreeMap::new());
    for file in &files {
        let text = cif_input::read_text(file).map_err(Error::io("read", file))?;
        let damaged = |problem: String| {
            Error::refused(format!("{}: {problem}", file.display()), "export the scan again, with raw data")
        };
        let camera: CameraJson = serde_json::from_slice(&text).map_err(|error| damaged(error.to_string()))?;
        let number = |key: String| {
            let value = camera.rest.get(&key).and_then(serde_json::Value::as_f64);
            value.filter(|value| value.is_finite()).ok_or_else(|| damaged(format!("{key} is missing")))
        };
        let column = |c: usize| -> Result<DVec3, Error> {
            // Rows 2, 0, 1: y up becomes z up.
            Ok(DVec3::new(number(format!("t_2{c}"))?, number(format!("t_0{c}"))?, number(format!("t_1{c}"))?))
        };
        let rotation = DMat3::from_cols(column(0)?, -column(1)?, -column(2)?);
        let world_from_camera = RigidTransform { rotation, translation: column(3)? };
        if world_from_camera.orthonormality_error() > 1e-3 || !(camera.fx > 0.0 && camera.fy > 0.0) {
            return Err(damaged(
                "its pose is no rigid transform, or a focal length is not positive".to_owned(),
            ));
        }
        let name = file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let lens = Lens {
            size: (camera.width.max(1), camera.height.max(1)),
            focal_px: [camera.fx, camera.fy],
            principal_px: [camera.cx, camera.cy],
            distortion: LensDistortion::default(),
        };
        // Microseconds of the device.
        times.extend(camera.timestamp.map(|stamp| (name.clone(), stamp * 1e-6)));
        add(&mut poses, name, lens, world_from_camera);
    }
    if poses.images.is_empty() {
        return Err(Error::refused(
            format!("{}: it holds no camera", folder.display()),
            "export the scan again, with raw data",
        ));
    }
    Ok(Imported {
        poses,
        times,
        tool: "Polycam",
        metres_known: true,
        up_known: true,
        of_stored_pixels: true,
        notes: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_export_is_read_with_metres_and_up() {
        let root = tempfile::tempdir().unwrap();
        let cameras = root.path().join("keyframes/corrected_cameras");
        std::fs::create_dir_all(&cameras).unwrap();
        // Upright at 1.5 m height, looking along -z of ARKit.
        let text = r#"{"fx": 700.0, "fy": 701.0, "cx": 512.0, "cy": 384.0, "width": 1024, "height": 768,
            "t_00": 1, "t_01": 0, "t_02": 0, "t_03": 0.25, "t_10": 0, "t_11": 1, "t_12": 0, "t_13": 1.5,
            "t_20": 0, "t_21": 0, "t_22": 1, "t_23": -2.0, "timestamp": 2500000, "blur_score": 90.0}"#;
        std::fs::write(cameras.join("17.json"), text).unwrap();
        let found = read(&folder(root.path()).unwrap()).unwrap();
        let pose = found.poses.images["17"].world_from_camera;
        assert_eq!(pose.translation, DVec3::new(-2.0, 0.25, 1.5));
        assert_eq!(pose.rotation * -DVec3::Y, DVec3::Z, "the top of the picture is up");
        assert_eq!(pose.rotation * DVec3::Z, -DVec3::X);
        assert!(found.metres_known && found.up_known);
        assert_eq!(found.times["17"], 2.5);
        std::fs::write(cameras.join("18.json"), text.replace("\"t_13\": 1.5,", "")).unwrap();
        let error = read(&cameras).unwrap_err().to_string();
        assert!(error.contains("18.json") && error.contains("t_13"), "{error}");
    }
}
