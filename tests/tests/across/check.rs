//! `cif check`: sound scenes pass, broken ones are reported with counts and places, and repaired into a new file.

use std::fs;
use std::path::Path;

use cif_field::{Checkpoint, Field};
use cif_test::capture;
use cif_test::command::{Run, run};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

/// Trains a few steps, so that the scene has motion, identities and a training state.
fn with_scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    capture::write(&folder.path().join("table"), 5);
    let line = "train table -o table.cif -q --iterations-coarse 4 --iterations-fine 6 --iterations-instance 12 \
                --stop-after 20 --debug-validation --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    cif(folder.path(), line).succeeds();
    folder
}

/// Writes values into tensors of a scene behind its back: `cif` itself refuses to.
fn damage(path: &Path, tensor: &str, floats: &[(usize, f32)]) {
    let mut bytes = fs::read(path).unwrap();
    let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let json: Value = serde_json::from_slice(&bytes[8..8 + header]).unwrap();
    let start = json[tensor]["data_offsets"][0].as_u64().unwrap_or_else(|| panic!("{tensor}")) as usize;
    for (index, value) in floats {
        let at = 8 + header + start + 4 * index;
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_sound_scene_passes_and_a_broken_one_is_repaired() {
    let folder = with_scene();
    let path = folder.path();
    let sound = Checkpoint::load(path.join("table.cif")).unwrap();
    assert!(sound.training.is_some());
    let report: Value = serde_json::from_str(&cif(path, "check table.cif --json").succeeds().stdout).unwrap();
    assert_eq!((&report["broken"], &report["views_checked"]), (&0.into(), &true.into()), "{report:#}");
    let stdout = cif(path, "check table.cif").succeeds().stdout;
    assert!(stdout.contains(&format!("{} Gaussians", sound.field.len())), "{stdout}");

    // Moments alone: the state of the training stays.
    fs::copy(path.join("table.cif"), path.join("moments.cif")).unwrap();
    damage(&path.join("moments.cif"), "training.adam.means.second", &[(4, f32::NAN)]);
    cif(path, "check moments.cif").fails(1, &["moments.cif", "--fix"]);
    cif(path, "check moments.cif --fix mended.cif").succeeds();
    let mended = Checkpoint::load(path.join("mended.cif")).unwrap();
    assert_eq!(mended.field, sound.field);
    assert!(mended.training.is_some());

    fs::copy(path.join("table.cif"), path.join("broken.cif")).unwrap();
    let broken = path.join("broken.cif");
    damage(&broken, "gaussians.means", &[(3, f32::NAN), (10, f32::INFINITY)]);
    damage(&broken, "gaussians.quaternions", &[(28, 0.0), (29, 0.0), (30, 0.0), (31, 0.0)]);
    damage(&broken, "deformation.planes", &[(9, f32::NAN)]);
    let before = fs::read(&broken).unwrap();
    assert!(Field::load(&broken).is_err());
    let failed = cif(path, "check broken.cif --json");
    assert_eq!(failed.code, Some(1), "{}", failed.stderr);
    let report: Value = serde_json::from_str(&failed.stdout).unwrap();
    let findings = report["findings"].as_array().unwrap();
    let of = |check: &str, array: &str| {
        let found = findings.iter().find(|f| f["check"] == check && f["array"] == array);
        found.unwrap_or_else(|| panic!("{check} {array}: {report:#}")).clone()
    };
    assert_eq!(of("not finite", "means")["first"], serde_json::json!([1, 3]));
    assert_eq!(of("degenerate", "quaternions")["first"], serde_json::json!([7]));
    assert_eq!(of("not finite", "deformation.planes")["count"], 1);

    cif(path, "check broken.cif --fix broken.cif").fails(2, &["broken.cif is read by this command"]);
    cif(path, "check broken.cif --fix table.cif").fails(1, &["exists"]);
    let stdout = cif(path, "check broken.cif --fix repaired.cif").succeeds().stdout;
    assert!(stdout.contains("3 x Gaussians that cannot be drawn were removed"), "{stdout}");
    assert!(stdout.contains("training state was left out"), "{stdout}");
    assert_eq!(fs::read(&broken).unwrap(), before, "the broken scene is kept as it is");
    let repaired = Checkpoint::load(path.join("repaired.cif")).unwrap();
    assert_eq!(repaired.field.len(), sound.field.len() - 3);
    assert!(repaired.training.is_none());
    assert_eq!(repaired.field.gaussians.means[0], sound.field.gaussians.means[0]);
    assert_eq!(repaired.field.gaussians.means[1], sound.field.gaussians.means[2], "rows 1, 3 and 7 are gone");
    cif(path, "check repaired.cif").succeeds();
}

/// Rewrites what a scene says about itself behind its back.
fn rewrite(path: &Path, change: impl FnOnce(&mut Value)) {
    let bytes = fs::read(path).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let mut field: Value =
        serde_json::from_str(header["__metadata__"]["cif.field"].as_str().unwrap()).unwrap();
    change(&mut field);
    header["__metadata__"]["cif.field"] = field.to_string().into();
    let mut header = header.to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let mut written = (header.len() as u64).to_le_bytes().to_vec();
    written.extend(header);
    written.extend(&bytes[8 + length..]);
    fs::write(path, written).unwrap();
}

#[test]
fn camera_sizes_are_checked_before_memory_is_taken() {
    let folder = with_scene();
    let path = folder.path();
    let resize = |name: &str, width: u32, height: u32| {
        fs::copy(path.join("table.cif"), path.join(name)).unwrap();
        rewrite(&path.join(name), |field| {
            for record in field["cameras"].as_array_mut().unwrap().drain(1..) {
                drop(record);
            }
            let camera = &mut field["cameras"][0]["camera"];
            let factor = f64::from(width) / camera["width"].as_f64().unwrap();
            for key in ["focal_px", "principal_px"] {
                for axis in 0..2 {
                    camera[key][axis] = (camera[key][axis].as_f64().unwrap() * factor).into();
                }
            }
            (camera["width"], camera["height"]) = (width.into(), height.into());
        });
    };
    for (width, height, pixels) in
        [(60_000, 60_000, "has 3600000000, more than"), (u32::MAX, u32::MAX, "a side of 4294967295")]
    {
        resize("huge.cif", width, height);
        let run = cif(path, "check huge.cif --json");
        assert_eq!(run.code, Some(1), "{}", run.stderr);
        let report: Value = serde_json::from_str(&run.stdout).unwrap();
        assert_eq!(report["views_checked"], false);
        let findings = report["findings"].to_string();
        assert!(findings.contains("camera") && findings.contains(pixels), "{findings}");
        cif(path, "render huge.cif --capture table -o out").fails(1, &["huge.cif", pixels]);
    }
    // As wide, and within the limit.
    resize("wide.cif", 60_000, 16);
    let run = cif(path, "check wide.cif --json").succeeds();
    let report: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(report["views_checked"], true);
}

#[test]
fn points_at_absurd_distances_end_no_training() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("table"), 5);
    let points = path.join("table/points.npy");
    let mut bytes = fs::read(&points).unwrap();
    let first = bytes.len() - 6 * 12;
    for (point, far) in bytes[first..].chunks_exact_mut(12).zip([1e17_f32, -1e17, 1e20, -1e30, 1e38, 3e38]) {
        point[8..].copy_from_slice(&far.to_le_bytes());
    }
    fs::write(&points, bytes).unwrap();
    let line = "train table -o far.cif -q --iterations-coarse 2 --iterations-fine 4 --iterations-instance 4 \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    cif(path, line).succeeds();
    let report = cif(path, "check far.cif --json").stdout;
    assert!(report.contains("far away"), "{report}");
}

#[test]
fn what_is_no_scene_or_beyond_repair_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    cif(path, "check nothing.cif").fails(1, &["nothing.cif"]);
    fs::write(path.join("text.cif"), "hello, this is no scene").unwrap();
    cif(path, "check text.cif").fails(1, &["text.cif"]);
    capture::write(&path.join("table"), 4);
    cif(path, "check table").fails(1, &["is a folder"]);
    cif(path, "check table.cif --force").fails(2, &["--fix"]);
}
