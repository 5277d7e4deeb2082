//! Masks of ids: what moves is left out of the poses, and the capture keeps them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use image::GrayImage;

use crate::frames::Shot;
use crate::{Error, Hooks};

/// Pixels by which what moves is widened before it is left out: features reach beyond their centre.
const WIDENED_PX: u32 = 3;

/// Where more than this share of an image is left out, there is little left to find its pose by.
const MOST: f64 = 0.85;

/// Masks of images by name.
#[derive(Clone, Debug, Default)]
pub struct Masks {
    /// Folder that was given.
    pub folder: PathBuf,
    /// Mask of an image.
    pub files: BTreeMap<String, PathBuf>,
}

impl Masks {
    /// The file of labels: in the folder of masks, else beside it, as captures have it.
    #[must_use]
    pub fn labels(&self) -> Option<PathBuf> {
        let beside = cif_output::folder_of(&self.folder);
        [&self.folder, &beside].iter().map(|folder| folder.join("instances.json")).find(|file| file.is_file())
    }
}

/// Finds the masks of images: `NAME.png` with or without the ending of the image, below the folder or, of one
/// camera, in it.
///
/// # Errors
/// When there is no such folder, or it holds no mask of any image.
pub fn find(folder: &Path, shots: &[Shot]) -> Result<Masks, Error> {
    let mut files = BTreeMap::new();
    for shot in shots {
        let stem = shot.name.rsplit_once('.').map_or(shot.name.as_str(), |(stem, _)| stem);
        // Alone, a camera has no folder; its masks may have one all the same.
        let candidates =
            [format!("{stem}.png"), format!("{}.png", shot.name), format!("{}/{stem}.png", shot.camera)];
        if let Some(found) = candidates.iter().map(|name| folder.join(name)).find(|path| path.is_file()) {
            files.insert(shot.name.clone(), found);
        }
    }
    if files.is_empty() {
        let example = shots.first().map_or("000000.png".to_owned(), |shot| {
            format!("{}.png", shot.name.rsplit_once('.').map_or(shot.name.as_str(), |(stem, _)| stem))
        });
        let problem = if folder.is_dir() {
            format!("{}: it holds no mask of any image", folder.display())
        } else {
            format!("{}: there is no such folder of masks", folder.display())
        };
        return Err(Error::refused(
            problem,
            format!("masks are PNG files of ids, 0 for what is not labelled, named as the images: {example}"),
        ));
    }
    Ok(Masks { folder: folder.to_owned(), files })
}

/// Writes what pycolmap leaves out: black where a moving object is, of `moving` ids or of all but 0.
///
/// # Errors
/// When a mask cannot be read or has another size than its image, or little is left of most images.
pub fn leave_out(
    masks: &Masks,
    shots: &[Shot],
    moving: Option<&BTreeSet<u16>>,
    into: &Path,
    hooks: &Hooks<'_>,
) -> Result<(), Error> {
    let mut covered = 0;
    for shot in shots {
        hooks.go_on()?;
        let Some(path) = masks.files.get(&shot.name) else { continue };
        let ids = cif_dataset::masks::read_ids(path)?;
        if (ids.width, ids.height) != shot.size {
            return Err(Error::refused(
                format!(
                    "{}: {} x {} pixels, but its image has {} x {}",
                    path.display(),
                    ids.width,
                    ids.height,
                    shot.size.0,
                    shot.size.1
                ),
                "paint masks on the images of the capture, at their size",
            ));
        }
        let left = left_over(&ids, moving);
        let black = left.pixels().filter(|pixel| pixel.0[0] == 0).count();
        covered += usize::from(black as f64 > MOST * ids.pixels.len() as f64);
        let file = into.join(format!("{}.png", shot.name));
        let parent = file.parent().unwrap_or(into).to_owned();
        std::fs::create_dir_all(&parent).map_err(Error::io("create", &parent))?;
        left.save(&file).map_err(|error| Error::io("write", &file)(std::io::Error::other(error)))?;
    }
    if 2 * covered > masks.files.len() {
        return Err(Error::refused(
            format!(
                "{}: the masks cover more than {:.0} % of most images, so that little is left to find poses by",
                masks.folder.display(),
                100.0 * MOST
            ),
            "name the ids of what moves by --moving-ids, as in --moving-ids 1,4",
        ));
    }
    Ok(())
}

/// White where an image shows what stands still.
fn left_over(ids: &PixelGrid<u16>, moving: Option<&BTreeSet<u16>>) -> GrayImage {
    let moves = |id: u16| moving.map_or(id != 0, |moving| moving.contains(&id));
    let mut image = GrayImage::from_pixel(ids.width, ids.height, image::Luma([255]));
    for y in 0..ids.height {
        for x in 0..ids.width {
            if !moves(ids.pixels[(y * ids.width + x) as usize]) {
                continue;
            }
            for v in y.saturating_sub(WIDENED_PX)..(y + WIDENED_PX + 1).min(ids.height) {
                for u in x.saturating_sub(WIDENED_PX)..(x + WIDENED_PX + 1).min(ids.width) {
                    image.put_pixel(u, v, image::Luma([0]));
                }
            }
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_moves_is_left_out_and_widened() {
        let mut ids = PixelGrid::filled(20, 16, 0_u16);
        ids.pixels[8 * 20 + 10] = 4;
        ids.pixels[8 * 20] = 7;
        let black = |moving: Option<&BTreeSet<u16>>| {
            let left = left_over(&ids, moving);
            left.enumerate_pixels()
                .filter(|(_, _, p)| p.0[0] == 0)
                .map(|(x, y, _)| (x, y))
                .collect::<Vec<_>>()
        };
        let only = black(Some(&BTreeSet::from([4])));
        assert_eq!(only.len(), 49);
        assert!(only.contains(&(7, 5)) && only.contains(&(13, 11)) && !only.contains(&(6, 8)));
        assert_eq!(black(None).len(), 49 + 28, "0 stands still, all other ids move");
    }
}
