//! Points that images with known poses see. One moment of a rig gives few: most are seen by two cameras alone,
//! which mappers leave out because they have no poses yet to check them by. With poses, two views fix a place as
//! well as more, and other moments show what people or things hid. Poses of other tools, and captures that are trained
//! on as they are, may come without any.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_dataset::orientation::Orientation;
use cif_dataset::{Dataset, Frame};
use cif_geometry::PinholeCamera;
use rayon::prelude::*;

use super::features::Features;
use super::pairs::{Order, pairs};
use super::python::{Group, Job, KnownPose, run};
use super::request::{Lenses, Request};
use super::stage::Staged;
use crate::frames::Shot;
use crate::picture::Photograph;
use crate::poses::{Lens, Point, Pose, Poses, spread};
use crate::{Error, Hooks, Impression};

/// Moments of the rig that are looked at; each adds about as many points, and takes as long, as the first.
const MOMENTS: usize = 4;

/// Images of a rig that are looked at at least, as far as it has moments, so that small rigs have enough of them.
const IMAGES_OF_RIG: usize = 60;

/// Most images that are looked at of cameras that take one at a time, spread evenly: their matches take half a minute.
const IMAGES_OF_WALK: usize = 150;

/// Each such image is matched with these of the others, from the one with the most similar view on: near ones show the
/// same from nearly the same place, far ones fix its distance.
const NEIGHBOURS: [usize; 7] = [1, 2, 3, 5, 8, 13, 21];

/// Images that have to see a point where they are of different times: by two alone, what has moved can look as if it lay
/// elsewhere.
const SEEN_AT_TIMES: usize = 3;

/// Lens of COLMAP that holds those of other tools: focal lengths, principal point, k1, k2, p1, p2.
const KNOWN_LENS: &str = "OPENCV";

/// Points of images of a rig, by poses that are known and stay as they are; `request.order` and `request.masks`
/// do not count, because the images of a moment are matched each with each and what moves stands still in them.
///
/// # Errors
/// When pycolmap is missing or fails, or the caller stops.
pub fn points_of_rig(request: &Request<'_>, poses: &Poses, hooks: &Hooks<'_>) -> Result<Vec<Point>, Error> {
    let (shots, pairs) = moments(request.shots, poses, MOMENTS);
    points(&Request { shots: &shots, masks: None, ..*request }, poses, &pairs, 2, hooks)
}

/// Points of the training images of a capture, by the poses that it has, in its world. Cameras that take three or more
/// images at a time are taken as a rig, and as cameras that walk otherwise: of these, points are what three images of
/// whatever times agree on, which is what stands still. `work` is a folder for files, and may be removed afterwards.
///
/// # Errors
/// When pycolmap is missing or fails, an image cannot be read, or the caller stops.
pub fn points_of_capture(
    dataset: &Dataset,
    work: &Path,
    threads: usize,
    hooks: &Hooks<'_>,
) -> Result<Vec<Point>, Error> {
    let train = dataset.train_frames();
    let is_rig = dataset.is_rig();
    let count = if is_rig { train.len() } else { train.len().min(IMAGES_OF_WALK) };
    let frames: Vec<usize> = (0..count).map(|k| train[k * train.len() / count.max(1)]).collect();
    let (shots, poses) = known(dataset, &frames, work)?;
    let kept = work.join("kept");
    std::fs::create_dir_all(&kept).map_err(Error::io("create", &kept))?;
    let request = Request {
        shots: &shots,
        masks: None,
        order: Order::Any,
        lenses: Lenses::PerCamera,
        focal_px: None,
        moving: true,
        work,
        kept: &kept,
        threads,
    };
    if is_rig {
        let (shots, pairs) =
            moments(&shots, &poses, MOMENTS.max(IMAGES_OF_RIG.div_ceil(dataset.images_at_once())));
        return points(&Request { shots: &shots, ..request }, &poses, &pairs, 2, hooks);
    }
    let cameras: Vec<PinholeCamera> = frames.iter().map(|index| dataset.frames[*index].camera).collect();
    points(&request, &poses, &neighbours(&cameras), SEEN_AT_TIMES, hooks)
}

