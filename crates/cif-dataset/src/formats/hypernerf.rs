//! HyperNeRF and Nerfies captures, and DyCheck's of an iPhone in the same layout. Source: methods reference 2.1 (time)
//! and 10.2 (cameras, splits); `datasets/iphone.py` of KAIR-BAIR/dycheck (`splits/`, `extra.json`).
//!
//! DyCheck's lists `splits/train.json` and `splits/val.json` go before those of `dataset.json`; its `depth/`,
//! `covisible/` (where a held-out view shows what training views see) and `keypoint/` are not read. `scale` and `center` of `scene.json` are not applied: cameras and points share the raw frame.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::LensDistortion;
use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;

use super::colmap;
use super::draft::{Draft, DraftCamera, DraftFocal, DraftFrame, Source, some_of, world_to_camera};
use crate::files::{json, listing};
use crate::{Error, Split};

#[derive(Deserialize)]
struct DatasetFile {
    ids: Vec<String>,
    #[serde(default)]
    train_ids: Vec<String>,
    #[serde(default)]
    val_ids: Vec<String>,
}

/// A list of DyCheck's.
#[derive(Deserialize)]
struct SplitFile {
    frame_names: Vec<String>,
}

/// `extra.json` of DyCheck.
#[derive(Deserialize)]
struct Extra {
    fps: Option<f64>,
}

#[derive(Deserialize)]
struct Metadata {
    warp_id: Option<u64>,
    #[serde(default)]
    camera_id: u64,
}

#[derive(Deserialize)]
struct CameraFile {
    orientation: [[f64; 3]; 3],
    position: [f64; 3],
    focal_length: f64,
    principal_point: [f64; 2],
    #[serde(default)]
    skew: f64,
    #[serde(default = "one")]
    pixel_aspect_ratio: f64,
    #[serde(default, alias = "radial")]
    radial_distortion: Vec<f64>,
    #[serde(default, alias = "tangential")]
    tangential_distortion: Vec<f64>,
    image_size: [f64; 2],
}

fn one() -> f64 {
    1.0
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let list_path = root.join("dataset.json");
    let mut list: DatasetFile = json::read(&list_path)?;
    let metadata_path = root.join("metadata.json");
    if !listing::is_there(&metadata_path) {
        return Err(Error::MissingFile {
            path: metadata_path,
            fix: "a HyperNeRF capture keeps warp_id (time) and camera_id of every frame there".to_owned(),
        });
    }
    let metadata: BTreeMap<String, Metadata> = json::read(&metadata_path)?;
    let (images, reduction) = image_folder(root, source.options.downscale.unwrap_or(1))?;
    let (mut warnings, mut unused) = (Vec::new(), Vec::new());

    let of_dycheck = [root.join("splits/train.json"), root.join("splits/val.json")];
    let splits = if of_dycheck.iter().all(|path| listing::is_there(path)) {
        let [train, val] = of_dycheck;
        list.train_ids = json::read::<SplitFile>(&train)?.frame_names;
        list.val_ids = json::read::<SplitFile>(&val)?.frame_names;
        listed(&list, &root.join("splits"), &mut warnings, &mut unused)?
    } else if list.val_ids.is_empty() {
        unused.push("every second frame, as there are no lists of what to hold out".to_owned());
        every_fourth(&list, &list_path)?
    } else {
        listed(&list, &list_path, &mut warnings, &mut unused)?
    };
    let extra_path = root.join("extra.json");
    let frames_per_second =
        if listing::is_there(&extra_path) { json::read::<Extra>(&extra_path)?.fps } else { None };
    let (frames, without_image) = frames(root, &splits, &metadata, &images)?;
    if !without_image.is_empty() {
        warnings.push(format!(
            "{}: {} training frames have no image in {} and are left out: {}",
            list_path.display(),
            without_image.len(),
            images.display(),
            some_of(without_image.iter().copied())
        ));
    }
    let unlisted = listing::images(&images)?.len().saturating_sub(list.ids.len() - without_image.len());
    if unlisted > 0 {
        let folder = images.strip_prefix(root).unwrap_or(&images);
        unused.push(format!("{unlisted} images in {} that dataset.json does not list", folder.display()));
    }
    let mut notes = Vec::new();
    let points = colmap::points_next_to(root, &frames, &mut notes, &mut warnings)?;
    Ok(Draft {
        frames,
        stored_reduction: reduction,
        points,
        frames_per_second,
        warnings,
        notes,
        unused,
        ..Draft::default()
    })
}

