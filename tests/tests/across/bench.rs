//! `cif bench`: every part of a step has a row, the JSON has the same, and wrong input is named. How long
//! anything takes is not tested.

use std::fs;
use std::path::Path;

use cif_test::capture;
use cif_test::command::{Run, run};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Parts of a step, as the table and the JSON name them.
const PARTS: [&str; 14] = [
    "deform",
    "project",
    "bin and sort",
    "rasterize",
    "losses",
    "rasterize backward",
    "project backward",
    "deform backward",
    "optimiser: Gaussians",
    "optimiser: planes",
    "optimiser: network",
    "densify, resample",
    "other",
    "total",
];

/// Few steps of a small model.
const SHORT: &str = "--steps 3 --warm-up 1 --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

fn with_capture() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    capture::write(&folder.path().join("table"), 4);
    folder
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// Checks that parts are there, and sum to the total.
fn check_parts(report: &Value) {
    let stages = report["stages"].as_object().expect("a table of stages");
    assert_eq!(stages.len(), PARTS.len(), "{report:#}");
    let mean = |part: &str| stages[part]["mean_ms"].as_f64().unwrap_or_else(|| panic!("{part}: {report:#}"));
    assert!(mean("total") > 0.0);
    let sum: f64 = PARTS.iter().filter(|part| **part != "total").map(|part| mean(part)).sum();
    assert!((sum / mean("total") - 1.0).abs() < 1e-6, "{sum}: {report:#}");
    assert!(PARTS.iter().all(|part| stages[*part]["median_ms"].is_number()));
    let floor = |part: &str| stages[part]["floor"]["ms"].as_f64();
    assert!(PARTS[..10].iter().all(|part| floor(part) >= Some(0.0)), "{report:#}");
    assert!(floor("rasterize") > Some(0.0) && floor("total").is_none(), "{report:#}");
    let units = &report["units"];
    let count = |unit: &str| units[unit]["per_step"].as_f64().unwrap_or_else(|| panic!("{unit}: {report:#}"));
    assert!(count("Gaussians") >= count("visible Gaussians"));
    assert!(count("visible Gaussians") >= count("Gaussians deformed backward"));
    assert!(count("evaluated pairs") > count("tile pairs") && count("tile pairs") > 0.0, "{report:#}");
    assert!(report["evaluated_pairs_per_second_and_thread"].as_f64() > Some(0.0), "{report:#}");
}

#[test]
fn every_part_of_a_step_is_in_the_table_and_the_json() {
    let folder = with_capture();
    let path = folder.path();
    let line = format!("bench step table --threads 2 --simd portable --json cost.json {SHORT}");
    let table = cif(path, &line).succeeds().stdout;
    assert!(table.contains("fine stage, 3 steps after 1, 2 threads"), "{table}");
    for row in PARTS {
        assert!(table.lines().any(|line| line.trim_start().starts_with(row)), "{row} in {table}");
    }
    assert!(table.contains("evaluated pairs per second"), "{table}");
    let report = json(&fs::read_to_string(path.join("cost.json")).unwrap());
    check_parts(&report);
    assert_eq!((&report["stage"], &report["steps"]), (&"fine".into(), &3.into()));
    assert_eq!((&report["warm_up"], &report["threads"]), (&1.into(), &2.into()));
    assert_eq!(report["instance_pass"], Value::Array(vec![]));
    assert!(report["units"]["Gaussians deformed backward"]["per_step"].as_f64().unwrap() > 0.0);

    // Without motion nothing is deformed.
    let coarse =
        json(&cif(path, &format!("bench step table --stage coarse --json - {SHORT}")).succeeds().stdout);
    check_parts(&coarse);
    assert_eq!(coarse["units"]["Gaussians deformed backward"]["per_step"], 0.0);

    cif(path, &line).fails(1, &["cost.json exists", "--force"]);
}

#[test]
fn the_instance_pass_is_compared_for_any_number_of_instances() {
    let folder = with_capture();
    let path = folder.path();
    let tiny = "--iterations-coarse 6 --iterations-fine 6 --iterations-instance 6 \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    cif(path, &format!("train table -o scene.cif --simd portable {tiny}")).succeeds();
    let facts = json(&cif(path, "info scene.cif --json").succeeds().stdout);
    assert!(facts["provenance"]["train"]["simd"].is_string(), "{facts:#}");

    // The stage is that of the scene; refreshed identities and resampling meet the longer tables too.
    let line = "bench step table --scene scene.cif --instances 40,2,8 --steps 4 --warm-up 1 \
                --set resample.every=2 --set resample.from=1 --set identity.refresh_every=3 --json -";
    let report = json(&cif(path, line).succeeds().stdout);
    check_parts(&report);
    assert_eq!((&report["stage"], &report["instances"]), (&"instance".into(), &2.into()));
    let passes = report["instance_pass"].as_array().unwrap();
    let tables: Vec<&Value> = passes.iter().map(|pass| &pass["instances"]).collect();
    assert_eq!(tables, [2, 2, 8, 40]);
    for key in ["raster_ms", "raster_ms_without", "raster_overhead_percent", "total_overhead_percent"] {
        assert!(passes.iter().all(|pass| pass[key].is_number()), "{key}: {report:#}");
    }
    cif(path, "bench step table --scene scene.cif --instances 1").fails(1, &["2 instances"]);
    let facts_after = json(&cif(path, "info scene.cif --json").succeeds().stdout);
    assert_eq!(facts, facts_after, "measuring leaves the scene alone");

    // Without a scene, identities are estimated first; the table gives the overhead.
    let table = cif(path, &format!("bench step table --stage instance {SHORT}")).succeeds().stdout;
    assert!(table.contains("Instance pass on top of colour") && table.contains('%'), "{table}");
}

