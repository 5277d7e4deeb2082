//! COLMAP reconstructions: `sparse/0` with text or binary files, and `images/`. Where the mapper could not join all images
//! it made several models, `sparse/0`, `sparse/1`, ..., each in a place of its own.
//!
//! Static: all times are 0. Every eighth image in name order is held out. Poses are world-to-camera, as here;
//! pixel (0, 0) has its centre at (0.5, 0.5), as here.

mod binary;
mod model;
mod reconstruction;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::transform::angle_between;
use cif_geometry::{Bounds, RigidTransform, Similarity};
use glam::{DMat3, DQuat, DVec3};

use self::reconstruction::{Image, Reconstruction};
use super::draft::{
    Draft, DraftCamera, DraftFrame, Source, customary_points, hold_out_every_eighth, some_of,
};
use super::transforms;
use crate::files::listing;
use crate::files::points::RawPoints;
use crate::{Error, Split};

/// The model that is read of those that the mapper made, and the note on the others.
pub(crate) struct Chosen {
    pub(crate) folder: PathBuf,
    pub(crate) note: Option<String>,
}

fn is_model(folder: &Path) -> bool {
    ["cameras.bin", "cameras.txt"].iter().any(|name| listing::is_there(&folder.join(name)))
}

/// Folders of models in a folder: those that are called by numbers, as the mapper numbers them, and it itself.
fn models(parent: &Path) -> Vec<PathBuf> {
    let number = |path: &PathBuf| path.file_name()?.to_str()?.parse::<u32>().ok();
    let mut numbered: Vec<(u32, PathBuf)> = listing::entries(parent)
        .unwrap_or_default()
        .into_iter()
        .filter(|path| is_model(path))
        .filter_map(|path| Some((number(&path)?, path)))
        .collect();
    numbered.sort();
    let itself = is_model(parent).then(|| parent.to_owned());
    numbered.into_iter().map(|(_, path)| path).chain(itself).collect()
}

/// Images of a model; 0 where that cannot be read, which reading it reports.
fn registered(folder: &Path) -> u64 {
    let count = if listing::is_there(&folder.join("cameras.bin")) {
        binary::count_images(folder)
    } else {
        text::count_images(folder)
    };
    count.unwrap_or(0)
}

/// The model with most images, of equal ones the first, of the first of `parents` that holds any.
fn largest_model(parents: impl IntoIterator<Item = PathBuf>) -> Option<Chosen> {
    let found = parents.into_iter().map(|parent| models(&parent)).find(|models| !models.is_empty())?;
    let mut counted: Vec<(u64, PathBuf)> =
        found.into_iter().map(|folder| (registered(&folder), folder)).collect();
    counted.sort_by_key(|(images, _)| std::cmp::Reverse(*images));
    let (images, folder) = counted.remove(0);
    let others: Vec<String> =
        counted.iter().map(|(images, folder)| format!("{} ({images})", folder.display())).collect();
    let note = (!others.is_empty()).then(|| {
        format!(
            "{}: of {} models it has most images, {images}, and is read; others, in places of their own, are not: {}",
            folder.display(),
            others.len() + 1,
            some_of(others.iter().map(String::as_str))
        )
    });
    Some(Chosen { folder, note })
}

/// The reconstruction of a capture, where it has one.
pub(crate) fn sparse_model(root: &Path) -> Option<Chosen> {
    largest_model(["sparse", "colmap/sparse"].map(|name| root.join(name)))
        // A folder without cameras still marks the layout, so that the reader can say what is missing.
        .or_else(|| {
            let folder = Some(root.join("sparse/0")).filter(|folder| folder.is_dir())?;
            Some(Chosen { folder, note: None })
        })
}

