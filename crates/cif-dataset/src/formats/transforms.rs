//! The `transforms*.json` files of NeRF, D-NeRF, instant-ngp and nerfstudio.

use std::path::{Component, Path, PathBuf};

use cif_geometry::LensDistortion;
use glam::DVec2;
use serde::Deserialize;

use super::draft::{DraftCamera, DraftFocal, from_opengl};
use crate::files::{json, listing};
use crate::{Error, FrameSource};

/// A whole file.
#[derive(Deserialize)]
pub(super) struct TransformsFile {
    #[serde(flatten)]
    pub(super) intrinsics: Intrinsics,
    pub(super) frames: Vec<FrameEntry>,
    pub(super) ply_file_path: Option<PathBuf>,
    pub(super) train_filenames: Option<Vec<PathBuf>>,
    pub(super) val_filenames: Option<Vec<PathBuf>>,
    pub(super) test_filenames: Option<Vec<PathBuf>>,
    pub(super) fps: Option<f64>,
    /// Knowledge of `cif capture` of the world.
    pub(super) cif: Option<World>,
}

/// Knowledge of the world that poses are in. Files of others do not state it, and are taken at their word.
#[derive(Clone, Copy, Deserialize)]
pub(super) struct World {
    #[serde(default = "known")]
    pub(super) metres_known: bool,
    #[serde(default = "known")]
    pub(super) up_known: bool,
}

fn known() -> bool {
    true
}

/// One frame of a file.
#[derive(Deserialize)]
pub(super) struct FrameEntry {
    pub(super) file_path: PathBuf,
    pub(super) transform_matrix: Vec<[f64; 4]>,
    pub(super) time: Option<f64>,
    pub(super) mask_path: Option<PathBuf>,
    /// Recording that `cif capture` made the image of.
    pub(super) cif: Option<FrameSource>,
    #[serde(flatten)]
    pub(super) intrinsics: Intrinsics,
}

/// Intrinsics of a file or of one frame, which overrides the file.
#[derive(Deserialize, Default)]
pub(super) struct Intrinsics {
    camera_model: Option<String>,
    camera_angle_x: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    is_fisheye: Option<bool>,
}

/// Reads a file.
///
/// # Errors
/// When it does not parse or lists no frame.
pub(super) fn read(path: &Path) -> Result<TransformsFile, Error> {
    let mut file: TransformsFile = json::read(path)?;
    with_slashes(path.parent().unwrap_or(Path::new("")), &mut file);
    if file.frames.is_empty() {
        return Err(Error::invalid(path, "`frames` is empty; list the frames there"));
    }
    Ok(file)
}

/// Writes paths with `/` that a tool on Windows wrote with `\\`, unless such a file is there.
fn with_slashes(root: &Path, file: &mut TransformsFile) {
    let lists = [&mut file.train_filenames, &mut file.val_filenames, &mut file.test_filenames];
    let listed = lists.into_iter().flatten().flatten();
    let of_frames = file
        .frames
        .iter_mut()
        .flat_map(|entry| std::iter::once(&mut entry.file_path).chain(&mut entry.mask_path));
    for path in listed.chain(of_frames).chain(&mut file.ply_file_path) {
        let text = path.to_string_lossy();
        if text.contains('\\') && listing::with_image_extension(&root.join(&*path)).is_none() {
            *path = PathBuf::from(text.replace('\\', "/"));
        }
    }
}

/// Cameras of a file by the paths of their images, with their times, and the file of points that it names.
///
/// # Errors
/// When it is damaged.
#[allow(clippy::type_complexity, reason = "one caller")]
pub(crate) fn named_cameras(
    path: &Path,
) -> Result<(Vec<(String, DraftCamera, Option<f64>)>, Option<PathBuf>), Error> {
    let file = read(path)?;
    let cameras = file.frames.iter().map(|entry| {
        let parts = clean(&entry.file_path);
        let name =
            parts.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/");
        camera(path, &file, entry).map(|camera| (name, camera, entry.time))
    });
    Ok((cameras.collect::<Result<_, _>>()?, file.ply_file_path.as_deref().map(clean)))
}

/// The image of a frame, with the extension where the file leaves it out.
///
/// # Errors
/// When there is no such image.
pub(super) fn image(root: &Path, path: &Path, entry: &FrameEntry) -> Result<PathBuf, Error> {
    let image = root.join(clean(&entry.file_path));
    listing::with_image_extension(&image).ok_or_else(|| Error::CameraWithoutImage {
        frame: frame_name(&entry.file_path),
        source_file: path.to_owned(),
        image,
    })
}

