use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs;
use std::io::Cursor;
use std::path::PathBuf;

use glam::DVec3;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde_json::json;

use super::write::MAX_JSON_DEPTH;
use super::*;
use crate::{FieldError, Identities, Joint, JointKind, Owner, Record, RotationEvidence, testing};

/// Words of the message that a change must cause.
type Change<T> = (&'static str, fn(&mut T));

fn training() -> TrainingState {
    let tensors = [
        // Training state keeps every bit pattern, NaN payloads too.
        ("adam.means.m", StateTensor::F32(vec![1.0e-40, -0.0, f32::INFINITY, f32::from_bits(0x7fc0_1234)])),
        ("adam.means.v", StateTensor::F64(vec![5e-324, 0.1 + 0.2, f64::MIN])),
        ("births", StateTensor::U32(vec![0, u32::MAX])),
        ("rng", StateTensor::U64(vec![u64::MAX, 1 << 63])),
        ("empty", StateTensor::F32(Vec::new())),
    ];
    TrainingState {
        json: json!({ "step": 12_345, "lr": 1.6e-4 / 3.0, "state": u64::MAX, "nested": { "b": [1, null], "a": "é" } }),
        tensors: tensors.into_iter().map(|(name, tensor)| (name.to_owned(), tensor)).collect(),
    }
}

fn bytes_of(checkpoint: &Checkpoint) -> Vec<u8> {
    let mut bytes = Vec::new();
    checkpoint.write(&mut bytes, "memory").unwrap();
    bytes
}

fn read_bytes(bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
    Checkpoint::read(&mut Cursor::new(bytes), "memory.cif")
}

fn example(n: usize) -> Checkpoint {
    Checkpoint { field: testing::field(n, 4), training: Some(training()), head: None }
}

/// A file with another header; the tensors' bytes stay.
fn with_header(bytes: &[u8], change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    change(&mut header);
    let header = serde_json::to_vec(&header).unwrap();
    let mut changed = (header.len() as u64).to_le_bytes().to_vec();
    changed.extend(header);
    changed.extend(&bytes[8 + length..]);
    changed
}

/// A file whose `cif.field` JSON is changed.
fn with_field(bytes: &[u8], change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    with_header(bytes, |header| {
        let text = header["__metadata__"]["cif.field"].as_str().unwrap().to_owned();
        let mut field = serde_json::from_str(&text).unwrap();
        change(&mut field);
        header["__metadata__"]["cif.field"] = json!(field.to_string());
    })
}

fn message(result: Result<Checkpoint, CheckpointError>) -> String {
    result.unwrap_err().to_string()
}

#[test]
fn a_file_brings_back_every_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.cif");
    let saved = example(57);
    saved.save(&path).unwrap();
    let loaded = Checkpoint::load(&path).unwrap();
    assert_eq!(loaded.field, saved.field);
    // Equal values may differ in bits (zeros, NaN); equal bytes do not.
    assert_eq!(bytes_of(&loaded), fs::read(&path).unwrap());
    assert_eq!(
        loaded.field.gaussians.means[3].map(f32::to_bits),
        saved.field.gaussians.means[3].map(f32::to_bits)
    );
    let nan = match &loaded.training.as_ref().unwrap().tensors["adam.means.m"] {
        StateTensor::F32(values) => values[3].to_bits(),
        other => panic!("{other:?}"),
    };
    assert_eq!(nan, 0x7fc0_1234);
    assert_eq!(loaded.training.unwrap().json, training().json);
    // The scene alone.
    assert_eq!(Field::load(&path).unwrap(), saved.field);
    saved.field.save(&path).unwrap();
    assert_eq!(Checkpoint::load(&path).unwrap(), Checkpoint { training: None, ..saved.clone() });
    saved.field.save_with_training(&training(), &path).unwrap();
    assert_eq!(fs::read(&path).unwrap(), bytes_of(&saved));
}

#[test]
fn fields_without_the_optional_parts_survive() {
    for n in [0, 1, 5] {
        let field = Field {
            deformation: None,
            identities: None,
            instances: Vec::new(),
            cameras: Vec::new(),
            ..testing::field(n, 1)
        };
        let checkpoint = Checkpoint { field, training: None, head: None };
        assert_eq!(read_bytes(&bytes_of(&checkpoint)).unwrap(), checkpoint);
        let full = example(n);
        assert_eq!(bytes_of(&read_bytes(&bytes_of(&full)).unwrap()), bytes_of(&full));
    }
}

