//! Captures in the layout of Dynamic 3D Gaussians, such as those of the CMU Panoptic Studio: `train_meta.json`,
//! `test_meta.json`, `ims/`, `seg/`, `init_pt_cld.npz`.
//!
//! A file of cameras has, per time and image, the 3 x 3 matrix `k` (pixels), `w2c` (world to camera; x right, y down,
//! z forwards, as here), the file name `fn` below `ims` and the number `cam_id`. Held out are the images of
//! `test_meta.json`. Source: `train.py` and `helpers.py` of JonathonLuiten/Dynamic3DGaussians.

use std::path::{Path, PathBuf};

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;

use super::draft::{Draft, DraftCamera, DraftFocal, DraftFrame, Source, customary_points};
use super::transforms;
use crate::files::npy::{Archive, Elements};
use crate::files::points::{RawPoints, by_range};
use crate::files::{json, listing};
use crate::{Error, Split};

/// A file of cameras: `[times][images]`.
#[derive(Deserialize)]
struct Meta {
    w: f64,
    h: f64,
    k: Vec<Vec<[[f64; 3]; 3]>>,
    w2c: Vec<Vec<Vec<[f64; 4]>>>,
    #[serde(rename = "fn")]
    names: Vec<Vec<PathBuf>>,
    /// Absent where the folders of the images name the cameras.
    cam_id: Option<Vec<Vec<u64>>>,
}

/// A file of cameras with its path, and what its images are for.
struct List {
    path: PathBuf,
    split: Split,
    meta: Meta,
}

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let mut lists = Vec::new();
    for (name, split) in [("train_meta.json", Split::Train), ("test_meta.json", Split::Val)] {
        let path = root.join(name);
        if split == Split::Train || listing::is_there(&path) {
            let meta: Meta = json::read(&path)?;
            check_lengths(&path, &meta)?;
            lists.push(List { path, split, meta });
        }
    }
    let times = times(&lists)?;
    let mut frames = Vec::new();
    for (list, times) in lists.iter().zip(times) {
        for (step, time) in times.into_iter().enumerate() {
            for at in 0..list.meta.names[step].len() {
                frames.push(frame(root, list, step, at, time)?);
            }
        }
    }
    let points = match points(root)? {
        Some(points) => Some(points),
        None => customary_points(root)?,
    };
    Ok(Draft { frames, stored_reduction: 1, points, ..Draft::default() })
}

/// Refuses a file whose lists are of different lengths.
fn check_lengths(path: &Path, meta: &Meta) -> Result<(), Error> {
    let times = meta.names.len();
    let cameras = meta.cam_id.as_deref();
    for (key, length) in [("k", meta.k.len()), ("w2c", meta.w2c.len())]
        .into_iter()
        .chain(cameras.map(|cameras| ("cam_id", cameras.len())))
    {
        if length != times {
            return Err(Error::invalid(
                path,
                format!("`fn` has {times} times, `{key}` {length}; every list needs an entry per time"),
            ));
        }
    }
    for (step, names) in meta.names.iter().enumerate() {
        let images = names.len();
        for (key, length) in [("k", meta.k[step].len()), ("w2c", meta.w2c[step].len())]
            .into_iter()
            .chain(cameras.map(|cameras| ("cam_id", cameras[step].len())))
        {
            if length != images {
                return Err(Error::invalid(
                    path,
                    format!("time {step} has {images} images in `fn`, but {length} entries in `{key}`"),
                ));
            }
        }
    }
    Ok(())
}

/// Normalised times, `[lists][times]`: frame numbers where the images of every time share one and they ascend, so that
/// lists of different times agree and gaps stay gaps; else positions in the lists.
fn times(lists: &[List]) -> Result<Vec<Vec<f64>>, Error> {
    let numbered: Option<Vec<Vec<u64>>> = lists.iter().map(|list| frame_numbers(&list.meta.names)).collect();
    let lengths = || lists.iter().map(|list| list.meta.names.len());
    let steps = match numbered {
        Some(numbers) => numbers,
        None if lengths().all(|length| Some(length) == lengths().next()) => {
            lengths().map(|length| (0..length as u64).collect()).collect()
        }
        None => {
            let lengths: Vec<String> = lengths().map(|length| length.to_string()).collect();
            return Err(Error::invalid(
                &lists[0].path,
                format!(
                    "it and test_meta.json have {} times, and the images of a time do not share a frame number that \
                     says which belong together; list the same times in both, empty where there is no image",
                    lengths.join(" and ")
                ),
            ));
        }
    };
    let all = || steps.iter().flatten().copied();
    let (first, last) = (all().min().unwrap_or(0), all().max().unwrap_or(0));
    let span = (last - first).max(1) as f64;
    Ok(steps.iter().map(|steps| steps.iter().map(|step| (step - first) as f64 / span).collect()).collect())
}

