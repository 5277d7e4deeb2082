//! Which mask belongs to which frame, and which ids the masks hold.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use rayon::prelude::*;

use crate::cryptomatte::{self, ObjectIds};
use crate::files::{confidence, listing, mask};
use crate::masks::{CONFIDENCE_FOLDER, files_of_video};
use crate::sizes::same_aspect;
use crate::{Error, Frame, Layout, Split};

/// Mask folder that is taken where none is asked for.
pub(crate) const DEFAULT_FOLDER: &str = "masks";

/// The mask folder of Dynamic 3D Gaussians: white where the foreground is, mostly of one bit per pixel.
pub(crate) const SEGMENTS: &str = "seg";

/// A folder of masks, as one named it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct MaskFolder {
    /// A name inside the capture, or a path.
    pub(crate) name: PathBuf,
    /// Path of the folder.
    pub(crate) path: PathBuf,
}

impl MaskFolder {
    /// The folder that somebody asked for: a name inside the capture, else a path, relative to the current folder.
    pub(crate) fn asked(root: &Path, name: &Path) -> Self {
        let inside = root.join(name);
        let path = if inside.is_dir() || !name.is_dir() { inside } else { name.to_owned() };
        Self { name: name.to_owned(), path }
    }

    /// The folder that nobody named, which is one of the capture and of no other place.
    pub(crate) fn of_capture(root: &Path, layout: Layout) -> Self {
        let segments = layout == Layout::DynamicGaussians
            && !root.join(DEFAULT_FOLDER).is_dir()
            && root.join(SEGMENTS).is_dir();
        let name = if segments { SEGMENTS } else { DEFAULT_FOLDER };
        Self { name: name.into(), path: root.join(name) }
    }
}

/// Endings of mask files, first choice first.
const EXTENSIONS: [&str; 2] = ["png", "exr"];

/// True when a mask is a Cryptomatte.
pub(crate) fn is_cryptomatte(path: &Path) -> bool {
    listing::has_extension(path, &["exr"])
}

/// Reads the header of a mask.
///
/// # Errors
/// When the file is missing or no mask.
fn probe(path: &Path) -> Result<mask::MaskHeader, Error> {
    if !is_cryptomatte(path) {
        return mask::probe(path);
    }
    let header = cryptomatte::read_header(path)?;
    Ok(mask::MaskHeader { width: header.width, height: header.height, largest_id: u16::MAX })
}

/// Decodes a mask: a PNG file of ids, or a Cryptomatte whose objects have the ids of `objects`.
///
/// # Errors
/// When the file is missing, truncated or no mask.
pub(crate) fn decode(path: &Path, objects: &ObjectIds) -> Result<PixelGrid<u16>, Error> {
    if is_cryptomatte(path) { Ok(cryptomatte::read(path)?.flatten(objects)) } else { mask::decode(path) }
}

/// Objects of all Cryptomatte masks by name; empty for PNG masks.
///
/// # Errors
/// When a header cannot be read; the first in frame order is reported.
pub(crate) fn manifests(frames: &[Frame]) -> Result<BTreeMap<String, u32>, Error> {
    let headers: Vec<Result<cryptomatte::Header, Error>> = frames
        .par_iter()
        .filter_map(|frame| frame.mask.as_deref().filter(|path| is_cryptomatte(path)))
        .map(cryptomatte::read_header)
        .collect();
    let mut objects = BTreeMap::new();
    for header in headers {
        objects.extend(header?.objects);
    }
    Ok(objects)
}

/// Pixels of each id of one mask, without 0.
pub(crate) type PixelCounts = BTreeMap<u16, u64>;

/// Mask files of a folder by frame.
pub(crate) struct MaskListing {
    /// `[frames]`.
    pub(crate) paths: Vec<Option<PathBuf>>,
    /// Confidences of these masks, `[frames]`.
    pub(crate) confidences: Vec<Option<PathBuf>>,
    /// Folder of these masks, which may hold labels of its own; of several, the one of the first training frame.
    pub(crate) folder: Option<PathBuf>,
    /// The folder in messages.
    pub(crate) place: String,
    /// PNG and EXR files in the folders that belong to no frame.
    pub(crate) strangers: usize,
    /// True when files belong to frames by their numbers instead of their names.
    pub(crate) numbered: bool,
}