#[test]
fn other_software_can_read_the_tensors() {
    let bytes = bytes_of(&example(9));
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let means = tensors.tensor("gaussians.means").unwrap();
    assert_eq!((means.dtype(), means.shape()), (safetensors::Dtype::F32, &[9, 3][..]));
    assert_eq!(tensors.tensor("gaussians.sh_coefficients").unwrap().shape(), [9, 16, 3]);
    assert_eq!(means.data(), bytemuck::cast_slice::<_, u8>(&example(9).field.gaussians.means));
    // Aligned in the file.
    let start = bytes.as_ptr().addr();
    for (name, tensor) in tensors.iter() {
        let offset = tensor.data().as_ptr().addr() - start;
        assert!(offset.is_multiple_of(tensor.dtype().bitsize() / 8), "{name} at {offset}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn random_fields_survive(
        n in 0_usize..40,
        seed in any::<u64>(),
        static_scene in any::<bool>(),
        times in proptest::collection::btree_set(0_u64..=u64::MAX >> 11, 4..9),
        floats in proptest::collection::vec(any::<f32>(), 0..20),
        doubles in proptest::collection::vec(any::<f64>(), 0..20),
        text in ".*",
        extent in 0.0_f32..f32::MAX,
    ) {
        let mut field = testing::field(n, seed);
        if static_scene {
            field.deformation = None;
        }
        field.timeline.times = times.iter().map(|step| *step as f64 / (1_u64 << 53) as f64).collect();
        field.extent = extent;
        field.instances[1].label = text.replace('\0', "");
        let finite = |values: &[f64]| values.iter().copied().filter(|value| value.is_finite()).collect::<Vec<_>>();
        field.record.notes.insert("text".to_owned(), json!(text));
        field.record.notes.insert("doubles".to_owned(), json!(finite(&doubles)));
        for (row, value) in floats.iter().filter(|value| value.is_finite()).take(n).enumerate() {
            field.gaussians.means[row][1] = *value;
        }
        let training = TrainingState {
            json: json!(finite(&doubles)),
            tensors: [
                (text.clone(), StateTensor::F32(floats)),
                (format!("{text}2"), StateTensor::F64(doubles)),
            ].into(),
        };
        let saved = Checkpoint { field, training: Some(training), head: None };
        let bytes = bytes_of(&saved);
        let loaded = read_bytes(&bytes).unwrap();
        prop_assert_eq!(&loaded.field, &saved.field);
        prop_assert_eq!(&loaded.training.as_ref().unwrap().json, &saved.training.as_ref().unwrap().json);
        prop_assert!(bytes == bytes_of(&loaded));
    }
}

#[test]
fn damaged_files_are_refused_and_never_panic() {
    let valid = bytes_of(&example(6));
    let header_end = 8 + u64::from_le_bytes(valid[..8].try_into().unwrap()) as usize;
    for length in (0..valid.len()).step_by(3) {
        assert!(read_bytes(&valid[..length]).is_err(), "cut to {length} of {} bytes", valid.len());
    }
    let mut rng = Pcg64::seed_from_u64(11);
    let mut accepted = 0;
    for case in 0..6000 {
        let mut bytes = valid.clone();
        for _ in 0..rng.random_range(1..4) {
            // Mostly in the header, where the structure is.
            let end = if case % 3 == 0 { bytes.len() } else { header_end };
            let at = rng.random_range(0..end);
            match rng.random_range(0..4) {
                0 => bytes[at] ^= 1 << rng.random_range(0..8),
                1 => bytes[at] = rng.random_range(0..=255),
                // Digits in place of digits: sizes, offsets, labels.
                2 => bytes[at] = b'0' + rng.random_range(0..10),
                _ => {
                    bytes.remove(at);
                }
            }
        }
        if let Ok(checkpoint) = read_bytes(&bytes) {
            // A changed float or letter is still a scene; everything that later code relies on must hold.
            checkpoint.field.validate().unwrap();
            assert_eq!(checkpoint.field.query(&[glam::DVec3::ZERO], 0.5).len(), 1);
            accepted += 1;
        }
    }
    assert!(accepted > 100, "{accepted} of 6000 accepted: the damage is not subtle enough");
}

#[test]
fn headers_that_announce_too_much_are_refused_before_anything_is_allocated() {
    let bytes = bytes_of(&example(3));
    let mut huge = bytes.clone();
    huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(matches!(read_bytes(&huge), Err(CheckpointError::NotSafetensors { .. })));
    huge[..8].copy_from_slice(&99_000_000_u64.to_le_bytes());
    assert!(matches!(read_bytes(&huge), Err(CheckpointError::Truncated { .. })));
    let shape = with_header(&bytes, |header| {
        header["gaussians.means"]["shape"] = json!([u64::MAX, 3]);
    });
    assert!(matches!(read_bytes(&shape), Err(CheckpointError::Header { .. })));
    let config = with_field(&bytes, |field| {
        field["deformation"]["config"]["spatial_resolution"] = json!([4096, 4096, 4096]);
        field["deformation"]["config"]["channels"] = json!(200);
    });
    assert!(message(read_bytes(&config)).contains("floats together"));
    let width = with_field(&bytes, |field| field["deformation"]["config"]["width"] = json!(1000));
    assert!(message(read_bytes(&width)).contains("tensor `deformation.mlp` has the shape"));
    let deep = with_header(&bytes, |header| {
        header["__metadata__"]["cif.training"] = json!("[".repeat(100_000));
    });
    assert!(message(read_bytes(&deep)).contains("recursion"));
}

#[test]
fn foreign_files_are_distinguished() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.cif");
    let load = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        message(Checkpoint::load(&path))
    };
    assert!(load(b"#usda 1.0\n(\n)\n").contains("not a safetensors file"));
    assert!(load(b"abc").contains("not a safetensors file"));
    assert!(load(b"").contains("is cut short: 0 of"));
    let tensor = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![1], &[0; 4]).unwrap();
    let foreign = safetensors::serialize([("weight", tensor)], None).unwrap();
    assert!(load(&foreign).contains("is not a cif scene"));
    let bytes = bytes_of(&example(3));
    assert!(load(&bytes[..bytes.len() - 1]).contains("is cut short"));
    assert!(load(&[&bytes[..], b"\n"].concat()).contains("is damaged"));
    assert!(message(Checkpoint::load(folder.path())).contains("it is a folder"));
    assert!(message(Checkpoint::load(folder.path().join("none.cif"))).contains("none.cif"));
}