/// The reconstruction that a folder is, or holds.
pub(crate) fn model_in(path: &Path) -> Option<Chosen> {
    largest_model(["", "sparse", "colmap/sparse"].map(|name| path.join(name)))
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let missing = |path: PathBuf, fix: &str| Error::MissingFile { path, fix: fix.to_owned() };
    let Chosen { folder, note } = sparse_model(root)
        .ok_or_else(|| missing(root.join("sparse/0"), "a COLMAP capture keeps its reconstruction there"))?;
    let reconstruction = reconstruction(&folder)?;
    let Reconstruction { images, images_path, .. } = &reconstruction;
    let image_folder = root.join("images");
    if !image_folder.is_dir() {
        return Err(missing(image_folder, "a COLMAP capture keeps its images there"));
    }
    let mut frames = Vec::with_capacity(images.len());
    for image in images {
        let mut relative = transforms::clean(Path::new(&image.name));
        // COLMAP was given the whole capture as the folder of images.
        if let Ok(inside) = relative.strip_prefix("images")
            && !listing::is_there(&image_folder.join(&relative))
            && listing::is_there(&image_folder.join(inside))
        {
            relative = inside.to_owned();
        }
        let name = transforms::frame_name(&relative);
        let path = image_folder.join(&relative);
        if !listing::is_there(&path) {
            let source_file = images_path.clone();
            return Err(Error::CameraWithoutImage { frame: name, source_file, image: path });
        }
        frames.push(DraftFrame {
            camera_name: if reconstruction.cameras.len() == 1 {
                "camera".to_owned()
            } else {
                format!("camera_{}", image.camera)
            },
            time: 0.0,
            split: Split::Train,
            image: path,
            mask: None,
            camera: camera(&reconstruction, image, &name)?,
            name,
        });
    }
    frames.sort_by(|a, b| a.name.cmp(&b.name));
    hold_out_every_eighth(&mut frames);
    let mut unused = Vec::new();
    let unlisted = listing::count_images_below(&image_folder)?.saturating_sub(frames.len());
    if unlisted > 0 {
        let list = images_path.file_name().unwrap_or_default().to_string_lossy();
        unused.push(format!("{unlisted} images in images that have no camera in {list}"));
    }
    let Reconstruction { points, points_path, .. } = reconstruction;
    Ok(Draft {
        frames,
        stored_reduction: 1,
        points: (!points.positions.is_empty()).then_some((points, points_path)),
        notes: note.into_iter().collect(),
        unused,
        of_stored_pixels: true,
        ..Draft::default()
    })
}

/// Reads a reconstruction.
///
/// # Errors
/// When a file is missing or damaged, or it has no image.
fn reconstruction(folder: &Path) -> Result<Reconstruction, Error> {
    let found = if listing::is_there(&folder.join("cameras.bin")) {
        binary::read(folder)?
    } else if listing::is_there(&folder.join("cameras.txt")) {
        text::read(folder)?
    } else {
        return Err(Error::MissingFile {
            path: folder.join("cameras.bin"),
            fix: "export the reconstruction from COLMAP (cameras, images, points3D)".to_owned(),
        });
    };
    if found.images.is_empty() {
        return Err(Error::invalid(&found.images_path, "it has no image; COLMAP registered none"));
    }
    Ok(found)
}

/// Cameras by the names of their images, and points, of a folder with a reconstruction.
///
/// # Errors
/// As its files are missing or damaged.
pub(crate) fn named_cameras(folder: &Path) -> Result<(Vec<(String, DraftCamera)>, RawPoints), Error> {
    let reconstruction = reconstruction(folder)?;
    let cameras = reconstruction.images.iter().map(|image| {
        let name = image.name.clone();
        camera(&reconstruction, image, &name).map(|camera| (name, camera))
    });
    Ok((cameras.collect::<Result<_, _>>()?, reconstruction.points))
}

/// The customary points of a capture, else those of the reconstruction next to it, whose damage is a warning.
///
/// # Errors
/// When the file of customary points is damaged.
pub(super) fn points_next_to(
    root: &Path,
    frames: &[DraftFrame],
    notes: &mut Vec<String>,
    warnings: &mut Vec<String>,
) -> Result<Option<(RawPoints, PathBuf)>, Error> {
    if let Some(points) = customary_points(root)? {
        return Ok(Some(points));
    }
    Ok(points_among(root, frames, notes).unwrap_or_else(|error| {
        warnings.push(format!("{error}; the points of the reconstruction are not used"));
        None
    }))
}

/// Largest distance of camera centres that are one, in sizes of what all centres span; chosen.
const SAME_PLACE: f64 = 1e-3;

/// The same once a similarity brings them together: poses may have been refined since; chosen.
const FITTING_PLACE: f64 = 1e-2;

/// Largest angle then between two orientations of a camera, radians (1 degree); chosen.
const FITTING_ANGLE: f64 = 0.0175;

/// Fewest cameras that a similarity is fitted to: two leave a turn open, three check themselves.
const FEWEST: usize = 4;

