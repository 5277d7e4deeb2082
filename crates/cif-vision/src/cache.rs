//! Masks that were made before, by prompt, picture and models.
//!
//! A folder per prompt and models, `steel_jug-0123456789abcdef`, holds a PNG file per picture,
//! `cam03_0007_0123456789abcdef.png`, white where the prompt is. The numbers change with the manifest, the files of the
//! models, the thresholds and the pixels of the picture, so that nothing that is out of date is ever taken; what is
//! broken is made anew. Folders can be deleted at any time.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use xxhash_rust::xxh3::Xxh3;

use crate::grounding::{FoundBox, Thresholds};
use crate::models::Models;
use crate::{Error, Picture};

/// Goes up when the same models and pictures give other masks.
const VERSION: u32 = 1;

/// Keyword of the text that holds the boxes, as JSON.
const KEYWORD: &str = "cif boxes";

/// Longest part of a prompt in a name, characters.
const NAME: usize = 40;

/// The masks of a prompt by the models of a folder.
#[derive(Clone, Debug)]
pub struct Cache {
    folder: PathBuf,
}

impl Cache {
    /// The cache of a prompt inside a folder, neither of which has to be there.
    ///
    /// # Errors
    /// When a file of the models is gone.
    pub fn new(folder: &Path, models: &Models, prompt: &str, thresholds: Thresholds) -> Result<Self, Error> {
        let mut hash = Xxh3::new();
        hash.update(&VERSION.to_le_bytes());
        hash.update(&models.stamp()?.to_le_bytes());
        hash.update(&thresholds.boxes.to_le_bytes());
        hash.update(&thresholds.text.to_le_bytes());
        hash.update(prompt.as_bytes());
        Ok(Self { folder: folder.join(format!("{}-{:016x}", readable(prompt), hash.digest())) })
    }

    /// The file of a picture, whose name starts with `name`.
    #[must_use]
    pub fn file(&self, name: &str, picture: &Picture) -> PathBuf {
        let mut hash = Xxh3::new();
        hash.update(&picture.width.to_le_bytes());
        hash.update(picture.pixels.as_flattened());
        self.folder.join(format!("{name}_{:016x}.png", hash.digest()))
    }
}

/// The boxes of a mask, where a file holds a whole one of the size of a picture.
#[must_use]
pub fn boxes(file: &Path, (width, height): (u32, u32)) -> Option<Vec<FoundBox>> {
    let mut reader = png::Decoder::new(BufReader::new(cif_input::open(file).ok()?)).read_info().ok()?;
    // Before memory is taken for what a broken header says.
    if (reader.info().width, reader.info().height) != (width, height) {
        return None;
    }
    let mut pixels = vec![0; reader.output_buffer_size()?];
    reader.next_frame(&mut pixels).ok()?;
    reader.finish().ok()?;
    let text = reader.info().utf8_text.iter().find(|text| text.keyword == KEYWORD)?.get_text().ok()?;
    serde_json::from_str(&text).ok()
}

/// Writes a mask, white on black, with the boxes that it was found in; missing folders on the way are made.
///
/// # Errors
/// When the file system refuses.
pub fn write(file: &Path, mask: &PixelGrid<bool>, boxes: &[FoundBox]) -> Result<(), Error> {
    let failed = |source| Error::Io { action: "write", path: file.to_owned(), source };
    if let Some(folder) = file.parent() {
        std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    }
    let text = serde_json::to_string(boxes).map_err(|error| failed(error.into()))?;
    let grey: Vec<u8> = mask.pixels.iter().map(|inside| if *inside { u8::MAX } else { 0 }).collect();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, mask.width, mask.height);
    encoder.set_color(png::ColorType::Grayscale);
    let written = encoder
        .add_itxt_chunk(KEYWORD.to_owned(), text)
        .and_then(|()| encoder.write_header())
        .and_then(|mut writer| writer.write_image_data(&grey).and_then(|()| writer.finish()));
    written.map_err(|error| failed(std::io::Error::other(error)))?;
    cif_output::write(file, &bytes).map_err(failed)
}

/// A prompt as part of a name.
fn readable(prompt: &str) -> String {
    let plain = |letter: char| if letter.is_alphanumeric() { letter } else { '_' };
    prompt.trim().chars().take(NAME).map(plain).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_masks_are_not_taken() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("deep/mask.png");
        assert_eq!(boxes(&file, (3, 2)), None);
        let found =
            [FoundBox { corners: [0.5, 1.0, 2.0, 2.0], score: 0.625, words: "Krügle, rot".to_owned() }];
        let mask = PixelGrid::from_pixels(3, 2, vec![true, false, false, false, true, true]);
        write(&file, &mask, &found).unwrap();
        assert_eq!(boxes(&file, (3, 2)).as_deref(), Some(found.as_slice()));
        assert_eq!(boxes(&file, (2, 3)), None);
        let bytes = std::fs::read(&file).unwrap();
        for length in [0, 10, bytes.len() / 2, bytes.len() - 20] {
            std::fs::write(&file, &bytes[..length]).unwrap();
            assert_eq!(boxes(&file, (3, 2)), None, "{length} of {} bytes", bytes.len());
        }
        std::fs::write(&file, "no picture").unwrap();
        assert_eq!(boxes(&file, (3, 2)), None);
        // A picture of others is no mask of ours.
        let mut other = Vec::new();
        let mut writer = png::Encoder::new(&mut other, 3, 2).write_header().unwrap();
        assert!(writer.write_image_data(&[0; 18]).is_ok() || writer.write_image_data(&[0; 6]).is_ok());
        writer.finish().unwrap();
        std::fs::write(&file, other).unwrap();
        assert_eq!(boxes(&file, (3, 2)), None);
    }

    #[test]
    fn names_tell_prompts_and_pictures_apart() {
        let cache = Cache { folder: PathBuf::from("cache") };
        let picture = |value: u8, width| Picture::from_pixels(width, 6 / width, vec![[value; 3]; 6]);
        let file = cache.file("cam_1", &picture(0, 2));
        assert!(file.starts_with("cache") && file.to_string_lossy().contains("cam_1_"));
        assert_eq!(cache.file("cam_1", &picture(0, 2)), file);
        assert_ne!(cache.file("cam_1", &picture(1, 2)), file);
        assert_ne!(cache.file("cam_1", &picture(0, 3)), file, "the same pixels in other rows");
        assert_eq!(readable(" ../Steel jug?\n"), "___Steel_jug_");
        assert_eq!(readable(&"x".repeat(300)).len(), NAME);
    }
}
