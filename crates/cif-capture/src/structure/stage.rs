//! Images and masks as pycolmap reads them: in folders of their own, under names that its lists can hold, which have
//! no spaces, and once more under names made of their content, by which features are kept.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use xxhash_rust::xxh3::{Xxh3, xxh3_128};

use super::request::Request;
use crate::Error;

/// Images that were put into place.
#[derive(Clone, Debug)]
pub(super) struct Staged {
    /// Folder of the images by [`Self::names`].
    pub(super) images: PathBuf,
    /// Folder of `NAME.png`, in which black is left out.
    pub(super) masks: Option<PathBuf>,
    /// Folder of the images by [`Self::keys`].
    pub(super) pictures: PathBuf,
    /// Names of the images in their order.
    pub(super) names: Vec<String>,
    /// The same images by names that are the same for the same content, whatever the capture.
    pub(super) keys: Vec<String>,
    /// Fingerprint of every mask; 0 without one.
    masks_content: Vec<u128>,
}

impl Staged {
    /// Puts the images and masks of a request below `work`.
    ///
    /// # Errors
    /// When the file system refuses.
    pub(super) fn new(request: &Request<'_>, work: &Path) -> Result<Self, Error> {
        let (images, masks, pictures) = (work.join("images"), work.join("masks"), work.join("pictures"));
        for folder in [&images, &masks, &pictures] {
            std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        }
        let content =
            |file: &Path| std::fs::read(file).map(|bytes| xxh3_128(&bytes)).map_err(Error::io("read", file));
        let mask_of = |name: &str| request.masks.map(|masks| masks.join(format!("{name}.png")));
        let read: Vec<(u128, Option<u128>)> = request
            .shots
            .par_iter()
            .map(|shot| {
                let mask = mask_of(&shot.name).filter(|mask| mask.is_file());
                Ok((content(&shot.file)?, mask.map(|mask| content(&mask)).transpose()?))
            })
            .collect::<Result<_, Error>>()?;
        let mut names = Vec::with_capacity(request.shots.len());
        let mut keys = Vec::with_capacity(request.shots.len());
        for (number, (shot, (image, mask))) in request.shots.iter().zip(&read).enumerate() {
            let ending = shot.file.extension().map(|ending| ending.to_string_lossy().to_lowercase());
            let ending = ending.as_deref().unwrap_or("png");
            let (name, key) = (format!("{number:06}.{ending}"), format!("{image:032x}.{ending}"));
            put(&shot.file, &images.join(&name))?;
            // Frames of videos may be alike.
            if !pictures.join(&key).exists() {
                put(&shot.file, &pictures.join(&key))?;
            }
            if let Some(file) = mask.and_then(|_| mask_of(&shot.name)) {
                put(&file, &masks.join(format!("{name}.png")))?;
            }
            names.push(name);
            keys.push(key);
        }
        let masks_content = read.into_iter().map(|(_, mask)| mask.unwrap_or(0)).collect();
        Ok(Self { images, masks: request.masks.map(|_| masks), pictures, names, keys, masks_content })
    }

    /// A name made of the images in their order, their masks, and `settings`.
    pub(super) fn fingerprint(&self, settings: &str) -> String {
        let mut hash = Xxh3::new();
        for (key, mask) in self.keys.iter().zip(&self.masks_content) {
            hash.update(key.as_bytes());
            hash.update(&mask.to_le_bytes());
        }
        hash.update(settings.as_bytes());
        format!("{:016x}", hash.digest())
    }
}

/// A second name of a file; a copy where the file system has no links.
fn put(from: &Path, to: &Path) -> Result<(), Error> {
    // The file behind a link: a link with a relative target leads nowhere from another folder.
    let link = std::fs::canonicalize(from).and_then(|file| std::fs::hard_link(file, to));
    link.or_else(|_| std::fs::copy(from, to).map(drop)).map_err(Error::io("copy", from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shot;
    use crate::picture::Impression;
    use crate::picture::tests::board;
    use crate::structure::{Lenses, Order};

    fn staged(folder: &Path, contents: &[(&str, &str, Option<&str>)], work: &str) -> Staged {
        let masks = folder.join("black");
        std::fs::create_dir_all(&masks).unwrap();
        let shots: Vec<Shot> = contents
            .iter()
            .map(|(name, content, mask)| {
                let file = folder.join(name);
                std::fs::write(&file, content).unwrap();
                let black = masks.join(format!("{name}.png"));
                let _ = std::fs::remove_file(&black);
                if let Some(mask) = mask {
                    std::fs::write(black, mask).unwrap();
                }
                Shot {
                    camera: "a".to_owned(),
                    name: (*name).to_owned(),
                    file,
                    time: None,
                    source: None,
                    size: (64, 48),
                    turned: cif_dataset::orientation::Orientation::NoTransforms,
                    impression: Impression::of(&board(50, 0)),
                }
            })
            .collect();
        let request = Request {
            shots: &shots,
            masks: Some(&masks),
            order: Order::Any,
            lenses: Lenses::PerSize,
            focal_px: None,
            moving: false,
            work: folder,
            kept: folder,
            threads: 1,
        };
        Staged::new(&request, &folder.join(work)).unwrap()
    }

    #[test]
    fn names_follow_content_and_not_files() {
        let folder = tempfile::tempdir().unwrap();
        let first =
            staged(folder.path(), &[("a b.PNG", "1", None), ("c.png", "2", None), ("d.png", "1", None)], "1");
        assert_eq!(first.names, ["000000.png", "000001.png", "000002.png"]);
        assert!(first.keys[0] == first.keys[2] && first.keys[0] != first.keys[1], "{:?}", first.keys);
        assert_eq!(std::fs::read_to_string(first.images.join("000001.png")).unwrap(), "2");
        assert_eq!(std::fs::read_to_string(first.pictures.join(&first.keys[2])).unwrap(), "1");
        let second = staged(folder.path(), &[("x.png", "2", None), ("y.png", "3", None)], "2");
        assert!(second.keys[0] == first.keys[1] && !first.keys.contains(&second.keys[1]));
    }

    #[test]
    fn fingerprints_know_order_masks_and_settings() {
        let folder = tempfile::tempdir().unwrap();
        let of = |contents: &[(&str, &str, Option<&str>)], work: &str, settings: &str| {
            staged(folder.path(), contents, work).fingerprint(settings)
        };
        let plain = of(&[("a.png", "1", None), ("b.png", "2", None)], "1", "s");
        assert_eq!(plain, of(&[("x.png", "1", None), ("y.png", "2", None)], "2", "s"));
        for other in [
            of(&[("b.png", "2", None), ("c.png", "1", None)], "3", "s"),
            of(&[("a.png", "1", Some("m")), ("b.png", "2", None)], "4", "s"),
            of(&[("a.png", "1", None), ("b.png", "2", None)], "5", "t"),
        ] {
            assert_ne!(plain, other);
        }
        let masked = of(&[("a.png", "1", Some("m")), ("b.png", "2", None)], "6", "s");
        assert_ne!(masked, of(&[("a.png", "1", Some("n")), ("b.png", "2", None)], "7", "s"));
        assert_ne!(masked, of(&[("a.png", "1", None), ("b.png", "2", Some("m"))], "8", "s"));
    }
}
