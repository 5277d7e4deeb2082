//! Poses that other tools have found: COLMAP, nerfstudio, Polycam, RealityCapture and Metashape.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::foreign::{self, NamedCamera};

pub use self::imported::Imported;
use self::imported::add;
use crate::Error;
use crate::frames::Shot;
use crate::poses::{Lens, Point, Poses};

mod imported;
mod metashape;
mod polycam;
mod reality_capture;
#[cfg(test)]
mod tests;

/// Reads poses for images, whose sizes some tools do not write.
///
/// # Errors
/// When nothing there is of a known tool, or its files are damaged.
pub fn read(path: &Path, shots: &[Shot]) -> Result<Imported, Error> {
    let is_there = |name: &str| path.join(name).exists();
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if let Some((folder, note)) = foreign::find_colmap(path) {
        let (cameras, points) = foreign::read_colmap(&folder)?;
        let found = imported(&folder, cameras, points, "COLMAP", true)?;
        return Ok(Imported { notes: note.into_iter().collect(), ..found });
    }
    if is_there("transforms.json") || ending.as_deref() == Some("json") {
        let file = if path.is_dir() { path.join("transforms.json") } else { path.to_owned() };
        let (cameras, points) = foreign::read_transforms(&file)?;
        return imported(&file, cameras, points, "nerfstudio", false);
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
    path: &Path,
    cameras: Vec<NamedCamera>,
    points: Vec<([f64; 3], [u8; 3])>,
    tool: &'static str,
    of_stored_pixels: bool,
) -> Result<Imported, Error> {
    let mut poses = Poses::default();
    let mut times = BTreeMap::new();
    for camera in cameras {
        let size = camera.size.ok_or_else(|| {
            Error::refused(
                format!("{}: {}: the file does not give the size of its images", path.display(), camera.name),
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
    let point =
        |(position, color): ([f64; 3], [u8; 3])| Point { position: glam::DVec3::from(position), color };
    poses.points = points.into_iter().map(point).collect();
    let (metres_known, up_known) = (false, false);
    Ok(Imported { poses, times, tool, metres_known, up_known, of_stored_pixels, notes: Vec::new() })
}
