//! COLMAP reconstructions: `sparse/0` with text or binary files, and `images/`.
//!
//! Static: all times are 0. Every eighth image in name order is held out. Poses are world-to-camera, as here;
//! pixel (0, 0) has its centre at (0.5, 0.5), as here.

mod binary;
mod model;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::{Bounds, RigidTransform};
use glam::{DMat3, DQuat, DVec3};

use super::{Draft, DraftCamera, DraftFrame, Source, hold_out_every_eighth, transforms};
use crate::files::listing;
use crate::points::RawPoints;
use crate::{Error, Split};

/// A row of `cameras`.
struct Camera {
    model: String,
    size: [f64; 2],
    params: Vec<f64>,
}

/// A row of `images`.
struct Image {
    name: String,
    /// (w, x, y, z), world to camera.
    rotation: [f64; 4],
    translation: [f64; 3],
    camera: u32,
}

/// A reconstruction as its three files tell it.
struct Reconstruction {
    cameras: BTreeMap<u32, Camera>,
    cameras_path: PathBuf,
    images: Vec<Image>,
    images_path: PathBuf,
    points: RawPoints,
    points_path: PathBuf,
}

/// Folder with the reconstruction, where the capture has one.
pub(crate) fn sparse_folder(root: &Path) -> Option<PathBuf> {
    ["sparse/0", "sparse", "colmap/sparse/0"]
        .iter()
        .map(|name| root.join(name))
        .find(|folder| {
            listing::is_there(&folder.join("cameras.bin")) || listing::is_there(&folder.join("cameras.txt"))
        })
        // A folder without cameras still marks the layout, so that the reader can say what is missing.
        .or_else(|| Some(root.join("sparse/0")).filter(|folder| folder.is_dir()))
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let missing = |path: PathBuf, fix: &str| Error::MissingFile { path, fix: fix.to_owned() };
    let folder = sparse_folder(root)
        .ok_or_else(|| missing(root.join("sparse/0"), "a COLMAP capture keeps its reconstruction there"))?;
    let reconstruction = reconstruction(&folder)?;
    let Reconstruction { images, images_path, .. } = &reconstruction;
    let image_folder = root.join("images");
    if !image_folder.is_dir() {
        return Err(missing(image_folder, "a COLMAP capture keeps its images there"));
    }
    let mut frames = Vec::with_capacity(images.len());
    for image in images {
        let relative = transforms::clean(Path::new(&image.name));
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
        unused,
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

/// Largest distance of camera centres that are one, in sizes of what all centres span.
const SAME_PLACE: f64 = 1e-3;

/// Points of the reconstruction of a capture, where its cameras stand where those of the frames do: then its points
/// and the frames share their coordinates. Images belong to frames by the stems of their names.
///
/// # Errors
/// As the files of the reconstruction are damaged.
pub(super) fn points_among(
    root: &Path,
    frames: &[DraftFrame],
) -> Result<Option<(RawPoints, PathBuf)>, Error> {
    let found = sparse_folder(root).map(|folder| reconstruction(&folder)).transpose()?;
    let Some(found) = found.filter(|found| !found.points.positions.is_empty()) else { return Ok(None) };
    let centre = |pose: &RigidTransform| -(pose.rotation.transpose() * pose.translation);
    let of_images: BTreeMap<String, DVec3> = found
        .images
        .iter()
        .filter_map(|image| Some((listing::stem(Path::new(&image.name)), centre(&pose(image)?))))
        .collect();
    let pairs: Vec<[DVec3; 2]> = frames
        .iter()
        .filter_map(|frame| {
            let theirs = of_images.get(&listing::stem(&frame.image))?;
            Some([*theirs, centre(&frame.camera.camera_from_world)])
        })
        .collect();
    let size = Bounds::around(pairs.iter().map(|[_, ours]| *ours)).size().length();
    let is_one = |[theirs, ours]: &[DVec3; 2]| theirs.distance(*ours) <= SAME_PLACE * size;
    // One camera has no size to measure distances in.
    let same = pairs.len() > 1 && pairs.iter().all(is_one);
    Ok(same.then_some((found.points, found.points_path)))
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
    if !(length.is_finite() && length > 1e-6) {
        return None;
    }
    Some(RigidTransform {
        rotation: DMat3::from_quat(quaternion * (1.0 / length)),
        translation: DVec3::from_array(image.translation),
    })
}