/// Frames with their cameras and times in [0, 1], and the training frames that have no image.
fn frames<'a>(
    root: &Path,
    splits: &'a [(String, Split)],
    metadata: &BTreeMap<String, Metadata>,
    images: &Path,
) -> Result<(Vec<DraftFrame>, Vec<&'a str>), Error> {
    let metadata_path = root.join("metadata.json");
    let mut frames = Vec::with_capacity(splits.len());
    let (mut first_warp, mut last_warp) = (u64::MAX, 0);
    let mut without_image = Vec::new();
    for (id, split) in splits {
        let entry = metadata.get(id).ok_or_else(|| {
            Error::invalid(
                &metadata_path,
                format!("no entry for frame {id}, which dataset.json lists; add it"),
            )
        })?;
        let warp = entry.warp_id.ok_or_else(|| {
            Error::invalid(&metadata_path, format!("frame {id} has no warp_id, which gives its time; add it"))
        })?;
        (first_warp, last_warp) = (first_warp.min(warp), last_warp.max(warp));
        let camera_path = root.join("camera").join(format!("{id}.json"));
        let image = listing::with_image_extension(&images.join(id));
        let image = match (image, listing::is_there(&camera_path)) {
            (Some(image), true) => image,
            (Some(image), false) => return Err(Error::ImageWithoutCamera { image, camera: camera_path }),
            // Published lists name frames that were taken out of the folder of images again.
            (None, _) if *split == Split::Train => {
                without_image.push(id.as_str());
                continue;
            }
            (None, _) => {
                return Err(Error::CameraWithoutImage {
                    frame: id.clone(),
                    source_file: root.join("dataset.json"),
                    image: images.join(format!("{id}.png")),
                });
            }
        };
        frames.push(DraftFrame {
            name: id.clone(),
            camera_name: format!("camera_{}", entry.camera_id),
            // Shifted and scaled below, once the first and last are known.
            time: warp as f64,
            split: *split,
            image,
            mask: None,
            camera: camera(&camera_path, id)?,
        });
    }
    for frame in &mut frames {
        frame.time = (frame.time - first_warp as f64) / (last_warp - first_warp).max(1) as f64;
    }
    Ok((frames, without_image))
}

/// The ids of a capture, each once.
///
/// # Errors
/// When there is none, or one is there twice.
fn ids<'a>(list: &'a DatasetFile, path: &Path) -> Result<BTreeSet<&'a str>, Error> {
    if list.ids.is_empty() {
        return Err(Error::invalid(path, "`ids` is empty; list the frames there"));
    }
    let mut seen = BTreeSet::new();
    for id in &list.ids {
        if !seen.insert(id.as_str()) {
            return Err(Error::DuplicateFrame { path: path.to_owned(), frame: id.clone() });
        }
    }
    Ok(seen)
}

/// Frames of a capture without lists: every fourth one is trained on and the one two later held out, as in the base
/// code (which also leaves out the last held-out frame, only to stay inside the list).
fn every_fourth(list: &DatasetFile, path: &Path) -> Result<Vec<(String, Split)>, Error> {
    ids(list, path)?;
    let split = |(index, id): (usize, &String)| match index % 4 {
        0 => Some((id.clone(), Split::Train)),
        2 => Some((id.clone(), Split::Val)),
        _ => None,
    };
    Ok(list.ids.iter().enumerate().filter_map(split).collect())
}

