//! `cif bench hardness` on a small capture: what must not matter does not, and nothing breaks.

use std::fs;
use std::path::Path;

use cif_test::capture;
use cif_test::command::{Run, run};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

/// A small model and few steps.
const SHORT: &str = "--quick --set motion.rigid=false --set stages.coarse=30 --set stages.fine=120 --set stages.instance=40 \
                     --set model.spatial_resolution=[8,8,8] --set model.width=16 --set model.channels=4";

#[test]
fn hard_captures_end_with_a_finite_scene() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("table"), 13);
    // Whether a change matters shows only in longer runs: here a difference may be reported, a failure may not.
    let output = cif(path, &format!("bench hardness table -o hard {SHORT}"));
    let report: Value =
        serde_json::from_str(&fs::read_to_string(path.join("hard/report.json")).unwrap()).unwrap();
    let rows = report["variants"].as_array().unwrap();
    assert!(rows.len() >= 9, "{report:#}");
    for row in rows {
        assert_ne!(row["verdict"], "failed", "{row:#}\n{}", output.stderr);
        assert!(row["psnr"].as_f64().is_some_and(f64::is_finite), "{row:#}");
        assert_eq!(row["rolled_back"], 0, "{row:#}");
    }
    assert!(rows[0]["notes"].to_string().contains("mean of 3 seeds: PSNR"), "{}", rows[0]);
    let of = |name: &str| rows.iter().find(|row| row["name"] == name).unwrap_or_else(|| panic!("{name}"));
    // The same frame, up to rounding: even short runs end close together.
    for name in ["scaled-down", "moved"] {
        let change = of(name)["psnr_change"].as_f64().unwrap();
        assert!(change.abs() < 1.0, "{name} changes PSNR by {change}");
        let notes = of(name)["notes"].to_string();
        assert!(notes.contains("in a frame of its own"), "{notes}");
    }
    assert!(fs::read_to_string(path.join("hard/report.md")).unwrap().contains("| wrong-camera |"));
}

#[test]
fn a_capture_far_away_trains_and_renders_as_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("far"), 5);
    for frame in 0..5 {
        capture::edit(&path.join(format!("far/camera/{frame:06}.json")), |camera| {
            let position = camera["position"].as_array().unwrap().clone();
            let moved: Vec<f64> = position.iter().map(|v| v.as_f64().unwrap() + 30_000.0).collect();
            camera["position"] = moved.into();
        });
    }
    // Points in single precision lie where the file puts them.
    let bytes = fs::read(path.join("far/points.npy")).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let mut moved = bytes[..start].to_vec();
    for value in bytes[start..].chunks_exact(4) {
        let value = f32::from_le_bytes(value.try_into().unwrap()) + 30_000.0;
        moved.extend(value.to_le_bytes());
    }
    fs::write(path.join("far/points.npy"), moved).unwrap();

    let tiny = "--iterations-coarse 6 --iterations-fine 8 --iterations-instance 6 -q";
    let output = cif(path, &format!("train far -o far.cif {tiny}")).succeeds();
    assert!(output.stderr.contains("in a frame of its own"), "{}", output.stderr);
    let facts: Value = serde_json::from_str(&cif(path, "info far.cif --json").succeeds().stdout).unwrap();
    let offset = &facts["provenance"]["dataset"]["frame"]["offset"];
    assert!((offset[2].as_f64().unwrap() - 30_001.1).abs() < 1.0, "{facts:#}");
    assert!(facts["box"]["to"][0].as_f64().unwrap().abs() < 10.0, "{facts:#}");
    let stderr = cif(path, "export far.cif --gltf far.glb").succeeds().stderr;
    assert!(stderr.contains("in a frame of its own"), "{stderr}");
    // Commands that open the capture again read it in the same frame.
    let scores = cif(path, "eval far.cif far --json -").succeeds().stdout;
    let scores: Value = serde_json::from_str(&scores).unwrap();
    let psnr = scores["psnr"].as_f64().or_else(|| scores["overall"]["psnr"].as_f64());
    assert!(psnr.is_none_or(|psnr| psnr > 8.0), "{scores:#}");
}

#[test]
fn unknown_variants_are_named() {
    let folder = tempfile::tempdir().unwrap();
    capture::write(&folder.path().join("table"), 4);
    cif(folder.path(), "bench hardness table -o hard --only nonsense")
        .fails(2, &["nonsense", "wrong-camera"]);
}
