//! Frames and poses made before a capture was refused or interrupted, kept for the next try.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use cif_dataset::masks::NewFolder;

use crate::Error;
use crate::frames::{self, Shot};
use crate::poses::Poses;
use crate::source::Source;
use crate::write::{self, Capture};

/// Name of the table of times.
const TIMES: &str = "times.csv";

/// A folder with what was kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unfinished {
    /// The folder: `images/` with the frames of videos, `times.csv` and, with poses, `transforms.json` and
    /// points.
    pub place: PathBuf,
    /// The inputs of the next try: frames kept here instead of videos, photographs where they are.
    pub inputs: Vec<String>,
    /// Frames that were kept.
    pub frames: usize,
    /// Table of times, where all images have one.
    pub times: Option<PathBuf>,
    /// True where poses were kept, which [`crate::import::read`] takes from the folder.
    pub has_poses: bool,
}

/// Keeps frames of videos, their times, and poses, in `PLACE-unfinished`, or the first of `PLACE-unfinished-2`
/// and so on that is free; `None` where there is nothing to be kept. `poses` are those found so far, with where
/// they are from.
///
/// # Errors
/// When the file system refuses.
pub fn keep(
    sources: &[Source],
    shots: &[Shot],
    poses: Option<(&Poses, &str)>,
    place: &Path,
) -> Result<Option<Unfinished>, Error> {
    let is_video =
        |camera: &str| sources.iter().any(|source| source.camera == camera && source.photographs.is_none());
    let frames: Vec<&Shot> = shots.iter().filter(|shot| is_video(&shot.camera)).collect();
    if frames.is_empty() && poses.is_none() {
        return Ok(None);
    }
    let place = free(place);
    let folder = NewFolder::create(&place)?;
    for shot in &frames {
        write::copy(&shot.file, &write::inside(folder.path(), "images", &shot.name)?)?;
    }
    frames::remember(&folder.path().join("images"), &frames)?;
    let timed = shots.iter().all(|shot| shot.time.is_some());
    if timed {
        let mut text = String::new();
        for shot in shots {
            // Writing to memory does not fail.
            let _ = writeln!(text, "{},{}", shot.name, shot.time.unwrap_or_default());
        }
        let path = folder.path().join(TIMES);
        std::fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    if let Some((poses, poses_from)) = poses {
        let capture = Capture { shots, poses, masks: None, metres_known: false, up_known: false, poses_from };
        write::write_cameras(&capture, folder.path())?;
    }
    folder.finish()?;
    let input = |source: &Source| {
        let images = place.join("images");
        let path = match (&source.photographs, sources.len()) {
            (Some(_), _) => source.path.clone(),
            (None, 1) => images,
            (None, _) => images.join(&source.camera),
        };
        format!("{}={}", source.camera, path.display())
    };
    Ok(Some(Unfinished {
        inputs: sources.iter().map(input).collect(),
        frames: frames.len(),
        times: timed.then(|| place.join(TIMES)),
        has_poses: poses.is_some(),
        place,
    }))
}

/// A name next to `place` at which nothing is.
fn free(place: &Path) -> PathBuf {
    let numbered = |number: usize| {
        let mut name = place.as_os_str().to_owned();
        name.push("-unfinished");
        if number > 1 {
            name.push(format!("-{number}"));
        }
        PathBuf::from(name)
    };
    // Files of more tries than this would have been noticed; creating the folder then fails.
    (1..1000).map(numbered).find(|name| !name.exists()).unwrap_or_else(|| numbered(1000))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::{Choice, Notes};
    use crate::picture::Impression;
    use crate::picture::tests::board;
    use crate::poses::{Lens, Pose};
    use crate::{Hooks, import, source, times};
    use cif_dataset::{FrameSource, VideoFrame};
    use cif_geometry::RigidTransform;
    use glam::{DMat3, DVec3};

    /// Frames of two videos; the third of each has no pose.
    fn rig(folder: &Path) -> (Vec<Source>, Vec<Shot>, Poses) {
        let sources = ["left", "right"].map(|camera| Source {
            camera: camera.to_owned(),
            path: folder.join(format!("{camera}.mp4")),
            photographs: None,
        });
        let mut poses = Poses { lenses: vec![Lens::small()], ..Poses::default() };
        let mut shots = Vec::new();
        for (k, source) in sources.iter().enumerate() {
            for n in 0..3_u8 {
                let name = format!("{}/{n:06}.png", source.camera);
                let file = folder.join("scratch").join(&name);
                std::fs::create_dir_all(file.parent().unwrap()).unwrap();
                // Patterned, as frames are that are not left out.
                image::GrayImage::from_fn(64, 48, |x, y| image::Luma([(7 * x + 3 * y + u32::from(n)) as u8]))
                    .save(&file)
                    .unwrap();
                let translation = DVec3::new(k as f64, f64::from(n), 0.5);
                let world_from_camera = RigidTransform { rotation: DMat3::IDENTITY, translation };
                if n < 2 {
                    poses.images.insert(name.clone(), Pose { lens: 0, world_from_camera, points: 0 });
                }
                shots.push(Shot {
                    camera: source.camera.clone(),
                    name,
                    file,
                    time: Some(f64::from(n) / 3.0),
                    size: (64, 48),
                    turned: cif_dataset::orientation::Orientation::NoTransforms,
                    impression: Impression::of(&board(50, usize::from(n))),
                    source: Some(FrameSource {
                        file: format!("{}.mp4", source.camera),
                        size: [128, 96],
                        video: Some(VideoFrame { frame: u64::from(n), of: 3, time: f64::from(n) / 3.0 }),
                    }),
                });
            }
        }
        (sources.to_vec(), shots, poses)
    }

    #[test]
    fn the_next_try_finds_frames_times_and_poses() {
        let folder = tempfile::tempdir().unwrap();
        let (sources, shots, poses) = rig(folder.path());
        let place = folder.path().join("table");
        let kept = keep(&sources, &shots, Some((&poses, "a test")), &place).unwrap().unwrap();
        assert_eq!((kept.place, kept.frames), (folder.path().join("table-unfinished"), 6));
        let again = source::sources(&kept.inputs).unwrap();
        let (hooks, mut notes) = (Hooks::silent(), Notes::new());
        let mut found =
            frames::collect(&again, &Choice::default(), folder.path(), &hooks, &mut notes).unwrap();
        let table = kept.times.unwrap();
        times::apply(&times::read(&table).unwrap(), &table, &mut found).unwrap();
        let facts = |shot: &Shot| {
            (shot.name.clone(), shot.time, shot.source.clone(), std::fs::read(&shot.file).unwrap())
        };
        assert_eq!(found.iter().map(facts).collect::<Vec<_>>(), shots.iter().map(facts).collect::<Vec<_>>());
        let kept = folder.path().join("table-unfinished");
        let read = import::read(&kept, &found).unwrap().matched(&kept, &mut found).unwrap().poses;
        assert_eq!(read.images, poses.images);
    }

    #[test]
    fn nothing_is_overwritten_and_photographs_stay_where_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let (mut sources, shots, poses) = rig(folder.path());
        let place = folder.path().join("table");
        for name in ["table-unfinished", "table-unfinished-2"] {
            let kept = keep(&sources, &shots, None, &place).unwrap().unwrap();
            assert_eq!((kept.place, kept.has_poses), (folder.path().join(name), false));
        }
        sources.iter_mut().for_each(|source| source.photographs = Some(Vec::new()));
        assert_eq!(keep(&sources, &shots, None, &place).unwrap(), None);
        let kept = keep(&sources, &shots, Some((&poses, "a test")), &place).unwrap().unwrap();
        assert_eq!(kept.inputs[0], format!("left={}", folder.path().join("left.mp4").display()));
        assert!(!kept.place.join("images").exists());
    }
}
