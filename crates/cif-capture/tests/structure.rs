//! Poses of rendered pictures, whose cameras are known; skipped where Python has no pycolmap.

use std::path::Path;
use std::process::Command;

use cif_capture::frames::{self, Choice, Notes, Shot};
use cif_capture::poses::{Lens, Point, Pose, Poses};
use cif_capture::source::sources;
use cif_capture::structure::{self, Found, Lenses, Order, Request};
use cif_capture::{Error, Hooks, Progress};
use cif_dataset::{Dataset, OpenOptions, PointSource};
use cif_geometry::{LensDistortion, RigidTransform};
use cif_system::environment;
use glam::{DMat3, DVec2, DVec3};

const WIDTH: u32 = 240;
const HEIGHT: u32 = 180;
const FOCAL: f64 = 220.0;

/// True where the Python that is taken has pycolmap.
fn has_pycolmap() -> bool {
    let python = environment::PYTHON.text().unwrap_or_else(|| "python3".to_owned());
    let found = Command::new(python).args(["-c", "import pycolmap"]).output();
    let found = found.is_ok_and(|output| output.status.success());
    if !found {
        eprintln!("skipped: there is no pycolmap; CIF_PYTHON names a Python that has it");
    }
    found
}

/// A number in [0, 1) for a cell of a grid.
fn noise(x: i64, y: i64, seed: i64) -> f64 {
    let mut hash =
        (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B) ^ seed.wrapping_mul(0xC2B2_AE35)) as u64;
    hash = (hash ^ (hash >> 15)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    hash = (hash ^ (hash >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    (hash >> 40) as f64 / (1_u64 << 24) as f64
}

/// Smooth noise of three sizes.
fn texture(place: DVec2, seed: i64) -> f64 {
    [4.0, 11.0, 29.0]
        .iter()
        .map(|frequency| {
            let p = place * *frequency;
            let (x, y) = (p.x.floor(), p.y.floor());
            let [u, v] = [p.x - x, p.y - y].map(|t| t * t * (3.0 - 2.0 * t));
            let at = |i: i64, j: i64| noise(x as i64 + i, y as i64 + j, seed);
            (at(0, 0) * (1.0 - u) + at(1, 0) * u) * (1.0 - v) + (at(0, 1) * (1.0 - u) + at(1, 1) * u) * v
        })
        .sum::<f64>()
        / 3.0
}

/// Brightness along a ray: a floor, two walls and a box on the floor.
fn trace(origin: DVec3, ray: DVec3) -> f64 {
    let mut nearest = (f64::INFINITY, 0.5);
    let mut plane = |axis: usize, at: f64, seed: i64, inside: &dyn Fn(DVec3) -> bool| {
        let distance = (at - origin[axis]) / ray[axis];
        let point = origin + ray * distance;
        if distance > 1e-6 && distance < nearest.0 && inside(point) {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            nearest = (distance, texture(DVec2::new(point[u], point[v]), seed));
        }
    };
    plane(2, 0.0, 1, &|_| true);
    plane(0, -2.0, 2, &|_| true);
    plane(1, -2.0, 3, &|_| true);
    let low = DVec3::new(-0.4, -0.3, 0.0);
    let high = DVec3::new(0.4, 0.3, 0.6);
    for axis in 0..3 {
        for (number, at) in [low[axis], high[axis]].into_iter().enumerate() {
            let seed = 10 + 2 * axis as i64 + number as i64;
            let inside = |point: DVec3| (0..3).all(|k| k == axis || (low[k]..=high[k]).contains(&point[k]));
            plane(axis, at, seed, &inside);
        }
    }
    nearest.1
}

/// Cameras on an arc that look at the box.
fn cameras(count: usize) -> Vec<RigidTransform> {
    (0..count)
        .map(|k| {
            let angle = 0.2 + 1.2 * k as f64 / count as f64;
            let place = DVec3::new(2.6 * angle.cos(), 2.6 * angle.sin(), 1.0 + 0.5 * (2.0 * angle).sin());
            let forward = (DVec3::new(0.0, 0.0, 0.25) - place).normalize();
            let right = forward.cross(DVec3::Z).normalize();
            let rotation = DMat3::from_cols(right, forward.cross(right), forward);
            RigidTransform { rotation, translation: place }
        })
        .collect()
}

/// Renders the views into a folder as photographs.
fn photographs(folder: &Path, cameras: &[RigidTransform]) {
    for (k, camera) in cameras.iter().enumerate() {
        let image = image::GrayImage::from_fn(WIDTH, HEIGHT, |x, y| {
            let sample = |dx: f64, dy: f64| {
                let plane = DVec3::new(
                    (f64::from(x) + dx - 0.5 * f64::from(WIDTH)) / FOCAL,
                    (f64::from(y) + dy - 0.5 * f64::from(HEIGHT)) / FOCAL,
                    1.0,
                );
                trace(camera.translation, camera.rotation * plane)
            };
            let offsets = [0.25, 0.75];
            let mean = offsets.iter().flat_map(|dx| offsets.map(|dy| sample(*dx, dy))).sum::<f64>() / 4.0;
            image::Luma([(255.0 * mean).clamp(0.0, 255.0) as u8])
        });
        image.save(folder.join(format!("{k:02}.png"))).expect("the folder takes pictures");
    }
}

fn shots(folder: &Path) -> Vec<Shot> {
    let inputs = [format!("walk={}", folder.display())];
    let mut notes = Notes::new();
    let sources = sources(&inputs).expect("a folder of photographs");
    frames::collect(&sources, &Choice::default(), folder, &Hooks::silent(), &mut notes).expect("photographs")
}

/// The images as they are, each matched with each, in folders that are made.
fn request<'a>(shots: &'a [Shot], work: &'a Path, kept: &'a Path) -> Request<'a> {
    for folder in [work, kept] {
        std::fs::create_dir_all(folder).expect("a new folder");
    }
    Request {
        shots,
        masks: None,
        order: Order::Any,
        lenses: Lenses::PerSize,
        focal_px: None,
        moving: false,
        work,
        kept,
        threads: 2,
    }
}

