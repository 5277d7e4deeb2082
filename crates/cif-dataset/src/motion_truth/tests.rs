use std::fs;
use std::io::Write;

use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::*;

/// A version 1.0 NumPy file.
fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

fn ids(ids: &[i64]) -> Vec<u8> {
    let data: Vec<u8> = ids.iter().flat_map(|id| id.to_le_bytes()).collect();
    npy("<i8", &format!("({},)", ids.len()), &data)
}

fn points(shape: &str, values: &[f32]) -> Vec<u8> {
    npy("<f4", shape, &values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())
}

fn npz(path: &Path, method: CompressionMethod, members: &[(&str, Vec<u8>)]) {
    let mut zip = ZipWriter::new(fs::File::create(path).unwrap());
    for (name, bytes) in members {
        zip.start_file(format!("{name}.npy"), SimpleFileOptions::default().compression_method(method))
            .unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap();
}

/// Two instances at two steps; 3 moves by (1, 2, 3).
fn motion() -> serde_json::Value {
    let matrix = |x: f64, y: f64, z: f64| {
        serde_json::json!([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])
    };
    let instance = |label: &str, motion: &str, x: f64, y: f64, z: f64| {
        serde_json::json!({
            "label": label, "motion": motion, "matrix": [matrix(0.0, 0.0, 0.0), matrix(x, y, z)], "parts": {},
            "aabb_min": [[-1.0, -1.0, -1.0], [x - 1.0, y - 1.0, z - 1.0]],
            "aabb_max": [[1.0, 1.0, 1.0], [x + 1.0, y + 1.0, z + 1.0]],
        })
    };
    serde_json::json!({
        "units": "metres",
        "frames": [{ "time": 0.0, "images": ["a"] }, { "time": 1.0, "images": ["b"] }],
        "instances": {
            "3": instance("mug", "rigid", 1.0, 2.0, 3.0), "7": instance("box", "static", 0.0, 0.0, 0.0),
        },
    })
}

fn folder(motion: &serde_json::Value) -> (TempDir, PathBuf, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let (json, tracks) = (folder.path().join(MOTION_FILE), folder.path().join(TRACKS_FILE));
    fs::write(&json, motion.to_string()).unwrap();
    (folder, json, tracks)
}

#[test]
fn poses_boxes_and_points_are_read() {
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let (_folder, json, tracks) = folder(&motion());
        // Instance 7 first; one point each, at two steps.
        let values = [9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 0.5, 0.0, 0.0, 1.5, 2.0, 3.0];
        npz(&tracks, method, &[("points", points("(2, 1, 2, 3)", &values)), ("ids", ids(&[7, 3]))]);
        let mut truth = MotionTruth::read(&json).unwrap();
        assert!(truth.instances[&3].points.is_empty());
        truth.add_tracks(&tracks).unwrap();
        assert_eq!(truth.times, [0.0, 1.0]);
        let mug = &truth.instances[&3];
        assert_eq!((mug.label.as_str(), mug.kind.as_str()), ("mug", "rigid"));
        assert_eq!(mug.world_from_object[1].transform_point3(DVec3::X), DVec3::new(2.0, 2.0, 3.0));
        assert_eq!(mug.boxes[1].low, DVec3::new(0.0, 1.0, 2.0));
        assert_eq!(mug.points, [[DVec3::X * 0.5, DVec3::new(1.5, 2.0, 3.0)]]);
        assert_eq!(truth.instances[&7].points, [[DVec3::splat(9.0); 2]]);
    }
}