/// The frame number that all images of each time share; `None` where they do not, or it does not ascend.
fn frame_numbers(names: &[Vec<PathBuf>]) -> Option<Vec<u64>> {
    let mut numbers = Vec::with_capacity(names.len());
    for images in names {
        let mut of_images = images.iter().map(|name| listing::stem(name).parse::<u64>().ok());
        let number = of_images.next()??;
        if of_images.any(|other| other != Some(number)) || numbers.last().is_some_and(|last| *last >= number)
        {
            return None;
        }
        numbers.push(number);
    }
    Some(numbers)
}

fn frame(root: &Path, list: &List, step: usize, at: usize, time: f64) -> Result<DraftFrame, Error> {
    let List { path, split, meta } = list;
    let file = transforms::clean(&meta.names[step][at]);
    let name = transforms::frame_name(&file);
    let image = root.join("ims").join(&file);
    let image = listing::with_image_extension(&image).ok_or_else(|| Error::CameraWithoutImage {
        frame: name.clone(),
        source_file: path.clone(),
        image,
    })?;
    let camera_name = match &meta.cam_id {
        Some(ids) => format!("camera_{}", ids[step][at]),
        None => file.parent().map(|folder| folder.to_string_lossy().into_owned()).unwrap_or_default(),
    };
    let [[fx, skew, cx], [_, fy, cy], _] = meta.k[step][at];
    let rows = &meta.w2c[step][at];
    if !(3..=4).contains(&rows.len()) || rows.get(3).is_some_and(|row| *row != [0.0, 0.0, 0.0, 1.0]) {
        return Err(Error::Pose {
            path: path.clone(),
            frame: name,
            problem: "is not a 4 x 4 world-to-camera matrix (`w2c`) with last row 0 0 0 1".to_owned(),
        });
    }
    let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
    Ok(DraftFrame {
        name,
        camera_name: if camera_name.is_empty() { "camera".to_owned() } else { camera_name },
        time,
        split: *split,
        image,
        mask: None,
        camera: DraftCamera {
            source: path.clone(),
            size: Some(DVec2::new(meta.w, meta.h)),
            focal: DraftFocal::Pixels(DVec2::new(fx, fy)),
            principal_px: Some(DVec2::new(cx, cy)),
            lens: LensDistortion { skew_px: skew, ..LensDistortion::default() },
            camera_from_world: RigidTransform {
                rotation: DMat3::from_cols(column(0), column(1), column(2)),
                translation: column(3),
            },
        },
    })
}

/// Points of `init_pt_cld.npz`: its array `data` has a row (x, y, z, r, g, b, segment) per point, colours from 0 to 1.
fn points(root: &Path) -> Result<Option<(RawPoints, PathBuf)>, Error> {
    let path = root.join("init_pt_cld.npz");
    if !listing::is_there(&path) {
        return Ok(None);
    }
    let array = Archive::open(&path)?.array("data", Elements::Floats)?;
    let columns = match array.shape[..] {
        [_, columns] if columns >= 6 => columns,
        _ => {
            return Err(Error::invalid(
                &path,
                format!(
                    "array `data` has the shape {:?} where [points, 7] is expected: x, y, z, r, g, b, segment",
                    array.shape
                ),
            ));
        }
    };
    let rows = || array.values.chunks_exact(columns);
    let colors: Vec<[f64; 3]> = rows().map(|row| [row[3], row[4], row[5]]).collect();
    let (colors, end) = by_range(&colors, false);
    let note = (end > 1.0).then(|| format!("its colours go to {end}, not 1, and are taken so"));
    Ok(Some((
        RawPoints {
            positions: rows().map(|row| [row[0], row[1], row[2]]).collect(),
            colors: Some(colors),
            note,
        },
        path,
    )))
}
