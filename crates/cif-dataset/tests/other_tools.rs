//! Conventions of cameras and of other tools.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod support;

use std::path::Path;

use cif_dataset::masks::Import;
use cif_dataset::orientation::Orientation;
use cif_dataset::{Dataset, OpenOptions, PointSource, foreign};
use glam::{DMat3, DQuat, DVec2, DVec3};
use image::codecs::jpeg::JpegEncoder;
use image::{ImageEncoder, Rgb, RgbImage};
use serde_json::json;
use support::*;
use tempfile::TempDir;

/// Orientations by which phones store pictures, of EXIF.
const TURNED: [u8; 4] = [3, 6, 8, 5];

/// Stores an image so that a program that knows EXIF shows it as `shown` is.
fn write_photograph(path: &Path, shown: &RgbImage, exif: u8) {
    let orientation = Orientation::from_exif(exif).unwrap();
    let back = match orientation {
        Orientation::Rotate90 => Orientation::Rotate270,
        Orientation::Rotate270 => Orientation::Rotate90,
        other => other,
    };
    let mut image = image::DynamicImage::ImageRgb8(shown.clone());
    image.apply_orientation(back);
    let mut encoder = JpegEncoder::new_with_quality(std::fs::File::create(path).unwrap(), 95);
    let mut facts = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    facts.extend([exif, 0, 0, 0, 0, 0, 0, 0]);
    encoder.set_exif_metadata(facts).unwrap();
    image.into_rgb8().write_with_encoder(encoder).unwrap();
}

/// Red above, green below left, blue below right.
fn upright() -> RgbImage {
    RgbImage::from_fn(WIDTH, HEIGHT, |x, y| match (y < HEIGHT / 2, x < WIDTH / 2) {
        (true, _) => Rgb([250, 0, 0]),
        (false, true) => Rgb([0, 250, 0]),
        (false, false) => Rgb([0, 0, 250]),
    })
}

fn shows(dataset: &Dataset, index: usize, colors: [(u32, u32, usize); 3]) {
    let image = dataset.load_image(index, [1.0; 3]).unwrap();
    for (x, y, channel) in colors {
        let pixel = image.at(x, y);
        assert!(pixel[channel] > 200 && pixel.iter().filter(|value| **value > 60).count() == 1, "{pixel:?}");
    }
}

const AS_SEEN: [(u32, u32, usize); 3] = [(16, 3, 0), (4, 20, 1), (28, 20, 2)];

/// Makes the images of a capture photographs of a phone.
fn photographs(folder: &TempDir, exif: u8) {
    for entry in std::fs::read_dir(folder.path().join("images")).unwrap() {
        let path = entry.unwrap().path();
        write_photograph(&path.with_extension("jpg"), &upright(), exif);
        std::fs::remove_file(path).unwrap();
    }
}

#[test]
fn photographs_and_masks_are_upright_where_cameras_are() {
    for exif in TURNED {
        let folder = nerfstudio(3);
        let root = folder.path();
        photographs(&folder, exif);
        edit_json(&root.join("transforms.json"), |value| {
            for k in 0..3 {
                value["frames"][k]["file_path"] = json!(format!("images/{k:04}.jpg"));
            }
        });
        write_mask(&root.join("masks/0000.png"), WIDTH, HEIGHT, |x, _| u8::from(x < WIDTH / 2));
        // Masks of the pixels as they are stored: the upper half of the image, wherever it lies.
        let is_turned = [6, 8, 5].contains(&exif);
        if is_turned {
            write_mask(&root.join("masks/0001.png"), HEIGHT, WIDTH, |x, _| {
                u8::from(if exif == 6 || exif == 5 { x < HEIGHT / 2 } else { x >= HEIGHT / 2 })
            });
        }
        let dataset = open(&folder);
        let frame = &dataset.frames[0];
        assert_eq!((frame.camera.width, frame.camera.height), (WIDTH, HEIGHT), "{exif}");
        assert_eq!(frame.camera.focal_px, DVec2::splat(FOCAL));
        shows(&dataset, 0, AS_SEEN);
        assert!(notes(&dataset, &["3 images are turned upright"]), "{:?}", dataset.notes);
        let mask = dataset.load_mask(0).unwrap().unwrap();
        assert_eq!((*mask.at(3, 20), *mask.at(28, 3)), (1, 0), "{exif}: masks of the upright image stay");
        if is_turned {
            let mask = dataset.load_mask(1).unwrap().unwrap();
            assert_eq!((*mask.at(16, 3), *mask.at(16, 20)), (1, 0), "{exif}");
        }
        assert!(!warns(&dataset, &["resized"]), "{:?}", dataset.warnings);
    }
}

