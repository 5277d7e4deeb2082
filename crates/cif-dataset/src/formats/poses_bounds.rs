//! `poses_bounds.npy` of LLFF: a row per camera or image, which Neu3D took over for its rigs.
//!
//! A row is a 3 x 5 matrix, row by row, and two depths: columns down, right, back, position, (height, width, focal
//! length). Source: the README of Fyusion's LLFF, "Using your own poses".

use std::path::{Path, PathBuf};

use cif_geometry::LensDistortion;
use glam::{DMat3, DVec2, DVec3};

use super::draft::{DraftCamera, DraftFocal, world_to_camera};
use crate::files::{image, npy};
use crate::{Error, Turn};

/// The file's name.
pub(super) const NAME: &str = "poses_bounds.npy";

/// Cameras of a file, row by row.
pub(super) struct Poses {
    pub(super) path: PathBuf,
    pub(super) cameras: Vec<DraftCamera>,
}

/// Reads the file of a capture.
///
/// # Errors
/// When it is damaged, or its rows are too short for a pose.
pub(super) fn read(root: &Path) -> Result<Poses, Error> {
    let path = root.join(NAME);
    let matrix = npy::read_matrix(&path)?;
    if matrix.columns < 15 {
        return Err(Error::invalid(
            &path,
            format!(
                "{} values per camera; 17 are expected: a 3 x 5 pose (down, right, back, position, (H, W, f)) and \
                 two depths",
                matrix.columns
            ),
        ));
    }
    let rows: Vec<&[f64]> = matrix.values.chunks_exact(matrix.columns).collect();
    // EndoNeRF gives its fixed endoscope the identity, and takes that as right, up, back; in LLFF's axes such a
    // camera would lie on its side.
    let turned = rows.iter().all(|row| axes(row) == DMat3::IDENTITY);
    let cameras = rows.iter().map(|row| camera(&path, row, turned)).collect();
    Ok(Poses { path, cameras })
}

/// Columns 0 to 2 of a pose.
fn axes(row: &[f64]) -> DMat3 {
    DMat3::from_cols(column(row, 0), column(row, 1), column(row, 2))
}

fn column(row: &[f64], c: usize) -> DVec3 {
    DVec3::new(row[c], row[5 + c], row[10 + c])
}

/// The camera of a row whose axes are down, right, back, or right, up, back where `opengl`.
fn camera(path: &Path, row: &[f64], opengl: bool) -> DraftCamera {
    let DMat3 { x_axis: first, y_axis: second, z_axis: back } = axes(row);
    let (right, down) = if opengl { (first, -second) } else { (second, first) };
    let size = column(row, 4);
    DraftCamera {
        source: path.to_owned(),
        size: Some(DVec2::new(size.y, size.x)),
        focal: DraftFocal::Pixels(DVec2::splat(size.z)),
        principal_px: None,
        lens: LensDistortion::default(),
        camera_from_world: world_to_camera(DMat3::from_cols(right, down, -back), column(row, 3)),
    }
}

/// Reduction of an image relative to the size that its pose is of, as preprocessing by others leaves it; 1 where it is
/// no whole number, or differs between width and height by more than rounding.
///
/// # Errors
/// When the header of the image cannot be read.
pub(super) fn stored_reduction(camera: &DraftCamera, path: &Path) -> Result<u32, Error> {
    let Some(captured) = camera.size else { return Ok(1) };
    let header = image::probe(path)?;
    let stored = (header.width, header.height);
    let (width, height) = header.size_in(Turn::for_camera(header.orientation, stored, Some(captured), false));
    let factor = (captured.x / f64::from(width)).round();
    if !(1.0..=64.0).contains(&factor) {
        return Ok(1);
    }
    let rounded = |captured: f64, stored: u32| (captured / factor - f64::from(stored)).abs() <= 1.0;
    let fits = rounded(captured.x, width) && rounded(captured.y, height);
    Ok(if fits { factor as u32 } else { 1 })
}
