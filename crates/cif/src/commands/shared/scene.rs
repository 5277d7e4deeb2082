//! Trained scenes as commands take them.

use std::path::Path;

use cif_field::{Checkpoint, Field};
use cif_render::RenderSettings;
use cif_scene::CaptureFrame;
use cif_train::heads::Decoder;

use crate::error::Error;
use crate::messages::note;
use crate::moment::{Frames, Moment, note_fraction};

/// Loads a `.cif` file.
///
/// # Errors
/// When it is missing, truncated or not a scene.
pub(in crate::commands) fn load(path: &Path) -> Result<Field, Error> {
    refuse_folder(path)?;
    Field::load(path).map_err(Error::plain)
}

fn refuse_folder(path: &Path) -> Result<(), Error> {
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a trained scene (.cif) is expected here", path.display()),
            "train one first: cif train CAPTURE -o scene.cif",
        ));
    }
    Ok(())
}

/// Loads a `.cif` file with the head that labels its pixels, where its identity rows do not; a head that gives
/// none is left out.
///
/// # Errors
/// As [`load`], and when the head does not fit the scene.
pub fn load_with_head(path: &Path) -> Result<(Field, Option<Decoder>), Error> {
    refuse_folder(path)?;
    let Checkpoint { field, head, .. } = Checkpoint::load(path).map_err(Error::plain)?;
    let Some(head) = head else { return Ok((field, None)) };
    let decoder = Decoder::of_scene(&field, &head);
    decoder
        .map(|decoder| (field, Some(decoder).filter(Decoder::tells_labels)))
        .map_err(|error| Error::plain(format!("{}: {error}", path.display())))
}

/// The settings that a scene is to be rendered with: those of its training.
pub(in crate::commands) fn render_settings(field: &Field) -> RenderSettings {
    cif_train::metrics::trained_settings(field)
}

/// Where a scene lies in the world of its capture.
///
/// # Errors
/// When what the scene records of it is no frame.
pub(in crate::commands) fn frame(field: &Field) -> Result<CaptureFrame, Error> {
    cif_scene::frame_of(field).map_err(Error::plain)
}

/// Says where a scene lies in the world of its capture, where that is not at its origin; `notes` name formats
/// whose files do not place it.
pub(in crate::commands) fn note_frame(frame: &CaptureFrame, notes: impl IntoIterator<Item = &'static str>) {
    if frame.is_identity() {
        return;
    }
    let [x, y, z] = frame.offset;
    note!(
        "the scene is in a frame of its own, around ({x}, {y}, {z}), lengths times {}; the root of a stage \
         or glTF file places the scene there",
        frame.scale
    );
    for note in notes {
        note!("{note}");
    }
}

/// Image reduction that a scene was trained with.
pub(in crate::commands) fn trained_downscale(field: &Field) -> Option<u32> {
    cif_train::metrics::training_config(field)?.downscale
}

/// Normalised time of a moment in a scene; `flag` and the name of the file are for errors.
///
/// # Errors
/// When the scene does not have it.
pub(in crate::commands) fn time(
    field: &Field,
    place: &str,
    flag: &str,
    moment: Moment,
) -> Result<f64, Error> {
    note_fraction(flag, moment);
    let times = &field.timeline.times;
    let code = Frames::of(field, place).code(flag, moment)?;
    Ok(code_at(&field.time_codes(), times, code))
}

/// Time code of a normalised time: linear between captured times, which need not be evenly spaced.
pub(in crate::commands) fn code_at(times: &[f64], codes: &[f64], time: f64) -> f64 {
    let after = times.partition_point(|captured| *captured <= time);
    if after == 0 {
        return codes.first().copied().unwrap_or(0.0);
    }
    if after == times.len() {
        return codes[after - 1];
    }
    let fraction = (time - times[after - 1]) / (times[after] - times[after - 1]);
    codes[after - 1] + fraction * (codes[after] - codes[after - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_between_captured_ones_are_interpolated() {
        let (times, codes) = ([0.0, 0.25, 1.0], [0.0, 1.0, 2.0]);
        for (time, code) in [(0.0, 0.0), (0.125, 0.5), (0.25, 1.0), (0.625, 1.5), (1.0, 2.0)] {
            assert_eq!(code_at(&times, &codes, time), code);
        }
        assert_eq!(code_at(&[0.5], &[3.0], 0.0), 3.0);
        assert_eq!(code_at(&[0.5], &[3.0], 1.0), 3.0);
    }
}
