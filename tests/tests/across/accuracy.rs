//! Reports of the cost of accuracy: the curve of a run, budgets and targets, drafts, and the report of ladders. How long
//! anything takes is not tested.

use std::fs;
use std::path::Path;

use cif_test::capture;
use cif_test::command::{Run, SMALL_MODEL as SMALL, json, run_line};
use serde_json::Value;

fn cif(folder: &Path, line: &str) -> Run {
    run_line(env!("CARGO_BIN_EXE_cif-under-test"), folder, line)
}

#[test]
fn a_run_tells_its_curve_and_a_draft_its_error() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let steps = "--iterations-coarse 10 --iterations-fine 120 --iterations-instance 30 --set stages.batch=1";
    cif(path, &format!("train table -o table.cif --log run.jsonl {steps} {SMALL}")).succeeds();
    let text = cif(path, "info table.cif").succeeds().stdout;
    assert!(text.contains("2 held-out frames; measuring took"), "{text}");
    assert!(
        text.contains("PSNR dB") && text.lines().any(|line| line.trim_start().starts_with("fine")),
        "{text}"
    );
    let facts = json(&cif(path, "info table.cif --json").succeeds().stdout);
    let points = facts["curve"]["points"].as_array().expect("a list of points");
    let at: Vec<(&str, u64)> =
        points.iter().map(|p| (p["stage"].as_str().unwrap(), p["step"].as_u64().unwrap())).collect();
    assert_eq!(at, [("fine", 110), ("fine", 130), ("identity", 130), ("instance", 160)]);
    assert!(points[0]["miou"].is_null() && points[3]["miou"].is_number());
    assert!(points.windows(2).all(|pair| pair[0]["wall_s"].as_f64() <= pair[1]["wall_s"].as_f64()));
    let log = fs::read_to_string(path.join("run.jsonl")).unwrap();
    let measured: Vec<Value> = log.lines().map(json).filter(|event| event["event"] == "measured").collect();
    assert_eq!(measured.len(), 4);
    assert_eq!(measured[1]["psnr"], points[1]["psnr"]);

    let stderr = cif(path, "render table.cif --capture table -o draft --quality draft").succeeds().stderr;
    assert!(stderr.contains("draft: PSNR") && stderr.contains("of 2 views measured"), "{stderr}");
    cif(path, "render table.cif --capture table -o final").succeeds();
    let picture = |folder: &str| image_size(&path.join(folder).join("rgb/000002.png"));
    assert_eq!(picture("draft"), picture("final"));
    cif(path, "render table.cif --capture table -o x --exr --quality draft").fails(2, &["--exr", "draft"]);
}

fn image_size(path: &Path) -> (u32, u32) {
    image::image_dimensions(path).expect("a picture")
}

#[test]
fn a_budget_says_what_it_buys_and_writes_the_settings_that_came_of_it() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let stderr = cif(path, &format!("train table -o table.cif --budget 2s {SMALL}")).succeeds().stderr;
    assert!(stderr.contains("budget 2 s: the settings of standard would take about"), "{stderr}");
    assert!(stderr.contains("of the budget of 2 s") && stderr.contains("\ntime: "), "{stderr}");
    let settings = fs::read_to_string(path.join("table.train.toml")).unwrap();
    let settings: toml::Table = settings.parse().unwrap();
    let facts = json(&cif(path, "info table.cif --json").succeeds().stdout);
    let steps = &facts["provenance"]["train"]["iterations_by_stage"];
    for stage in ["coarse", "fine", "instance"] {
        assert_eq!(settings["stages"][stage].as_integer(), steps[stage].as_i64(), "{stage}: {steps}");
        assert!(steps[stage].as_i64() > Some(0));
    }
    assert_eq!(facts["provenance"]["train"]["goals"]["budget"]["seconds"], 2.0);
    // Of the phases that are reported, those too short to be seen are left out; they count all the same.
    let times = &facts["provenance"]["train"]["wall_s_by_phase"];
    assert!(times["open"].as_f64() > Some(0.0) && times["fine"].as_f64() > Some(0.0), "{times}");

    cif(path, "train table -o b.cif --budget soon").fails(2, &["--budget"]);
    cif(path, "train table -o b.cif --budget 9s --iterations-fine 3").fails(2, &["--iterations-fine"]);
    cif(path, "train table -o b.cif --target-miou 120").fails(2, &["100 percent"]);
    cif(path, "train table -o b.cif --no-masks --target-miou 50")
        .fails(1, &["--target-miou", "labelled pixel"]);
}