#[test]
fn growth_is_measured_by_gaussians_and_pixels() {
    let folder = with_capture();
    let path = folder.path();
    let line = "bench growth table --threads 2 --reductions 1,2";
    let report = json(&cif(path, &format!("{line} --gaussians 400,1200 --json -")).succeeds().stdout);
    let cells = report["cells"].as_array().unwrap();
    let counts: Vec<&Value> = cells.iter().map(|cell| &cell["gaussians"]).collect();
    assert_eq!(counts, [400, 1200, 400, 1200], "fewer and more than the points of the capture");
    let width = |cell: usize| cells[cell]["image_size"][0].as_u64().unwrap();
    assert_eq!((width(0), width(2)), (width(1), width(0) / 2));
    assert!(cells.iter().all(|cell| cell["ms"].as_f64() > Some(0.0) && cell["steps"].as_u64() >= Some(3)));
    for slopes in ["by_gaussians", "by_pixels"] {
        let slopes = report[slopes].as_array().unwrap();
        assert!(slopes.len() == 2 && slopes.iter().all(|slope| slope["exponent"].is_number()), "{report:#}");
    }
    let pairs = |cell: usize| cells[cell]["evaluated_pairs"].as_f64().unwrap();
    assert!(pairs(0) > pairs(2), "{report:#}");
}

#[test]
fn the_ladder_of_tolerances_tells_what_gltf_misses() {
    let folder = with_capture();
    let path = folder.path();
    let tiny = "--iterations-coarse 6 --iterations-fine 6 --iterations-instance 6 \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    // So few steps teach the network next to nothing: all would be taken to stand still.
    cif(path, &format!("train table -o scene.cif --effects all {tiny}")).succeeds();
    let line = "bench export scene.cif --tolerances 0.000001,50%";
    let report = json(&cif(path, &format!("{line} --json -")).succeeds().stdout);
    let rungs = report["rungs"].as_array().unwrap();
    assert_eq!(rungs.len(), 2);
    for rung in rungs {
        let files = rung["files"].as_array().unwrap();
        let gltf = files.iter().find(|file| file["format"] == "glTF").unwrap();
        assert!(
            gltf["bytes"].as_u64().unwrap() > 1000 && gltf["seconds"].as_f64().unwrap() >= 0.0,
            "{gltf:#}"
        );
        let dense =
            rung["models"].as_array().unwrap().iter().find(|count| count["model"] == "dense").unwrap();
        let is_dense = dense["nodes"].as_u64().unwrap() > 0;
        assert_eq!(gltf["simplified"].is_object(), is_dense, "{rung:#}");
        let outside = gltf["nodes_outside"].as_u64().unwrap();
        assert_eq!(outside > 0, gltf["worst_share"].as_f64().unwrap() > 1.0, "{gltf:#}");
        for row in gltf["simplified"]["nodes"].as_array().into_iter().flatten() {
            assert_ne!(row["model"], "dense", "{row:#}");
        }
    }
    assert!(
        rungs[0]["files"].as_array().unwrap().iter().any(|file| file["simplified"].is_object()),
        "{report:#}"
    );
    let table = cif(path, line).succeeds().stdout;
    assert!(table.contains("glTF") && table.contains("worst") && table.contains("decisive"), "{table}");
    let bare = json(&cif(path, &format!("{line} --no-files --json -")).succeeds().stdout);
    assert!(bare["rungs"].as_array().unwrap().iter().all(|rung| rung["files"] == serde_json::json!([])));
}

#[test]
fn wrong_input_is_named() {
    let folder = with_capture();
    let path = folder.path();
    cif(path, "bench").fails(2, &["step"]);
    cif(path, "bench step").fails(2, &["CAPTURE"]);
    cif(path, "bench step nowhere").fails(1, &["nowhere"]);
    cif(path, "bench step table --scene nowhere.cif").fails(1, &["nowhere.cif"]);
    cif(path, "bench step table --steps 0").fails(2, &["--steps"]);
    cif(path, "bench step table --stage identity").fails(2, &["coarse, fine, instance"]);
    cif(path, "bench step table --instances 8").fails(2, &["--stage instance"]);
    cif(path, "bench step table --stage fine --instances 8").fails(2, &["--stage instance"]);
    cif(path, "bench step nowhere --preset fast").fails(1, &["fast", "draft, standard, best, paper"]);
    cif(path, "bench step nowhere --set stages.fien=3").fails(1, &["stages.fine"]);
    cif(path, "bench step table --json no/where.json").fails(1, &["no/where.json"]);
    fs::remove_dir_all(path.join("table/masks")).unwrap();
    cif(path, "bench step table --stage instance").fails(1, &["no training mask"]);
}
