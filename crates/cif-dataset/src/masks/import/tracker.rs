//! Pictures with a value or a colour per object: DEVA and other video trackers.
//!
//! Grey and palette PNG files hold ids as they are. In colour PNG files every colour is an object, black none; ids are
//! given by the frame in which a colour is seen first, then by its red, green and blue. DEVA lists categories in
//! `pred.json`, where a colour is the id R + 256 G + 65536 B.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use cif_geometry::PixelGrid;
use png::ColorType;
use rayon::prelude::*;
use serde::Deserialize;

use super::files_below::files_below;
use super::picture::{Content, Listing, Picture, Place, Table};
use crate::Error;
use crate::files::{json, mask};

/// A table of more colours than this is none.
const MAX_COLORS: usize = 4096;

/// Objects by pixel.
pub(super) fn decode(path: &Path, table: &Table) -> Result<PixelGrid<Option<usize>>, Error> {
    Ok(match table {
        Table::Values(objects) => mask::decode(path)?.map(|value| objects.get(value).copied()),
        Table::Colors(objects) => mask::decode_colors(path)?.map(|color| objects.get(color).copied()),
    })
}

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let annotations = source.join("Annotations");
    let folder = if annotations.is_dir() { &annotations } else { source };
    let files = files_below(folder, &["png"])?;
    let Some(first) = files.values().next() else { return Ok(Listing::default()) };
    let colored = |path: &PathBuf| Ok(matches!(mask::color_type(path)?, ColorType::Rgb | ColorType::Rgba));
    let in_colors = colored(first)?;
    for path in files.values() {
        if colored(path)? != in_colors {
            return Err(Error::invalid(
                path,
                format!(
                    "this picture is {} and {} is not; export all of them in one way",
                    if in_colors { "grey or a palette" } else { "in colours" },
                    first.display()
                ),
            ));
        }
    }
    let predictions = Predictions::read(source)?;
    let mut listing = Listing::default();
    let table = if in_colors {
        colors(&files, &predictions, &mut listing)?
    } else {
        values(&files, &predictions, &mut listing)?
    };
    let table = Arc::new(table);
    let picture = |(name, path): (String, PathBuf)| Picture {
        name,
        place: Place::file(&path),
        size: None,
        content: Content::Values(path, Arc::clone(&table)),
    };
    listing.pictures = files.into_iter().map(picture).collect();
    Ok(listing)
}

/// True where some picture shows several objects by its values or colours.
///
/// # Errors
/// When one cannot be read.
pub(super) fn has_several<'a>(mut files: impl Iterator<Item = &'a PathBuf>) -> Result<bool, Error> {
    let several = |path: &PathBuf| -> Result<bool, Error> {
        if matches!(mask::color_type(path)?, ColorType::Rgb | ColorType::Rgba) {
            return Ok(colors_of(path)?.keys().filter(|color| **color != [0; 3]).count() > 1);
        }
        let picture = mask::decode(path)?;
        let mut shown = picture.pixels.iter().filter(|value| **value != 0);
        let first = shown.next();
        Ok(shown.any(|value| Some(value) != first))
    };
    files.try_fold(false, |found, path| Ok(found || several(path)?))
}

/// Ids of grey and palette pictures, which stay.
fn values(
    files: &BTreeMap<String, PathBuf>,
    predictions: &Predictions,
    listing: &mut Listing,
) -> Result<Table, Error> {
    let found: Vec<Result<BTreeSet<u16>, Error>> = files
        .par_iter()
        .map(|(_, path)| Ok(mask::decode(path)?.pixels.chunk_by(|a, b| a == b).map(|run| run[0]).collect()))
        .collect();
    let mut all = BTreeSet::new();
    for found in found {
        all.extend(found?);
    }
    let mut objects = BTreeMap::new();
    for id in all.into_iter().filter(|id| *id != 0) {
        let category = predictions.category(u64::from(id));
        let entered = listing.objects.enter_id(id, category.as_deref());
        objects.insert(id, entered.map_err(|problem| predictions.error(problem))?);
    }
    Ok(Table::Values(objects))
}

/// Facts about a colour in a picture.
#[derive(Clone, Copy, Default)]
struct Seen {
    /// It fills a square of 2 x 2 pixels somewhere.
    solid: bool,
}