#[test]
fn captures_without_points_say_what_they_start_from() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    fs::remove_file(path.join("table/points.npy")).unwrap();
    let short = format!("{SMALL} --iterations-coarse 3 --iterations-fine 3 --iterations-instance 0");
    let stderr = cif(path, &format!("train table -o a.cif {short}")).succeeds().stderr;
    // Which of the two depends on whether Python has pycolmap.
    let found = stderr.contains("were triangulated from its images");
    assert!(found != stderr.contains("points drawn at random"), "{stderr}");
    let triangulates = |scene: &str| {
        let settings: toml::Table =
            fs::read_to_string(path.join(format!("{scene}.train.toml"))).unwrap().parse().unwrap();
        settings["model"]["triangulate"].as_bool()
    };
    assert_eq!(triangulates("a"), Some(found), "a run that goes on starts from the same");
    let plain = cif(path, &format!("train table -o b.cif --set model.triangulate=false {short}"));
    assert!(!plain.succeeds().stderr.contains("triangulate"), "nothing is looked for");
    assert_eq!(triangulates("b"), Some(false));
}

#[test]
fn a_target_stops_a_run() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let line = format!("train table -o table.cif --target-psnr 8 --target-miou 5 {SMALL}");
    let stderr = cif(path, &line).succeeds().stderr;
    assert!(stderr.contains("targets reached on 1 training frames withheld from training: PSNR"), "{stderr}");
    let facts = json(&cif(path, "info table.cif --json").succeeds().stdout);
    let train = &facts["provenance"]["train"];
    assert!(train["iterations"].as_u64() < Some(2_500), "{train:#}");
    assert_eq!(train["goals"]["targets"]["reached"], true);
}

#[test]
fn a_report_holds_its_ladders_and_goes_on_where_it_stopped() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    capture::write_motion(&path.join("table"), 8);
    let short = "--set stages.coarse=5 --set stages.fine=20 --set stages.instance=10";
    let line = format!(
        "bench accuracy table -o report --quick --ladders sh,storage,precision,render,export {short} {SMALL}"
    );
    let stderr = cif(path, &line).succeeds().stderr;
    // Three degrees, of which the highest is the base; four, three, five and four of the others. A quick report
    // begins with the base and ends with what trains longest.
    assert!(stderr.contains("[1/19] sh: degree ") && stderr.contains("[17/19] export: 0.3 %: "), "{stderr}");
    assert!(stderr.contains("[18/19] sh: degree 0: ") && !stderr.contains("left out"), "{stderr}");
    let page = fs::read_to_string(path.join("report/report.html")).unwrap();
    for word in [
        "View-dependent colour",
        "Storage",
        "Precision",
        "Rendering",
        "Export tolerance",
        "<svg",
        "data:image/png",
        "Motion of objects",
        "<td>red ball</td>",
    ] {
        assert!(page.contains(word), "{word}");
    }
    let report = json(&fs::read_to_string(path.join("report/report.json")).unwrap());
    let rungs = report["rungs"].as_array().unwrap();
    assert_eq!(rungs.len(), 19);
    let moving = report["motion"]["instances"].as_array().unwrap();
    assert_eq!(moving.len(), 2);
    assert!(moving[0]["error_mm"].is_number(), "{moving:?}");
    let rung =
        |id: &str| rungs.iter().find(|rung| rung["id"] == id).unwrap_or_else(|| panic!("{id}: {report:#}"));
    assert!(rungs.iter().any(|rung| rung["front_psnr"] == true));
    assert!(rung("storage-all")["bytes"].as_u64() < rung("storage-f32")["bytes"].as_u64());
    assert_eq!(rung("storage-f32")["psnr"], rung("base")["psnr"]);
    assert_eq!(rung("precision-f64")["residual"], 0.0);
    let fast = rung("precision-fast")["residual"].as_f64().unwrap();
    assert!(fast > 0.0 && fast < 2e-3, "{fast}");
    assert_eq!(rung("render-final")["residual"], 0.0);
    assert!(rung("render-half")["residual"].as_f64() > Some(0.0));
    assert!(rung("export-0.3")["residual"].as_f64() <= rung("export-10")["residual"].as_f64());
    let table = fs::read_to_string(path.join("report/rungs.csv")).unwrap();
    assert_eq!(table.lines().count(), 20);

    // Everything is kept; a record that is gone is measured again, other settings make all of them void.
    fs::remove_file(path.join("report/rungs/sh-1.json")).unwrap();
    let stderr = cif(path, &line).succeeds().stderr;
    assert_eq!(stderr.matches(": kept, ").count(), 18, "{stderr}");
    let stderr = cif(path, &format!("{line} --set seed=5")).succeeds().stderr;
    assert_eq!(stderr.matches(": kept, ").count(), 0, "{stderr}");
    cif(path, "bench accuracy table -o table --quick").fails(1, &["not empty"]);
    cif(path, "bench accuracy table -o report --ladders none").fails(2, &["iterations", "export"]);
}

