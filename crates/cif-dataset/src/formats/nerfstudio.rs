//! nerfstudio and instant-ngp captures: one `transforms.json`.
//!
//! Held out are the frames of `test_filenames` and `val_filenames`, else every eighth one in name order.
//! `applied_transform` is left alone: cameras and points share the file's frame.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::draft::{Draft, DraftFrame, Source, customary_points, hold_out_every_eighth, some_of};
use super::transforms::{self, TransformsFile, World};
use crate::files::{listing, ply};
use crate::{Error, Split};

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let path = root.join("transforms.json");
    let file = transforms::read(&path)?;
    let mut unused = Vec::new();
    let file_paths: Vec<&Path> = file.frames.iter().map(|entry| entry.file_path.as_path()).collect();
    let inner = transforms::inside(root, &file_paths);
    let folder = transforms::common_folder(inner.iter().map(PathBuf::as_path));
    let folders: BTreeSet<PathBuf> = file.frames.iter().map(|entry| folder_of(&entry.file_path)).collect();
    let times: Vec<Option<f64>> = file.frames.iter().map(|entry| entry.time).collect();
    let times = transforms::times(&path, &times)?;
    let mut frames = Vec::with_capacity(file.frames.len());
    let mut sources = BTreeMap::new();
    for ((entry, inner), time) in file.frames.iter().zip(&inner).zip(times.normalised.iter().copied()) {
        let inner = inner.strip_prefix(&folder).unwrap_or(inner);
        let name = transforms::frame_name(inner);
        if let Some(source) = &entry.cif {
            if !source.is_sound() {
                let problem =
                    format!("frame {name}: `cif` has a number that its video does not have; remove `cif`");
                return Err(Error::invalid(&path, problem));
            }
            sources.insert(name.clone(), source.clone());
        }
        frames.push(DraftFrame {
            name,
            camera_name: camera_name(inner, folders.len()),
            time,
            split: Split::Train,
            image: transforms::image(root, &path, entry)?,
            mask: entry.mask_path.as_ref().map(|mask| root.join(transforms::clean(mask))),
            camera: transforms::camera(&path, &file, entry)?,
        });
    }
    let listed = lists(&file, &path)?;
    if let Some(splits) = listed {
        let mut kept = Vec::with_capacity(frames.len());
        let mut unlisted = 0;
        for (frame, entry) in frames.into_iter().zip(&file.frames) {
            match splits.get(&transforms::clean(&entry.file_path)) {
                Some(split) => kept.push(DraftFrame { split: *split, ..frame }),
                None => unlisted += 1,
            }
        }
        if unlisted > 0 {
            unused.push(format!("{unlisted} frames that no list of transforms.json has"));
        }
        frames = kept;
    } else {
        // The order of the frames in the file is arbitrary; that of their names is not.
        frames.sort_by(|a, b| a.name.cmp(&b.name));
        hold_out_every_eighth(&mut frames);
    }
    let unlisted = listing::count_images_below(&root.join(&folder))?;
    if !folder.as_os_str().is_empty() && unlisted > file.frames.len() {
        unused.push(format!(
            "{} images in {} that have no camera in transforms.json",
            unlisted - file.frames.len(),
            folder.display()
        ));
    }
    let points = match &file.ply_file_path {
        Some(name) => {
            let ply_path = root.join(transforms::clean(name));
            if !listing::is_there(&ply_path) {
                return Err(Error::MissingFile {
                    path: ply_path,
                    fix: "ply_file_path in transforms.json names it; restore it or remove the entry"
                        .to_owned(),
                });
            }
            Some((ply::read_points(&ply_path)?, ply_path))
        }
        None => customary_points(root)?,
    };
    let unit = if file.fps.is_none() { times.note(&path) } else { None };
    Ok(Draft {
        frames,
        stored_reduction: 1,
        points,
        notes: unit.into_iter().collect(),
        frames_per_second: file.fps.or(times.per_second),
        unused,
        sources,
        unknown: file.cif.and_then(unknown),
        ..Draft::default()
    })
}

/// Guesses of exports of a capture, where it does not know the metre or up.
fn unknown(world: World) -> Option<String> {
    let what = match (world.metres_known, world.up_known) {
        (true, true) => return None,
        (false, true) => "does not know the metre: sizes and masses",
        (true, false) => "does not know which way is up: gravity",
        (false, false) => "knows neither the metre nor which way is up: sizes, masses and gravity",
    };
    Some(format!("the capture {what} of exported physics are guesses"))
}

/// Folder of a path.
fn folder_of(path: &Path) -> PathBuf {
    transforms::clean(path).parent().map(Path::to_owned).unwrap_or_default()
}

/// Images in several folders are several cameras, named by folder; else there is one moving camera.
fn camera_name(inner: &Path, folders: usize) -> String {
    match inner.parent() {
        Some(parent) if folders > 1 && !parent.as_os_str().is_empty() => {
            parent.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
        }
        _ => "camera".to_owned(),
    }
}

/// Split of every listed image, where the file has lists.
fn lists(file: &TransformsFile, path: &Path) -> Result<Option<BTreeMap<PathBuf, Split>>, Error> {
    let lists = [
        (&file.train_filenames, Split::Train),
        (&file.val_filenames, Split::Val),
        (&file.test_filenames, Split::Val),
    ];
    if lists.iter().all(|(names, _)| names.is_none()) {
        return Ok(None);
    }
    let known: BTreeSet<PathBuf> =
        file.frames.iter().map(|entry| transforms::clean(&entry.file_path)).collect();
    let mut splits = BTreeMap::new();
    for (names, split) in lists {
        for name in names.iter().flatten().map(|name| transforms::clean(name)) {
            if !known.contains(&name) {
                let name = name.to_string_lossy();
                return Err(Error::invalid(
                    path,
                    format!(
                        "a list of file names has {}, which `frames` does not; correct the list",
                        some_of(std::iter::once(name.as_ref()))
                    ),
                ));
            }
            // Held out wins over trained on.
            splits.insert(name, split);
        }
    }
    if file.train_filenames.is_none() {
        for name in known {
            splits.entry(name).or_insert(Split::Train);
        }
    }
    Ok(Some(splits))
}
