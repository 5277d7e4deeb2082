//! PNG files.

use std::cell::RefCell;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use cif_geometry::PixelGrid;
use png::{BitDepth, ColorType, Compression, Encoder, StreamWriter};

use super::Picture;
use crate::error::Error;
use crate::output::NewFile;

/// Writes an 8-bit RGB PNG; missing folders on the way are made.
///
/// # Errors
/// When the file cannot be written.
pub fn save_rgb(path: &Path, picture: &Picture) -> Result<(), Error> {
    let mut file = PngFile::rgb(path, picture.width, picture.height)?;
    file.add_rgb(&picture.pixels)?;
    file.finish()
}

/// An 8-bit RGB PNG in memory.
///
/// # Errors
/// When the picture is empty.
pub fn png_bytes(picture: &Picture) -> Result<Vec<u8>, Error> {
    encoded(ColorType::Rgb, picture.width, picture.height, picture.pixels.as_flattened())
}

/// An 8-bit PNG of red, green, blue and alpha in memory.
///
/// # Errors
/// When the picture is empty.
pub fn png_bytes_rgba(picture: &PixelGrid<[u8; 4]>) -> Result<Vec<u8>, Error> {
    encoded(ColorType::Rgba, picture.width, picture.height, picture.pixels.as_flattened())
}

fn encoded(color: ColorType, width: u32, height: u32, values: &[u8]) -> Result<Vec<u8>, Error> {
    let failed = |error: png::EncodingError| Error::plain(format!("cannot encode a picture: {error}"));
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(values).and_then(|()| writer.finish()).map_err(failed)?;
    Ok(bytes)
}

/// Writes a 16-bit grey PNG; missing folders on the way are made.
///
/// # Errors
/// When the file cannot be written.
pub fn save_grey(path: &Path, values: &PixelGrid<u16>) -> Result<(), Error> {
    let mut file = PngFile::grey(path, values.width, values.height)?;
    file.add_grey(&values.pixels)?;
    file.finish()
}

/// A PNG file that takes pixels as they come and is written whole or not at all.
pub struct PngFile {
    path: PathBuf,
    file: NewFile,
    sink: Rc<RefCell<Sink>>,
    stream: StreamWriter<'static, SharedSink>,
}

impl PngFile {
    /// An 8-bit RGB file; missing folders on the way are made.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn rgb(path: &Path, width: u32, height: u32) -> Result<Self, Error> {
        Self::create(path, width, height, ColorType::Rgb, BitDepth::Eight)
    }

    /// A 16-bit grey file; missing folders on the way are made.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn grey(path: &Path, width: u32, height: u32) -> Result<Self, Error> {
        Self::create(path, width, height, ColorType::Grayscale, BitDepth::Sixteen)
    }

    fn create(
        path: &Path,
        width: u32,
        height: u32,
        color: ColorType,
        depth: BitDepth,
    ) -> Result<Self, Error> {
        /// Bytes of a chunk of compressed pixels.
        const CHUNK: usize = 1 << 16;
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
        }
        let file = NewFile::create(path)?;
        let written = file.file().try_clone().map_err(Error::io("write", path))?;
        let sink = Rc::new(RefCell::new(Sink { file: BufWriter::new(written), failure: None }));
        let mut encoder = Encoder::new(SharedSink(Rc::clone(&sink)), width, height);
        encoder.set_color(color);
        encoder.set_depth(depth);
        encoder.set_compression(Compression::Fast);
        encoder.set_filter(png::Filter::Adaptive);
        let stream = encoder.write_header().and_then(|writer| writer.into_stream_writer_with_size(CHUNK));
        let stream = stream.map_err(|error| encode(path, error))?;
        Ok(Self { path: path.to_owned(), file, sink, stream })
    }

    /// The next pixels of an RGB file, row by row.
    ///
    /// # Errors
    /// When they cannot be written, or are more than the file has.
    pub fn add_rgb(&mut self, pixels: &[[u8; 3]]) -> Result<(), Error> {
        self.stream.write_all(pixels.as_flattened()).map_err(Error::io("write", &self.path))
    }

    /// The next pixels of a grey file, row by row.
    ///
    /// # Errors
    /// When they cannot be written, or are more than the file has.
    pub fn add_grey(&mut self, values: &[u16]) -> Result<(), Error> {
        // Some at a time, so that their bytes take no memory to speak of.
        const AT_ONCE: usize = 1 << 14;
        for values in values.chunks(AT_ONCE) {
            let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_be_bytes()).collect();
            self.stream.write_all(&bytes).map_err(Error::io("write", &self.path))?;
        }
        Ok(())
    }

    /// Puts the file in its place.
    ///
    /// # Errors
    /// When pixels are missing, or the file system refuses.
    pub fn finish(self) -> Result<(), Error> {
        let Self { path, file, sink, stream } = self;
        stream.finish().map_err(|error| encode(&path, error))?;
        // The encoder writes its last bytes when it is dropped, where it has no way to say that they did not fit.
        let mut sink = sink.borrow_mut();
        let failure = sink.failure.take().map_or(Ok(()), |kind| Err(io::Error::from(kind)));
        failure.and_then(|()| sink.file.flush()).map_err(Error::io("write", &path))?;
        file.finish()
    }
}

fn encode(path: &Path, error: png::EncodingError) -> Error {
    match error {
        png::EncodingError::IoError(source) => Error::io("write", path)(source),
        error => Error::plain(format!("cannot encode {}: {error}", path.display())),
    }
}

/// Where bytes go, and why the first that were refused were.
struct Sink {
    file: BufWriter<File>,
    failure: Option<io::ErrorKind>,
}

/// The sink as the encoder holds it, which gives nothing back.
struct SharedSink(Rc<RefCell<Sink>>);

impl Sink {
    fn noting<T>(&mut self, result: io::Result<T>) -> io::Result<T> {
        if let Err(error) = &result {
            self.failure.get_or_insert(error.kind());
        }
        result
    }
}

impl Write for SharedSink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut sink = self.0.borrow_mut();
        let written = sink.file.write(bytes);
        sink.noting(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        let mut sink = self.0.borrow_mut();
        let flushed = sink.file.flush();
        sink.noting(flushed)
    }
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

    #[test]
    fn pixels_come_in_pieces() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let values = PixelGrid::from_pixels(300, 200, (0..60_000).map(|k| (k * 31) as u16).collect());
        let mut file = PngFile::grey(&path, 300, 200).unwrap();
        for rows in values.pixels.chunks(16 * 300) {
            file.add_grey(rows).unwrap();
            assert!(!path.exists());
        }
        file.finish().unwrap();
        assert_eq!(image::open(&path).unwrap().into_luma16().into_raw(), values.pixels);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    }

    #[test]
    fn a_file_that_lacks_pixels_is_not_put_in_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut file = PngFile::rgb(&path, 2, 2).unwrap();
        file.add_rgb(&[[1, 2, 3]; 2]).unwrap();
        assert!(file.finish().unwrap_err().to_string().contains("a.png"));
        let mut file = PngFile::rgb(&path, 2, 2).unwrap();
        file.add_rgb(&[[1, 2, 3]; 2]).unwrap();
        drop(file);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