/// The cameras that rendered the pictures, without points.
fn true_poses(shots: &[Shot], cameras: &[RigidTransform]) -> Poses {
    let lens = Lens {
        size: (WIDTH, HEIGHT),
        focal_px: [FOCAL; 2],
        principal_px: [0.5 * f64::from(WIDTH), 0.5 * f64::from(HEIGHT)],
        distortion: LensDistortion::default(),
    };
    let pose = |(shot, camera): (&Shot, &RigidTransform)| {
        (shot.name.clone(), Pose { lens: 0, world_from_camera: *camera, points: 0 })
    };
    let images = shots.iter().zip(cameras).map(pose).collect();
    Poses { lenses: vec![lens], images, ..Poses::default() }
}

fn find(folder: &Path, shots: &[Shot], work: &str) -> Result<Found, Error> {
    let (work, kept) = (folder.join(work), folder.join(format!("{work}-kept")));
    let request = request(shots, &work, &kept);
    structure::find(&request, &Hooks::silent())
}

#[test]
fn cameras_of_rendered_pictures_are_found_twice_alike() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let cameras = cameras(14);
    photographs(folder.path(), &cameras);
    let shots = shots(folder.path());
    let found = find(folder.path(), &shots, "first").unwrap();
    assert!(found.verdict.is_good(), "{}", found.verdict);
    assert_eq!(found.poses.images.len(), 14);
    let focal = found.poses.lenses[0].focal_px[0];
    assert!((focal / FOCAL - 1.0).abs() < 0.05, "{focal}");
    let mut truth = found.poses.clone();
    for (pose, camera) in truth.images.values_mut().zip(&cameras) {
        pose.world_from_camera = *camera;
    }
    let difference = cif_capture::similarity::difference(&found.poses, &truth).unwrap();
    assert!(difference.places < 0.02 && difference.median_angle.to_degrees() < 1.0, "{difference:?}");
    let again = find(folder.path(), &shots, "second").unwrap();
    assert_eq!(again.poses, found.poses, "the same input gives the same poses");
}

#[test]
fn more_points_are_seen_where_poses_are_known() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let cameras = cameras(5);
    photographs(folder.path(), &cameras);
    // Each picture is a camera of its own, which took it at one moment.
    let mut shots = shots(folder.path());
    shots.iter_mut().for_each(|shot| shot.camera = shot.name.clone());
    let found = find(folder.path(), &shots, "moment").unwrap();
    let poses = true_poses(&shots, &cameras);
    let (work, kept) = (folder.path().join("points"), folder.path().join("points-kept"));
    let request = request(&shots, &work, &kept);
    let before = found.poses.points.len();
    for find in [structure::points_of_rig, structure::points_of_images] {
        // The lens is of images twice as large, as another tool may have seen them.
        let lens = poses.lenses[0].scaled((2 * WIDTH, 2 * HEIGHT));
        let poses = Poses { lenses: vec![lens], ..poses.clone() };
        let _ = std::fs::remove_dir_all(&work);
        let points = find(&request, &poses, &Hooks::silent()).unwrap();
        assert!(2 * points.len() > 3 * before, "{} after {before}", points.len());
        assert!(on_surfaces(&points));
    }
}