#[test]
fn a_later_format_names_the_cif_that_reads_it() {
    let later = with_header(&bytes_of(&example(3)), |header| {
        header["__metadata__"]["cif.format"] = json!((FORMAT + 1).to_string());
        header["__metadata__"]["cif.version"] = json!("7.8.9");
        // What else a later format may bring does not matter.
        header["__metadata__"]["cif.field"] = json!("?");
    });
    let message = message(read_bytes(&later));
    assert!(message.contains("use cif 7.8.9 or later"), "{message}");
    for format in ["0", "-1", "one", ""] {
        let broken = with_header(&bytes_of(&example(3)), |header| {
            header["__metadata__"]["cif.format"] = json!(format);
        });
        assert!(matches!(read_bytes(&broken), Err(CheckpointError::Header { .. })), "{format}");
    }
}

#[test]
fn recorded_motion_survives_and_raises_the_format() {
    let format = |bytes: &[u8]| {
        let (_, header) = safetensors::SafeTensors::read_metadata(bytes).unwrap();
        header.metadata().clone().unwrap()["cif.format"].clone()
    };
    let plain = example(20);
    assert_eq!(format(&bytes_of(&plain)), "1", "older software reads fields without tracks");
    let tracked = Checkpoint { field: testing::tracked_field(20, 4), training: None, head: None };
    let bytes = bytes_of(&tracked);
    assert_eq!(format(&bytes), "4", "opacities and colours change over time");
    let loaded = read_bytes(&bytes).unwrap();
    assert_eq!(loaded, tracked);
    assert_eq!(bytes_of(&loaded), bytes);
    let mut moving = tracked.clone();
    for group in &mut moving.field.tracks.as_mut().unwrap().groups {
        (group.opacities, group.colors) = (None, None);
    }
    let bytes = bytes_of(&moving);
    assert_eq!(format(&bytes), "2", "older software reads motion without them");
    assert_eq!(read_bytes(&bytes).unwrap(), moving);
    let mut known = moving.clone();
    let groups = &mut known.field.tracks.as_mut().unwrap().groups;
    (groups[0].rotation, groups[2].rotation) =
        (Some(RotationEvidence::Observed), Some(RotationEvidence::Assumed));
    let bytes = bytes_of(&known);
    assert_eq!(format(&bytes), "5", "evidence for rotations");
    assert_eq!(read_bytes(&bytes).unwrap(), known);
    assert_eq!(
        known.field.gather(&[0, 1, 2]).tracks.unwrap().groups[0].rotation,
        Some(RotationEvidence::Observed)
    );
    let empty = Checkpoint {
        field: Field { tracks: Some(Default::default()), ..testing::field(0, 1) },
        training: None,
        head: None,
    };
    assert_eq!(read_bytes(&bytes_of(&empty)).unwrap(), empty);
}