#[test]
fn damaged_poses_name_the_file_and_the_remedy() {
    let refused = |edit: &dyn Fn(&mut serde_json::Value), words: &[&str]| {
        let mut value = motion();
        edit(&mut value);
        let (_folder, json, _) = folder(&value);
        let message = MotionTruth::read(&json).unwrap_err().to_string();
        assert!(message.starts_with(&json.display().to_string()), "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{words:?} in {message}");
    };
    refused(&|value| value["instances"] = serde_json::json!(null), &["expected are `frames`"]);
    refused(
        &|value| drop(value.as_object_mut().unwrap().remove("instances")),
        &["missing field `instances`"],
    );
    refused(&|value| value["instances"]["mug"] = value["instances"]["3"].clone(), &["expected are `frames`"]);
    refused(
        &|value| value["frames"].as_array_mut().unwrap().clear(),
        &["instance 3 has 2 of `matrix`", "0 frames"],
    );
    refused(
        &|value| value["instances"]["7"]["matrix"][0] = serde_json::json!([1]),
        &["expected are `frames`"],
    );
    refused(
        &|value| value["instances"]["7"]["aabb_min"][1] = serde_json::json!([2.0, 0.0, 0.0]),
        &["instance 7", "frame 1", "exchange"],
    );
    let (_folder, json, tracks) = folder(&motion());
    fs::write(&json, &motion().to_string()[..100]).unwrap();
    assert!(MotionTruth::read(&json).unwrap_err().to_string().contains("EOF"));
    assert!(MotionTruth::read(&tracks).unwrap_err().to_string().contains("cannot be read"));
}

#[test]
fn damaged_tracks_name_the_file_and_the_remedy() {
    let (_folder, json, tracks) = folder(&motion());
    let refused = |words: &[&str]| {
        let message = MotionTruth::read(&json).unwrap().add_tracks(&tracks).unwrap_err().to_string();
        assert!(message.starts_with(&tracks.display().to_string()), "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{words:?} in {message}");
    };
    let good = || points("(1, 1, 2, 3)", &[0.0; 6]);
    let write = |members: &[(&str, Vec<u8>)]| npz(&tracks, CompressionMethod::Stored, members);
    write(&[("points", good())]);
    refused(&["`ids`", "missing", "numpy.savez"]);
    write(&[("ids", ids(&[3]))]);
    refused(&["`points`", "missing"]);
    write(&[("ids", ids(&[3])), ("points", points("(1, 2, 1, 3)", &[0.0; 6]))]);
    refused(&["[1, 2, 1, 3]", "2 times"]);
    write(&[("ids", ids(&[3, 7])), ("points", good())]);
    refused(&["[2]", "[1, 1, 2, 3]"]);
    write(&[("ids", ids(&[4])), ("points", good())]);
    refused(&["instance 4", "not in motion.json"]);
    write(&[("ids", ids(&[-65_533])), ("points", good())]);
    refused(&["instance -65533"]);
    write(&[("ids", ids(&[3, 3])), ("points", points("(2, 1, 2, 3)", &[0.0; 12]))]);
    refused(&["instance 3", "twice"]);
    write(&[("ids", ids(&[3])), ("points", points("(1, 1, 2, 3)", &[0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0]))]);
    refused(&["instance 3", "not finite"]);
    write(&[("ids", good()), ("points", good())]);
    refused(&["`ids`", "integers are expected"]);
    write(&[("ids", b"no array".to_vec()), ("points", good())]);
    refused(&["`ids`", "not a NumPy array"]);
    // Cut short, another byte in an array, and another kind of file.
    write(&[("ids", ids(&[3])), ("points", good())]);
    let bytes = fs::read(&tracks).unwrap();
    fs::write(&tracks, &bytes[..bytes.len() / 2]).unwrap();
    refused(&["cut short", "copy it again"]);
    let mut changed = bytes.clone();
    let place = bytes.windows(4).position(|window| window == b"(1,)").unwrap();
    changed[place + 8] ^= 1;
    fs::write(&tracks, &changed).unwrap();
    refused(&["`ids`", "damaged", "copy it again"]);
    fs::write(&tracks, "text").unwrap();
    refused(&["not a NumPy archive"]);
}

#[test]
fn times_are_matched_by_value_or_by_frame() {
    let truth = MotionTruth { times: vec![0.0, 0.5, 1.0], ..MotionTruth::default() };
    assert_eq!(truth.steps_at(&[0.0, 0.500_05, 1.0], &[0, 1, 2]), [Some(0), Some(1), Some(2)]);
    assert_eq!(truth.steps_at(&[0.5, 1.0], &[1, 2]), [Some(1), Some(2)]);
    // Divided by the number of frames.
    assert_eq!(truth.steps_at(&[0.0, 1.0 / 3.0, 2.0 / 3.0], &[0, 1, 2]), [Some(0), Some(1), Some(2)]);
    assert_eq!(truth.steps_at(&[0.0, 0.25, 0.5, 0.75], &[0, 1, 2, 3]), [Some(0), None, Some(1), None]);
}