/// Finds the masks of a folder.
///
/// Looked for, in this order: `<camera>/<folder>/<stem>.png` (Neu3D), `<folder>/<frame>.png`,
/// `<folder>/<frame>.<image extension>.png`, where stems are unique `<folder>/<stem>.png`, and the folder next to the
/// image (`train/<folder>/<stem>.png`); each also with `.exr`. Files that are numbered as the frames of the video that the
/// capture was made of, one for each, are those of its frames. Where none fits, EXR files that are bare numbers count
/// the frames from 0, as renderers number them, and masks of an LLFF sequence belong to the images of their numbers
/// (`frame-000012.mask.png` to `000012.png`).
pub(crate) fn locate(root: &Path, layout: Layout, frames: &[Frame], folder: &MaskFolder) -> MaskListing {
    let MaskFolder { name: folder, path: base } = folder;
    let stems: Vec<String> = frames.iter().map(|frame| listing::stem(&frame.image)).collect();
    let mut occurrences: BTreeMap<&str, usize> = BTreeMap::new();
    for stem in &stems {
        *occurrences.entry(stem).or_default() += 1;
    }
    let mut paths: Vec<Option<PathBuf>> = frames
        .iter()
        .zip(&stems)
        .map(|(frame, stem)| {
            let mut candidates = Vec::new();
            if layout == Layout::Neu3d && folder.is_relative() {
                candidates.push(root.join(&frame.camera_name).join(folder).join(stem));
            }
            candidates.push(base.join(&frame.name));
            if let Some(extension) = frame.image.extension() {
                candidates.push(base.join(format!("{}.{}", frame.name, extension.to_string_lossy())));
            }
            if occurrences[stem.as_str()] == 1 {
                candidates.push(base.join(stem));
            }
            if let (true, Some(parent)) = (folder.is_relative(), frame.image.parent()) {
                candidates.push(parent.join(folder).join(stem));
            }
            candidates.iter().find_map(|candidate| {
                EXTENSIONS.iter().find_map(|extension| {
                    let mut name = candidate.clone().into_os_string();
                    name.push(".");
                    name.push(extension);
                    Some(PathBuf::from(name)).filter(|path| listing::is_there(path))
                })
            })
        })
        .collect();
    let of_videos = of_videos(base, frames, &mut paths);
    let numbered = paths.iter().all(Option::is_none)
        && (number(base, &mut paths) || layout == Layout::Llff && by_number(base, &stems, &mut paths));
    let found: BTreeSet<&Path> = paths.iter().flatten().map(PathBuf::as_path).collect();
    // Masks of a folder may lie in subfolders, those of cameras and splits in folders of their own.
    let mut folders: BTreeSet<&Path> =
        found.iter().filter(|path| !path.starts_with(base)).filter_map(|path| path.parent()).collect();
    let (folder_of_masks, place) = if base.is_dir() {
        (Some(base.clone()), base.display().to_string())
    } else {
        let next_to_images = format!("{}: {}/ beside the images", root.display(), folder.display());
        (folder_of_training(frames, &paths), next_to_images)
    };
    folders.insert(base);
    let confidences = |folder: &Path| folder.join(CONFIDENCE_FOLDER);
    let files: usize = folders
        .iter()
        .map(|folder| count_files(folder).saturating_sub(count_files(&confidences(folder))))
        .sum();
    let strangers = files.saturating_sub(found.len() + of_videos);
    let folder_of_confidences = confidences(base);
    let confidence = |(frame, mask): (&Frame, &Option<PathBuf>)| {
        let path = folder_of_confidences.join(format!("{}.png", frame.name));
        mask.as_ref().map(|_| path).filter(|path| listing::is_there(path))
    };
    let confidences = frames.iter().zip(&paths).map(confidence).collect();
    MaskListing { paths, confidences, folder: folder_of_masks, place, strangers, numbered }
}

/// Folder of the mask of the first training frame that has one.
fn folder_of_training(frames: &[Frame], paths: &[Option<PathBuf>]) -> Option<PathBuf> {
    let trained = frames.iter().zip(paths).filter(|(frame, _)| frame.split == Split::Train);
    trained.filter_map(|(_, path)| path.as_deref()?.parent()).next().map(Path::to_owned)
}

