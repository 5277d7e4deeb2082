//! The capture as a folder in nerfstudio's layout, which `cif train` and other tools take.

use std::fs;
use std::path::{Path, PathBuf};

use cif_dataset::Turn;
use cif_dataset::masks::{NewFolder, read_ids, read_ids_at, write_ids};
use cif_geometry::Bounds;
use cif_geometry::stats::upper_median;
use serde_json::{Map, Value, json};

use crate::frames::Shot;
use crate::masks::Masks;
use crate::poses::{Lens, Point, Pose, Poses};
use crate::{Error, Hooks};

/// Name of the file of points.
const POINTS: &str = "points3d.ply";

/// Everything that a capture holds.
pub struct Capture<'a> {
    /// Images; those without a pose are left out.
    pub shots: &'a [Shot],
    /// Poses, by name of the image.
    pub poses: &'a Poses,
    /// Masks of ids, to be kept next to the images.
    pub masks: Option<&'a Masks>,
    /// True where a unit of the poses is a metre.
    pub metres_known: bool,
    /// True where +z is known to be up.
    pub up_known: bool,
    /// How the poses came about, in words.
    pub poses_from: &'a str,
}

/// Copies images and masks and writes cameras and points; the folder appears when all of it is there.
///
/// # Errors
/// When something is at `place`, or the file system refuses.
pub fn write(capture: &Capture<'_>, place: &Path, hooks: &Hooks<'_>) -> Result<(), Error> {
    let folder = NewFolder::create(place)?;
    for shot in capture.shots.iter().filter(|shot| capture.poses.images.contains_key(&shot.name)) {
        hooks.go_on()?;
        copy(&shot.file, &inside(folder.path(), "images", &shot.name)?)?;
        let Some(masks) = capture.masks else { continue };
        let Some(mask) = masks.files.get(&shot.name) else { continue };
        let name = mask_name(&shot.name);
        write_mask(mask, shot, &inside(folder.path(), "masks", &name)?)?;
        let confidence = masks.folder.join("confidence").join(&name);
        if confidence.is_file() {
            write_mask(&confidence, shot, &inside(&folder.path().join("masks"), "confidence", &name)?)?;
        }
    }
    if let Some(labels) = capture.masks.and_then(Masks::labels) {
        copy(&labels, &folder.path().join("masks/instances.json"))?;
    }
    write_cameras(capture, folder.path())?;
    Ok(folder.finish()?)
}

/// Writes cameras and points, `transforms.json`, into a folder.
pub(crate) fn write_cameras(capture: &Capture<'_>, folder: &Path) -> Result<(), Error> {
    let mut frames = Vec::new();
    let one_lens = capture.poses.lenses.len() == 1;
    // All images have a time, or none.
    let timed = capture.shots.iter().all(|shot| shot.time.is_some());
    let start = capture.shots.iter().filter_map(|shot| shot.time).fold(f64::INFINITY, f64::min);
    for shot in capture.shots {
        let Some(pose) = capture.poses.images.get(&shot.name) else { continue };
        let mut frame = Map::new();
        frame.insert("file_path".to_owned(), json!(format!("images/{}", shot.name)));
        if let Some(time) = shot.time.filter(|_| timed) {
            // Microseconds: cameras that record together have equal times.
            frame.insert("time".to_owned(), json!(((time - start) * 1e6).round() / 1e6));
        }
        if capture.masks.is_some_and(|masks| masks.files.contains_key(&shot.name)) {
            frame.insert("mask_path".to_owned(), json!(format!("masks/{}", mask_name(&shot.name))));
        }
        if !one_lens {
            insert_lens(&mut frame, &capture.poses.lenses[pose.lens].scaled(shot.size));
        }
        if let Some(source) = &shot.source {
            frame.insert("cif".to_owned(), json!(source));
        }
        frame.insert("transform_matrix".to_owned(), matrix(pose));
        frames.push(Value::Object(frame));
    }
    let mut file = Map::new();
    file.insert("camera_model".to_owned(), json!("OPENCV"));
    if let (true, Some(shot)) = (one_lens, capture.shots.first()) {
        insert_lens(&mut file, &capture.poses.lenses[0].scaled(shot.size));
    }
    if let Some(rate) = frames_per_second(capture.shots).filter(|_| timed) {
        file.insert("fps".to_owned(), json!(rate));
    }
    if !capture.poses.points.is_empty() {
        file.insert("ply_file_path".to_owned(), json!(POINTS));
        let path = folder.join(POINTS);
        fs::write(&path, ply(&capture.poses.points)).map_err(Error::io("write", &path))?;
    }
    let known = json!({
        "metres_known": capture.metres_known,
        "up_known": capture.up_known,
        "poses_from": capture.poses_from,
    });
    file.insert("cif".to_owned(), known);
    file.insert("frames".to_owned(), json!(frames));
    let path = folder.join("transforms.json");
    let text = format!("{:#}\n", Value::Object(file));
    fs::write(&path, text).map_err(Error::io("write", &path))
}