/// A relative path without `./`.
pub(super) fn clean(path: &Path) -> PathBuf {
    path.components().filter(|part| !matches!(part, Component::CurDir)).collect()
}

/// The paths of images without `./`, and relative to the capture where they lie inside it or, as some tools write
/// them, all outside of it in one folder: such paths become names of frames.
pub(super) fn inside(root: &Path, file_paths: &[&Path]) -> Vec<PathBuf> {
    let real_root = root.canonicalize();
    let roots = [Some(root), real_root.as_deref().ok()];
    let paths: Vec<PathBuf> = file_paths
        .iter()
        .map(|path| {
            let path = clean(path);
            let below = roots.into_iter().flatten().find_map(|root| path.strip_prefix(root).ok());
            below.filter(|_| path.is_absolute()).map(Path::to_owned).unwrap_or(path)
        })
        .collect();
    let leaves =
        |path: &PathBuf| path.is_absolute() || path.components().any(|part| part == Component::ParentDir);
    if !paths.iter().all(leaves) {
        return paths;
    }
    let folder = common_folder(paths.iter().map(PathBuf::as_path));
    paths.iter().map(|path| path.strip_prefix(&folder).unwrap_or(path).to_owned()).collect()
}

/// The folder that all of some files share, as far as their paths show.
pub(super) fn common_folder<'a>(paths: impl Iterator<Item = &'a Path>) -> PathBuf {
    let folders = paths.map(|path| path.parent().unwrap_or(Path::new("")).to_owned());
    let shared = |a: PathBuf, b: PathBuf| {
        a.components().zip(b.components()).take_while(|(a, b)| a == b).map(|(a, _)| a).collect()
    };
    folders.reduce(shared).unwrap_or_default()
}

/// Path of an image without `./` and extension, with `/` between its parts.
pub(super) fn frame_name(path: &Path) -> String {
    let path = clean(path);
    let path = if listing::is_image(&path) { path.with_extension("") } else { path };
    path.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}

/// The camera of a frame.
///
/// # Errors
/// When the matrix is not 3 x 4 or 4 x 4, no focal length is given, or the lens model is not known.
pub(super) fn camera(path: &Path, file: &TransformsFile, entry: &FrameEntry) -> Result<DraftCamera, Error> {
    let name = || frame_name(&entry.file_path);
    let intrinsics = |problem: String| Error::Intrinsics { path: path.to_owned(), frame: name(), problem };
    let rows = &entry.transform_matrix;
    if !(3..=4).contains(&rows.len()) || rows.get(3).is_some_and(|row| *row != [0.0, 0.0, 0.0, 1.0]) {
        return Err(Error::Pose {
            path: path.to_owned(),
            frame: name(),
            problem: "is not a 4 x 4 camera-to-world matrix with last row 0 0 0 1".to_owned(),
        });
    }
    let (own, all) = (&entry.intrinsics, &file.intrinsics);
    macro_rules! value {
        ($field:ident) => {
            own.$field.or(all.$field)
        };
    }
    let model = own.camera_model.as_deref().or(all.camera_model.as_deref()).unwrap_or("OPENCV");
    if value!(is_fisheye).unwrap_or(false)
        || !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"].contains(&model)
    {
        let model = if value!(is_fisheye).unwrap_or(false) { "fisheye" } else { model };
        return Err(intrinsics(format!(
            "camera model {model} is not supported; undistort the images to PINHOLE or OPENCV first"
        )));
    }
    let size = value!(w).zip(value!(h)).map(|(w, h)| DVec2::new(w, h));
    let focal = match (value!(fl_x), value!(fl_y), value!(camera_angle_x)) {
        (Some(x), y, _) => DraftFocal::Pixels(DVec2::new(x, y.unwrap_or(x))),
        (None, Some(y), _) => DraftFocal::Pixels(DVec2::splat(y)),
        (None, None, Some(angle)) => DraftFocal::HorizontalAngle(angle),
        (None, None, None) => {
            return Err(intrinsics("neither fl_x nor camera_angle_x is given; add one".to_owned()));
        }
    };
    let principal = match (value!(cx), value!(cy)) {
        (Some(x), Some(y)) => Some(DVec2::new(x, y)),
        (None, None) => None,
        _ => return Err(intrinsics("only one of cx and cy is given; add the other".to_owned())),
    };
    Ok(DraftCamera {
        source: path.to_owned(),
        size,
        focal,
        principal_px: principal,
        lens: LensDistortion {
            radial: [value!(k1), value!(k2), value!(k3), value!(k4)].map(|k| k.unwrap_or(0.0)),
            tangential: [value!(p1), value!(p2)].map(|p| p.unwrap_or(0.0)),
            skew_px: 0.0,
        },
        camera_from_world: from_opengl(rows),
    })
}