#[test]
fn joints_survive_raise_the_format_and_are_checked() {
    let joint = Joint { base: 0, kind: JointKind::Revolute, axis: DVec3::new(0.6, 0.0, 0.8) };
    let mut jointed = Checkpoint { field: testing::tracked_field(20, 4), training: None, head: None };
    jointed.field.tracks.as_mut().unwrap().groups[2].joint = Some(joint);
    let bytes = bytes_of(&jointed);
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    assert_eq!(header.metadata().clone().unwrap()["cif.format"], "6");
    assert_eq!(read_bytes(&bytes).unwrap(), jointed);
    for (wrong, reason) in [
        (Joint { base: 2, ..joint }, "only an earlier one"),
        (Joint { axis: DVec3::new(0.6, 0.0, 0.9), ..joint }, "axis is not unit"),
        (Joint { axis: DVec3::NAN, ..joint }, "axis is not unit"),
    ] {
        let mut field = jointed.field.clone();
        field.tracks.as_mut().unwrap().groups[2].joint = Some(wrong);
        let error = field.validate().unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
    }
    // A base without Gaussians goes, and its joints with it; others are renumbered.
    let tracks = jointed.field.tracks.clone().unwrap();
    let kept = |rows: &[u32]| tracks.gather(rows).compact().unwrap().groups;
    assert_eq!(kept(&[0, 2])[1].joint, Some(joint));
    assert_eq!(kept(&[1, 2])[1].joint, None);
    let mut other = tracks.clone();
    other.groups[2].joint = Some(Joint { base: 1, ..joint });
    assert_eq!(other.gather(&[1, 2]).compact().unwrap().groups[1].joint, Some(joint));
}

#[test]
fn instances_of_groups_survive_raise_the_format_and_are_checked() {
    let mut named = Checkpoint { field: testing::tracked_field(20, 4), training: None, head: None };
    let unnamed = named.field.fingerprint();
    let id = named.field.instances[1].id;
    named.field.tracks.as_mut().unwrap().groups[2].instance = Some(id);
    assert_ne!(named.field.fingerprint(), unnamed);
    let bytes = bytes_of(&named);
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    assert_eq!(header.metadata().clone().unwrap()["cif.format"], FORMAT.to_string());
    let loaded = read_bytes(&bytes).unwrap();
    assert_eq!(loaded, named);
    let groups = |field: &Field| field.tracks.clone().unwrap().groups;
    assert_eq!(groups(&loaded.field.gather(&[2, 2, 1]))[1].instance, Some(id), "groups take it along");
    let problem = |change: &dyn Fn(&mut Field)| {
        let mut field = named.field.clone();
        change(&mut field);
        field.validate().unwrap_err().to_string()
    };
    let unknown = problem(&|field| field.tracks.as_mut().unwrap().groups[2].instance = Some(999));
    assert_eq!(
        unknown,
        "track group 2 (\"added\") is of the instance id 999, which is not in the instance table"
    );
    let joint = Joint { base: 0, kind: JointKind::Revolute, axis: DVec3::X };
    let apart = problem(&|field| field.tracks.as_mut().unwrap().groups[2].joint = Some(joint));
    assert!(apart.contains("has a joint on a group of another instance"), "{apart}");
    let row = named.field.tracks.as_ref().unwrap().group_of.iter().position(|group| *group == 2).unwrap();
    let owned = |owner| {
        move |field: &mut Field| {
            let owners = &mut field.identities.as_mut().unwrap().owners;
            owners.resize(20, Owner::Estimated);
            owners[row] = owner;
        }
    };
    for owner in [Owner::Background, Owner::Instance(0)] {
        let message = problem(&owned(owner));
        assert!(message.contains(&format!("but its Gaussian {row} is not")), "{message}");
    }
    let mut field = named.field.clone();
    owned(Owner::Instance(1))(&mut field);
    field.validate().unwrap();
    // Another table of instances knows nothing of the old ones.
    field.replace_instances(Vec::new());
    field.validate().unwrap();
    assert!(field.identities.is_none() && groups(&field).iter().all(|group| group.instance.is_none()));
}

#[test]
fn what_stands_still_survives_and_raises_the_format() {
    let format = |bytes: &[u8]| {
        let (_, header) = safetensors::SafeTensors::read_metadata(bytes).unwrap();
        header.metadata().clone().unwrap()["cif.format"].clone()
    };
    for (field, expected) in [(testing::field(20, 4), "3"), (testing::tracked_field(20, 4), "4")] {
        let mut partly = Checkpoint { field, training: None, head: None };
        let other = partly.field.fingerprint();
        partly.field.deformation.as_mut().unwrap().still = (0..20).map(|row| row % 3 == 1).collect();
        assert_ne!(partly.field.fingerprint(), other);
        let bytes = bytes_of(&partly);
        assert_eq!(format(&bytes), expected);
        let loaded = read_bytes(&bytes).unwrap();
        assert_eq!(loaded, partly);
        assert_eq!(bytes_of(&loaded), bytes);
        // Rows keep standing still wherever they go.
        let gathered = loaded.field.gather(&[4, 0, 1, 1]);
        assert_eq!(gathered.deformation.as_ref().unwrap().still, [true, false, true, true]);
        assert_eq!(gathered.deformed(0.7).means[0], loaded.field.deformed(0.7).means[4]);
    }
    let mut field = testing::field(20, 4);
    field.deformation.as_mut().unwrap().still = vec![false; 20];
    assert_eq!(format(&bytes_of(&Checkpoint { field: field.clone(), training: None, head: None })), "1");
    field.deformation.as_mut().unwrap().still = vec![true; 21];
    let error = field.validate().unwrap_err().to_string();
    assert!(error.contains("deformation.still"), "{error}");

    let mut field = testing::field(20, 4);
    field.deformation.as_mut().unwrap().still = vec![true; 20];
    let mut bytes = bytes_of(&Checkpoint { field, training: None, head: None });
    // Bytes are the narrowest tensor, so that they come last.
    *bytes.last_mut().unwrap() = 7;
    let refused = message(read_bytes(&bytes));
    assert!(refused.contains("deformation.still") && refused.contains('7'), "{refused}");
}