impl MaskListing {
    /// Lets the masks that frames name themselves go first. Those of the folder go to the other frames where the named
    /// ones lie in it too; else they count ids of their own, so that none of them is taken, and the files left out are
    /// counted.
    pub(crate) fn after_named(self, folder: &MaskFolder, frames: &[Frame]) -> (Self, usize) {
        let named: BTreeSet<&Path> =
            frames.iter().filter_map(|frame| frame.mask.as_deref()?.parent()).collect();
        if named.is_empty() {
            return (self, 0);
        }
        let real = folder.path.canonicalize();
        let inside = |named: &&Path| {
            let named = named.canonicalize();
            real.as_ref().is_ok_and(|real| named.is_ok_and(|named| named.starts_with(real)))
        };
        if named.iter().all(inside) {
            let paths = frames.iter().zip(self.paths).map(|(frame, found)| frame.mask.clone().or(found));
            return (Self { paths: paths.collect(), numbered: false, ..self }, 0);
        }
        let left_out = self.paths.iter().flatten().count();
        let paths: Vec<_> = frames.iter().map(|frame| frame.mask.clone()).collect();
        let folder =
            folder_of_training(frames, &paths).or_else(|| named.first().map(|path| path.to_path_buf()));
        let place = folder.as_deref().map(|folder| folder.display().to_string()).unwrap_or_default();
        let confidences = vec![None; paths.len()];
        (Self { paths, confidences, folder, place, strangers: 0, numbered: false }, left_out)
    }
}

/// The number in a name that has one.
fn only_number(name: &str) -> Option<u64> {
    let mut numbers = name.split(|c: char| !c.is_ascii_digit()).filter(|digits| !digits.is_empty());
    let number = numbers.next()?.parse().ok();
    number.filter(|_| numbers.next().is_none())
}

/// Gives PNG files to the frames whose names hold the same number, where no two files or frames share one; whether
/// there are any.
fn by_number(folder: &Path, stems: &[String], paths: &mut [Option<PathBuf>]) -> bool {
    let mut files: BTreeMap<u64, Option<PathBuf>> = BTreeMap::new();
    let entries = if folder.is_dir() { listing::entries(folder).unwrap_or_default() } else { Vec::new() };
    for path in entries.into_iter().filter(|path| listing::has_extension(path, &["png"])) {
        if let Some(number) = only_number(&listing::stem(&path)) {
            files.entry(number).and_modify(|file| *file = None).or_insert(Some(path));
        }
    }
    let numbers: Vec<Option<u64>> = stems.iter().map(|stem| only_number(stem)).collect();
    let distinct: BTreeSet<u64> = numbers.iter().copied().flatten().collect();
    if distinct.len() < numbers.len() {
        return false;
    }
    for (path, number) in paths.iter_mut().zip(numbers) {
        *path = number.and_then(|number| files.get(&number).cloned().flatten());
    }
    paths.iter().any(Option::is_some)
}

/// Gives the masks of whole videos to the frames that were made of these: files of bare numbers, in the folder where there
/// is one camera, else in folders of their names. Returns how many are of frames that the capture does not have.
fn of_videos(base: &Path, frames: &[Frame], paths: &mut [Option<PathBuf>]) -> usize {
    let mut cameras: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (index, frame) in frames.iter().enumerate() {
        cameras.entry(&frame.camera_name).or_default().push(index);
    }
    let mut others = 0;
    for (camera, indices) in &cameras {
        let places: Option<Vec<_>> =
            indices.iter().map(|index| frames[*index].source.as_ref()?.video).collect();
        let Some(places) = places else { continue };
        let of = places[0].of;
        let folder = if cameras.len() == 1 { base.to_owned() } else { base.join(camera) };
        if !folder.is_dir() || places.iter().any(|place| place.of != of) {
            continue;
        }
        let Some(mut files) = files_of_video(&folder, &EXTENSIONS, of) else { continue };
        for (index, place) in indices.iter().zip(&places) {
            paths[*index] = files.remove(&place.frame);
        }
        others += files.len();
    }
    others
}

/// Gives numbered EXR files to the frames they count; whether there are any.
fn number(folder: &Path, paths: &mut [Option<PathBuf>]) -> bool {
    if !folder.is_dir() {
        return false;
    }
    for path in listing::entries(folder).unwrap_or_default() {
        let digits = listing::stem(&path);
        if listing::has_extension(&path, &["exr"])
            && digits.bytes().all(|digit| digit.is_ascii_digit())
            && let Some(place) = digits.parse::<usize>().ok().and_then(|index| paths.get_mut(index))
        {
            *place = Some(path);
        }
    }
    paths.iter().any(Option::is_some)
}