/// The image of a frame as COLMAP is to read it, which knows no EXIF, and its size: turned ones are written below `work`.
fn image_of(frame: &Frame, index: usize, work: &Path) -> Result<(PathBuf, (u32, u32)), Error> {
    if frame.turn.image == Orientation::NoTransforms {
        return Ok((frame.image.clone(), Photograph::size(&frame.image)?));
    }
    let folder = work.join("upright");
    std::fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
    let ending = frame.image.extension().unwrap_or_default();
    let file = folder.join(index.to_string()).with_extension(ending);
    let photograph = Photograph::read(&frame.image)?;
    photograph.write(&file)?;
    Ok((file, (photograph.image.width(), photograph.image.height())))
}

/// Frames of a capture as images with poses, by the names of the frames.
fn known(dataset: &Dataset, frames: &[usize], work: &Path) -> Result<(Vec<Shot>, Poses), Error> {
    let mut poses = Poses::default();
    let mut shots = Vec::with_capacity(frames.len());
    let images: Vec<(PathBuf, (u32, u32))> = frames
        .par_iter()
        .map(|index| image_of(&dataset.frames[*index], *index, work))
        .collect::<Result<_, _>>()?;
    for (index, (file, size)) in frames.iter().zip(images) {
        let frame = &dataset.frames[*index];
        let lens = Lens {
            size: (frame.camera.width, frame.camera.height),
            focal_px: frame.camera.focal_px.to_array(),
            principal_px: frame.camera.principal_px.to_array(),
            distortion: frame.lens,
        };
        let number = poses.lenses.iter().position(|other| *other == lens).unwrap_or_else(|| {
            poses.lenses.push(lens);
            poses.lenses.len() - 1
        });
        let world_from_camera = frame.camera.camera_from_world.inverse();
        poses.images.insert(frame.name.clone(), Pose { lens: number, world_from_camera, points: 0 });
        shots.push(Shot {
            camera: frame.camera_name.clone(),
            name: frame.name.clone(),
            file,
            time: Some(frame.time),
            size,
            turned: frame.turn.image,
            impression: Impression::unknown(),
            source: None,
        });
    }
    Ok((shots, poses))
}

/// Pairs of images that show the same, by where their cameras are and look: as far apart as their views differ, in
/// angles, and as they are away from each other, as a share of how far all of them spread.
fn neighbours(cameras: &[PinholeCamera]) -> Vec<(usize, usize)> {
    let centres: Vec<_> = cameras.iter().map(PinholeCamera::centre).collect();
    let spread = spread(&centres).max(f64::MIN_POSITIVE);
    let mut pairs = BTreeSet::new();
    for (a, camera) in cameras.iter().enumerate() {
        let apart = |b: usize| {
            camera.forward().angle_between(cameras[b].forward()) + centres[a].distance(centres[b]) / spread
        };
        let mut others: Vec<usize> = (0..cameras.len()).filter(|b| *b != a).collect();
        others.sort_by(|b, c| apart(*b).total_cmp(&apart(*c)));
        pairs.extend(
            NEIGHBOURS.iter().filter_map(|rank| others.get(rank - 1)).map(|b| (a.min(*b), a.max(*b))),
        );
    }
    pairs.into_iter().collect()
}

/// Points of images that follow each other as `request.order` says, by poses that are known and stay as they are.
/// Lenses are those of the poses.
///
/// # Errors
/// When pycolmap is missing or fails, or the caller stops.
pub fn points_of_images(
    request: &Request<'_>,
    poses: &Poses,
    hooks: &Hooks<'_>,
) -> Result<Vec<Point>, Error> {
    let mut shots = request.shots.to_vec();
    shots.retain(|shot| poses.images.contains_key(&shot.name));
    let cameras: Vec<&str> = shots.iter().map(|shot| shot.camera.as_str()).collect();
    let pairs = pairs(&cameras, request.order);
    points(&Request { shots: &shots, ..*request }, poses, &pairs, 2, hooks)
}

