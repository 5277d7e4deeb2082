//! Image sequences of one moving camera with LLFF's `poses_bounds.npy`: NSFF, NVIDIA's dynamic scenes, NR-NeRF,
//! EndoNeRF.
//!
//! Rows of poses belong to the images in name order; the time of an image is its place in the sequence. Held out is
//! every eighth image from the second on: one of the first or the last time would have to be foreseen, not
//! interpolated, and papers on EndoNeRF's sequences report these. Where `mv_images` has what other cameras saw at the
//! same times (NVIDIA's dynamic scenes, as NSFF keeps them), these are held out, and every image is trained on.
//!
//! Points are those of the COLMAP reconstruction that LLFF took the poses from, where it is still there.

use std::path::{Path, PathBuf};

use super::draft::{Draft, DraftCamera, DraftFrame, Source, some_of};
use super::{colmap, poses_bounds};
use crate::files::{image, listing};
use crate::{Error, Split};

/// Images per held-out one.
const HOLD_OUT: usize = 8;

/// Cameras of NVIDIA's rig. Camera k took every twelfth image of the sequence, from the k-th on.
const RIG: usize = 12;

/// True when a folder holds `images`, or reduced ones as LLFF's loaders write them.
pub(crate) fn has_image_folder(root: &Path) -> bool {
    image_folders(root).is_ok_and(|folders| !folders.is_empty())
}

/// Folders with images: `images`, `images_4` (reduced by 4), `images_512x288`.
fn image_folders(root: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut folders = Vec::new();
    for path in listing::entries(root)?.into_iter().filter(|path| path.is_dir()) {
        let name = listing::stem(&path);
        let number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        let is_named = name == "images"
            || name.strip_prefix("images_").is_some_and(|rest| {
                number(rest)
                    || rest.split_once('x').is_some_and(|(width, height)| number(width) && number(height))
            });
        if is_named && !listing::images(&path)?.is_empty() {
            folders.push(path);
        }
    }
    Ok(folders)
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let poses = poses_bounds::read(root)?;
    let Some(first) = poses.cameras.first() else {
        return Err(Error::invalid(&poses.path, "it has no row; give one per image"));
    };
    // The largest images, or the smallest that the requested reduction is a multiple of.
    let requested = source.options.downscale.unwrap_or(1);
    let mut folders = Vec::new();
    for folder in image_folders(root)? {
        let images = listing::images(&folder)?;
        let width = image::probe(&images[0])?.width;
        folders.push((poses_bounds::stored_reduction(first, &images[0])?, std::cmp::Reverse(width), images));
    }
    folders.sort();
    folders.dedup_by_key(|(reduction, ..)| *reduction);
    let largest = folders.first().cloned();
    let fitting = folders.into_iter().rev().find(|(reduction, ..)| requested.is_multiple_of(*reduction));
    let Some((stored_reduction, _, images)) = fitting.or(largest) else {
        return Err(Error::MissingFile {
            path: root.join("images"),
            fix: "the images that poses_bounds.npy has the poses of lie there".to_owned(),
        });
    };
    if images.len() != poses.cameras.len() {
        return Err(Error::invalid(
            &poses.path,
            format!(
                "it has {} rows, {} has {} images; a row per image in name order is expected",
                poses.cameras.len(),
                images[0].parent().unwrap_or(root).display(),
                images.len()
            ),
        ));
    }
    let stems: Vec<String> = images.iter().map(|image| listing::stem(image)).collect();
    let ranks = ranks(&stems);
    let last = images.len() - 1;
    let mut unused = Vec::new();
    let seen_by_others = seen_by_others(root, &poses.cameras, last, &mut unused)?;
    let held_out = |rank: usize| seen_by_others.is_empty() && rank % HOLD_OUT == 1 && rank < last;
    let mut frames: Vec<DraftFrame> = images
        .into_iter()
        .zip(stems)
        .zip(&poses.cameras)
        .zip(ranks)
        .map(|(((image, name), camera), rank)| DraftFrame {
            name,
            camera_name: "camera".to_owned(),
            time: rank as f64 / last.max(1) as f64,
            split: if held_out(rank) { Split::Val } else { Split::Train },
            image,
            mask: None,
            camera: camera.clone(),
        })
        .collect();
    let mut warnings = Vec::new();
    let mut notes = Vec::new();
    let points = colmap::points_next_to(root, &frames, &mut notes, &mut warnings)?;
    frames.extend(seen_by_others);
    Ok(Draft { frames, stored_reduction, points, warnings, notes, unused, ..Draft::default() })
}

/// Place of every image in the sequence: numbers that outgrow their leading zeros come last.
fn ranks(stems: &[String]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..stems.len()).collect();
    order.sort_by(|a, b| stems[*a].len().cmp(&stems[*b].len()).then_with(|| stems[*a].cmp(&stems[*b])));
    let mut ranks = vec![0; stems.len()];
    for (rank, index) in order.into_iter().enumerate() {
        ranks[index] = rank;
    }
    ranks
}

/// Images `mv_images/00007/cam03.jpg` of the times of the sequence by the cameras that did not take it then. Camera k
/// has the pose of the k-th image.
fn seen_by_others(
    root: &Path,
    cameras: &[DraftCamera],
    last: usize,
    unused: &mut Vec<String>,
) -> Result<Vec<DraftFrame>, Error> {
    let folder = root.join("mv_images");
    if !folder.is_dir() || cameras.len() < RIG {
        return Ok(Vec::new());
    }
    let mut frames = Vec::new();
    let mut strangers = Vec::new();
    for of_time in listing::entries(&folder)?.into_iter().filter(|path| path.is_dir()) {
        let time = listing::stem(&of_time);
        for image in listing::images(&of_time)? {
            let name = listing::stem(&image);
            let step = time.parse::<usize>().ok().filter(|step| *step <= last);
            let camera = name.strip_prefix("cam").and_then(|number| number.parse::<usize>().ok());
            let camera = camera.and_then(|number| number.checked_sub(1)).filter(|camera| *camera < RIG);
            let (Some(step), Some(camera)) = (step, camera) else {
                strangers.push(format!("{time}/{name}"));
                continue;
            };
            if step % RIG != camera {
                frames.push(DraftFrame {
                    name: format!("mv_images/{time}/{name}"),
                    camera_name: name,
                    time: step as f64 / last.max(1) as f64,
                    split: Split::Val,
                    image,
                    mask: None,
                    camera: cameras[camera].clone(),
                });
            }
        }
    }
    if !strangers.is_empty() {
        unused.push(format!(
            "images in mv_images of no time of the sequence or no camera from cam01 to cam{RIG}: {}",
            some_of(strangers.iter().map(String::as_str))
        ));
    }
    Ok(frames)
}
