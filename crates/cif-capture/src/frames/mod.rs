//! Frames of a capture: photographs, and chosen frames of videos.

mod bt2100;
mod check;
pub mod choose;
mod ffmpeg;
mod photographs;
mod pixmap;
mod video;

use std::path::{Path, PathBuf};

pub use check::{Notes, check, is_fixed};
pub use choose::Choice;
use cif_dataset::FrameSource;
use cif_dataset::orientation::Orientation;
pub(crate) use photographs::remember;

use crate::picture::Impression;
use crate::source::Source;
use crate::{Error, Hooks};

/// One image of a capture.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Camera that took it, of [`Source::camera`].
    pub camera: String,
    /// Path below the folder of images, with `/` and extension.
    pub name: String,
    /// Where the image lies.
    pub file: PathBuf,
    /// Seconds since its camera's first frame, plus the offset of the camera; `None` for photographs without times.
    pub time: Option<f64>,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// How the pixels of a photograph were turned to be upright, by its EXIF.
    pub turned: Orientation,
    /// Its looks from afar.
    pub impression: Impression,
    /// Photograph, or frame of a video, that it was made of; `None` where it is not known.
    pub source: Option<FrameSource>,
}

/// Collects the images of all cameras; frames of videos, and photographs that are reduced, are written below `folder`.
///
/// # Errors
/// When a video or photograph cannot be read, ffmpeg is needed and missing, or an offset is of no camera.
pub fn collect(
    sources: &[Source],
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    let is_video = |name: &str| sources.iter().any(|s| s.camera == name && s.photographs.is_none());
    if let Some(name) = choice.offsets_s.keys().find(|name| !is_video(name)) {
        let known: Vec<&str> = sources.iter().map(|source| source.camera.as_str()).collect();
        return Err(Error::refused(
            format!("an offset is given for {name}, which is no video"),
            format!("name one of the cameras: {}", known.join(", ")),
        ));
    }
    // Frames are counted from the moment at which all cameras record, so that they show the same moments.
    let of = |source: &Source| choice.offsets_s.get(&source.camera).copied().unwrap_or(0.0);
    let all_record = sources.iter().map(of).fold(f64::NEG_INFINITY, f64::max);
    let from_s = choice.from_s.or((!choice.offsets_s.is_empty()).then_some(all_record));
    let choice = &Choice { from_s, ..choice.clone() };
    let mut shots = Vec::new();
    for source in sources {
        // Images of one camera lie in one folder, without a folder of its own.
        let prefix = if sources.len() > 1 { format!("{}/", source.camera) } else { String::new() };
        shots.extend(match &source.photographs {
            Some(files) => photographs::read(source, files, &prefix, choice, folder, hooks, notes)?,
            None => {
                let choice =
                    Choice { sharpest: choice.sharpest.or(Some(sources.len() == 1)), ..choice.clone() };
                video::read(source, &prefix, &choice, folder, hooks, notes)?
            }
        });
    }
    Ok(shots)
}
