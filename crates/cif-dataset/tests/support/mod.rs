//! Small captures of every layout, written into temporary folders.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    reason = "test helpers; each test file uses its own part"
)]

pub mod imports;

use std::fs;
use std::path::Path;

use cif_dataset::{Dataset, Error, OpenOptions};
use glam::{DMat3, DVec3};
use serde_json::{Value, json};
use tempfile::TempDir;

pub const WIDTH: u32 = 32;
pub const HEIGHT: u32 = 24;
pub const FOCAL: f64 = 40.0;

pub fn open(folder: &TempDir) -> Dataset {
    Dataset::open(folder.path(), &OpenOptions::default()).unwrap()
}

/// The message that opening the capture gives.
pub fn failure(folder: &TempDir) -> String {
    failure_with(folder, &OpenOptions::default())
}

pub fn failure_with(folder: &TempDir, options: &OpenOptions) -> String {
    let error: Error = Dataset::open(folder.path(), options).unwrap_err();
    error.to_string()
}

/// True when some warning holds all the words.
pub fn warns(dataset: &Dataset, words: &[&str]) -> bool {
    dataset.warnings.iter().any(|warning| words.iter().all(|word| warning.contains(word)))
}

/// True when some note holds all the words.
pub fn notes(dataset: &Dataset, words: &[&str]) -> bool {
    dataset.notes.iter().any(|note| words.iter().all(|word| note.contains(word)))
}

/// Asserts that a message holds all the words.
#[track_caller]
pub fn holds(message: &str, words: &[&str]) {
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

pub fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

pub fn write_json(path: &Path, value: &Value) {
    write(path, serde_json::to_string_pretty(value).unwrap());
}

pub fn edit_json(path: &Path, edit: impl FnOnce(&mut Value)) {
    let mut value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    edit(&mut value);
    write_json(path, &value);
}

pub fn write_rgb(path: &Path, width: u32, height: u32, color: impl Fn(u32, u32) -> [u8; 3]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb(color(x, y))).save(path).unwrap();
}

pub fn write_rgba(path: &Path, width: u32, height: u32, color: impl Fn(u32, u32) -> [u8; 4]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbaImage::from_fn(width, height, |x, y| image::Rgba(color(x, y))).save(path).unwrap();
}

/// A palette mask, 8 bit, whose palette colours differ from the indices.
pub fn write_mask(path: &Path, width: u32, height: u32, id: impl Fn(u32, u32) -> u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut encoder = png::Encoder::new(fs::File::create(path).unwrap(), width, height);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette((0..256).flat_map(|k| [255 - k as u8, 7, 9]).collect::<Vec<u8>>());
    let ids: Vec<u8> =
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| id(x, y)).collect();
    encoder.write_header().unwrap().write_image_data(&ids).unwrap();
}

/// A grey mask of one bit per pixel; widths of whole bytes.
pub fn write_bits(path: &Path, width: u32, height: u32, is_white: impl Fn(u32, u32) -> bool) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut encoder = png::Encoder::new(fs::File::create(path).unwrap(), width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::One);
    let byte = |x: u32, y: u32| (0..8).fold(0, |byte, bit| byte << 1 | u8::from(is_white(x + bit, y)));
    let bytes: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).step_by(8).map(move |x| (x, y)))
        .map(|(x, y)| byte(x, y))
        .collect();
    encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
}

/// A grey mask, 16 bit.
pub fn write_wide_mask(path: &Path, width: u32, height: u32, id: impl Fn(u32, u32) -> u16) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_fn(width, height, |x, y| image::Luma([id(x, y)]))
        .save(path)
        .unwrap();
}

/// A NumPy matrix of doubles.
pub fn npy(rows: usize, columns: usize, values: &[f64]) -> Vec<u8> {
    npy_of(&format!("({rows}, {columns})"), values)
}

