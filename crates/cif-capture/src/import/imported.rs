//! Poses of another tool, and their images.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::orientation::{Orientation, turned_size};
use cif_dataset::{Turn, same_aspect};
use cif_geometry::RigidTransform;
use glam::DVec2;

use crate::Error;
use crate::frames::Shot;
use crate::poses::{Lens, Pose, Poses, turned};
use crate::times::entry;

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
    /// True where poses are of the pixels as files store them, unless the sizes of the cameras show otherwise; false
    /// where the tool turns photographs upright, as their EXIF says.
    pub of_stored_pixels: bool,
    /// Notes on images that were left out or turned, one sentence each.
    pub notes: Vec<String>,
}

/// Adds a camera; equal lenses are one.
pub(super) fn add(poses: &mut Poses, name: String, lens: Lens, world_from_camera: RigidTransform) {
    let number = poses.lenses.iter().position(|known| *known == lens).unwrap_or_else(|| {
        poses.lenses.push(lens);
        poses.lenses.len() - 1
    });
    poses.images.insert(name, Pose { lens: number, world_from_camera, points: 0 });
}

impl Imported {
    /// The same poses under the names of the images of a capture, which are upright, with times where the file has them
    /// and the images do not.
    ///
    /// # Errors
    /// When no image has a pose, or a camera is of another aspect than its image.
    pub fn matched(mut self, path: &Path, shots: &mut [Shot]) -> Result<Self, Error> {
        let mut matched = Poses::default();
        let mut turned = 0;
        for shot in shots.iter_mut() {
            if let Some(pose) = entry(&self.poses.images, &shot.name) {
                let (lens, place, quarters) =
                    self.upright(pose, shot).map_err(|problem| of_image(path, shot, problem))?;
                turned += usize::from(quarters > 0);
                add(&mut matched, shot.name.clone(), lens, place);
                shot.time = shot.time.or_else(|| entry(&self.times, &shot.name).copied());
            }
        }
        if turned > 0 {
            self.notes.push(format!(
                "{}: its cameras are of the pixels as {turned} photographs store them, and are turned with these",
                path.display()
            ));
        }
        if matched.images.is_empty() {
            let (image, known) = (
                shots.first().map(|shot| shot.name.as_str()).unwrap_or_default(),
                self.poses.images.keys().next().map(String::as_str).unwrap_or_default(),
            );
            return Err(Error::refused(
                format!("{}: its names fit no image: it has {known:?}, the images {image:?}", path.display()),
                "give the images that these poses were found with, under the same names",
            ));
        }
        matched.points = self.poses.points;
        Ok(Self { poses: matched, ..self })
    }

    /// Lens and place of an image that is upright, and the quarters by which they were turned.
    fn upright(&self, pose: &Pose, shot: &Shot) -> Result<(Lens, RigidTransform, u32), String> {
        let lens = &self.poses.lenses[pose.lens];
        let stored = turned_size(shot.turned, shot.size);
        let (width, height) = lens.size;
        let size = DVec2::new(f64::from(width), f64::from(height));
        let turn = Turn::for_camera(shot.turned, stored, Some(size), self.of_stored_pixels);
        let quarters = match shot.turned {
            _ if turn.image == shot.turned => 0,
            Orientation::Rotate90 => 1,
            Orientation::Rotate180 => 2,
            Orientation::Rotate270 => 3,
            _ => return Err("its EXIF mirrors it, and its pose is that of the stored image".to_owned()),
        };
        let (lens, place) = turned(lens, pose.world_from_camera, quarters);
        if !same_aspect(lens.size, shot.size) {
            let (seen_width, seen_height) = shot.size;
            return Err(format!(
                "its camera is for {width} x {height} pixels, the image has {seen_width} x {seen_height}: another aspect"
            ));
        }
        Ok((lens, place, quarters))
    }
}

/// The error of an image whose pose does not fit it.
fn of_image(path: &Path, shot: &Shot, problem: String) -> Error {
    Error::refused(
        format!("{}: {}: {problem}", path.display(), shot.name),
        "give the images that these poses were found with, neither cropped nor turned, or correct the size of the camera",
    )
}