/// Points of the reconstruction next to a capture, in its coordinates: where its cameras stand where those of the frames do,
/// as they are, else by the similarity that brings the cameras together, which `notes` state. Images belong to frames by
/// the stems of their names.
///
/// # Errors
/// As the files of the reconstruction are damaged.
fn points_among(
    root: &Path,
    frames: &[DraftFrame],
    notes: &mut Vec<String>,
) -> Result<Option<(RawPoints, PathBuf)>, Error> {
    let Some(model) = largest_model(["sparse", "colmap/sparse", "colmap"].map(|name| root.join(name))) else {
        return Ok(None);
    };
    let mut found = reconstruction(&model.folder)?;
    if found.points.positions.is_empty() {
        return Ok(None);
    }
    let of_images: BTreeMap<String, RigidTransform> = found
        .images
        .iter()
        .filter_map(|image| Some((listing::stem(Path::new(&image.name)), pose(image)?.inverse())))
        .collect();
    let pairs: Vec<[RigidTransform; 2]> = frames
        .iter()
        .filter_map(|frame| {
            let theirs = of_images.get(&listing::stem(&frame.image))?;
            Some([*theirs, frame.camera.camera_from_world.inverse()])
        })
        .collect();
    let [theirs, ours] =
        [0, 1].map(|side| pairs.iter().map(|pair| pair[side].translation).collect::<Vec<_>>());
    let size = Bounds::around(ours.iter().copied()).size().length();
    let farthest = |places: &mut dyn Iterator<Item = DVec3>| {
        places.zip(&ours).map(|(theirs, ours)| theirs.distance(*ours)).fold(0.0, f64::max)
    };
    // One camera has no size to measure distances in.
    if pairs.len() > 1 && farthest(&mut theirs.iter().copied()) <= SAME_PLACE * size {
        notes.extend(model.note);
        return Ok(Some((found.points, found.points_path)));
    }
    let shown = model.folder.display();
    let similarity = Similarity::fitting(&theirs, &ours).filter(|_| pairs.len() >= FEWEST);
    let fits = |similarity: &Similarity| {
        let angle = |[theirs, ours]: &[RigidTransform; 2]| {
            angle_between(&(similarity.rotation * theirs.rotation), &ours.rotation)
        };
        farthest(&mut theirs.iter().map(|place| similarity.apply(*place))) <= FITTING_PLACE * size
            && pairs.iter().map(angle).fold(0.0, f64::max) <= FITTING_ANGLE
    };
    let Some(similarity) = similarity.filter(fits) else {
        notes.push(format!(
            "{shown}: its points are not taken: its cameras are not those of the capture ({} images have the names of \
             frames), however they are moved, turned and scaled together",
            pairs.len()
        ));
        return Ok(None);
    };
    for position in &mut found.points.positions {
        *position = similarity.apply(DVec3::from_array(*position)).to_array();
    }
    notes.extend(model.note);
    notes.push(format!(
        "{shown}: its {} points are moved, turned and scaled by {:.6} into the coordinates of the capture, as {} cameras \
         that both have tell",
        found.points.positions.len(),
        similarity.scale,
        pairs.len()
    ));
    Ok(Some((found.points, found.points_path)))
}

/// The camera of an image.
///
/// # Errors
/// When it is not listed or not supported, or the image has no valid pose.
fn camera(reconstruction: &Reconstruction, image: &Image, name: &str) -> Result<DraftCamera, Error> {
    let Reconstruction { cameras, cameras_path, images_path, .. } = reconstruction;
    let camera = cameras.get(&image.camera).ok_or_else(|| Error::Intrinsics {
        path: images_path.clone(),
        frame: name.to_owned(),
        problem: format!("camera {} is not in {}; export both again", image.camera, cameras_path.display()),
    })?;
    let camera_from_world = pose(image).ok_or_else(|| Error::Pose {
        path: images_path.clone(),
        frame: name.to_owned(),
        problem: "has a quaternion without length, or a value that is not finite".to_owned(),
    })?;
    model::camera(camera, cameras_path, name, camera_from_world)
}

/// World to camera; `None` for a quaternion that is no rotation.
fn pose(image: &Image) -> Option<RigidTransform> {
    let [w, x, y, z] = image.rotation;
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    let length = quaternion.length();
    // Any other length is taken out, as COLMAP does; squares of smaller numbers vanish.
    if !(length.is_finite() && length > 1e-150) {
        return None;
    }
    Some(RigidTransform {
        rotation: DMat3::from_quat(quaternion * (1.0 / length)),
        translation: DVec3::from_array(image.translation),
    })
}