#[test]
fn cameras_of_another_aspect_than_the_upright_photograph_are_refused_with_both_sizes() {
    let folder = nerfstudio(2);
    photographs(&folder, 6);
    edit_json(&folder.path().join("transforms.json"), |value| {
        (value["w"], value["h"]) = (json!(40), json!(40));
        for k in 0..2 {
            value["frames"][k]["file_path"] = json!(format!("images/{k:04}.jpg"));
        }
    });
    holds(&failure(&folder), &["40 x 40", "32 x 24", "aspect"]);
}

#[test]
fn colmap_reads_photographs_as_they_are_stored() {
    for (exif, size) in [(6, "24 32"), (3, "32 24")] {
        let folder = colmap_text(3);
        photographs(&folder, exif);
        let sparse = folder.path().join("sparse/0");
        let images = std::fs::read_to_string(sparse.join("images.txt")).unwrap().replace(".png", ".jpg");
        write(&sparse.join("images.txt"), images);
        write(&sparse.join("cameras.txt"), format!("1 SIMPLE_PINHOLE {size} 40 12 12\n"));
        let dataset = open(&folder);
        assert_eq!(dataset.frames[0].turn.image, Orientation::NoTransforms, "{exif}");
        let stored = if exif == 6 {
            [(3, 16, 0), (20, 28, 1), (20, 4, 2)]
        } else {
            [(16, 20, 0), (28, 3, 1), (4, 3, 2)]
        };
        shows(&dataset, 0, stored);
    }
    // A tool before it turned them.
    let folder = colmap_text(3);
    photographs(&folder, 6);
    let images = folder.path().join("sparse/0/images.txt");
    let text = std::fs::read_to_string(&images).unwrap().replace(".png", ".jpg");
    write(&images, text);
    shows(&open(&folder), 0, AS_SEEN);
}

#[test]
fn clocks_of_captures_may_begin_anywhere() {
    for start in [100.0, 1.7e9] {
        let folder = nerfstudio(12);
        edit_json(&folder.path().join("transforms.json"), |value| {
            for k in 0..12 {
                value["frames"][k]["time"] = json!(start + 0.1 * k as f64);
            }
        });
        let dataset = open(&folder);
        assert_eq!((dataset.times.len(), dataset.times[0], dataset.times[11]), (12, 0.0, 1.0));
        assert!(dataset.times.iter().enumerate().all(|(k, time)| (time - k as f64 / 11.0).abs() < 1e-6));
        assert_eq!(dataset.frames_per_second, Some(10.0));
    }
    let folder = hypernerf(4);
    edit_json(&folder.path().join("metadata.json"), |value| {
        for k in 0..4 {
            value[format!("{k:06}")]["warp_id"] = json!(300 + 10 * k);
        }
    });
    let times = open(&folder).times;
    assert!(
        times.iter().zip([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]).all(|(a, b)| (a - b).abs() < 1e-12),
        "{times:?}"
    );
}

#[test]
fn points_far_from_the_origin_keep_their_places_among_the_cameras() {
    let far = DVec3::new(500_123.25, 4_649_776.5, 215.75);
    let ply = |offset: DVec3| {
        let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 40\nproperty double x\nproperty double y\n\
                          property double z\nend_header\n"
            .to_vec();
        for k in 0..40 {
            let point = offset + DVec3::new(0.01, 0.002, -0.013) * f64::from(k);
            bytes.extend(point.to_array().into_iter().flat_map(f64::to_le_bytes));
        }
        bytes
    };
    let relative = |offset: DVec3| -> (Dataset, Vec<DVec3>) {
        let folder = nerfstudio(5);
        edit_json(&folder.path().join("transforms.json"), |value| {
            for k in 0..5 {
                for (axis, away) in offset.to_array().into_iter().enumerate() {
                    let place = value["frames"][k]["transform_matrix"][axis][3].as_f64().unwrap();
                    value["frames"][k]["transform_matrix"][axis][3] = json!(place + away);
                }
            }
        });
        write(&folder.path().join("points3d.ply"), ply(offset));
        let dataset = open(&folder);
        let centre = dataset.frames[0].camera.centre();
        let points = &dataset.points.positions;
        let points = points.iter().map(|p| DVec3::from_array(p.map(f64::from)) - centre).collect();
        (dataset, points)
    };
    let (_, near) = relative(DVec3::ZERO);
    let (dataset, moved) = relative(far);
    for (a, b) in near.iter().zip(&moved) {
        assert!(a.distance(*b) < 1e-6, "{a} {b}");
    }
    let first =
        dataset.frame.capture_from_dataset(DVec3::from_array(dataset.points.positions[0].map(f64::from)));
    assert!(first.distance(far) < 1e-6, "{first}");
}