#[test]
fn tracks_that_do_not_fit_their_tensors_are_refused() {
    let bytes = bytes_of(&Checkpoint { field: testing::tracked_field(20, 4), training: None, head: None });
    let change = |change: &dyn Fn(&mut serde_json::Value)| {
        message(read_bytes(&with_field(&bytes, |field| change(&mut field["tracks"]))))
    };
    let poses = change(&|tracks| tracks[0]["poses"] = json!(5));
    assert!(poses.contains("`tracks.poses` has the shape [4, 8], expected [6, 8]"), "{poses}");
    let overflow = change(&|tracks| tracks[0]["poses"] = json!(u64::MAX));
    assert!(overflow.contains("`tracks.poses`"), "{overflow}");
    let dense = change(&|tracks| tracks[1]["dense"]["rows"] = json!(14));
    assert!(dense.contains("`tracks.means` has the shape [15, 3]"), "{dense}");
    let times = change(&|tracks| tracks[1]["dense"]["times"] = json!([0.1, 0.5]));
    assert!(times.contains("has 15 centres for 2 samples of 5 Gaussians"), "{times}");
    let none = change(&|tracks| *tracks = serde_json::Value::Null);
    assert!(none.contains("is not part of a scene"), "{none}");
}

#[test]
fn tensors_that_do_not_fit_are_named() {
    let bytes = bytes_of(&example(4));
    let reshape = |name: &str, shape: serde_json::Value| {
        message(read_bytes(&with_header(&bytes, |header| header[name]["shape"] = shape)))
    };
    assert!(reshape("gaussians.means", json!([12])).contains("expected [N, 3]"));
    assert!(reshape("gaussians.means", json!([3, 4])).contains("`gaussians.means` has the shape [3, 4]"));
    assert!(reshape("gaussians.quaternions", json!([8, 2])).contains("[8, 2], expected [4, 4]"));
    assert!(reshape("gaussians.opacity_logits", json!([4, 1])).contains("expected [4]"));
    assert!(reshape("identities.row_offsets", json!([5, 1])).contains("expected [5]"));
    let renamed = with_header(&bytes, |header| {
        let tensor = header.as_object_mut().unwrap().remove("gaussians.log_scales").unwrap();
        header["gaussians.scales"] = tensor;
    });
    assert!(message(read_bytes(&renamed)).contains("tensor `gaussians.log_scales` is missing"));
    let stray = with_field(&bytes, |field| field["has_identities"] = json!(false));
    assert!(message(read_bytes(&stray)).contains("is not part of a scene"));
    let retyped = with_header(&bytes, |header| header["gaussians.means"]["dtype"] = json!("I32"));
    assert!(message(read_bytes(&retyped)).contains("has the type I32, expected F32"));
    let typo = with_field(&bytes, |field| field["sh_degre"] = json!(3));
    assert!(message(read_bytes(&typo)).contains("sh_degre"));
}