/// A NumPy array of doubles; the shape as Python writes it.
pub fn npy_of(shape: &str, values: &[f64]) -> Vec<u8> {
    let mut header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// A NumPy archive with one array of doubles, stored.
pub fn npz(name: &str, shape: &str, values: &[f64]) -> Vec<u8> {
    use std::io::{Cursor, Write};
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    archive.start_file(format!("{name}.npy"), options).unwrap();
    archive.write_all(&npy_of(shape, values)).unwrap();
    archive.finish().unwrap().into_inner()
}

/// Camera `k` of a ring around the origin: axes right, down, forward as columns, and the centre.
pub fn ring_camera(k: usize) -> (DMat3, DVec3) {
    let angle = 0.3 * k as f64;
    let centre = DVec3::new(4.0 * angle.sin(), 0.5, -4.0 * angle.cos());
    let forward = (-centre).try_normalize().unwrap();
    let right = DVec3::Y.cross(forward).try_normalize().unwrap();
    (DMat3::from_cols(right, forward.cross(right), forward), centre)
}

/// Camera-to-world as OpenGL has it: x right, y up, z backward.
pub fn opengl_matrix(k: usize) -> Value {
    let (axes, centre) = ring_camera(k);
    let columns = [axes.x_axis, -axes.y_axis, -axes.z_axis, centre];
    let row = |r: usize| columns.map(|column| column[r]).to_vec();
    json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

pub fn shade(k: usize) -> impl Fn(u32, u32) -> [u8; 3] {
    move |x, y| [(x * 7) as u8, (y * 10) as u8, (k * 10) as u8]
}

pub fn nerfies_camera(k: usize) -> Value {
    let (axes, centre) = ring_camera(k);
    json!({
        "orientation": [axes.x_axis.to_array(), axes.y_axis.to_array(), axes.z_axis.to_array()],
        "position": centre.to_array(),
        "focal_length": FOCAL,
        "principal_point": [16.5, 11.0],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [WIDTH, HEIGHT],
    })
}

/// A HyperNeRF capture of `count` frames with masks of two instances; every third frame from the second on is
/// held out.
pub fn hypernerf(count: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let ids: Vec<String> = (0..count).map(|k| format!("{k:06}")).collect();
    let (mut metadata, mut train, mut val) = (json!({}), Vec::new(), Vec::new());
    for (k, id) in ids.iter().enumerate() {
        metadata[id] = json!({"warp_id": k, "appearance_id": k, "camera_id": 0, "time_id": k});
        if k % 3 == 1 {
            val.push(id)
        } else {
            train.push(id)
        }
        write_json(&root.join(format!("camera/{id}.json")), &nerfies_camera(k));
        write_rgb(&root.join(format!("rgb/1x/{id}.png")), WIDTH, HEIGHT, shade(k));
        write_mask(&root.join(format!("masks/{id}.png")), WIDTH, HEIGHT, |x, _| (x / 11) as u8);
    }
    write_json(&root.join("dataset.json"), &json!({"ids": ids, "train_ids": train, "val_ids": val}));
    write_json(&root.join("metadata.json"), &metadata);
    write_json(
        &root.join("scene.json"),
        &json!({"scale": 0.5, "center": [1.0, 2.0, 3.0], "near": 0.1, "far": 9.0}),
    );
    write_json(
        &root.join("instances.json"),
        &json!([{"id": 1, "label": "red mug", "category": "mug"}, {"id": 2, "label": "blue ball"}]),
    );
    write(&root.join("points.npy"), npy(2, 3, &[0.0, 0.0, 0.0, 0.1, 0.2, 0.3]));
    folder
}

/// DyCheck's capture of a phone that moves and one that stands: `hypernerf` with two cameras, lists and much more.
pub fn dycheck() -> TempDir {
    let folder = hypernerf(1);
    let root = folder.path();
    for name in ["masks", "camera", "rgb"] {
        fs::remove_dir_all(root.join(name)).unwrap();
    }
    let ids: Vec<String> =
        (0..2).flat_map(|camera| (0..6).map(move |time| format!("{camera}_{time:05}"))).collect();
    let mut metadata = json!({});
    for (k, id) in ids.iter().enumerate() {
        metadata[id] = json!({"warp_id": k % 6, "appearance_id": k % 6, "camera_id": k / 6});
        write_json(&root.join(format!("camera/{id}.json")), &nerfies_camera(if k < 6 { k } else { 9 }));
        for (factor, divisor) in [("1x", 1), ("2x", 2)] {
            write_rgb(
                &root.join(format!("rgb/{factor}/{id}.png")),
                WIDTH / divisor,
                HEIGHT / divisor,
                shade(k),
            );
        }
        write(&root.join(format!("depth/1x/{id}.npy")), npy(1, 1, &[1.0]));
        write_mask(&root.join(format!("covisible/2x/val/{id}.png")), WIDTH / 2, HEIGHT / 2, |_, _| 255);
    }
    let (train, val) = ids.split_at(6);
    write_json(&root.join("metadata.json"), &metadata);
    write_json(&root.join("dataset.json"), &json!({"ids": ids, "train_ids": ids, "val_ids": []}));
    for (name, frames, camera) in [("train", train, 0), ("val", &val[1..], 1)] {
        let (times, cameras) = (vec![0; frames.len()], vec![camera; frames.len()]);
        let list = json!({"frame_names": frames, "time_ids": times, "camera_ids": cameras});
        write_json(&root.join(format!("splits/{name}.json")), &list);
    }
    write_json(&root.join("extra.json"), &json!({"factor": 2, "fps": 30.0, "up": [0.0, 1.0, 0.0]}));
    fs::remove_file(root.join("instances.json")).unwrap();
    folder
}

/// A Neu3D capture with masks inside the camera folders.
pub fn neu3d(cameras: usize, steps: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    // At twice the size of the images.
    let poses = llff_poses(cameras, [2 * WIDTH, 2 * HEIGHT], 2.0 * FOCAL);
    for camera in 0..cameras {
        for step in 0..steps {
            let name = format!("{step:04}.png");
            let place = root.join(format!("cam{camera:02}"));
            write_rgb(&place.join("images").join(&name), WIDTH, HEIGHT, shade(step));
            write_mask(&place.join("masks").join(&name), WIDTH, HEIGHT, |x, _| (x / 11) as u8);
        }
    }
    write(&root.join("poses_bounds.npy"), npy(cameras, 17, &poses));
    folder
}

/// A capture of Dynamic 3D Gaussians of frames 10, 20, ...; camera 0 is held out and has no masks.
pub fn dynamic_gaussians(cameras: usize, steps: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let list = |cameras: std::ops::Range<usize>| {
        let mut meta = json!({"w": WIDTH, "h": HEIGHT, "k": [], "w2c": [], "fn": [], "cam_id": []});
        for step in 0..steps {
            let of = |entry: &dyn Fn(usize) -> Value| cameras.clone().map(entry).collect::<Vec<Value>>();
            // Row by row, world to camera, as OpenCV has it.
            let pose = |camera: usize| {
                let (axes, centre) = ring_camera(camera);
                let rotation = axes.transpose();
                let translation = -(rotation * centre);
                let row = |r: usize| {
                    json!([rotation.x_axis[r], rotation.y_axis[r], rotation.z_axis[r], translation[r]])
                };
                json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
            };
            let push = |meta: &mut Value, key: &str, entries: Vec<Value>| {
                meta[key].as_array_mut().unwrap().push(json!(entries));
            };
            push(&mut meta, "k", of(&|_| json!([[FOCAL, 0.0, 16.5], [0.0, FOCAL, 11.0], [0.0, 0.0, 1.0]])));
            push(&mut meta, "w2c", of(&pose));
            push(&mut meta, "fn", of(&|camera| json!(format!("{camera}/{:06}.jpg", 10 * (step + 1)))));
            push(&mut meta, "cam_id", of(&|camera| json!(camera)));
        }
        meta
    };
    write_json(&root.join("train_meta.json"), &list(1..cameras));
    write_json(&root.join("test_meta.json"), &list(0..1));
    for camera in 0..cameras {
        for step in 0..steps {
            let name = format!("{camera}/{:06}", 10 * (step + 1));
            write_rgb(&root.join(format!("ims/{name}.jpg")), WIDTH, HEIGHT, shade(step));
            if camera > 0 {
                write_mask(&root.join(format!("seg/{name}.png")), WIDTH, HEIGHT, |x, _| 255 * (x / 16) as u8);
            }
        }
    }
    folder
}

/// Rows of `poses_bounds.npy`: columns down, right, back, position, (H, W, f), and two depths.
pub fn llff_poses(count: usize, size: [u32; 2], focal: f64) -> Vec<f64> {
    let mut poses = Vec::new();
    for k in 0..count {
        let (axes, centre) = ring_camera(k);
        let size = DVec3::new(f64::from(size[1]), f64::from(size[0]), focal);
        let columns = [axes.y_axis, axes.x_axis, -axes.z_axis, centre, size];
        poses.extend((0..3).flat_map(|row| columns.map(|column| column[row])));
        poses.extend([0.1, 10.0]);
    }
    poses
}

/// A sequence of one moving camera with LLFF's poses, without masks or points.
pub fn llff(count: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    for k in 0..count {
        write_rgb(&root.join(format!("images/{k:05}.png")), WIDTH, HEIGHT, shade(k));
    }
    write(&root.join("poses_bounds.npy"), npy(count, 17, &llff_poses(count, [WIDTH, HEIGHT], FOCAL)));
    folder
}

/// A D-NeRF capture without masks or points.
pub fn dnerf(train: usize, test: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    for (split, count) in [("train", train), ("test", test)] {
        let frames: Vec<Value> = (0..count)
            .map(|k| {
                let color = shade(k);
                write_rgba(&root.join(format!("{split}/r_{k:03}.png")), WIDTH, HEIGHT, |x, y| {
                    let [r, g, b] = color(x, y);
                    [r, g, b, if x < WIDTH / 2 { 0 } else { 255 }]
                });
                json!({
                    "file_path": format!("./{split}/r_{k:03}"),
                    "time": 2.0 * k as f64 / (count.max(2) - 1) as f64,
                    "transform_matrix": opengl_matrix(k),
                })
            })
            .collect();
        let angle = 2.0 * (f64::from(WIDTH) / (2.0 * FOCAL)).atan();
        write_json(
            &root.join(format!("transforms_{split}.json")),
            &json!({"camera_angle_x": angle, "frames": frames}),
        );
    }
    folder
}

/// A nerfstudio capture without masks or points.
pub fn nerfstudio(count: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let frames: Vec<Value> = (0..count)
        .map(|k| {
            write_rgb(&root.join(format!("images/{k:04}.png")), WIDTH, HEIGHT, shade(k));
            json!({"file_path": format!("images/{k:04}.png"), "transform_matrix": opengl_matrix(k)})
        })
        .collect();
    write_json(
        &root.join("transforms.json"),
        &json!({
            "camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": FOCAL, "cx": 16.5, "cy": 11.0,
            "w": WIDTH, "h": HEIGHT, "frames": frames,
        }),
    );
    folder
}

/// Quaternion (w, x, y, z) and translation of camera `k`, world to camera.
pub fn colmap_pose(k: usize) -> ([f64; 4], [f64; 3]) {
    let (axes, centre) = ring_camera(k);
    let rotation = axes.transpose();
    let q = glam::DQuat::from_mat3(&rotation);
    ([q.w, q.x, q.y, q.z], (-(rotation * centre)).to_array())
}

/// A COLMAP capture in text form.
pub fn colmap_text(count: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write(
        &root.join("sparse/0/cameras.txt"),
        format!("# Camera list\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 16.5 11\n"),
    );
    let mut images = "# Image list\n".to_owned();
    for k in 0..count {
        let ([w, x, y, z], [tx, ty, tz]) = colmap_pose(k);
        images.push_str(&format!("{} {w} {x} {y} {z} {tx} {ty} {tz} 1 {k:04}.png\n", k + 1));
        // Images without 2D points have an empty line.
        images.push_str(if k % 2 == 0 { "\n" } else { "1.5 2.5 1 3.5 4.5 -1\n" });
        write_rgb(&root.join(format!("images/{k:04}.png")), WIDTH, HEIGHT, shade(k));
    }
    write(&root.join("sparse/0/images.txt"), images);
    write(
        &root.join("sparse/0/points3D.txt"),
        "# Points\n7 0.5 -0.25 1 10 20 30 0.1 1 0 2 0\n9 0 0 0 1 2 3 0.1\n",
    );
    folder
}

/// The same capture in binary form.
pub fn colmap_binary(count: usize) -> TempDir {
    let folder = colmap_text(count);
    let sparse = folder.path().join("sparse/0");
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        fs::remove_file(sparse.join(name)).unwrap();
    }
    let mut cameras = 1_u64.to_le_bytes().to_vec();
    cameras.extend(1_u32.to_le_bytes());
    cameras.extend(1_u32.to_le_bytes());
    cameras.extend(u64::from(WIDTH).to_le_bytes());
    cameras.extend(u64::from(HEIGHT).to_le_bytes());
    cameras.extend([FOCAL, FOCAL, 16.5, 11.0].iter().flat_map(|v| v.to_le_bytes()));
    write(&sparse.join("cameras.bin"), cameras);
    let mut images = (count as u64).to_le_bytes().to_vec();
    for k in 0..count {
        let (q, t) = colmap_pose(k);
        images.extend((k as u32 + 1).to_le_bytes());
        images.extend(q.iter().chain(&t).flat_map(|v| v.to_le_bytes()));
        images.extend(1_u32.to_le_bytes());
        images.extend(format!("{k:04}.png\0").as_bytes());
        images.extend(1_u64.to_le_bytes());
        images.extend([0; 24]);
    }
    write(&sparse.join("images.bin"), images);
    let mut points = 2_u64.to_le_bytes().to_vec();
    for (id, position, color) in [(7_u64, [0.5, -0.25, 1.0_f64], [10, 20, 30]), (9, [0.0; 3], [1, 2, 3])] {
        points.extend(id.to_le_bytes());
        points.extend(position.iter().flat_map(|v| v.to_le_bytes()));
        points.extend(color);
        points.extend(0.1_f64.to_le_bytes());
        points.extend(1_u64.to_le_bytes());
        points.extend([0; 8]);
    }
    write(&sparse.join("points3D.bin"), points);
    folder
}