#[test]
fn the_largest_of_several_models_is_read_and_the_others_are_named() {
    let folder = colmap_text(12);
    let root = folder.path();
    for (from, to) in [("0", "1"), ("0", "10")] {
        std::fs::create_dir(root.join("sparse").join(to)).unwrap();
        for name in ["cameras.txt", "images.txt", "points3D.txt"] {
            std::fs::copy(root.join("sparse").join(from).join(name), root.join("sparse").join(to).join(name))
                .unwrap();
        }
    }
    let few = |model: &str, images: usize| {
        let path = root.join("sparse").join(model).join("images.txt");
        let text = std::fs::read_to_string(&path).unwrap();
        write(&path, text.lines().take(1 + 2 * images).collect::<Vec<_>>().join("\n") + "\n");
    };
    few("0", 3);
    few("10", 5);
    let dataset = open(&folder);
    assert_eq!(dataset.frames.len(), 12);
    assert!(
        notes(&dataset, &["sparse/1: of 3 models", "12", "sparse/10 (5)", "sparse/0 (3)"]),
        "{:?}",
        dataset.notes
    );
    let (model, note) = foreign::find_colmap(root).unwrap();
    assert!(model.ends_with("sparse/1") && note.is_some());
    let (model, note) = foreign::find_colmap(&root.join("sparse/0")).unwrap();
    assert!(model.ends_with("sparse/0") && note.is_none(), "one that is named is taken");
    // Without a first one.
    std::fs::remove_dir_all(root.join("sparse/0")).unwrap();
    assert_eq!(open(&folder).frames.len(), 12);
}

#[test]
fn images_of_a_model_written_by_hand_need_no_second_lines() {
    let folder = colmap_text(5);
    let path = folder.path().join("sparse/0/images.txt");
    let text = std::fs::read_to_string(&path).unwrap();
    let rows: Vec<&str> = text.lines().filter(|line| line.ends_with(".png")).collect();
    assert_eq!(rows.len(), 5);
    let some = format!("{}\n1.5 2.5 1 3.5 4.5 -1\n{}\n", rows[0], rows[1..].join("\n"));
    for text in [rows.join("\n"), rows.join("\n\n"), some] {
        write(&path, &text);
        let dataset = open(&folder);
        assert_eq!(dataset.frames.len(), 5, "{text}");
    }
}

#[test]
fn quaternions_may_have_any_length() {
    let folder = colmap_text(3);
    let path = folder.path().join("sparse/0/images.txt");
    let text = std::fs::read_to_string(&path).unwrap();
    let before = open(&folder).frames[1].camera;
    let shrink = |line: &str| {
        let words: Vec<String> = line
            .split(' ')
            .enumerate()
            .map(|(k, word)| match (k, word.parse::<f64>()) {
                (1..=4, Ok(value)) => (value * 5e-7).to_string(),
                _ => word.to_owned(),
            })
            .collect();
        words.join(" ")
    };
    let rows = text.lines().map(|line| if line.ends_with(".png") { shrink(line) } else { line.to_owned() });
    write(&path, rows.collect::<Vec<_>>().join("\n"));
    let after = open(&folder).frames[1].camera;
    assert!(
        (before.forward() - after.forward()).length() < 1e-9
            && before.centre().distance(after.centre()) < 1e-9
    );
}

#[test]
fn marks_of_byte_order_are_no_text() {
    let folder = nerfstudio(3);
    let path = folder.path().join("transforms.json");
    let text = std::fs::read_to_string(&path).unwrap();
    write(&path, format!("\u{feff}{text}"));
    assert_eq!(open(&folder).frames.len(), 3);
    let folder = colmap_text(3);
    for name in ["cameras", "images", "points3D"] {
        let path = folder.path().join(format!("sparse/0/{name}.txt"));
        let text = std::fs::read_to_string(&path).unwrap();
        let rows = text.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n");
        write(&path, format!("\u{feff}{rows}"));
    }
    assert_eq!(open(&folder).frames.len(), 3);
}

