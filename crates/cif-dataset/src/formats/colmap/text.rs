//! `cameras.txt`, `images.txt`, `points3D.txt`.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use super::reconstruction::{Camera, Image, Reconstruction};
use crate::Error;
use crate::files::listing;
use crate::files::points::RawPoints;

/// Reads the three files; points may be missing.
///
/// # Errors
/// When a file is missing or a line does not parse; the message names the line.
pub(super) fn read(folder: &Path) -> Result<Reconstruction, Error> {
    let [cameras_path, images_path, points_path] =
        ["cameras.txt", "images.txt", "points3D.txt"].map(|name| folder.join(name));
    let mut cameras = BTreeMap::new();
    for (number, line) in lines(&cameras_path)?.iter().filter(|(_, line)| !line.is_empty()) {
        let mut words = Words { path: &cameras_path, number: *number, words: line.split_whitespace() };
        let id: u32 = words.next("CAMERA_ID")?;
        let model: String = words.next("MODEL")?;
        let size = [words.next("WIDTH")?, words.next("HEIGHT")?];
        let params = words.rest("PARAMS")?;
        if cameras.insert(id, Camera { model, size, params }).is_some() {
            return Err(words.problem(&format!("camera {id} is listed twice")));
        }
    }
    let images = images(&images_path)?;
    let mut points = RawPoints { positions: Vec::new(), colors: Some(Vec::new()), note: None };
    if listing::is_there(&points_path) {
        for (number, line) in lines(&points_path)?.iter().filter(|(_, line)| !line.is_empty()) {
            let mut words = Words { path: &points_path, number: *number, words: line.split_whitespace() };
            let _: u64 = words.next("POINT3D_ID")?;
            points.positions.push([words.next("X")?, words.next("Y")?, words.next("Z")?]);
            let color = [words.next("R")?, words.next("G")?, words.next("B")?];
            if let Some(colors) = &mut points.colors {
                colors.push(color);
            }
        }
    }
    Ok(Reconstruction { cameras, cameras_path, images, images_path, points, points_path })
}

/// How many images a model has.
///
/// # Errors
/// As its list of images is missing or does not parse.
pub(super) fn count_images(folder: &Path) -> Result<u64, Error> {
    images(&folder.join("images.txt")).map(|images| images.len() as u64)
}

/// The rows of `images.txt`.
fn images(path: &Path) -> Result<Vec<Image>, Error> {
    let mut images = Vec::new();
    let rows = lines(path)?;
    let mut rows = rows.iter().skip_while(|(_, line)| line.is_empty()).peekable();
    while let Some((number, line)) = rows.next() {
        if line.is_empty() {
            continue;
        }
        let mut words = Words { path, number: *number, words: line.split_whitespace() };
        let _: u32 = words.next("IMAGE_ID")?;
        let rotation = [words.next("QW")?, words.next("QX")?, words.next("QY")?, words.next("QZ")?];
        let translation = [words.next("TX")?, words.next("TY")?, words.next("TZ")?];
        let camera = words.next("CAMERA_ID")?;
        let name = words.words.collect::<Vec<_>>().join(" ");
        if name.is_empty() {
            let words = Words { path, number: *number, words: "".split_whitespace() };
            return Err(words.problem("NAME is missing"));
        }
        images.push(Image { name, rotation, translation, camera });
        // The second line of an image holds its 2D points, and may be empty; people who write one by hand leave it out.
        rows.next_if(|(_, line)| are_points(line));
    }
    Ok(images)
}

/// True for a line of 2D points: threes of numbers (X, Y, POINT3D_ID), or nothing. The row of an image has ten words and
/// a name that is no number, or, with a number for a name, ten.
fn are_points(line: &str) -> bool {
    let words = line.split_whitespace();
    words.clone().count().is_multiple_of(3) && words.into_iter().all(|word| word.parse::<f64>().is_ok())
}

/// Lines without comments, with their numbers from 1; empty lines are kept.
fn lines(path: &Path) -> Result<Vec<(usize, String)>, Error> {
    if !listing::is_there(path) {
        return Err(Error::MissingFile {
            path: path.to_owned(),
            fix: "export the reconstruction from COLMAP (cameras, images, points3D)".to_owned(),
        });
    }
    let text = cif_input::read_to_string(path).map_err(Error::read(path))?;
    Ok(text
        .lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line.trim().to_owned()))
        .filter(|(_, line)| !line.starts_with('#'))
        .collect())
}

struct Words<'a, I> {
    path: &'a Path,
    number: usize,
    words: I,
}

impl<'a, I: Iterator<Item = &'a str>> Words<'a, I> {
    fn problem(&self, problem: &str) -> Error {
        Error::invalid(self.path, format!("line {}: {problem}", self.number))
    }

    fn next<T: FromStr>(&mut self, what: &str) -> Result<T, Error> {
        let word = self.words.next().ok_or_else(|| self.problem(&format!("{what} is missing")))?;
        word.parse().map_err(|_| self.problem(&format!("{what}: `{word}` is no such value")))
    }

    fn rest<T: FromStr>(&mut self, what: &str) -> Result<Vec<T>, Error> {
        let mut values = Vec::new();
        while let Some(word) = self.words.next() {
            values
                .push(word.parse().map_err(|_| self.problem(&format!("{what}: `{word}` is no such value")))?);
        }
        Ok(values)
    }
}
