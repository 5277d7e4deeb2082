//! Frames of a capture: photographs, and chosen frames of videos.

mod check;
pub mod choose;
mod photographs;
mod video;

use std::path::{Path, PathBuf};

pub use check::{Notes, check, is_fixed};
pub use choose::Choice;

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
    /// Seconds since its camera's first frame; `None` for photographs without times.
    pub time: Option<f64>,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Its looks from afar.
    pub impression: Impression,
}

/// Collects the images of all cameras; frames of videos are written below `folder`.
///
/// # Errors
/// When a video or photograph cannot be read, or ffmpeg is needed and missing.
pub fn collect(
    sources: &[Source],
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    let mut shots = Vec::new();
    for source in sources {
        // Images of one camera lie in one folder, without a folder of its own.
        let prefix = if sources.len() > 1 { format!("{}/", source.camera) } else { String::new() };
        shots.extend(match &source.photographs {
            Some(files) => photographs::read(source, files, &prefix, choice, hooks, notes)?,
            None => {
                let choice =
                    Choice { sharpest: choice.sharpest.or(Some(sources.len() == 1)), ..choice.clone() };
                video::read(source, &prefix, &choice, folder, hooks, notes)?
            }
        });
    }
    Ok(shots)
}