/// Frames that the lists use with their split, in the order of `ids`. `path` is where the lists are.
fn listed(
    list: &DatasetFile,
    path: &Path,
    warnings: &mut Vec<String>,
    unused: &mut Vec<String>,
) -> Result<Vec<(String, Split)>, Error> {
    let seen = ids(list, path)?;
    let val: BTreeSet<&str> = list.val_ids.iter().map(String::as_str).collect();
    let train: BTreeSet<&str> = if list.train_ids.is_empty() {
        seen.difference(&val).copied().collect()
    } else {
        list.train_ids.iter().map(String::as_str).collect()
    };
    let unknown: Vec<&str> = train.union(&val).copied().filter(|id| !seen.contains(id)).collect();
    if !unknown.is_empty() {
        return Err(Error::invalid(
            path,
            format!(
                "its lists to train on or hold out name {}, not in `ids` of dataset.json; correct the lists",
                some_of(unknown.into_iter())
            ),
        ));
    }
    let both: Vec<&str> = train.intersection(&val).copied().collect();
    if !both.is_empty() {
        warnings.push(format!(
            "{}: in both lists, taken as held out: {}",
            path.display(),
            some_of(both.into_iter())
        ));
    }
    let in_none =
        list.ids.iter().filter(|id| !train.contains(id.as_str()) && !val.contains(id.as_str())).count();
    if in_none > 0 {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        unused.push(format!("{in_none} frames that no list of {name} has"));
    }
    Ok(list
        .ids
        .iter()
        .filter_map(|id| {
            if val.contains(id.as_str()) {
                Some((id.clone(), Split::Val))
            } else {
                train.contains(id.as_str()).then(|| (id.clone(), Split::Train))
            }
        })
        .collect())
}

/// The image folder to read for a requested reduction, and its own reduction: the coarsest stored one that divides
/// the requested reduction, else the largest images.
fn image_folder(root: &Path, requested: u32) -> Result<(PathBuf, u32), Error> {
    let rgb = root.join("rgb");
    let missing = |fix: &str| Error::MissingFile { path: rgb.clone(), fix: fix.to_owned() };
    if !rgb.is_dir() {
        return Err(missing("a HyperNeRF capture keeps its images in rgb/1x, rgb/2x, ..."));
    }
    let mut stored: Vec<(u32, PathBuf)> = listing::entries(&rgb)?
        .into_iter()
        .filter(|path| path.is_dir())
        .filter_map(|path| {
            let name = path.file_name()?.to_str()?;
            let factor: u32 = name.strip_suffix('x')?.parse().ok()?;
            (factor > 0).then(|| (factor, path.clone()))
        })
        .collect();
    stored.sort();
    let first = stored.first().ok_or_else(|| missing("it has no folder 1x, 2x, ... with images"))?.clone();
    let (factor, folder) =
        stored.into_iter().rev().find(|(factor, _)| requested.is_multiple_of(*factor)).unwrap_or(first);
    Ok((folder, factor))
}

/// A camera file: rows of `orientation` are the camera's axes right, down, forward in the world.
fn camera(path: &Path, frame: &str) -> Result<DraftCamera, Error> {
    let file: CameraFile = json::read(path)?;
    let intrinsics =
        |problem: String| Error::Intrinsics { path: path.to_owned(), frame: frame.to_owned(), problem };
    let [r, t] = [&file.radial_distortion, &file.tangential_distortion];
    if r.len() > 4 || t.len() > 2 {
        return Err(intrinsics(format!(
            "{} radial and {} tangential distortion coefficients; at most 4 and 2 are known",
            r.len(),
            t.len()
        )));
    }
    let at = |values: &[f64], k: usize| values.get(k).copied().unwrap_or(0.0);
    let axes = DMat3::from_cols_array_2d(&file.orientation);
    Ok(DraftCamera {
        source: path.to_owned(),
        size: Some(DVec2::from_array(file.image_size)),
        focal: DraftFocal::Pixels(DVec2::new(file.focal_length, file.focal_length * file.pixel_aspect_ratio)),
        principal_px: Some(DVec2::from_array(file.principal_point)),
        lens: LensDistortion {
            radial: std::array::from_fn(|k| at(r, k)),
            tangential: [at(t, 0), at(t, 1)],
            skew_px: file.skew,
        },
        camera_from_world: world_to_camera(axes, DVec3::from_array(file.position)),
    })
}
