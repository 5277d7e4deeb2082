//! Points that images with known poses see. One moment of a rig gives few: most are seen by two cameras alone,
//! which mappers leave out because they have no poses yet to check them by. With poses, two views tell a place as
//! well as more, and other moments show what people or things hid. Poses of other tools may come without any.

use std::collections::BTreeMap;

use super::features::Features;
use super::ladder::Request;
use super::pairs::pairs;
use super::python::{Group, Job, KnownPose, run};
use super::stage::Staged;
use crate::frames::Shot;
use crate::poses::{Point, Poses};
use crate::{Error, Hooks};

/// Moments of the rig that are looked at; each adds about as many points, and takes as long, as the first.
const MOMENTS: usize = 4;

/// Lens of COLMAP that holds those of other tools: focal lengths, principal point, k1, k2, p1, p2.
const KNOWN_LENS: &str = "OPENCV";

/// Points of images of a rig, by poses that are known and stay as they are; `request.order` and `request.masks`
/// do not count, because the images of a moment are matched each with each and what moves stands still in them.
///
/// # Errors
/// When pycolmap is missing or fails, or the caller stops.
pub fn points_of_rig(request: &Request<'_>, poses: &Poses, hooks: &Hooks<'_>) -> Result<Vec<Point>, Error> {
    let (shots, pairs) = moments(request.shots, poses);
    points(&Request { shots: &shots, masks: None, ..*request }, poses, &pairs, hooks)
}

/// Points of images that follow each other as `request.order` tells, by poses that are known and stay as they are.
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
    points(&Request { shots: &shots, ..*request }, poses, &pairs, hooks)
}

/// Points of images that are matched in pairs; all have a pose.
fn points(
    request: &Request<'_>,
    poses: &Poses,
    pairs: &[(usize, usize)],
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
    Ok(run(&job, hooks)?.points)
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
fn moments(shots: &[Shot], poses: &Poses) -> (Vec<Shot>, Vec<(usize, usize)>) {
    let mut cameras: BTreeMap<&str, Vec<&Shot>> = BTreeMap::new();
    for shot in shots.iter().filter(|shot| poses.images.contains_key(&shot.name)) {
        cameras.entry(&shot.camera).or_default().push(shot);
    }
    let Some(first) = cameras.values().next().cloned() else { return Default::default() };
    let count = MOMENTS.min(first.len());
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
        let (chosen, pairs) = moments(&shots, &poses);
        let names: Vec<&str> = chosen.iter().map(|shot| shot.name.as_str()).collect();
        assert_eq!(
            names,
            ["a/0.png", "b/0.png", "a/3.png", "b/1.png", "a/6.png", "b/2.png", "a/9.png", "b/4.png"]
        );
        assert_eq!(pairs, [(0, 1), (2, 3), (4, 5), (6, 7)]);
        // Photographs of cameras, and a camera that has fewer.
        let (shots, poses) = rig(&[("a", &[None; 2]), ("b", &[None; 1]), ("c", &[None; 2])]);
        let (chosen, pairs) = moments(&shots, &poses);
        let names: Vec<&str> = chosen.iter().map(|shot| shot.name.as_str()).collect();
        assert_eq!(names, ["a/0.png", "b/0.png", "c/0.png", "a/1.png", "c/1.png"]);
        assert_eq!(pairs, [(0, 1), (0, 2), (1, 2), (3, 4)]);
        assert!(moments(&shots, &Poses::default()).0.is_empty());
    }
}