/// Points that at least so many of the images see, which are matched in pairs; all have a pose.
fn points(
    request: &Request<'_>,
    poses: &Poses,
    pairs: &[(usize, usize)],
    least: usize,
    hooks: &Hooks<'_>,
) -> Result<Vec<Point>, Error> {
    let work = request.work.join("points");
    let request = &Request { work: &work, ..*request };
    let staged = Staged::new(request, &work)?;
    let largest = request.shots.iter().map(|shot| shot.size.0.max(shot.size.1)).max().unwrap_or(1);
    let lenses = lenses(request.shots, poses);
    let known = |(name, shot): (&String, &Shot)| {
        (name.clone(), KnownPose::of(&poses.images[&shot.name].world_from_camera))
    };
    // As many as there are: training starts from them.
    let job = Job {
        model: KNOWN_LENS,
        poses: Some(staged.names.iter().zip(request.shots).map(known).collect()),
        ..Job::of(request, &staged, pairs, &lenses, Features::all(largest))
    };
    let found = run(&job, hooks)?.points.into_iter();
    Ok(found.filter(|(_, images)| *images >= least).map(|(point, _)| point).collect())
}

/// Images by their lens and size.
fn lenses(shots: &[Shot], poses: &Poses) -> Vec<Group> {
    let mut groups: BTreeMap<(usize, (u32, u32)), Vec<usize>> = BTreeMap::new();
    for (index, shot) in shots.iter().enumerate() {
        groups.entry((poses.images[&shot.name].lens, shot.size)).or_default().push(index);
    }
    let group = |((lens, size), images): ((usize, (u32, u32)), Vec<usize>)| {
        let lens = poses.lenses[lens].scaled(size);
        let ([fx, fy], [cx, cy]) = (lens.focal_px, lens.principal_px);
        let ([k1, k2, ..], [p1, p2]) = (lens.distortion.radial, lens.distortion.tangential);
        Group { images, params: Some(vec![fx, fy, cx, cy, k1, k2, p1, p2]), size }
    };
    groups.into_iter().map(group).collect()
}

