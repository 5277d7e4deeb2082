//! Trained scenes as commands take them.

use std::path::Path;

use cif_field::Field;
use cif_render::RenderSettings;
use cif_scene::CaptureFrame;

use crate::error::Error;

/// Loads a `.cif` file.
///
/// # Errors
/// When it is missing, truncated or not a scene.
pub(super) fn load(path: &Path) -> Result<Field, Error> {
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a trained scene (.cif) is expected here", path.display()),
            "train one first: cif train CAPTURE -o scene.cif",
        ));
    }
    Field::load(path).map_err(Error::plain)
}

/// Whether a path names a trained scene rather than a stage or a capture.
pub(super) fn is_scene(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("cif"))
}

/// What a file is, by its extension.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// A trained scene.
    Scene,
    /// A stage.
    Usd,
    /// A glTF file.
    Gltf,
}

/// Extensions of every format.
const FORMATS: [(&str, Format); 7] = [
    ("cif", Format::Scene),
    ("usda", Format::Usd),
    ("usdc", Format::Usd),
    ("usdz", Format::Usd),
    ("usd", Format::Usd),
    ("glb", Format::Gltf),
    ("gltf", Format::Gltf),
];

/// Tells what a file is.
///
/// # Errors
/// When its extension is none of ours.
pub(super) fn format(path: &Path) -> Result<Format, Error> {
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
    let known = FORMATS.iter().find(|(name, _)| extension.as_deref() == Some(name));
    known.map(|(_, format)| *format).ok_or_else(|| {
        let names: Vec<String> = FORMATS.iter().map(|(name, _)| format!(".{name}")).collect();
        Error::usage(
            format!("{}: the extension does not say what the file is", path.display()),
            format!("files that can be asked end with {}", names.join(", ")),
        )
    })
}

/// The settings that a scene is to be rendered with: those of its training.
pub(super) fn render_settings(field: &Field) -> RenderSettings {
    cif_train::metrics::trained_settings(field)
}

/// Where a scene lies in the world of its capture.
///
/// # Errors
/// When what the scene records of it is no frame.
pub(super) fn frame(field: &Field) -> Result<CaptureFrame, Error> {
    cif_scene::frame_of(field).map_err(Error::plain)
}

/// Says where a scene lies in the world of its capture, where that is not at its origin. `relative`: whether a file
/// that is written holds places relative to there.
pub(super) fn note_frame(frame: &CaptureFrame, relative: bool) {
    if frame.is_identity() {
        return;
    }
    let [x, y, z] = frame.offset;
    eprintln!(
        "note: the capture was read in a frame of its own, around ({x}, {y}, {z}), lengths times {}; the root of a stage \
         or glTF file places the scene there",
        frame.scale
    );
    if relative {
        eprintln!(
            "note: splats of PLY files, which are single precision, stay in that frame; the comments `world offset` and \
             `world scale` tell it: a place in the world is that in the file / scale + offset"
        );
    }
}

/// Image reduction that a scene was trained with.
pub(super) fn trained_downscale(field: &Field) -> Option<u32> {
    cif_train::metrics::training_config(field)?.downscale
}

/// Checks a normalised time.
///
/// # Errors
/// Outside [0, 1].
pub(super) fn check_time(time: Option<f64>) -> Result<(), Error> {
    match time {
        Some(time) if !(0.0..=1.0).contains(&time) => Err(Error::usage(
            format!("--time {time}: times are normalised"),
            "give a number from 0 (first captured time) to 1 (last)",
        )),
        _ => Ok(()),
    }
}
