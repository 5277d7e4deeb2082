//! A small capture in the HyperNeRF layout: a chequered floor, a red ball that rolls, a blue ball that stands.
//! Images and masks are traced with one ray per pixel centre, so that both are exact.

use std::f64::consts::TAU;
use std::fs;
use std::io::Write;
use std::path::Path;

use glam::DVec3;
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::json;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

/// Image width, pixels.
pub const WIDTH: u32 = 40;
/// Image height, pixels.
pub const HEIGHT: u32 = 30;
/// Focal length, pixels.
const FOCAL: f64 = 42.0;
/// Mask value of the ball that rolls, labelled `red ball`.
pub const ROLLING: u16 = 3;
/// Mask value of the ball that stands, labelled `blue ball`.
pub const STANDING: u16 = 7;
/// Radius of both balls, metres.
const RADIUS: f64 = 0.22;

/// A folder with the capture in `table/`.
///
/// # Panics
/// When it cannot be written.
#[must_use]
pub fn in_folder(frames: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    write(&folder.path().join("table"), frames);
    folder
}

/// Centre of a ball at a normalised time, world, metres; z is up and the floor is z = 0.
#[must_use]
pub fn centre(id: u16, time: f64) -> DVec3 {
    if id == ROLLING { DVec3::new(-0.4 + 0.5 * time, -0.25, RADIUS) } else { DVec3::new(0.3, 0.2, RADIUS) }
}

/// Writes a capture with `frames` images, of which every fourth is held out.
///
/// # Panics
/// When the folder cannot be written.
pub fn write(folder: &Path, frames: usize) {
    for name in ["camera", "rgb/1x", "masks"] {
        fs::create_dir_all(folder.join(name)).expect("the folder can be made");
    }
    let ids: Vec<String> = (0..frames).map(|frame| format!("{frame:06}")).collect();
    let held_out = |frame: usize| frame % 4 == 2;
    let select = |val: bool| -> Vec<&String> {
        ids.iter().enumerate().filter(|(frame, _)| held_out(*frame) == val).map(|(_, id)| id).collect()
    };
    let mut metadata = serde_json::Map::new();
    for (frame, id) in ids.iter().enumerate() {
        let time = frame as f64 / (frames.max(2) - 1) as f64;
        let camera = Camera::orbit(time);
        save(folder, &format!("camera/{id}.json"), &camera.json());
        metadata.insert(
            id.clone(),
            json!({ "warp_id": frame, "appearance_id": frame, "camera_id": 0, "time_id": frame }),
        );
        let mut picture = RgbImage::new(WIDTH, HEIGHT);
        let mut mask = GrayImage::new(WIDTH, HEIGHT);
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                let (color, id) = trace(camera.position, camera.ray(x, y), time);
                picture.put_pixel(x, y, Rgb(color));
                mask.put_pixel(x, y, Luma([id as u8]));
            }
        }
        picture.save(folder.join(format!("rgb/1x/{id}.png"))).expect("the image can be written");
        mask.save(folder.join(format!("masks/{id}.png"))).expect("the mask can be written");
    }
    save(
        folder,
        "dataset.json",
        &json!({
            "count": frames, "num_exemplars": select(false).len(), "ids": ids,
            "train_ids": select(false), "val_ids": select(true),
        }),
    );
    save(folder, "metadata.json", &json!(metadata));
    save(folder, "scene.json", &json!({ "scale": 1.0, "center": [0.0, 0.0, 0.0], "near": 0.1, "far": 5.0 }));
    save(
        folder,
        "instances.json",
        &json!([
            { "id": ROLLING, "label": "red ball", "category": "ball", "taxonomies": { "wikidata_qcode": "Q18545" } },
            { "id": STANDING, "label": "blue ball", "category": "ball" },
        ]),
    );
    let points = points();
    let data: Vec<u8> = points.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    fs::write(folder.join("points.npy"), npy("<f4", &[points.len(), 3], &data))
        .expect("the points can be written");
}