/// Copies a mask, or its confidence, at the size of its image.
fn write_mask(from: &Path, shot: &Shot, to: &Path) -> Result<(), Error> {
    let stored = read_ids(from)?;
    if (stored.width, stored.height) == shot.size {
        return copy(from, to);
    }
    Ok(write_ids(to, &read_ids_at(from, &shot.file, shot.size, Turn::upright(shot.turned))?)?)
}

/// Name of the mask of an image.
fn mask_name(image: &str) -> String {
    format!("{}.png", image.rsplit_once('.').map_or(image, |(stem, _)| stem))
}

/// A file in a folder of the capture, whose folders are made.
pub(crate) fn inside(folder: &Path, kind: &str, name: &str) -> Result<PathBuf, Error> {
    let path = folder.join(kind).join(name);
    let parent = path.parent().unwrap_or(folder);
    fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
    Ok(path)
}

pub(crate) fn copy(from: &Path, to: &Path) -> Result<(), Error> {
    // Not a link: what is done to the capture must not change the original.
    fs::copy(from, to).map(drop).map_err(Error::io("copy", from))
}

/// Camera to world with x right, y up and z backwards.
fn matrix(pose: &Pose) -> Value {
    let (rotation, place) = (pose.world_from_camera.rotation, pose.world_from_camera.translation);
    let row = |k: usize| {
        let row = rotation.row(k);
        [row.x, -row.y, -row.z, place[k]]
    };
    json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

fn insert_lens(object: &mut Map<String, Value>, lens: &Lens) {
    let [k1, k2, k3, k4] = lens.distortion.radial;
    let [p1, p2] = lens.distortion.tangential;
    let values = [
        ("fl_x", lens.focal_px[0]),
        ("fl_y", lens.focal_px[1]),
        ("cx", lens.principal_px[0]),
        ("cy", lens.principal_px[1]),
        ("k1", k1),
        ("k2", k2),
        ("k3", k3),
        ("k4", k4),
        ("p1", p1),
        ("p2", p2),
    ];
    object.insert("w".to_owned(), json!(lens.size.0));
    object.insert("h".to_owned(), json!(lens.size.1));
    object.extend(values.map(|(name, value)| (name.to_owned(), json!(value))));
}

/// Frames per second of the images of a camera, by their median distance; `None` for fewer than two.
fn frames_per_second(shots: &[Shot]) -> Option<f64> {
    let mut distances: Vec<f64> = shots
        .windows(2)
        .filter(|pair| pair[0].camera == pair[1].camera)
        .filter_map(|pair| Some(pair[1].time? - pair[0].time?))
        .filter(|distance| *distance > 1e-9)
        .collect();
    let median = upper_median(&mut distances)?;
    Some((1e3 / median).round() / 1e3)
}

/// Distance from the origin, in sizes of the cloud, from which on floats are more than a hundred thousandth of that apart.
const FAR: f64 = 100.0;

/// Points as a binary PLY file, in double precision where they lie far from the origin, as those of surveyors do.
fn ply(points: &[Point]) -> Vec<u8> {
    let bounds = Bounds::around(points.iter().map(|point| point.position));
    let largest = bounds.low.abs().max(bounds.high.abs()).max_element();
    let is_far = largest > FAR * bounds.size().length();
    let kind = if is_far { "double" } else { "float" };
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty {kind} x\nproperty {kind} y\n\
         property {kind} z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for point in points {
        for value in point.position.to_array() {
            if is_far {
                bytes.extend(value.to_le_bytes());
            } else {
                bytes.extend((value as f32).to_le_bytes());
            }
        }
        bytes.extend(point.color);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use cif_dataset::{Dataset, FrameSource, OpenOptions, VideoFrame};
    use glam::DVec3;

    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;
    use crate::similarity::Similarity;
    use crate::similarity::tests::arc;

    /// Images and poses of an arc.
    fn shots(folder: &Path, count: usize, times: bool) -> Vec<Shot> {
        (0..count)
            .map(|k| {
                let name = format!("{k:03}.png");
                let file = folder.join(&name);
                image::RgbImage::from_pixel(64, 48, image::Rgb([k as u8, 90, 40])).save(&file).unwrap();
                Shot {
                    camera: "walk".to_owned(),
                    name,
                    file,
                    time: times.then_some(0.25 + 0.1 * k as f64),
                    size: (64, 48),
                    turned: cif_dataset::orientation::Orientation::NoTransforms,
                    impression: Impression::of(&board(50, k)),
                    source: Some(FrameSource {
                        file: "walk.mp4".to_owned(),
                        size: [128, 96],
                        video: Some(VideoFrame { frame: 3 * k as u64, of: 40, time: 0.1 * k as f64 }),
                    }),
                }
            })
            .collect()
    }

    #[test]
    fn a_capture_is_read_as_it_was_meant() {
        let folder = tempfile::tempdir().unwrap();
        let shots = shots(folder.path(), 12, true);
        let mut poses = arc(12);
        poses.points = vec![Point { position: DVec3::new(0.5, -0.25, 1.0), color: [1, 2, 3] }; 40];
        poses.images.remove("007.png");
        let masks = folder.path().join("painted");
        fs::create_dir_all(masks.join("confidence")).unwrap();
        fs::write(masks.join("instances.json"), r#"[{"id": 5, "label": "red mug"}]"#).unwrap();
        for name in ["002.png", "003.png"] {
            image::GrayImage::from_pixel(64, 48, image::Luma([5])).save(masks.join(name)).unwrap();
            image::GrayImage::from_pixel(64, 48, image::Luma([200]))
                .save(masks.join("confidence").join(name))
                .unwrap();
        }
        let masks = crate::masks::find(&masks, &shots).unwrap();
        let place = folder.path().join("capture");
        let capture = Capture {
            shots: &shots,
            poses: &poses,
            masks: Some(&masks),
            metres_known: false,
            up_known: true,
            poses_from: "a test",
        };
        write(&capture, &place, &Hooks::silent()).unwrap();
        let dataset = Dataset::open(&place, &OpenOptions::default()).unwrap();
        assert_eq!(dataset.frames.len(), 11, "one image has no pose");
        assert_eq!(dataset.times.len(), 11);
        assert_eq!(dataset.frames_per_second, Some(10.0));
        assert_eq!(dataset.points.positions.len(), 40);
        assert_eq!(dataset.points.positions[0], [0.5, -0.25, 1.0]);
        assert_eq!(dataset.points.colors[0], [1, 2, 3]);
        assert_eq!(dataset.instances.iter().map(|i| i.label.as_str()).collect::<Vec<_>>(), ["red mug"]);
        let masked: Vec<&str> =
            dataset.frames.iter().filter(|f| f.confidence.is_some()).map(|f| f.name.as_str()).collect();
        assert_eq!(masked.len(), 2, "{masked:?}");
        for frame in &dataset.frames {
            let name = format!("{}.png", frame.name.rsplit('/').next().unwrap());
            let shot = shots.iter().find(|shot| shot.name == name).unwrap();
            assert_eq!(frame.source, shot.source, "the recording is remembered");
            let pose = poses.images[&name].world_from_camera;
            let found = frame.camera.camera_from_world.inverse();
            assert!((found.translation - pose.translation).length() < 1e-9, "{name}");
            assert!((found.rotation - pose.rotation).to_cols_array().iter().all(|d| d.abs() < 1e-9));
            // Lenses were of images ten times as large.
            assert!((frame.camera.focal_px.x - 60.0).abs() < 1e-9, "{}", frame.camera.focal_px);
        }
        assert!(write(&capture, &place, &Hooks::silent()).unwrap_err().to_string().contains("already"));
        // Far from the origin nothing is lost.
        let far = DVec3::new(500_123.25, 4_649_776.5, 215.75);
        let mut moved = poses.clone();
        moved.transform(&Similarity { translation: far, ..Similarity::IDENTITY });
        moved.points.iter_mut().enumerate().for_each(|(k, p)| p.position.x += 0.001 * k as f64);
        let place = folder.path().join("far");
        write(&Capture { poses: &moved, ..capture }, &place, &Hooks::silent()).unwrap();
        let dataset = Dataset::open(&place, &OpenOptions::default()).unwrap();
        for (point, position) in moved.points.iter().zip(&dataset.points.positions) {
            let found = dataset.frame.capture_from_dataset(DVec3::from(position.map(f64::from)));
            assert!((found - point.position).length() < 1e-6, "{found} {point:?}");
        }
        // Images without times have none in the file.
        let mut untimed = shots.clone();
        untimed[3].time = None;
        let place = folder.path().join("static");
        write(&Capture { shots: &untimed, ..capture }, &place, &Hooks::silent()).unwrap();
        let dataset = Dataset::open(&place, &OpenOptions::default()).unwrap();
        assert_eq!(dataset.times, [0.0]);
    }
}
