//! Photographs, which keep their names. All that follows sees them upright, so that poses, masks and other tools are of
//! the same pixels whether they know EXIF or not.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::FrameSource;
use cif_dataset::orientation::Orientation;
use rayon::prelude::*;

use super::check::Notes;
use super::choose::Choice;
use super::shot::Shot;
use crate::picture::{Impression, Photograph};
use crate::source::Source;
use crate::{Error, Hooks};

/// The photographs of a camera in name order; such that show nothing are left out. Larger ones than requested are reduced
/// and those that lie on their side turned upright below `folder`, all others stay where they are.
pub(super) fn read(
    source: &Source,
    files: &[PathBuf],
    prefix: &str,
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    if choice.rate.is_some() || choice.from_s.is_some() || choice.to_s.is_some() {
        notes.push(format!(
            "{}: photographs are taken as they are: a rate and a range of seconds are for videos",
            source.path.display()
        ));
    }
    hooks.say(&format!("photographs of {}", source.camera));
    // Evenly spread, as of a video.
    let files: Vec<&PathBuf> = match choice.count.filter(|count| *count < files.len()) {
        Some(count) => (0..count).map(|k| &files[k * files.len() / count]).collect(),
        None => files.iter().collect(),
    };
    let mut known = remembered(&source.path)?;
    let into = folder.join(&source.camera);
    std::fs::create_dir_all(&into).map_err(Error::io("create", &into))?;
    let read: Vec<_> = files.par_iter().map(|file| read_one(file, choice.max_side, &into, hooks)).collect();
    let mut shots = Vec::new();
    let mut empty = Vec::new();
    let mut upright = 0;
    for read in read {
        let Read { name, file, size, turned, whole, impression } = read?;
        if impression.is_empty() {
            empty.push(name);
            continue;
        }
        upright += usize::from(turned != Orientation::NoTransforms);
        let own = |file: &String| FrameSource { file: file.clone(), size: whole, video: None };
        shots.push(Shot {
            camera: source.camera.clone(),
            source: Some(known.remove(&name).unwrap_or_else(|| own(&name))),
            name: format!("{prefix}{name}"),
            file,
            time: None,
            size,
            turned,
            impression,
        });
    }
    if upright > 0 {
        notes.push(format!(
            "{}: {upright} of {} photographs are turned upright, as their EXIF says",
            source.path.display(),
            files.len()
        ));
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

/// File next to frames that were kept of videos: the recordings that they were made of, by file name.
const SOURCES: &str = "sources.json";

/// Writes the recordings of images next to them, so that [`read`] finds them.
///
/// # Errors
/// When the file system refuses.
pub(crate) fn remember(images: &Path, shots: &[&Shot]) -> Result<(), Error> {
    let mut folders: BTreeMap<PathBuf, BTreeMap<&str, &FrameSource>> = BTreeMap::new();
    for shot in shots {
        let (folder, file) = shot.name.rsplit_once('/').unwrap_or(("", &shot.name));
        let of_folder = folders.entry(images.join(folder)).or_default();
        of_folder.extend(shot.source.as_ref().map(|source| (file, source)));
    }
    for (folder, sources) in folders {
        let path = folder.join(SOURCES);
        let text = serde_json::to_string_pretty(&sources).unwrap_or_default();
        std::fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    Ok(())
}

/// Recordings that [`remember`] wrote into a folder.
fn remembered(folder: &Path) -> Result<BTreeMap<String, FrameSource>, Error> {
    let path = folder.join(SOURCES);
    if !path.is_file() {
        return Ok(BTreeMap::new());
    }
    let bytes = cif_input::read(&path).map_err(Error::io("read", &path))?;
    // A file of that name that somebody else wrote says nothing.
    Ok(serde_json::from_slice(&bytes).unwrap_or_default())
}

/// A photograph as it is taken.
struct Read {
    name: String,
    /// The photograph, or what was made of it.
    file: PathBuf,
    size: (u32, u32),
    /// How its pixels were turned.
    turned: Orientation,
    /// Width and height of the photograph, upright.
    whole: [u32; 2],
    impression: Impression,
}

fn read_one(file: &Path, max_side: Option<u32>, into: &Path, hooks: &Hooks<'_>) -> Result<Read, Error> {
    hooks.go_on()?;
    let name = file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    cif_output::check_name(&name).map_err(|problem| {
        Error::refused(
            format!(
                "{}: the name of the photograph {name:?} {problem}",
                cif_output::folder_of(file).display()
            ),
            "rename it: its name becomes part of those of other files",
        )
    })?;
    let mut photograph = Photograph::read(file)?;
    let whole = [photograph.image.width(), photograph.image.height()];
    let impression = Impression::of_image(&photograph.image);
    let turned = photograph.turned;
    let too_large = max_side.filter(|side| whole[0].max(whole[1]) > *side);
    if let Some(side) = too_large {
        photograph.reduce(side);
    }
    let mut taken = file.to_owned();
    if too_large.is_some() || turned != Orientation::NoTransforms {
        taken = into.join(&name);
        photograph.write(&taken)?;
    }
    let size = (photograph.image.width(), photograph.image.height());
    Ok(Read { name, file: taken, size, turned, whole, impression })
}

#[cfg(test)]
mod tests {
    use image::codecs::jpeg::JpegEncoder;
    use image::{ImageDecoder, ImageEncoder, ImageReader, Rgb, RgbImage};

    use super::*;

    /// Facts of EXIF with an orientation alone.
    fn orientation(exif: u8) -> Vec<u8> {
        let mut facts = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
        facts.extend([exif, 0, 0, 0, 0, 0, 0, 0]);
        facts
    }

    #[test]
    fn photographs_are_taken_upright() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).unwrap();
        let path = photos.join("a.jpg");
        // A quarter clockwise shows what is white on the left above.
        let stored = RgbImage::from_fn(64, 48, |x, _| if x < 32 { Rgb([250; 3]) } else { Rgb([5; 3]) });
        let mut encoder = JpegEncoder::new_with_quality(std::fs::File::create(&path).unwrap(), 95);
        encoder.set_exif_metadata(orientation(6)).unwrap();
        stored.write_with_encoder(encoder).unwrap();
        let source = Source { camera: "walk".into(), path: photos, photographs: None };
        let mut notes = Notes::new();
        let into = folder.path().join("frames");
        let files = [path.clone()];
        let shots =
            read(&source, &files, "", &Choice::default(), &into, &Hooks::silent(), &mut notes).unwrap();
        assert_eq!((shots[0].size, shots[0].turned), ((48, 64), Orientation::Rotate90));
        assert_eq!(shots[0].source.as_ref().unwrap().size, [48, 64]);
        assert!(notes.iter().any(|note| note.contains("1 of 1") && note.contains("upright")), "{notes:?}");
        let mut taken = ImageReader::open(&shots[0].file).unwrap().into_decoder().unwrap();
        assert_eq!(taken.orientation().unwrap(), Orientation::NoTransforms, "turned once, not twice");
        let upright = image::open(&shots[0].file).unwrap().into_rgb8();
        assert_eq!(upright.dimensions(), (48, 64));
        assert!(upright.get_pixel(24, 3)[0] > 200 && upright.get_pixel(24, 60)[0] < 60);
    }

    #[cfg(unix)]
    #[test]
    fn names_with_control_characters_are_refused_and_shown_safely() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a\u{1b}[31m.png");
        RgbImage::new(8, 8).save(&path).unwrap();
        let source = Source { camera: "walk".into(), path: folder.path().into(), photographs: None };
        let into = folder.path().join("frames");
        let read = read(&source, &[path], "", &Choice::default(), &into, &Hooks::silent(), &mut Notes::new());
        let message = read.unwrap_err().to_string();
        assert!(message.contains("control characters") && message.contains("\\u{1b}"), "{message}");
        assert!(!message.contains('\u{1b}'), "{message:?}");
    }

    #[test]
    fn larger_photographs_are_reduced_and_keep_their_facts() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).unwrap();
        let image = |width, height| {
            RgbImage::from_fn(width, height, |x, y| {
                Rgb([(x / 4 % 2 * 200) as u8, (y / 4 % 2 * 200) as u8, 90])
            })
        };
        // A focal length of 26 mm of small film, by which the lens is guessed.
        let exif = b"II*\0\x08\0\0\0\x01\0\x05\xa4\x03\0\x01\0\0\0\x1a\0\0\0\0\0\0\0".to_vec();
        let large = std::fs::File::create(photos.join("a.jpg")).unwrap();
        let mut encoder = JpegEncoder::new_with_quality(large, 95);
        encoder.set_exif_metadata(exif.clone()).unwrap();
        image(200, 120).write_with_encoder(encoder).unwrap();
        image(96, 160).save(photos.join("b.png")).unwrap();
        image(64, 48).save(photos.join("c.png")).unwrap();
        let source = Source { camera: "walk".into(), path: photos.clone(), photographs: None };
        let files: Vec<PathBuf> = ["a.jpg", "b.png", "c.png"].map(|name| photos.join(name)).to_vec();
        let choice = Choice { max_side: Some(80), ..Choice::default() };
        let mut notes = Notes::new();
        let into = folder.path().join("frames");
        let shots = read(&source, &files, "", &choice, &into, &Hooks::silent(), &mut notes).unwrap();
        assert!(notes.is_empty(), "{notes:?}");
        let sizes: Vec<_> = shots.iter().map(|shot| shot.size).collect();
        assert_eq!(sizes, [(80, 48), (48, 80), (64, 48)]);
        for shot in &shots {
            assert_eq!(image::image_dimensions(&shot.file).unwrap(), shot.size);
        }
        assert_eq!(shots[2].file, files[2], "small ones stay where they are");
        assert_eq!(shots[0].name, "a.jpg");
        let source = shots[0].source.as_ref().unwrap();
        assert_eq!((source.file.as_str(), source.size, source.video), ("a.jpg", [200, 120], None));
        let mut reduced = ImageReader::open(&shots[0].file).unwrap().into_decoder().unwrap();
        assert_eq!(reduced.exif_metadata().unwrap(), Some(exif));
        assert_eq!(image::image_dimensions(&files[0]).unwrap(), (200, 120), "the original is left alone");
    }
}