/// Writes feature maps of the training frames of a capture of so many images, each pixel the code of its mask value.
///
/// # Panics
/// When the folder cannot be written, or a mask not be read.
pub fn write_maps(capture: &Path, frames: usize, maps: &Path, code: impl Fn(u8) -> [f32; 3]) {
    fs::create_dir_all(maps).expect("the folder can be made");
    for id in (0..frames).filter(|frame| frame % 4 != 2).map(|frame| format!("{frame:06}")) {
        let mask =
            image::open(capture.join(format!("masks/{id}.png"))).expect("the mask can be read").into_luma8();
        let data: Vec<u8> =
            mask.pixels().flat_map(|pixel| code(pixel.0[0])).flat_map(f32::to_le_bytes).collect();
        let shape = [mask.height() as usize, mask.width() as usize, 3];
        fs::write(maps.join(format!("{id}.npy")), npy("<f4", &shape, &data)).expect("the map can be written");
    }
}

/// Writes the known motion of a capture of so many images: `motion.json`, and `tracks.npz` with 16 points per ball.
///
/// # Panics
/// When the folder cannot be written.
pub fn write_motion(folder: &Path, frames: usize) {
    let times: Vec<f64> = (0..frames).map(|frame| frame as f64 / (frames.max(2) - 1) as f64).collect();
    let mut instances = serde_json::Map::new();
    let mut tracks = Vec::new();
    for (id, label, motion) in [(ROLLING, "red ball", "rigid"), (STANDING, "blue ball", "static")] {
        let centres: Vec<DVec3> = times.iter().map(|time| centre(id, *time)).collect();
        let matrix = |at: &DVec3| {
            json!([[1.0, 0.0, 0.0, at.x], [0.0, 1.0, 0.0, at.y], [0.0, 0.0, 1.0, at.z], [0.0, 0.0, 0.0, 1.0]])
        };
        let corner = |sign: f64| -> Vec<[f64; 3]> {
            centres.iter().map(|centre| (*centre + sign * RADIUS).to_array()).collect()
        };
        let entry = json!({
            "label": label, "motion": motion, "matrix": centres.iter().map(matrix).collect::<Vec<_>>(),
            "aabb_min": corner(-1.0), "aabb_max": corner(1.0),
        });
        instances.insert(id.to_string(), entry);
        for normal in sphere(16) {
            tracks.extend(centres.iter().map(|centre| (*centre + normal * RADIUS).as_vec3().to_array()));
        }
    }
    let steps: Vec<_> = times.iter().map(|time| json!({ "time": time })).collect();
    save(folder, "motion.json", &json!({ "frames": steps, "instances": instances }));
    let ids = [ROLLING, STANDING].map(|id| i64::from(id).to_le_bytes()).concat();
    let points: Vec<u8> = tracks.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let mut zip =
        ZipWriter::new(fs::File::create(folder.join("tracks.npz")).expect("the tracks can be made"));
    for (name, array) in
        [("ids.npy", npy("<i8", &[2], &ids)), ("points.npy", npy("<f4", &[2, 16, frames, 3], &points))]
    {
        zip.start_file(name, SimpleFileOptions::default()).expect("the tracks can be written");
        zip.write_all(&array).expect("the tracks can be written");
    }
    zip.finish().expect("the tracks can be written");
}

/// Rewrites a JSON file of a capture.
///
/// # Panics
/// When it is not there, or not JSON.
pub fn edit(path: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let text = fs::read_to_string(path).expect("the file is there");
    let mut value = serde_json::from_str(&text).expect("the file is JSON");
    change(&mut value);
    fs::write(path, value.to_string()).expect("the file can be written");
}

struct Camera {
    position: DVec3,
    right: DVec3,
    down: DVec3,
    forward: DVec3,
}

impl Camera {
    /// Half a turn around the scene, looking at its middle.
    fn orbit(time: f64) -> Self {
        let angle = TAU * (0.55 + 0.4 * time);
        let position = DVec3::new(1.6 * angle.cos(), 1.6 * angle.sin(), 1.1);
        let forward = (DVec3::new(0.0, 0.0, 0.1) - position).normalize();
        let right = forward.cross(DVec3::Z).normalize();
        Self { position, right, down: forward.cross(right), forward }
    }