#[test]
fn captures_without_points_get_those_that_their_images_show() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let cameras = cameras(10);
    photographs(folder.path(), &cameras);
    let mut counts = Vec::new();
    // A camera that walks, and a rig at one moment.
    for is_rig in [false, true] {
        let mut shots = shots(folder.path());
        for (k, shot) in shots.iter_mut().enumerate() {
            shot.time = Some(if is_rig { 0.0 } else { k as f64 });
            if is_rig {
                (shot.camera, shot.name) = (format!("cam{k}"), format!("cam{k}/0.png"));
            }
        }
        let poses = true_poses(&shots, &cameras);
        let capture = cif_capture::write::Capture {
            shots: &shots,
            poses: &poses,
            masks: None,
            metres_known: true,
            up_known: true,
            poses_from: "the test",
        };
        let place = folder.path().join(format!("capture-{is_rig}"));
        cif_capture::write::write(&capture, &place, &Hooks::silent()).unwrap();
        let dataset = Dataset::open(&place, &OpenOptions::default()).unwrap();
        assert_eq!(dataset.points.source, PointSource::Random);
        assert_eq!(dataset.images_at_once() > 2, is_rig, "{}", dataset.images_at_once());
        let find = |work: &str| {
            let work = folder.path().join(format!("{work}-{is_rig}"));
            structure::points_of_capture(&dataset, &work, 2, &Hooks::silent()).unwrap()
        };
        let points = find("work");
        assert!(on_surfaces(&points) && points.len() > 100, "{}", points.len());
        assert_eq!(points, find("again"), "the same capture gives the same points");
        counts.push(points.len());
    }
    assert!(counts[1] > counts[0], "two images of one moment are enough: {counts:?}");
}

/// True where all but a twentieth of the points lie on the floor, a wall or the box.
fn on_surfaces(points: &[Point]) -> bool {
    let distance = |point: &Point| {
        let p = point.position;
        let outside = (p.abs() - DVec3::new(0.4, 0.3, 0.6)).max(DVec3::ZERO).length();
        p.z.abs().min((p.x + 2.0).abs()).min((p.y + 2.0).abs()).min(outside)
    };
    points.iter().filter(|point| distance(point) > 0.05).count() * 20 < points.len()
}

#[test]
fn a_later_run_goes_on_from_what_was_kept() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), &cameras(14));
    let shots = shots(folder.path());
    let (kept, fresh) = (folder.path().join("kept"), folder.path().join("fresh"));
    // Phases that were shown, with what was done when they began.
    let found = |shots: &[Shot], kept: &Path, work: &str, last: &str| {
        let work = folder.path().join(work);
        let shown = std::sync::Mutex::new(Vec::<(String, usize, usize)>::new());
        let progress = |progress: Progress<'_>| {
            let mut shown = shown.lock().unwrap();
            if let Some((done, total)) = progress.count
                && shown.last().is_none_or(|(words, ..)| words != progress.words)
            {
                shown.push((progress.words.to_owned(), done, total));
            }
        };
        let stop = || shown.lock().unwrap().iter().any(|(words, ..)| words.starts_with(last));
        let request = request(shots, &work, kept);
        let found = structure::find(&request, &Hooks { should_stop: &stop, progress: &progress });
        (found, shown.into_inner().unwrap())
    };
    let began = |shown: &[(String, usize, usize)], words: &str| {
        let phase = shown.iter().find(|(phase, ..)| phase.starts_with(words)).expect("a phase");
        (phase.1, phase.2)
    };
    // The first run ends where matches begin: it has found features only.
    let (stopped, shown) = found(&shots[..10], &kept, "1", "matches");
    assert!(matches!(stopped, Err(Error::Stopped)));
    assert_eq!(began(&shown, "features"), (0, 10));
    // The second one has more images; the third the same, and all of them are matched.
    let (second, shown) = found(&shots, &kept, "2", "nothing");
    assert_eq!(began(&shown, "features"), (10, 14));
    assert_eq!(began(&shown, "matches"), (0, 91));
    let (third, shown) = found(&shots, &kept, "3", "nothing");
    assert_eq!(began(&shown, "features"), (14, 14));
    assert_eq!(began(&shown, "matches"), (91, 91));
    // What was kept leaves no trace in the poses.
    let (anew, _) = found(&shots, &fresh, "4", "nothing");
    let anew = anew.unwrap().poses;
    assert!(second.unwrap().poses == anew && third.unwrap().poses == anew);
}