#[test]
fn broken_scenes_are_neither_saved_nor_loaded() {
    let breaks: [Change<Field>; 18] = [
        ("`means` holds NaN at row 2, column 1", |f| f.gaussians.means[2][1] = f32::NAN),
        ("`log_scales` holds inf at row 0, column 2", |f| f.gaussians.log_scales[0][2] = f32::INFINITY),
        ("`deformation.mlp` holds NaN at row 5", |f| f.deformation.as_mut().unwrap().mlp[5] = f32::NAN),
        ("`opacity_logits` has 5 entries, expected 6", |f| f.gaussians.opacity_logits.truncate(5)),
        ("sh_degree", |f| f.sh_degree = 4),
        ("background", |f| f.background[1] = f32::NAN),
        ("extent", |f| f.extent = -1.0),
        ("has the id 0", |f| f.instances[1].id = 0),
        ("of instance 0", |f| f.instances[1].id = f.instances[0].id),
        ("does not come after", |f| f.timeline.times[1] = 0.0),
        ("outside [0, 1]", |f| f.timeline.times[3] = 1.5),
        ("no times", |f| f.timeline.times.clear()),
        ("has the time index 9", |f| f.cameras[2].time_index = 9),
        ("not orthonormal", |f| f.cameras[1].camera.camera_from_world.rotation *= 1.01),
        ("focal lengths", |f| f.cameras[0].camera.focal_px.x = 0.0),
        ("must be finite and have a volume", |f| {
            let bounds = &mut f.deformation.as_mut().unwrap().bounds;
            bounds.high.y = bounds.low.y;
        }),
        ("time_resolution", |f| f.deformation.as_mut().unwrap().config.time_resolution = 1),
        ("frames per second", |f| f.timeline.frames_per_second = 0.0),
    ];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.cif");
    for (expected, change) in breaks {
        let mut field = testing::field(6, 2);
        change(&mut field);
        let error = field.save(&path).unwrap_err();
        assert!(matches!(error, CheckpointError::Unsaveable { .. }), "{error}");
        assert!(error.to_string().contains(expected), "{error}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
    // The same rules hold for what is read.
    let bytes = bytes_of(&example(6));
    let degree = with_field(&bytes, |field| field["sh_degree"] = json!(9));
    assert!(message(read_bytes(&degree)).contains("sh_degree"));
    let means = testing::field(6, 4).gaussians.means;
    let needle = bytemuck::cast_slice::<_, u8>(&means[..1]);
    let at = bytes.windows(12).position(|window| window == needle).unwrap();
    let mut poisoned = bytes.clone();
    poisoned[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(message(read_bytes(&poisoned)).contains("`means` holds NaN at row 0, column 0"));
}

#[test]
fn json_too_deep_to_be_read_back_is_not_saved() {
    let nested = |depth: usize| (0..depth).fold(json!(1), |inner, _| json!([inner]));
    let mut checkpoint = example(2);
    let record = |depth| Record { settings: Some(nested(depth - 1)), ..Record::default() };
    checkpoint.field.record = record(MAX_JSON_DEPTH);
    checkpoint.training.as_mut().unwrap().json = nested(MAX_JSON_DEPTH);
    let loaded = read_bytes(&bytes_of(&checkpoint)).unwrap();
    assert!(loaded.field.record == checkpoint.field.record);
    assert!(loaded.training.unwrap().json == checkpoint.training.as_ref().unwrap().json);
    checkpoint.field.record = record(MAX_JSON_DEPTH + 1);
    let error = checkpoint.write(&mut Vec::new(), "deep.cif").unwrap_err().to_string();
    assert!(error.contains("nested too deeply"), "{error}");
}

#[test]
fn broken_identity_rows_are_named() {
    let breaks: [Change<Identities>; 6] = [
        ("`identities.owners` has 3 entries, expected 9", |rows| rows.owners = vec![Owner::Background; 3]),
        ("identity row 0 spans", |rows| rows.row_offsets[1] = u32::MAX),
        ("identity row 0 starts", |rows| rows.row_offsets[0] = 1),
        ("do not ascend", |rows| {
            let range = (0..rows.len()).map(|row| rows.range(row)).find(|range| range.len() > 1).unwrap();
            rows.labels[range.start + 1] = rows.labels[range.start];
        }),
        ("has the label 65535, but there are 4 instances", |rows| *rows.labels.last_mut().unwrap() = 65_535),
        ("`identities.log_estimates` holds -inf", |rows| rows.log_estimates[3] = f32::NEG_INFINITY),
    ];
    for (expected, change) in breaks {
        let mut field = testing::field(9, 2);
        change(field.identities.as_mut().unwrap());
        let error: FieldError = field.validate().unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }
    let mut field = testing::field(9, 2);
    field.identities = field.identities.map(|rows| rows.gather(&[0, 1]));
    assert!(matches!(field.validate(), Err(FieldError::Length { array: "identities.row_offsets", .. })));
}

#[test]
fn owners_survive_and_raise_the_format() {
    let mut checkpoint = Checkpoint { field: testing::field(4, 2), training: None, head: None };
    let mut rows = Identities::empty();
    rows.push(Owner::Estimated, &[(0, 0.5), (2, 0.25)]);
    rows.push_certain(Some(3));
    rows.push_certain(None);
    rows.push(Owner::Background, &[(1, 0.125)]);
    checkpoint.field.identities = Some(rows);
    let bytes = bytes_of(&checkpoint);
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    assert_eq!(header.metadata().as_ref().unwrap()["cif.format"], "4");
    let loaded = read_bytes(&bytes).unwrap();
    assert_eq!(loaded, checkpoint);
    assert_eq!(bytes_of(&loaded), bytes);
    checkpoint.field.identities.as_mut().unwrap().owners[1] = Owner::Instance(4);
    let refused = checkpoint.field.validate().unwrap_err().to_string();
    assert!(refused.contains("identity row 1 belongs to instance 4, but there are 4"), "{refused}");
}

#[test]
fn owners_of_older_layouts_are_understood() {
    let mut field = testing::field(3, 2);
    field.identities = Some(Identities {
        row_offsets: vec![0, 1, 2, 3],
        labels: vec![3, 0, 1],
        log_estimates: vec![std::f32::consts::LN_2, -104.0, -0.5],
        log_calibrations: vec![0.0; 3],
        owners: Vec::new(),
    });
    let loaded = read_bytes(&bytes_of(&Checkpoint { field, training: None, head: None })).unwrap();
    let rows = loaded.field.identities.unwrap();
    assert_eq!(rows.owners, [Owner::Instance(3), Owner::Background, Owner::Estimated]);
    assert_eq!((rows.labels, rows.row_offsets), (vec![3, 1], vec![0, 1, 1, 2]));
}

/// Takes some bytes and then fails as a full disk does.
struct FullDisk {
    free: usize,
}

impl std::io::Write for FullDisk {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        if self.free == 0 {
            return Err(std::io::Error::from(std::io::ErrorKind::StorageFull));
        }
        let taken = bytes.len().min(self.free);
        self.free -= taken;
        Ok(taken)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_leaves_the_old_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.cif");
    let old = example(3);
    old.save(&path).unwrap();
    let new = example(8);
    for free in [0, 4, 100, 5000] {
        let result = super::write::replace_file(&path, |file| {
            // Part of the new file reaches the disk before it is full.
            file.write_all(&bytes_of(&new)[..free]).unwrap();
            new.write(&mut FullDisk { free }, &path)
        });
        let message = result.unwrap_err().to_string();
        assert!(message.contains("scene.cif: no space for it in"), "{message}");
        assert_eq!(fs::read(&path).unwrap(), bytes_of(&old));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "temporary files are removed");
    }
    new.save(&path).unwrap();
    assert_eq!(Checkpoint::load(&path).unwrap().field, new.field);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_device_is_reported() {
    let mut full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let message = example(3).write(&mut full, "/mnt/scene.cif").unwrap_err().to_string();
    assert!(message.contains("cannot save /mnt/scene.cif: no space for it in /mnt"), "{message}");
}

#[test]
fn unwritable_destinations_are_named_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let field = testing::field(3, 1);
    let save = |path: PathBuf| field.save(path).unwrap_err().to_string();
    let missing = save(folder.path().join("none/scene.cif"));
    assert!(missing.contains("none does not exist; create it first"), "{missing}");
    assert!(save(folder.path().to_owned()).contains("it is a folder"));
    let file = folder.path().join("file");
    fs::write(&file, "kept").unwrap();
    assert!(save(file.join("scene.cif")).contains("file is not a folder"));
    assert_eq!(fs::read_to_string(&file).unwrap(), "kept");
    #[cfg(target_os = "linux")]
    assert!(save(PathBuf::from("/dev/null")).contains("it is not a regular file"));
}

#[cfg(unix)]
#[test]
fn a_read_only_folder_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.cif");
    testing::field(3, 1).save(&path).unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o555)).unwrap();
    // The superuser may write everywhere.
    let result = testing::field(4, 1).save(&path);
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
    match result {
        Err(error) => {
            assert!(error.to_string().contains("may not be written"), "{error}");
            assert_eq!(Field::load(&path).unwrap().len(), 3);
        }
        Ok(()) => assert_eq!(Field::load(&path).unwrap().len(), 4),
    }
}

