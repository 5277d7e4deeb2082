//! Photographs, which keep their names.

use std::path::PathBuf;

use rayon::prelude::*;

use super::{Choice, Notes, Shot};
use crate::picture::Impression;
use crate::source::Source;
use crate::{Error, Hooks};

/// The photographs of a camera in name order; such that show nothing are left out.
pub(super) fn read(
    source: &Source,
    files: &[PathBuf],
    prefix: &str,
    choice: &Choice,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    if choice.rate.is_some() || choice.from_s.is_some() || choice.to_s.is_some() || choice.max_side.is_some()
    {
        notes.push(format!(
            "{}: photographs are taken as they are: a rate, a range of seconds and a size are for videos",
            source.path.display()
        ));
    }
    hooks.tell(&format!("photographs of {}", source.camera));
    // Evenly spread, as of a video.
    let files: Vec<&PathBuf> = match choice.count.filter(|count| *count < files.len()) {
        Some(count) => (0..count).map(|k| &files[k * files.len() / count]).collect(),
        None => files.iter().collect(),
    };
    let read: Vec<_> = files.par_iter().map(|file| Impression::of_file(file)).collect();
    hooks.go_on()?;
    let mut shots = Vec::new();
    let mut empty = Vec::new();
    for (file, read) in files.into_iter().zip(read) {
        let (impression, size) = read?;
        let name = file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if impression.is_empty() {
            empty.push(name);
            continue;
        }
        shots.push(Shot {
            camera: source.camera.clone(),
            name: format!("{prefix}{name}"),
            file: file.clone(),
            time: None,
            size,
            impression,
        });
    }
    if !empty.is_empty() {
        notes.push(format!(
            "{}: {} photographs are black or of one colour and are left out: {}",
            source.path.display(),
            empty.len(),
            super::check::some_of(&empty)
        ));
    }
    Ok(shots)
}