#[test]
fn colours_of_points_are_taken_by_their_range() {
    for (kind, row, color, note) in [
        ("float", "250 100 0", [250, 100, 0], "up to 255"),
        ("double", "1 0.2 0", [255, 51, 0], "up to 1"),
        ("ushort", "65535 257 0", [255, 1, 0], "up to 65535"),
        ("int", "250 100 0", [250, 100, 0], "up to 255"),
        ("uchar", "250 100 0", [250, 100, 0], ""),
    ] {
        let folder = nerfstudio(3);
        write(
            &folder.path().join("points3d.ply"),
            format!(
                "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                 property {kind} red\nproperty {kind} green\nproperty {kind} blue\nend_header\n0 0 0 {row}\n0 0 0.5 0 0 0\n"
            ),
        );
        let dataset = open(&folder);
        assert_eq!(dataset.points.colors[0], color, "{kind}");
        assert_eq!(notes(&dataset, &["points3d.ply", note]), !note.is_empty(), "{kind}: {:?}", dataset.notes);
    }
}

/// XML of a task of CVAT that took every fifth frame from `start` on, with a cup in two frames.
fn cvat(start: u32, frames: [u32; 2]) -> String {
    let shape =
        |frame: u32| format!("<polygon frame=\"{frame}\" outside=\"0\" points=\"0,0;8,0;8,24;0,24\"/>");
    format!(
        "<annotations><meta><task><start_frame>{start}</start_frame><frame_filter>step=5</frame_filter>\
         <original_size><width>32</width><height>24</height></original_size></task></meta>\
         <track id=\"0\" label=\"cup\">{}{}</track></annotations>",
        shape(frames[0]),
        shape(frames[1])
    )
}

#[test]
fn frames_of_a_cvat_task_are_those_that_it_took() {
    let folder = hypernerf(20);
    let path = folder.path().join("annotations.xml");
    let shown = |first: Option<u64>| {
        let dataset = open(&folder);
        let import = Import::open(&path, None, first, &dataset)?;
        let frames: Vec<&str> = (0..dataset.frames.len())
            .filter(|frame| import.shows(*frame))
            .map(|frame| dataset.frames[frame].name.as_str())
            .collect();
        Ok::<_, cif_dataset::Error>(frames.join(" "))
    };
    for (start, numbers, frames) in
        [(0, [0, 15], "000000 000003"), (100, [100, 110], "000000 000002"), (0, [5, 10], "000001 000002")]
    {
        write(&path, cvat(start, numbers));
        assert_eq!(shown(None).unwrap(), frames, "{start} {numbers:?}");
    }
    // Cameras of a HyperNeRF capture count their frames together.
    let cameras = |count: u32| {
        edit_json(&folder.path().join("metadata.json"), |value| {
            (0..20).for_each(|k| value[format!("{k:06}")]["camera_id"] = json!(k % count));
        });
    };
    cameras(2);
    write(&path, cvat(100, [100, 115]));
    let mut both: Vec<String> = shown(None).unwrap().split(' ').map(str::to_owned).collect();
    both.sort();
    assert_eq!(both, ["000000", "000003"]);
    cameras(1);
    let rig = neu3d(2, 3);
    write(&rig.path().join("annotations.xml"), cvat(100, [100, 105]));
    let refused = Import::open(&rig.path().join("annotations.xml"), None, None, &open(&rig));
    holds(&refused.err().unwrap().to_string(), &["annotations.xml", "2 cameras", "folder of its name"]);
    write(&path, cvat(0, [5, 10]));
    assert_eq!(shown(Some(0)).unwrap(), "000005 000010", "what people say counts");
    for numbers in [[3, 10], [0, 100]] {
        write(&path, cvat(0, numbers));
        let message = shown(None).unwrap_err().to_string();
        holds(
            &message,
            &[
                "annotations.xml",
                "0 + 5 k",
                &format!("frame {}", numbers.iter().find(|n| ![0, 10].contains(*n)).unwrap()),
            ],
        );
    }
}

#[test]
fn frames_that_are_named_by_the_video_keep_their_numbers() {
    let folder = nerfstudio(4);
    edit_json(&folder.path().join("transforms.json"), |value| {
        for k in 0..4 {
            let name = format!("images/{:06}.png", 100 + 5 * k);
            std::fs::rename(folder.path().join(format!("images/{k:04}.png")), folder.path().join(&name))
                .unwrap();
            value["frames"][k]["file_path"] = json!(name);
        }
    });
    let path = folder.path().join("annotations.xml");
    write(&path, cvat(95, [105, 110]));
    let dataset = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let import = Import::open(&path, None, None, &dataset).unwrap();
    let shown: Vec<bool> = (0..4).map(|frame| import.shows(frame)).collect();
    assert_eq!(shown, [false, true, true, false]);
}

