//! Models of a folder, run on one frame after the other; what they found is kept, so that a question that is asked again,
//! or goes on after Ctrl-C, is answered from there.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::masks::flat_name;
use cif_output::Workplace;
use cif_vision::cache::{self, Cache};
use cif_vision::grounding::Thresholds;
use cif_vision::{Models, Prompter};

use super::asked::{Asked, Detected, temporary};
use crate::error::Error;
use crate::interrupt;
use crate::mask_query::FoundMasks;
use crate::progress::FrameProgress;

/// Masks of a prompt on pictures of frames.
///
/// # Errors
/// When a picture cannot be read or a model does not fit or fails.
pub(super) fn detect(
    asked: &Asked<'_>,
    models: &Models,
    place: &Path,
    prompt: &str,
) -> Result<Detected, Error> {
    let thresholds = Thresholds::default();
    let pythons = cif_capture::structure::pythons();
    let mut prompter = Prompter::new(models, &pythons, thresholds);
    let mut folder = None;
    // Masks that somebody else has put there are no answers of these models.
    if let Err(error) = cif_output::private_folder(place) {
        not_kept(&Error::io("use the cache", place)(error));
        folder = Some(temporary()?);
    }
    let kept = folder.as_ref().map_or(place, Workplace::path);
    let mut cache = Cache::new(kept, models, prompt, thresholds)?;
    let mut files = vec![Vec::new(); asked.dataset.frames.len()];
    let mut boxes = BTreeMap::new();
    let mut progress = FrameProgress::new(false, asked.frames.len());
    for index in asked.frames {
        interrupt::go_on()?;
        let name = flat_name(&asked.dataset.frames[*index].name);
        let picture = (asked.picture)(*index)?;
        let mut file = cache.file(&name, &picture);
        let found = match cache::boxes(&file, (picture.width, picture.height)) {
            Some(found) => found,
            None => {
                let (mask, found) = prompter.mask(&picture, prompt)?;
                if let Err(error) = cache::write(&file, &mask, &found) {
                    let error = error.into();
                    if folder.is_some() {
                        return Err(error);
                    }
                    not_kept(&error);
                    let instead = folder.insert(temporary()?);
                    cache = Cache::new(instead.path(), models, prompt, thresholds)?;
                    file = cache.file(&name, &picture);
                    cache::write(&file, &mask, &found)?;
                }
                found
            }
        };
        boxes.insert(asked.dataset.frames[*index].name.clone(), found);
        files[*index].push(file);
        progress.step();
    }
    Ok(Detected { masks: FoundMasks { files, loaded: true }, boxes, _folder: folder })
}

fn not_kept(error: &Error) {
    crate::messages::note!("{error}; masks are not kept for the next time, see --cache");
}