/// Times of frames, of a clock that may begin anywhere.
pub(super) struct Times {
    /// From 0 for the first to 1 for the last, `[frames]`; all zero when the capture has no times.
    pub(super) normalised: Vec<f64>,
    /// Moments per second, where the times are seconds: those that end beyond 1 and are not whole, as numbers of frames are,
    /// or are of a clock that counts from 1970.
    pub(super) per_second: Option<f64>,
}

/// Seconds since 1970 before which no clock of a computer stands (1973); no video has so many frames.
const EARLIEST: f64 = 1e8;

/// Seconds since 1970 after which none stands (the year 5138): such clocks count milliseconds or less.
const LATEST: f64 = 1e11;

impl Times {
    /// A sentence on the unit, where frames per second come from the times.
    pub(super) fn note(&self, path: &Path) -> Option<String> {
        self.per_second.map(|rate| {
            format!("{}: its times are taken as seconds: {rate} moments per second", path.display())
        })
    }
}

/// Normalises times: `t = (time - first) / (last - first)`.
///
/// # Errors
/// When only some frames have a time, or one is not finite.
pub(super) fn times(path: &Path, times: &[Option<f64>]) -> Result<Times, Error> {
    if times.iter().all(Option::is_none) {
        return Ok(Times { normalised: vec![0.0; times.len()], per_second: None });
    }
    let values: Vec<f64> = times
        .iter()
        .map(|time| {
            time.filter(|time| time.is_finite()).ok_or_else(|| {
                Error::invalid(
                    path,
                    "some frames have no `time`, or one that is not finite; give every frame a time, or none",
                )
            })
        })
        .collect::<Result<_, _>>()?;
    let mut moments = values.clone();
    moments.sort_by(f64::total_cmp);
    moments.dedup();
    let (first, last) = (moments[0], moments[moments.len() - 1]);
    let span = last - first;
    if span <= 0.0 || !span.is_finite() {
        return Ok(Times { normalised: vec![0.0; times.len()], per_second: None });
    }
    let is_fraction = moments.iter().any(|moment| moment.fract() != 0.0);
    let is_clock = (first < 0.0 || last > 1.0) && last < LATEST && (is_fraction || first > EARLIEST);
    let per_second = is_clock.then(|| {
        // Clocks of days have microseconds left in double precision.
        ((moments.len() - 1) as f64 / span * 1e3).round() / 1e3
    });
    Ok(Times {
        normalised: values.iter().map(|time| (time - first) / span).collect(),
        per_second: per_second.filter(|rate| *rate > 0.0),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: &[f64]) -> Times {
        let values: Vec<Option<f64>> = values.iter().copied().map(Some).collect();
        times(Path::new("transforms.json"), &values).unwrap()
    }

    #[test]
    fn clocks_may_begin_anywhere() {
        for start in [0.0, 100.0, -3.0, 1.7e9] {
            let values: Vec<f64> = (0..12).map(|k| start + 0.1 * f64::from(k)).collect();
            let found = of(&values);
            for (k, time) in found.normalised.iter().enumerate() {
                assert!((time - k as f64 / 11.0).abs() < 1e-6, "{start}: {time}");
            }
            assert_eq!((found.normalised[0], found.normalised[11]), (0.0, 1.0));
            assert_eq!(found.per_second, Some(10.0), "{start}");
        }
    }

    #[test]
    fn numbers_of_frames_and_shares_are_no_seconds() {
        let numbers = of(&[500.0, 505.0, 510.0]);
        assert_eq!((numbers.normalised, numbers.per_second), (vec![0.0, 0.5, 1.0], None));
        assert_eq!(of(&[1.7e9, 1.7e9 + 2.0, 1.7e9 + 4.0]).per_second, Some(0.5), "a clock of whole seconds");
        assert_eq!(of(&[1.7e12, 1.7e12 + 33.5]).per_second, None, "milliseconds");
        let shares = of(&[0.0, 0.25, 1.0]);
        assert_eq!((shares.normalised, shares.per_second), (vec![0.0, 0.25, 1.0], None));
        let one = of(&[7.5, 7.5]);
        assert_eq!((one.normalised, one.per_second), (vec![0.0; 2], None));
    }
}
