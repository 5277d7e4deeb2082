//! Frames of a capture: photographs, and chosen frames of videos.

mod bt2100;
mod check;
pub mod choose;
mod ffmpeg;
mod photographs;
mod pixmap;
mod shot;
mod video;

use std::path::Path;

pub use check::{Notes, check, is_fixed};
pub use choose::Choice;
pub(crate) use photographs::remember;
pub use shot::Shot;

use crate::source::Source;
use crate::{Error, Hooks};

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