/// The colour table of all pictures.
fn colors(
    files: &BTreeMap<String, PathBuf>,
    predictions: &Predictions,
    listing: &mut Listing,
) -> Result<Table, Error> {
    let found: Vec<Result<BTreeMap<[u8; 3], Seen>, Error>> =
        files.par_iter().map(|(_, path)| colors_of(path)).collect();
    let mut all: BTreeMap<[u8; 3], Seen> = BTreeMap::new();
    let mut order = Vec::new();
    for (found, path) in found.into_iter().zip(files.values()) {
        for (color, seen) in found? {
            all.entry(color)
                .or_insert_with(|| {
                    order.push(color);
                    Seen::default()
                })
                .solid |= seen.solid;
        }
        if all.len() > MAX_COLORS {
            return Err(blended(path, &format!("{} colours up to this picture", all.len())));
        }
    }
    // Blends of two colours lie along edges: they are many, and fill no square.
    let thin = all.values().filter(|seen| !seen.solid).count();
    if thin > (all.len() - thin).max(3) {
        let first = files.values().next().map_or(Path::new(""), PathBuf::as_path);
        return Err(blended(
            first,
            &format!("{thin} of {} colours are nowhere 2 x 2 pixels large", all.len()),
        ));
    }
    if thin > 0 {
        listing.notes.push(format!("{thin} colours are nowhere 2 x 2 pixels large: are edges blended?"));
    }
    let mut objects = BTreeMap::new();
    let mut ids_of_colors = Vec::new();
    for color in order.into_iter().filter(|color| *color != [0; 3]) {
        let [r, g, b] = color;
        let name = format!("#{r:02x}{g:02x}{b:02x}");
        let id = u64::from(r) + 256 * u64::from(g) + 65_536 * u64::from(b);
        let category = predictions.category(id);
        let object = listing
            .objects
            .enter(&name, category.as_deref())
            .map_err(|problem| predictions.error(problem))?;
        objects.insert(color, object);
        ids_of_colors.push(format!("{name} is {}", object + 1));
        if category.is_none() {
            listing.objects.name(object, &crate::instances::default_label(object as u16 + 1));
        }
    }
    listing.notes.push(format!("colours as ids: {}", ids_of_colors.join(", ")));
    Ok(Table::Colors(objects))
}

fn colors_of(path: &Path) -> Result<BTreeMap<[u8; 3], Seen>, Error> {
    let picture = mask::decode_colors(path)?;
    let width = picture.width as usize;
    let mut found: BTreeMap<[u8; 3], Seen> = BTreeMap::new();
    for (y, row) in picture.pixels.chunks_exact(width.max(1)).enumerate() {
        let above = y.checked_sub(1).map(|y| &picture.pixels[y * width..(y + 1) * width]);
        let mut x = 0;
        for run in row.chunk_by(|a, b| a == b) {
            let square = |above: &[[u8; 3]]| {
                above[x..x + run.len()].windows(2).any(|pair| pair[0] == run[0] && pair[1] == run[0])
            };
            found.entry(run[0]).or_default().solid |= above.is_some_and(square);
            x += run.len();
        }
        if found.len() > MAX_COLORS {
            return Err(blended(path, &format!("more than {MAX_COLORS} colours")));
        }
    }
    Ok(found)
}

fn blended(path: &Path, problem: &str) -> Error {
    Error::mask(
        path,
        format!(
            "{problem}: its colours are blended along edges or by lossy compression, and no longer stand for objects; \
             export it again as PNG without antialiasing, resized with nearest neighbour"
        ),
    )
}

/// `pred.json` of DEVA.
#[derive(Default)]
struct Predictions {
    path: PathBuf,
    categories: BTreeMap<u64, String>,
}

#[derive(Deserialize)]
struct PredictionFile {
    annotations: Vec<FramePrediction>,
    #[serde(default)]
    categories: Vec<Category>,
}

#[derive(Deserialize)]
struct FramePrediction {
    segments_info: Vec<Segment>,
}

#[derive(Deserialize)]
struct Segment {
    id: u64,
    #[serde(default)]
    category_id: Option<i64>,
}

#[derive(Deserialize)]
struct Category {
    id: i64,
    name: String,
}

impl Predictions {
    fn read(source: &Path) -> Result<Self, Error> {
        let inside = [source.join("pred.json"), source.with_file_name("pred.json")];
        let is_annotations = source.file_name().is_some_and(|name| name == "Annotations");
        let known = inside.iter().take(if is_annotations { 2 } else { 1 });
        let Some(path) = known.into_iter().find(|path| path.is_file()) else { return Ok(Self::default()) };
        let file: PredictionFile = json::read(path)?;
        let names: BTreeMap<i64, String> =
            file.categories.into_iter().map(|category| (category.id, category.name)).collect();
        let mut categories = BTreeMap::new();
        for segment in file.annotations.into_iter().flat_map(|frame| frame.segments_info) {
            // Without a list, the number is that of a prompt, which the file does not keep.
            if let Some(name) = segment.category_id.and_then(|id| names.get(&id)) {
                categories.entry(segment.id).or_insert_with(|| name.clone());
            }
        }
        Ok(Self { path: path.clone(), categories })
    }

    fn category(&self, id: u64) -> Option<String> {
        self.categories.get(&id).cloned()
    }

    fn error(&self, problem: String) -> Error {
        Error::invalid(&self.path, problem)
    }
}
