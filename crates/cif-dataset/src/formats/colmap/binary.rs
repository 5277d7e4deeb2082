//! `cameras.bin`, `images.bin`, `points3D.bin` (little endian).
//!
//! Counts in the files are never trusted with memory: every read is checked against the bytes that are there.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use super::model::MODELS;
use super::reconstruction::{Camera, Image, Reconstruction};
use crate::Error;
use crate::files::listing;
use crate::files::points::RawPoints;

/// Reads the three files; points may be missing.
///
/// # Errors
/// When a file is missing or cut short.
pub(super) fn read(folder: &Path) -> Result<Reconstruction, Error> {
    let [cameras_path, images_path, points_path] =
        ["cameras.bin", "images.bin", "points3D.bin"].map(|name| folder.join(name));

    let bytes = load(&cameras_path)?;
    let mut cursor = Cursor { path: &cameras_path, bytes: &bytes };
    let mut cameras = BTreeMap::new();
    for _ in 0..cursor.u64()? {
        let id = cursor.u32()?;
        let model = cursor.u32()?;
        let size = [cursor.u64()? as f64, cursor.u64()? as f64];
        let &(name, count) = MODELS.get(model as usize).ok_or_else(|| {
            let problem = format!(
                "camera {id}: camera model number {model} is not supported; undistort the images with `colmap \
                 image_undistorter`"
            );
            Error::invalid(&cameras_path, problem)
        })?;
        let params = (0..count).map(|_| cursor.f64()).collect::<Result<_, _>>()?;
        cameras.insert(id, Camera { model: name.to_owned(), size, params });
    }

    let bytes = load(&images_path)?;
    let mut cursor = Cursor { path: &images_path, bytes: &bytes };
    let mut images = Vec::new();
    for _ in 0..cursor.u64()? {
        cursor.u32()?;
        let rotation = [cursor.f64()?, cursor.f64()?, cursor.f64()?, cursor.f64()?];
        let translation = [cursor.f64()?, cursor.f64()?, cursor.f64()?];
        let camera = cursor.u32()?;
        let name = cursor.text()?;
        let points = cursor.u64()?;
        cursor.skip(points, 24)?;
        images.push(Image { name, rotation, translation, camera });
    }

    let mut positions = Vec::new();
    let mut colors = Vec::new();
    if listing::is_there(&points_path) {
        let bytes = load(&points_path)?;
        let mut cursor = Cursor { path: &points_path, bytes: &bytes };
        for _ in 0..cursor.u64()? {
            cursor.u64()?;
            positions.push([cursor.f64()?, cursor.f64()?, cursor.f64()?]);
            colors.push(cursor.take::<3>()?);
            cursor.f64()?;
            let track = cursor.u64()?;
            cursor.skip(track, 8)?;
        }
    }
    let points = RawPoints { positions, colors: Some(colors), note: None };
    Ok(Reconstruction { cameras, cameras_path, images, images_path, points, points_path })
}

/// How many images a model says that it has.
///
/// # Errors
/// When its list of images is missing or cut short.
pub(super) fn count_images(folder: &Path) -> Result<u64, Error> {
    let path = folder.join("images.bin");
    let mut head = Vec::new();
    let file = cif_input::open(&path).map_err(Error::read(&path))?;
    file.take(8).read_to_end(&mut head).map_err(Error::read(&path))?;
    Cursor { path: &path, bytes: &head }.u64()
}

fn load(path: &Path) -> Result<Vec<u8>, Error> {
    if !listing::is_there(path) {
        return Err(Error::MissingFile {
            path: path.to_owned(),
            fix: "export the reconstruction from COLMAP (cameras, images, points3D)".to_owned(),
        });
    }
    cif_input::read(path).map_err(Error::read(path))
}

struct Cursor<'a> {
    path: &'a Path,
    bytes: &'a [u8],
}

impl Cursor<'_> {
    fn short(&self) -> Error {
        Error::invalid(self.path, "cut short, or no COLMAP file; export it again")
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let (head, rest) = self.bytes.split_first_chunk::<N>().ok_or_else(|| self.short())?;
        self.bytes = rest;
        Ok(*head)
    }

    fn u32(&mut self) -> Result<u32, Error> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, Error> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, Error> {
        self.take().map(f64::from_le_bytes)
    }

    fn text(&mut self) -> Result<String, Error> {
        let end = self.bytes.iter().position(|byte| *byte == 0).ok_or_else(|| self.short())?;
        let text = String::from_utf8_lossy(&self.bytes[..end]).into_owned();
        self.bytes = &self.bytes[end + 1..];
        Ok(text)
    }

    fn skip(&mut self, count: u64, size: u64) -> Result<(), Error> {
        let bytes = count.checked_mul(size).filter(|bytes| *bytes <= self.bytes.len() as u64);
        let bytes = bytes.ok_or_else(|| self.short())? as usize;
        self.bytes = &self.bytes[bytes..];
        Ok(())
    }
}