/// Images of some moments, spread evenly over the frames of the first camera, with a pose; and the pairs of
/// those that are of one moment. The image of another camera is the one nearest in time, without times the one
/// with the same number.
fn moments(shots: &[Shot], poses: &Poses, count: usize) -> (Vec<Shot>, Vec<(usize, usize)>) {
    let mut cameras: BTreeMap<&str, Vec<&Shot>> = BTreeMap::new();
    for shot in shots.iter().filter(|shot| poses.images.contains_key(&shot.name)) {
        cameras.entry(&shot.camera).or_default().push(shot);
    }
    let Some(first) = cameras.values().next().cloned() else { return Default::default() };
    let count = count.min(first.len());
    let mut chosen: Vec<Shot> = Vec::new();
    let mut pairs = Vec::new();
    for moment in 0..count {
        let number = moment * (first.len() - 1) / (count - 1).max(1);
        let time = first[number].time;
        let start = chosen.len();
        for frames in cameras.values() {
            let apart = |shot: &&&Shot| match (shot.time, time) {
                (Some(a), Some(b)) => (a - b).abs(),
                _ => f64::INFINITY,
            };
            let nearest = frames.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)));
            let shot = if time.is_some() { nearest } else { frames.get(number) };
            chosen.extend(shot.map(|shot| (*shot).clone()));
        }
        pairs.extend((start..chosen.len()).flat_map(|a| (a + 1..chosen.len()).map(move |b| (a, b))));
    }
    (chosen, pairs)
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;

    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;
    use crate::poses::{Lens, Pose};

    /// Frames of cameras at these times; all but those of camera `x` have a pose.
    fn rig(cameras: &[(&str, &[Option<f64>])]) -> (Vec<Shot>, Poses) {
        let mut poses = Poses { lenses: vec![Lens::small()], ..Poses::default() };
        let mut shots = Vec::new();
        for (camera, times) in cameras {
            for (k, time) in times.iter().enumerate() {
                let name = format!("{camera}/{k}.png");
                let pose = Pose { lens: 0, world_from_camera: RigidTransform::IDENTITY, points: 0 };
                if *camera != "x" {
                    poses.images.insert(name.clone(), pose);
                }
                shots.push(Shot {
                    camera: (*camera).to_owned(),
                    file: name.clone().into(),
                    name,
                    time: *time,
                    size: (64, 48),
                    turned: cif_dataset::orientation::Orientation::NoTransforms,
                    impression: Impression::of(&board(50, k)),
                    source: None,
                });
            }
        }
        (shots, poses)
    }

    #[test]
    fn images_of_one_moment_are_matched() {
        let times: Vec<Option<f64>> = (0..10).map(|k| Some(0.1 * f64::from(k))).collect();
        let half: Vec<Option<f64>> = (0..5).map(|k| Some(0.25 * f64::from(k))).collect();
        let (shots, poses) = rig(&[("a", &times), ("b", &half), ("x", &times)]);
        let (chosen, pairs) = moments(&shots, &poses, MOMENTS);
        let names: Vec<&str> = chosen.iter().map(|shot| shot.name.as_str()).collect();
        assert_eq!(
            names,
            ["a/0.png", "b/0.png", "a/3.png", "b/1.png", "a/6.png", "b/2.png", "a/9.png", "b/4.png"]
        );
        assert_eq!(pairs, [(0, 1), (2, 3), (4, 5), (6, 7)]);
        // Photographs of cameras, and a camera that has fewer.
        let (shots, poses) = rig(&[("a", &[None; 2]), ("b", &[None; 1]), ("c", &[None; 2])]);
        let (chosen, pairs) = moments(&shots, &poses, MOMENTS);
        let names: Vec<&str> = chosen.iter().map(|shot| shot.name.as_str()).collect();
        assert_eq!(names, ["a/0.png", "b/0.png", "c/0.png", "a/1.png", "c/1.png"]);
        assert_eq!(pairs, [(0, 1), (0, 2), (1, 2), (3, 4)]);
        assert!(moments(&shots, &Poses::default(), MOMENTS).0.is_empty());
    }

    #[test]
    fn images_are_matched_with_near_views_and_some_far_ones() {
        // Around a table, once.
        let camera = |k: usize| {
            let turn = glam::DMat3::from_rotation_y(std::f64::consts::TAU * k as f64 / 40.0);
            let world_from_camera =
                RigidTransform { rotation: turn, translation: turn * -3.0 * glam::DVec3::Z };
            PinholeCamera {
                width: 64,
                height: 48,
                focal_px: glam::DVec2::splat(60.0),
                principal_px: glam::DVec2::new(32.0, 24.0),
                camera_from_world: world_from_camera.inverse(),
            }
        };
        let cameras: Vec<PinholeCamera> = (0..40).map(camera).collect();
        let pairs = neighbours(&cameras);
        assert!(pairs.is_sorted() && pairs.iter().all(|(a, b)| a < b), "{pairs:?}");
        let steps = |a: usize, b: usize| (b - a).min(40 - (b - a));
        assert!((0..40).all(|k| pairs.contains(&(k.min((k + 1) % 40), k.max((k + 1) % 40)))), "the next one");
        assert!(pairs.iter().all(|(a, b)| steps(*a, *b) <= 11), "views of a quarter of the way at most");
        assert!(pairs.iter().any(|(a, b)| steps(*a, *b) > 8));
        assert!(pairs.len() <= 40 * NEIGHBOURS.len());
        assert!(neighbours(&cameras[..1]).is_empty());
    }
}