#[cfg(unix)]
#[test]
fn a_link_stays_a_link() {
    let folder = tempfile::tempdir().unwrap();
    let (target, link) = (folder.path().join("target.cif"), folder.path().join("link.cif"));
    testing::field(3, 1).save(&target).unwrap();
    std::os::unix::fs::symlink(&target, &link).unwrap();
    testing::field(4, 1).save(&link).unwrap();
    assert!(link.is_symlink());
    assert_eq!(Field::load(&target).unwrap().len(), 4);
}

#[test]
fn heads_and_taxonomies_survive_and_raise_the_format() {
    let head = TrainingState {
        json: json!({ "name": "sa4d" }),
        tensors: BTreeMap::from([("weights".to_owned(), StateTensor::F32(vec![0.25, -1.5]))]),
    };
    let field = testing::field(4, 2);
    let format_of = |bytes: &[u8]| {
        let (_, header) = safetensors::SafeTensors::read_metadata(bytes).unwrap();
        header.metadata().clone().unwrap()["cif.format"].clone()
    };
    let plain = bytes_of(&Checkpoint { field: field.clone(), training: None, head: None });
    assert!(format_of(&plain).parse::<u32>().unwrap() < 7, "older software reads scenes without heads");
    let finished = Checkpoint { field, training: None, head: Some(head) };
    let bytes = bytes_of(&finished);
    assert_eq!(format_of(&bytes), "7");
    assert_eq!(read_bytes(&bytes).unwrap(), finished);
    let mut named = finished.clone();
    named.field.instances[1].taxonomies = [("coco".to_owned(), "cup".to_owned())].into();
    let with_taxonomies = bytes_of(&named);
    assert_eq!(format_of(&with_taxonomies), "8");
    assert_eq!(read_bytes(&with_taxonomies).unwrap(), named);
    assert_ne!(named.field.fingerprint(), finished.field.fingerprint());
    named.field.instances[1].taxonomies = [("a-b".to_owned(), "cup".to_owned())].into();
    assert!(named.field.validate().unwrap_err().to_string().contains("\"a-b\", which is no name in USD"));
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), &bytes).unwrap();
    assert_eq!(Field::load(file.path()).unwrap(), finished.field, "the scene is read without it");
}

