//! Poses that other tools have found: COLMAP, nerfstudio, Polycam, RealityCapture and Metashape.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::foreign::{self, NamedCamera};

use crate::Error;
use crate::frames::Shot;
use crate::poses::{Lens, Point, Pose, Poses};
use crate::times::entry;

mod metashape;
mod polycam;
mod reality_capture;
#[cfg(test)]
mod tests;

/// Poses of a file or folder, and what the tool knows of the world.
#[derive(Clone, Debug)]
pub struct Imported {
    /// Poses by the names that the tool gives.
    pub poses: Poses,
    /// Times by these names, where the file has them.
    pub times: BTreeMap<String, f64>,
    /// Name of the tool.
    pub tool: &'static str,
    /// True where its unit is the metre.
    pub metres_known: bool,
    /// True where +z is up.
    pub up_known: bool,
}

/// Reads poses for images, whose sizes some tools do not write.
///
/// # Errors
/// When nothing there is of a known tool, or its files are damaged.
pub fn read(path: &Path, shots: &[Shot]) -> Result<Imported, Error> {
    let is_there = |name: &str| path.join(name).exists();
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if let Some(folder) = ["", "0", "sparse/0", "sparse", "colmap/sparse/0"]
        .iter()
        .map(|name| path.join(name))
        .find(|folder| ["cameras.bin", "cameras.txt"].iter().any(|name| folder.join(name).is_file()))
    {
        let (cameras, points) = foreign::read_colmap(&folder)?;
        return imported(cameras, points, "COLMAP");
    }
    if is_there("transforms.json") || ending.as_deref() == Some("json") {
        let file = if path.is_dir() { path.join("transforms.json") } else { path.to_owned() };
        let (cameras, points) = foreign::read_transforms(&file)?;
        return imported(cameras, points, "nerfstudio");
    }
    if let Some(cameras) = polycam::folder(path) {
        return polycam::read(&cameras);
    }
    if ending.as_deref() == Some("csv") {
        return reality_capture::read(path, shots);
    }
    if ending.as_deref() == Some("xml") {
        return metashape::read(path);
    }
    Err(Error::refused(
        format!("{}: it holds no poses of a tool that is known", path.display()),
        "give a COLMAP model (cameras.bin or cameras.txt), a nerfstudio transforms.json, the folder of a Polycam \
         export with keyframes/, a RealityCapture registration as .csv (Internal/External camera parameters), or \
         cameras of Metashape as .xml (Agisoft XML)",
    ))
}

/// Cameras and points as this crate has them.
fn imported(
    cameras: Vec<NamedCamera>,
    points: Vec<([f32; 3], [u8; 3])>,
    tool: &'static str,
) -> Result<Imported, Error> {
    let mut poses = Poses::default();
    let mut times = BTreeMap::new();
    for camera in cameras {
        let size = camera.size.ok_or_else(|| {
            Error::refused(
                format!("{}: the file does not tell the size of its images", camera.name),
                "add w and h to it",
            )
        })?;
        let lens = Lens {
            size,
            focal_px: camera.focal_px,
            principal_px: camera.principal_px,
            distortion: camera.lens,
        };
        times.extend(camera.time.map(|time| (camera.name.clone(), time)));
        add(&mut poses, camera.name, lens, camera.camera_from_world.inverse());
    }
    let point = |(position, color): ([f32; 3], [u8; 3])| Point {
        position: glam::DVec3::from(position.map(f64::from)),
        color,
    };
    poses.points = points.into_iter().map(point).collect();
    Ok(Imported { poses, times, tool, metres_known: false, up_known: false })
}

/// Adds a camera; equal lenses are one.
fn add(poses: &mut Poses, name: String, lens: Lens, world_from_camera: cif_geometry::RigidTransform) {
    let number = poses.lenses.iter().position(|known| *known == lens).unwrap_or_else(|| {
        poses.lenses.push(lens);
        poses.lenses.len() - 1
    });
    poses.images.insert(name, Pose { lens: number, world_from_camera, points: 0 });
}

impl Imported {
    /// The same poses under the names of the images of a capture, with times where the file has them and the
    /// images do not.
    ///
    /// # Errors
    /// When no image has a pose.
    pub fn matched(self, path: &Path, shots: &mut [Shot]) -> Result<Self, Error> {
        let mut images = BTreeMap::new();
        for shot in shots.iter_mut() {
            if let Some(pose) = entry(&self.poses.images, &shot.name) {
                images.insert(shot.name.clone(), *pose);
                shot.time = shot.time.or_else(|| entry(&self.times, &shot.name).copied());
            }
        }
        if images.is_empty() {
            let (image, known) = (
                shots.first().map(|shot| shot.name.as_str()).unwrap_or_default(),
                self.poses.images.keys().next().map(String::as_str).unwrap_or_default(),
            );
            return Err(Error::refused(
                format!("{}: its names fit no image: it has {known:?}, the images {image:?}", path.display()),
                "give the images that these poses were found with, under the same names",
            ));
        }
        Ok(Self { poses: Poses { images, ..self.poses }, ..self })
    }
}