#[test]
fn a_camera_that_stands_still_is_refused_by_its_name() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let camera = cameras(1)[0];
    photographs(folder.path(), &[camera; 4]);
    // A lamp that is turned up: no two images are the same.
    for k in 0..4_u8 {
        let path = folder.path().join(format!("{k:02}.png"));
        let mut image = image::open(&path).unwrap().to_luma8();
        image.pixels_mut().for_each(|pixel| pixel.0[0] = pixel.0[0] / 2 + 20 * k);
        image.save(&path).unwrap();
    }
    let Err(Error::StandsStill { problem, fix }) = find(folder.path(), &shots(folder.path()), "work") else {
        panic!("poses of a camera that stands still")
    };
    assert!(problem.contains("walk: the camera stands still") && fix.contains("--moving"), "{problem} {fix}");
}

#[test]
fn poses_are_found_on_reduced_images_and_are_those_of_the_images() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let cameras = cameras(14);
    photographs(folder.path(), &cameras);
    // Eight times as large, more than features are looked for on.
    for k in 0..14 {
        let path = folder.path().join(format!("{k:02}.png"));
        let image = image::open(&path).unwrap();
        image.resize(8 * WIDTH, 8 * HEIGHT, image::imageops::FilterType::Triangle).save(&path).unwrap();
    }
    let found = find(folder.path(), &shots(folder.path()), "work").unwrap();
    assert!(found.verdict.is_good(), "{}", found.verdict);
    let lens = &found.poses.lenses[0];
    assert_eq!(lens.size, (8 * WIDTH, 8 * HEIGHT));
    assert!((lens.focal_px[0] / (8.0 * FOCAL) - 1.0).abs() < 0.05, "{lens:?}");
    let mut truth = found.poses.clone();
    for (pose, camera) in truth.images.values_mut().zip(&cameras) {
        pose.world_from_camera = *camera;
    }
    let difference = cif_capture::similarity::difference(&found.poses, &truth).unwrap();
    assert!(difference.places < 0.02 && difference.median_angle.to_degrees() < 1.0, "{difference:?}");
    // Colours are those of the pixels at which points are seen, not of those of the reduced image.
    let spread =
        found.poses.points.iter().map(|point| point.color[0]).collect::<std::collections::BTreeSet<_>>();
    assert!(spread.len() > 40, "{spread:?}");
}

#[test]
fn pictures_that_do_not_overlap_have_no_poses() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for k in 0..4_i64 {
        let image = image::GrayImage::from_fn(WIDTH, HEIGHT, |x, y| {
            let place = DVec2::new(f64::from(x), f64::from(y)) / 60.0;
            image::Luma([(255.0 * texture(place, 100 + k)) as u8])
        });
        image.save(folder.path().join(format!("{k}.png"))).unwrap();
    }
    let Err(Error::System(cif_system::Error::Refused { problem, fix })) =
        find(folder.path(), &shots(folder.path()), "work")
    else {
        panic!("poses of nothing")
    };
    assert!(problem.contains("do not overlap") && fix.contains("two thirds"), "{problem} {fix}");
    // Without any texture there are no features to begin with.
    for k in 0..4_u8 {
        let image = image::GrayImage::from_fn(WIDTH, HEIGHT, |x, _| image::Luma([(x / 2) as u8 + k]));
        image.save(folder.path().join(format!("{k}.png"))).unwrap();
    }
    let error = find(folder.path(), &shots(folder.path()), "plain").unwrap_err().to_string();
    assert!(error.contains("features in the median"), "{error}");
}

#[test]
fn work_ends_when_the_caller_stops() {
    if !has_pycolmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), &cameras(3));
    let shots = shots(folder.path());
    let (work, kept) = (folder.path().join("work"), folder.path().join("kept"));
    let request = Request { threads: 1, ..request(&shots, &work, &kept) };
    let hooks = Hooks { should_stop: &|| true, progress: &|_| () };
    assert!(matches!(structure::find(&request, &hooks), Err(Error::Stopped)));
}