#[test]
fn the_configuration_of_the_paper_is_a_ladder_of_its_own_with_what_there_is_time_for() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let base = "--set stages.coarse=5 --set stages.fine=20 --set stages.instance=10 --set model.max_initial_points=300";
    let paper = "--paper-set model.max_initial_points=300 --paper-set model.spatial_resolution=[8,8,8]";
    let line = format!(
        "bench accuracy table -o paper --no-masks --ladders paper --paper-share 0.002 {paper} {base} {SMALL}"
    );
    let stderr = cif(path, &line).succeeds().stderr;
    assert!(
        stderr.contains("[1/2] paper: base: ") && stderr.contains("[2/2] paper: paper, 0.2 % of its steps: "),
        "{stderr}"
    );
    let report = json(&fs::read_to_string(path.join("paper/report.json")).unwrap());
    let rung = report["rungs"].as_array().unwrap().iter().find(|rung| rung["id"] == "paper").unwrap();
    let settings = [
        "preset=paper",
        "0.002 of its steps",
        "model.max_initial_points=300",
        "model.spatial_resolution=[8,8,8]",
    ];
    assert_eq!(rung["settings"], serde_json::json!(settings));
    assert!(rung["psnr"].is_number(), "{rung:#}");
    let kept = json(&fs::read_to_string(path.join("paper/rungs/paper.json")).unwrap());
    let trained = &kept["fingerprint"]["settings"];
    // Steps are shortened, what else the paper has for this layout is as it is.
    assert_eq!(
        trained["stages"],
        serde_json::json!({
            "coarse": 6, "fine": 20, "fine_includes_coarse": false, "instance": 6, "half_size": 0.0,
            "reduction": 1, "whole_size": 0.0, "batch": 2,
        })
    );
    assert_eq!((&trained["rates"]["schedule_steps"], &trained["downscale"]), (&40.into(), &2.into()));
    assert_eq!(trained["densify"]["max_gaussians"], 360_000);
    let page = fs::read_to_string(path.join("paper/report.html")).unwrap();
    for part in ["The paper's configuration", "<code>0.002 of its steps</code>", "--paper-share 0.002"] {
        assert!(page.contains(part), "{part}");
    }

    // An image that changes in place, under its name, makes all that was measured on it void.
    let stderr = cif(path, &line).succeeds().stderr;
    assert_eq!(stderr.matches(": kept, ").count(), 2, "{stderr}");
    fs::copy(path.join("table/rgb/1x/000001.png"), path.join("table/rgb/1x/000000.png")).unwrap();
    let stderr = cif(path, &line).succeeds().stderr;
    assert_eq!(
        stderr.matches("measured again: the image of frame 000000 has changed").count(),
        2,
        "{stderr}"
    );

    cif(path, "bench accuracy table -o x --paper-share 0.5").fails(2, &["--paper-share", "--ladders paper"]);
    cif(path, "bench accuracy table -o x --ladders paper --paper-share 0").fails(2, &["above 0"]);
    cif(path, "bench accuracy table -o x --ladders paper --paper-set model.wdth=3").fails(1, &["model.wdth"]);
}