    fn ray(&self, x: u32, y: u32) -> DVec3 {
        let x = (f64::from(x) + 0.5 - f64::from(WIDTH) / 2.0) / FOCAL;
        let y = (f64::from(y) + 0.5 - f64::from(HEIGHT) / 2.0) / FOCAL;
        (self.right * x + self.down * y + self.forward).normalize()
    }

    fn json(&self) -> serde_json::Value {
        json!({
            "orientation": [self.right.to_array(), self.down.to_array(), self.forward.to_array()],
            "position": self.position.to_array(),
            "focal_length": FOCAL,
            "principal_point": [f64::from(WIDTH) / 2.0, f64::from(HEIGHT) / 2.0],
            "skew": 0.0,
            "pixel_aspect_ratio": 1.0,
            "radial_distortion": [0.0, 0.0, 0.0],
            "tangential_distortion": [0.0, 0.0],
            "image_size": [WIDTH, HEIGHT],
        })
    }
}

/// Colour and mask value of what a ray meets first.
fn trace(origin: DVec3, direction: DVec3, time: f64) -> ([u8; 3], u16) {
    let floor = -origin.z / direction.z;
    let mut nearest = (if floor > 0.0 { floor } else { f64::INFINITY }, 0);
    for id in [ROLLING, STANDING] {
        let offset = origin - centre(id, time);
        let half = offset.dot(direction);
        let discriminant = half * half - offset.length_squared() + RADIUS * RADIUS;
        if discriminant > 0.0 {
            let distance = -half - discriminant.sqrt();
            if distance > 0.0 && distance < nearest.0 {
                nearest = (distance, id);
            }
        }
    }
    let (distance, id) = nearest;
    if !distance.is_finite() {
        return ([255; 3], 0);
    }
    let point = origin + direction * distance;
    if id == 0 {
        if point.x.abs() > 1.0 || point.y.abs() > 1.0 {
            return ([255; 3], 0);
        }
        let light = ((point.x * 3.0).floor() + (point.y * 3.0).floor()).rem_euclid(2.0) < 0.5;
        return (if light { [190, 180, 160] } else { [120, 115, 105] }, 0);
    }
    let normal = (point - centre(id, time)) / RADIUS;
    let shade = 0.55 + 0.45 * normal.dot(DVec3::new(0.3, -0.3, 0.9).normalize()).max(0.0);
    let base = if id == ROLLING { [230.0, 50.0, 40.0] } else { [40.0, 70.0, 220.0] };
    (base.map(|channel: f64| (channel * shade).round() as u8), id)
}

/// Points on the floor and on both balls at the first time.
fn points() -> Vec<[f32; 3]> {
    let mut points = Vec::new();
    for i in 0..20 {
        for j in 0..20 {
            points.push([-0.95 + 0.1 * i as f32, -0.95 + 0.1 * j as f32, 0.0]);
        }
    }
    for id in [ROLLING, STANDING] {
        points.extend(surface(id, 0.0, 120).iter().map(|point| point.as_vec3().to_array()));
    }
    points
}

/// Points on a ball at a normalised time, world, metres.
#[must_use]
pub fn surface(id: u16, time: f64, count: u32) -> Vec<DVec3> {
    sphere(count).map(|normal| centre(id, time) + normal * RADIUS).collect()
}

/// Unit vectors, spread evenly (Fibonacci sphere).
fn sphere(count: u32) -> impl Iterator<Item = DVec3> {
    (0..count).map(move |index| {
        let z = 1.0 - (2.0 * f64::from(index) + 1.0) / f64::from(count);
        let angle = TAU * 0.618_033_988_749_895 * f64::from(index);
        let ring = (1.0 - z * z).sqrt();
        DVec3::new(ring * angle.cos(), ring * angle.sin(), z)
    })
}

/// A version 1.0 NumPy file of these elements.
fn npy(descr: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let shape: String = shape.iter().map(|length| format!("{length}, ")).collect();
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

fn save(folder: &Path, name: &str, value: &serde_json::Value) {
    fs::write(folder.join(name), format!("{value:#}")).expect("the file can be written");
}