/// One scene for each version of the layout, which holds what that version added.
fn of_every_format() -> Vec<Checkpoint> {
    let plain = Checkpoint { field: testing::field(6, 2), training: None, head: None };
    let mut still = plain.clone();
    still.field.deformation.as_mut().unwrap().still = (0..6).map(|row| row % 2 == 1).collect();
    let recorded = Checkpoint { field: testing::tracked_field(6, 4), training: None, head: None };
    let changed = |change: &dyn Fn(&mut crate::Tracks)| {
        let mut scene = recorded.clone();
        change(scene.field.tracks.as_mut().unwrap());
        scene
    };
    let moving = changed(&|tracks| {
        for group in &mut tracks.groups {
            (group.opacities, group.colors) = (None, None);
        }
    });
    let evident = changed(&|tracks| tracks.groups[0].rotation = Some(RotationEvidence::Observed));
    let joint = Joint { base: 0, kind: JointKind::Prismatic, axis: DVec3::Y };
    let jointed = changed(&|tracks| tracks.groups[2].joint = Some(joint));
    let head = TrainingState {
        json: json!({ "name": "sa4d" }),
        tensors: BTreeMap::from([("weights".to_owned(), StateTensor::F32(vec![0.25, -1.5]))]),
    };
    let headed = Checkpoint { head: Some(head), ..jointed.clone() };
    let mut named = headed.clone();
    named.field.instances[1].taxonomies = [("coco".to_owned(), "cup".to_owned())].into();
    let mut owned = named.clone();
    let id = owned.field.instances[1].id;
    for group in [0, 2] {
        owned.field.tracks.as_mut().unwrap().groups[group].instance = Some(id);
    }
    vec![plain, moving, still, recorded, evident, jointed, headed, named, owned]
}

/// Scenes as each version of the layout was written, which every later cif reads: `formats/N.cif`. That of a new version is
/// written where it is missing, which fails once; those that are there stay.
#[test]
fn scenes_of_all_formats_are_read() {
    let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/src/checkpoint/formats"));
    let contents = folder.join("contents.json");
    let text = fs::read_to_string(&contents).unwrap_or_else(|_| "{}".to_owned());
    let mut known: BTreeMap<u32, String> = serde_json::from_str(&text).unwrap();
    let mut written = Vec::new();
    for (format, scene) in (1..).zip(of_every_format()) {
        assert_eq!(format::format_of(&scene.field, scene.head.is_some()), format);
        let path = folder.join(format!("{format}.cif"));
        if let Entry::Vacant(place) = known.entry(format) {
            scene.save(&path).unwrap();
            place.insert(scene.field.fingerprint());
            written.push(format);
        }
    }
    if !written.is_empty() {
        fs::write(&contents, serde_json::to_string_pretty(&known).unwrap() + "\n").unwrap();
    }
    assert!(written.is_empty(), "scenes of the layouts {written:?} were missing and are written; keep them");
    assert_eq!(known.keys().copied().collect::<Vec<_>>(), (1..=FORMAT).collect::<Vec<_>>());
    for (format, fingerprint) in known {
        let path = folder.join(format!("{format}.cif"));
        let bytes = fs::read(&path).unwrap();
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
        assert_eq!(header.metadata().as_ref().unwrap()["cif.format"], format.to_string());
        let loaded = Checkpoint::load(&path).unwrap();
        assert_eq!(loaded.field.fingerprint(), fingerprint, "format {format}");
        assert_eq!(loaded.field.cameras.len(), 4);
        assert_eq!(loaded.head.is_some(), format >= 7);
        let joints =
            loaded.field.tracks.iter().flat_map(|tracks| &tracks.groups).filter_map(|group| group.joint);
        assert_eq!(joints.count(), usize::from(format >= 6));
    }
}