/// Mask files in a folder and its subfolders.
fn count_files(folder: &Path) -> usize {
    if !folder.is_dir() {
        return 0;
    }
    let files = listing::below(folder).unwrap_or_default();
    files.iter().filter(|path| listing::has_extension(path, &EXTENSIONS)).count()
}

/// Folders of a capture that could hold masks, for messages.
pub(crate) fn folders_like_masks(root: &Path) -> Vec<String> {
    let mut names = BTreeSet::new();
    for entry in listing::entries(root).unwrap_or_default() {
        let inner = if entry.is_dir() { listing::entries(&entry).unwrap_or_default() } else { Vec::new() };
        for path in std::iter::once(entry).chain(inner) {
            let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
            let lower = name.to_lowercase();
            if path.is_dir() && (lower.contains("mask") || lower.contains("cryptomatte")) {
                names.insert(name);
            }
        }
    }
    names.into_iter().collect()
}

/// Facts from the headers of all masks.
pub(crate) struct MaskHeaders {
    /// Largest id that any of the files can hold.
    pub(crate) largest_id: u16,
    /// Masks of another size than their image.
    pub(crate) resized: Option<ResizedMasks>,
}

/// Masks that are resized on loading.
pub(crate) struct ResizedMasks {
    pub(crate) count: usize,
    /// The first of them, its size, and that of its image.
    pub(crate) example: PathBuf,
    pub(crate) mask_size: (u32, u32),
    pub(crate) image_size: (u32, u32),
}

/// Checks the headers of all masks and confidences against the sizes of the images in their files, once upright.
///
/// # Errors
/// When a mask is no PNG, a colour image, or has another aspect than its image; when a confidence is no 8-bit grey PNG or
/// has another aspect.
pub(crate) fn check_headers(frames: &[Frame], stored_sizes: &[(u32, u32)]) -> Result<MaskHeaders, Error> {
    let headers: Vec<Option<Result<mask::MaskHeader, Error>>> =
        frames.par_iter().map(|frame| frame.mask.as_deref().map(probe)).collect();
    let mut result = MaskHeaders { largest_id: 0, resized: None };
    for ((frame, header), stored) in frames.iter().zip(headers).zip(stored_sizes) {
        if let Some(path) = &frame.confidence {
            confidence::check(path, *stored, frame.turn)?;
        }
        let (Some(header), Some(path)) = (header, &frame.mask) else { continue };
        let header = header?;
        let size = frame.turn.seen_size((header.width, header.height), *stored);
        if size.0 == 0 || size.1 == 0 || !same_aspect(size, *stored) {
            return Err(Error::MaskSize {
                mask: path.clone(),
                mask_size: size,
                image: frame.image.clone(),
                image_size: *stored,
            });
        }
        result.largest_id = result.largest_id.max(header.largest_id);
        // Masks of the size of the recording are as they should be.
        let recorded = frame.source.as_ref().is_some_and(|source| source.size == [size.0, size.1]);
        if size != *stored && size != (frame.camera.width, frame.camera.height) && !recorded {
            match &mut result.resized {
                Some(resized) => resized.count += 1,
                None => {
                    result.resized = Some(ResizedMasks {
                        count: 1,
                        example: path.clone(),
                        mask_size: size,
                        image_size: *stored,
                    });
                }
            }
        }
    }
    Ok(result)
}

/// Decodes every mask as stored and counts the pixels of each id. `[frames]`, `None` without mask.
///
/// # Errors
/// When a mask cannot be decoded; the first in frame order is reported.
pub(crate) fn count_pixels(
    frames: &[Frame],
    objects: &ObjectIds,
) -> Result<Vec<Option<(PixelCounts, u64)>>, Error> {
    let counts: Vec<_> = frames
        .par_iter()
        .map(|frame| {
            frame.mask.as_deref().map(|path| {
                decode(path, objects).map(|mask| {
                    let mut counts = PixelCounts::new();
                    // Runs of one id are long: one look-up per run.
                    for run in mask.pixels.chunk_by(|a, b| a == b) {
                        if run[0] != 0 {
                            *counts.entry(run[0]).or_default() += run.len() as u64;
                        }
                    }
                    (counts, mask.pixels.len() as u64)
                })
            })
        })
        .collect();
    counts.into_iter().map(Option::transpose).collect()
}
