//! Points of the world that bring ids from camera to camera.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::{Dataset, PointSource};
use cif_field::Field;
use cif_geometry::RigidTransform;
use cif_masks::Keyframe;
use cif_train::Stop;
use glam::DVec3;

use crate::commands::shared::scene;
use crate::error::Error;
use crate::{interrupt, messages, starting_points};

/// Opacity from which a Gaussian of a scene is a point that carries ids.
const SOLID: f32 = 0.5;

/// Cameras whose poses differ by less than this, relative to the distance between the origin and the camera, are one.
const SAME_POSE: f64 = 1e-3;

/// Points of the world that bring ids from camera to camera.
pub(super) enum Points {
    /// Every camera has a keyframe, or there are none.
    None,
    /// Points that stand still.
    Still(Vec<DVec3>),
    /// Gaussians of a scene, which move.
    Scene(Box<Field>),
}

impl Points {
    /// Points of a scene, else of the capture.
    ///
    /// # Errors
    /// When the scene cannot be read or shows another capture; when a camera has no keyframe and there are no points.
    pub(super) fn new(
        scene: Option<&Path>,
        dataset: &Dataset,
        cameras: &BTreeMap<&str, Vec<usize>>,
        painted: &BTreeMap<usize, Keyframe>,
    ) -> Result<Self, Error> {
        let without: Vec<&str> = cameras
            .iter()
            .filter(|(_, frames)| frames.iter().all(|frame| !painted.contains_key(frame)))
            .map(|(name, _)| *name)
            .collect();
        if let Some(path) = scene {
            let field = scene::load(path)?;
            check_capture(path, &field, dataset)?;
            if without.is_empty() {
                eprintln!(
                    "note: every camera has a keyframe, so that nothing is taken from {}",
                    path.display()
                );
            }
            return Ok(Self::Scene(Box::new(field)));
        }
        if without.is_empty() {
            return Ok(Self::None);
        }
        let triangulated;
        let positions = if dataset.points.source == PointSource::Random {
            triangulated = triangulate(dataset, &without)?;
            &triangulated
        } else {
            &dataset.points.positions
        };
        let point = |point: &[f32; 3]| DVec3::from_array(point.map(f64::from));
        Ok(Self::Still(positions.iter().map(point).collect()))
    }

    /// World positions at a normalised time, metres.
    pub(super) fn at(&self, time: f64) -> Vec<DVec3> {
        match self {
            Self::None => Vec::new(),
            Self::Still(points) => points.clone(),
            Self::Scene(field) => {
                let gaussians = field.deformed(time);
                let solid = (0..gaussians.means.len()).filter(|row| gaussians.opacity(*row) >= SOLID);
                solid.map(|row| DVec3::from_array(gaussians.means[row].map(f64::from))).collect()
            }
        }
    }
}

/// Refuses a scene of another capture: its Gaussians would lie anywhere. Scenes that record no camera are taken.
fn check_capture(path: &Path, field: &Field, dataset: &Dataset) -> Result<(), Error> {
    let known = field.cameras.iter().any(|recorded| {
        dataset.frames.iter().any(|frame| {
            frame.camera_name == recorded.name
                && same_pose(&frame.camera.camera_from_world, &recorded.camera.camera_from_world)
        })
    });
    if scene::frame(field)? == dataset.frame && (known || field.cameras.is_empty()) {
        return Ok(());
    }
    Err(Error::failed(
        format!("{}: it was trained on another capture than {}", path.display(), dataset.root.display()),
        "give a scene of this capture, or train one: cif train CAPTURE -o scene.cif",
    ))
}

fn same_pose(a: &RigidTransform, b: &RigidTransform) -> bool {
    let apart = (a.translation - b.translation).length();
    apart <= SAME_POSE * a.translation.length().max(f64::MIN_POSITIVE)
        && a.rotation.abs_diff_eq(b.rotation, SAME_POSE)
}

/// Points of a capture that has none, by its own images; `without` names the cameras that have no keyframe.
fn triangulate(dataset: &Dataset, without: &[&str]) -> Result<Vec<[f32; 3]>, Error> {
    let mut dataset = dataset.clone();
    let is_found = starting_points::find(&mut dataset, &Stop::when(interrupt::requested).into())?;
    if is_found && dataset.points.source == PointSource::Triangulated {
        messages::note!(
            "{} points from the images of the capture bring ids to {}",
            dataset.points.positions.len(),
            without.join(", ")
        );
        return Ok(dataset.points.positions);
    }
    Err(Error::failed(
        format!(
            "{} {} no keyframe, and the capture has no points that could bring ids from other cameras, nor could any be \
             triangulated from its images",
            without.join(", "),
            if without.len() == 1 { "has" } else { "have" }
        ),
        "paint a frame of each camera, or train a scene without masks and give it with --scene; pip install \
         'cif4d[capture]' brings pycolmap, which finds points",
    ))
}
