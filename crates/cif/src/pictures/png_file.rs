//! PNG files.

use std::io::Cursor;
use std::path::Path;

use cif_geometry::PixelGrid;
use image::{ImageBuffer, ImageFormat, Luma, Rgb};

use super::Picture;
use crate::error::Error;

/// Writes an 8-bit RGB PNG; missing folders on the way are made.
///
/// # Errors
/// When the file cannot be written.
pub fn save_rgb(path: &Path, picture: &Picture) -> Result<(), Error> {
    let flat = picture.pixels.as_flattened().to_vec();
    let image: ImageBuffer<Rgb<u8>, _> = ImageBuffer::from_raw(picture.width, picture.height, flat)
        .expect("a pixel grid has width x height pixels");
    let mut bytes = Cursor::new(Vec::new());
    let encoded = image.write_to(&mut bytes, ImageFormat::Png);
    write(path, encoded, bytes.into_inner())
}

/// Writes a 16-bit grey PNG; missing folders on the way are made.
///
/// # Errors
/// When the file cannot be written.
pub fn save_grey(path: &Path, values: &PixelGrid<u16>) -> Result<(), Error> {
    let image: ImageBuffer<Luma<u16>, _> =
        ImageBuffer::from_raw(values.width, values.height, values.pixels.clone())
            .expect("a pixel grid has width x height pixels");
    let mut bytes = Cursor::new(Vec::new());
    let encoded = image.write_to(&mut bytes, ImageFormat::Png);
    write(path, encoded, bytes.into_inner())
}

fn write(path: &Path, encoded: Result<(), image::ImageError>, bytes: Vec<u8>) -> Result<(), Error> {
    encoded.map_err(|error| Error::plain(format!("cannot encode {}: {error}", path.display())))?;
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    }
    crate::output::write_file(path, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cam00/0001.png");
        let values = PixelGrid::from_pixels(2, 2, vec![0, 1, 300, 65_535]);
        save_grey(&path, &values).unwrap();
        let read = image::open(&path).unwrap();
        assert_eq!(read.color(), image::ColorType::L16);
        assert_eq!(read.into_luma16().into_raw(), values.pixels);

        save_rgb(&path, &Picture::from_pixels(1, 2, vec![[1, 2, 3], [4, 5, 6]])).unwrap();
        assert_eq!(image::open(&path).unwrap().into_rgb8().into_raw(), [1, 2, 3, 4, 5, 6]);
    }
}
