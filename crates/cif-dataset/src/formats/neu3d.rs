//! Neu3D / DyNeRF captures: fixed, synchronised cameras. Source: methods reference 2.1 (time) and 10.2 (poses).

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::DVec2;

use super::draft::{Draft, DraftCamera, DraftFrame, Source, customary_points, some_of};
use super::poses_bounds;
use crate::dataset::DEFAULT_VIDEO_FRAMES;
use crate::files::listing;
use crate::files::video::{self, Extraction};
use crate::sizes::reduced_size;
use crate::{Error, Split};

/// One camera of the rig with its images in order.
struct View {
    name: String,
    images: Vec<PathBuf>,
    camera: DraftCamera,
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let poses = poses_bounds::read(root)?;
    let (names, left_out) = cameras(root, &poses.path, poses.cameras.len(), &source.options.without_cameras)?;
    let mut views = Vec::new();
    for (name, camera) in names.into_iter().zip(poses.cameras) {
        if left_out.contains(&name) {
            continue;
        }
        let images = images(source, &name, camera.size)?;
        views.push(View { name, images, camera });
    }
    let Some(first) = views.first() else {
        return Err(Error::invalid(root, "every camera is left out; keep one to train on"));
    };
    let stored_reduction = poses_bounds::stored_reduction(&first.camera, &first.images[0])?;

    // Frames of different cameras belong together by name; a step that some camera lacks still counts.
    let steps: BTreeSet<String> =
        views.iter().flat_map(|view| view.images.iter().map(|image| listing::stem(image))).collect();
    let mut steps: Vec<String> = steps.into_iter().collect();
    // Frame numbers that outgrow their leading zeros come last.
    steps.sort_by_key(String::len);
    let mut warnings = Vec::new();
    let mut frames = Vec::new();
    let held_out =
        if views.iter().any(|view| view.name == "cam00") { "cam00" } else { views[0].name.as_str() };
    if held_out != "cam00" {
        warnings.push(format!("{}: there is no cam00; {held_out} is held out instead", root.display()));
    }
    for view in &views {
        if view.images.len() < steps.len() {
            warnings.push(format!(
                "{}: {} of {} frames are missing",
                root.join(&view.name).display(),
                steps.len() - view.images.len(),
                steps.len()
            ));
        }
        for image in &view.images {
            let stem = listing::stem(image);
            let step = steps
                .binary_search_by(|step| step.len().cmp(&stem.len()).then_with(|| step.cmp(&stem)))
                .expect("every stem was collected");
            frames.push(DraftFrame {
                name: format!("{}/{stem}", view.name),
                camera_name: view.name.clone(),
                time: step as f64 / steps.len() as f64,
                split: if view.name == held_out && views.len() > 1 { Split::Val } else { Split::Train },
                image: image.clone(),
                mask: None,
                camera: view.camera.clone(),
            });
        }
    }
    let points = customary_points(root)?;
    Ok(Draft { frames, stored_reduction, points, left_out, warnings, ..Draft::default() })
}

/// True when a name is that of a camera: `cam` and digits.
fn is_camera(name: &str) -> bool {
    name.strip_prefix("cam").is_some_and(|rest| !rest.is_empty() && rest.chars().all(|c| c.is_ascii_digit()))
}

/// Names of the cameras that a folder holds images or a video of.
fn rig(root: &Path) -> Result<BTreeSet<String>, Error> {
    let names = listing::entries(root)?
        .iter()
        .filter(|path| path.is_dir() || listing::has_extension(path, &["mp4"]))
        .map(|path| listing::stem(path))
        .filter(|name| is_camera(name))
        .collect();
    Ok(names)
}

/// True when a folder holds images or videos of several fixed cameras.
pub(crate) fn has_rig(root: &Path) -> bool {
    rig(root).is_ok_and(|names| !names.is_empty())
}

/// Names of the cameras in the order of the rows of poses, and those of them that are left out. A camera that is left
/// out keeps its row, whether its files are there or not.
fn cameras(
    root: &Path,
    poses_path: &Path,
    rows: usize,
    unwanted: &[String],
) -> Result<(Vec<String>, Vec<String>), Error> {
    let there = rig(root)?;
    if there.is_empty() {
        return Err(Error::MissingFile {
            path: root.join("cam00"),
            fix: "poses_bounds.npy needs camXX/images or camXX.mp4 beside it for fixed cameras, or images/ for one \
                  camera that moves"
                .to_owned(),
        });
    }
    let unwanted = unwanted.iter().filter(|name| is_camera(name)).cloned();
    let all: BTreeSet<String> = there.iter().cloned().chain(unwanted.clone()).collect();
    let names = if all.len() == rows { all } else { there };
    if names.len() != rows {
        return Err(Error::invalid(
            poses_path,
            format!(
                "it has {rows} cameras, but the capture has images of {} ({}): a camera without images or images \
                 without a camera; rows belong to the camera folders in name order",
                names.len(),
                some_of(names.iter().map(String::as_str))
            ),
        ));
    }
    let left_out = unwanted.filter(|name| names.contains(name)).collect();
    Ok((names.into_iter().collect(), left_out))
}

/// Images of a camera in order where there are any, else the frames of its video, reduced while they are decoded.
/// `captured` is the size that its pose is of, pixels.
fn images(source: &Source<'_>, name: &str, captured: Option<DVec2>) -> Result<Vec<PathBuf>, Error> {
    let (root, options) = (source.root, source.options);
    let folder = root.join(name);
    let mut images = listing::images(&folder.join("images"))?;
    if images.is_empty() {
        images = listing::images(&folder)?;
    }
    let movie = root.join(format!("{name}.mp4"));
    if images.is_empty() && listing::is_there(&movie) {
        let reduction = options.downscale.filter(|reduction| *reduction > 1);
        let size =
            reduction.zip(captured.filter(|size| size.min_element() >= 1.0)).map(|(reduction, size)| {
                let (width, height) = reduced_size(size.x as u32, size.y as u32, reduction);
                [width, height]
            });
        let most = options.video_frames.unwrap_or(DEFAULT_VIDEO_FRAMES);
        images = video::frames(root, &movie, &folder.join("images"), Extraction { most, size })?;
    }
    if images.is_empty() {
        return Err(Error::MissingFile {
            path: folder.join("images"),
            fix: format!("give the images of this camera there, or {name}.mp4 beside it"),
        });
    }
    if let Some(pair) = images.windows(2).find(|pair| listing::stem(&pair[0]) == listing::stem(&pair[1])) {
        return Err(Error::DuplicateFrame { path: folder, frame: listing::stem(&pair[0]) });
    }
    Ok(images)
}
