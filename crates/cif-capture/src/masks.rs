//! Masks of ids: what moves is left out of the poses, and the capture keeps them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_dataset::masks::files_of_video;
use cif_dataset::{Turn, VideoFrame};
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
    /// The ids of an image at its size, where it has a mask.
    ///
    /// # Errors
    /// When the mask cannot be read or has another aspect than its image.
    pub fn ids(&self, shot: &Shot) -> Result<Option<PixelGrid<u16>>, Error> {
        let Some(path) = self.files.get(&shot.name) else { return Ok(None) };
        Ok(Some(cif_dataset::masks::read_ids_at(path, &shot.file, shot.size, Turn::upright(shot.turned))?))
    }

    /// The file of labels: in the folder of masks, else next to it, as captures have it.
    #[must_use]
    pub fn labels(&self) -> Option<PathBuf> {
        let parent = cif_output::folder_of(&self.folder);
        [&self.folder, &parent].iter().map(|folder| folder.join("instances.json")).find(|file| file.is_file())
    }
}

/// Finds the masks of images: `NAME.png` with or without the ending of the image, below the folder or, of one
/// camera, in it; or PNG files that are numbered as the frames of the video, one for each of them.
///
/// # Errors
/// When there is no such folder, or it holds no mask of any image.
pub fn find(folder: &Path, shots: &[Shot]) -> Result<Masks, Error> {
    let mut files = of_videos(folder, shots);
    let known: BTreeSet<&str> =
        shots.iter().filter(|shot| files.contains_key(&shot.name)).map(|shot| shot.camera.as_str()).collect();
    let others: Vec<&Shot> = shots.iter().filter(|shot| !known.contains(shot.camera.as_str())).collect();
    for shot in others {
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
            format!("masks are PNG files of ids, 0 for unlabelled, named as the images: {example}"),
        ));
    }
    Ok(Masks { folder: folder.to_owned(), files })
}

/// Masks of whole videos, in the folder where there is one camera, else in folders of their names.
fn of_videos(folder: &Path, shots: &[Shot]) -> BTreeMap<String, PathBuf> {
    let cameras: BTreeSet<&str> = shots.iter().map(|shot| shot.camera.as_str()).collect();
    let mut files = BTreeMap::new();
    for camera in &cameras {
        let below = folder.join(camera);
        let folder = if cameras.len() == 1 && !below.is_dir() { folder } else { &below };
        let taken: Vec<(&Shot, VideoFrame)> = shots
            .iter()
            .filter(|shot| shot.camera == *camera)
            .filter_map(|shot| Some((shot, shot.source.as_ref()?.video?)))
            .collect();
        let Some((_, first)) = taken.first() else { continue };
        let Some(of_video) = files_of_video(folder, &["png"], first.of) else { continue };
        files.extend(
            taken
                .iter()
                .filter_map(|(shot, place)| Some((shot.name.clone(), of_video.get(&place.frame)?.clone()))),
        );
    }
    files
}

/// Writes what pycolmap leaves out: black where a moving object is, of `moving` ids or of all but 0.
///
/// # Errors
/// When a mask cannot be read or has another aspect than its image, or little is left of most images.
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
        let Some(ids) = masks.ids(shot)? else { continue };
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
    use cif_dataset::FrameSource;

    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;

    /// Every other frame of a video of ten, at half its size.
    fn every_other() -> Vec<Shot> {
        (0..5_u64)
            .map(|k| Shot {
                camera: "walk".to_owned(),
                name: format!("{:06}.png", 2 * k),
                file: "none.png".into(),
                time: Some(k as f64),
                size: (32, 24),
                turned: cif_dataset::orientation::Orientation::NoTransforms,
                impression: Impression::of(&board(50, 0)),
                source: Some(FrameSource {
                    file: "walk.mp4".to_owned(),
                    size: [64, 48],
                    video: Some(VideoFrame { frame: 2 * k, of: 10, time: k as f64 }),
                }),
            })
            .collect()
    }

    #[test]
    fn masks_of_the_whole_video_are_those_of_its_frames() {
        let folder = tempfile::tempdir().unwrap();
        let shots = every_other();
        // Six digits as the frames have, but counted from 1: names alone would be those of neighbours.
        for k in 1..=10_u8 {
            let mask = image::GrayImage::from_fn(64, 48, |x, _| image::Luma([if x < 32 { k } else { 0 }]));
            mask.save(folder.path().join(format!("{k:06}.png"))).unwrap();
        }
        let masks = find(folder.path(), &shots).unwrap();
        for (k, shot) in shots.iter().enumerate() {
            let ids = masks.ids(shot).unwrap().unwrap();
            assert_eq!((ids.width, ids.height), (32, 24));
            let id = 2 * k as u16 + 1;
            assert!((0..32).all(|x| ids.pixels[x] == if x < 16 { id } else { 0 }), "{}", shot.name);
        }
        // Without one of them it is not known which frames they are, and names count.
        std::fs::remove_file(folder.path().join("000010.png")).unwrap();
        let masks = find(folder.path(), &shots).unwrap();
        assert_eq!(masks.ids(&shots[1]).unwrap().unwrap().pixels[0], 2);
    }

    #[test]
    fn masks_of_another_aspect_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        image::GrayImage::new(24, 32).save(folder.path().join("000002.png")).unwrap();
        let shots = every_other();
        let masks = find(folder.path(), &shots).unwrap();
        let message = masks.ids(&shots[1]).unwrap_err().to_string();
        assert!(message.contains("24 x 32") && message.contains("32 x 24"), "{message}");
    }

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