#[test]
fn a_reconstruction_next_to_a_nerfies_capture_gives_its_points_in_the_world_of_its_cameras() {
    let folder = hypernerf(6);
    let root = folder.path();
    std::fs::remove_file(root.join("points.npy")).unwrap();
    assert_eq!(open(&folder).points.source, PointSource::Random);
    // The world of the reconstruction is turned, five times as large and elsewhere.
    let turn = DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.4).normalize(), 2.1);
    let away = DVec3::new(4.0, -2.0, 11.0);
    let mut images = String::new();
    for k in 0..6 {
        let (axes, centre) = ring_camera(k);
        let (axes, centre) = (turn * axes, 5.0 * (turn * centre) + away);
        let (q, t) = (DQuat::from_mat3(&axes.transpose()), -(axes.transpose() * centre));
        images += &format!("{k} {} {} {} {} {} {} {} 1 {k:06}.png\n\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z);
    }
    let place = DVec3::new(0.5, -0.25, 1.0);
    let p = 5.0 * (turn * place) + away;
    for sparse in ["colmap/sparse/0", "colmap"] {
        let model = root.join(sparse);
        write(&model.join("cameras.txt"), "1 PINHOLE 32 24 40 40 16.5 11\n");
        write(&model.join("images.txt"), &images);
        write(&model.join("points3D.txt"), format!("7 {} {} {} 10 20 30 0.1\n", p.x, p.y, p.z));
        let dataset = open(&folder);
        let found = DVec3::from_array(dataset.points.positions[0].map(f64::from));
        assert!(found.distance(place) < 1e-5, "{sparse}: {found}");
        assert_eq!(dataset.points.colors, [[10, 20, 30]]);
        assert!(notes(&dataset, &["1 points are moved", "0.2000", "6 cameras"]), "{:?}", dataset.notes);
        // Of other cameras.
        let (first, rest) = images.split_once('\n').unwrap();
        let mut words: Vec<&str> = first.split(' ').collect();
        words[5] = "90";
        write(&model.join("images.txt"), format!("{}\n{rest}", words.join(" ")));
        let dataset = open(&folder);
        assert_eq!(dataset.points.source, PointSource::Random);
        assert!(notes(&dataset, &["not taken", "6 images"]), "{:?}", dataset.notes);
        std::fs::remove_dir_all(root.join("colmap")).unwrap();
    }
}

#[test]
fn paths_of_windows_are_those_of_the_files() {
    let folder = nerfstudio(4);
    let dataset = open(&folder);
    edit_json(&folder.path().join("transforms.json"), |value| {
        for frame in value["frames"].as_array_mut().unwrap() {
            let path = frame["file_path"].as_str().unwrap().replace('/', "\\");
            frame["file_path"] = format!(".\\{path}").into();
        }
    });
    let again = open(&folder);
    let names = |dataset: &Dataset| dataset.frames.iter().map(|frame| frame.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&again), names(&dataset));
    assert_eq!(
        again.frames[1].image.canonicalize().unwrap(),
        dataset.frames[1].image.canonicalize().unwrap()
    );
}

#[test]
fn images_with_other_endings_than_colmap_saw_are_named() {
    let folder = colmap_text(4);
    let images = folder.path().join("images");
    let first = std::fs::read_dir(&images).unwrap().map(|entry| entry.unwrap().path()).min().unwrap();
    let renamed = first.with_extension("JPG");
    std::fs::rename(&first, &renamed).unwrap();
    let there = format!("(there is {})", renamed.file_name().unwrap().to_string_lossy());
    holds(&failure(&folder), &["is missing", &there]);
}

#[test]
fn models_whose_images_lie_in_the_whole_capture_are_read() {
    let folder = colmap_text(4);
    let expected = open(&folder);
    let path = folder.path().join("sparse/0/images.txt");
    let text = std::fs::read_to_string(&path).unwrap();
    let rows = text.lines().map(|line| match line.rsplit_once(' ') {
        Some((row, name)) if name.ends_with(".png") => format!("{row} images/{name}"),
        _ => line.to_owned(),
    });
    let rows: Vec<String> = rows.collect();
    write(&path, rows.join("\n"));
    let found = open(&folder);
    assert_eq!(found.frames[2].name, expected.frames[2].name);
    assert_eq!(found.frames[2].image, expected.frames[2].image);
}

#[test]
fn camera_models_that_came_later_are_reported_with_the_fix() {
    let folder = colmap_binary(4);
    let path = folder.path().join("sparse/0/cameras.bin");
    let mut bytes = std::fs::read(&path).unwrap();
    // COLMAP's RAD_TAN_THIN_PRISM_FISHEYE, behind the number of cameras and the id of the first.
    bytes[12..16].copy_from_slice(&11_u32.to_le_bytes());
    write(&path, &bytes);
    holds(
        &failure(&folder),
        &["cameras.bin", "camera model number 11 is not supported", "image_undistorter"],
    );
}
