//! The command on a GPU (or lavapipe): `CIF_TEST_GPU=off|auto|require` says whether one is used.

use std::fs;
use std::path::Path;

use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, generate};
use cif_system::environment::TEST_GPU;
use cif_test::command::{Run, run};
use serde_json::{Value, json};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

/// What `cif info --gpu` says, when a GPU is to be used here.
fn gpu(folder: &Path) -> Option<Value> {
    let wish = TEST_GPU.text().unwrap_or_else(|| "auto".to_owned());
    assert!(["off", "auto", "require"].contains(&wish.as_str()), "CIF_TEST_GPU is {wish}");
    if wish == "off" {
        eprintln!("skipped: CIF_TEST_GPU=off");
        return None;
    }
    let facts: Value =
        serde_json::from_str(&cif(folder, "info --gpu --json").succeeds().stdout).expect("JSON on stdout");
    if facts["used"].is_null() {
        assert!(wish == "auto", "CIF_TEST_GPU=require: {}", facts["fault"]);
        eprintln!("skipped: {}", facts["fault"]);
        return None;
    }
    Some(facts)
}

/// A moving scene with instances, and a camera file.
fn write_scene(folder: &Path) {
    let config = SyntheticConfig {
        seed: 5,
        gaussians: 400,
        instances: 5,
        width: 90,
        height: 70,
        heads: Some(ALL_HEADS),
        screen_size: (0.01, 0.08),
    };
    let scene = generate(&config);
    let pose = scene.camera.camera_from_world.inverse();
    let row = |k: usize| {
        let r = pose.rotation.row(k);
        json!([r.x, r.y, r.z, pose.translation[k]])
    };
    let view = json!([{
        "name": "a", "width": 90, "height": 70, "time": 0.4,
        "focal_px": scene.camera.focal_px.to_array(), "principal_px": scene.camera.principal_px.to_array(),
        "world_from_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
    }]);
    fs::write(folder.join("views.json"), view.to_string()).unwrap();
    scene.field.save(folder.join("scene.cif")).unwrap();
}

#[test]
fn info_tells_of_gpus_without_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    let Some(facts) = gpu(folder.path()) else { return };
    let first = &facts["adapters"][0];
    for key in ["name", "interface", "kind", "driver", "software", "timestamps", "limits", "used"] {
        assert!(!first[key].is_null(), "{key} in {first}");
    }
    assert!(first["limits"]["bytes_per_binding"].as_u64().unwrap() >= 128 << 20);
    let text = cif(folder.path(), "info --gpu").succeeds().stdout;
    assert!(text.contains(first["name"].as_str().unwrap()) && text.contains("bytes per binding"), "{text}");
    cif(folder.path(), "info").fails(2, &["CAPTURE"]);
    cif(folder.path(), "info table --gpu").fails(2, &["--gpu"]);
}

#[test]
fn a_gpu_renders_what_the_processor_renders() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let Some(facts) = gpu(path) else { return };
    write_scene(path);
    let what = "rgb,depth,alpha,instance,probability,foreground,coverage,entropy";
    for backend in ["cpu", "wgpu"] {
        cif(
            path,
            &format!("render scene.cif --camera views.json --what {what} --backend {backend} -o {backend}"),
        )
        .succeeds();
    }
    for layer in what.split(',') {
        let [a, b] = ["cpu", "wgpu"].map(|backend| {
            image::open(path.join(backend).join(layer).join("a.png")).unwrap().into_rgb16().into_raw()
        });
        // A step of 8 or 16 bits, and a few pixels where the two round to other sides of a threshold.
        let step = if layer == "rgb" { 257 } else { 20 };
        let far = a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > step).count();
        assert!(far * 50 < a.len(), "{layer}: {far} of {} values differ", a.len());
        assert!(a.iter().any(|value| *value > 0), "{layer} shows something");
    }
    // A draft leaves the same out on both, and keeps colours in 16 bits on the GPU.
    for backend in ["cpu", "wgpu"] {
        let line = "render scene.cif --camera views.json --quality draft --backend";
        let stderr = cif(path, &format!("{line} {backend} -o draft_{backend}")).succeeds().stderr;
        assert!(stderr.contains("draft: PSNR"), "{stderr}");
    }
    let [a, b] = ["draft_cpu", "draft_wgpu"]
        .map(|name| image::open(path.join(name).join("rgb/a.png")).unwrap().into_rgb8().into_raw());
    let far = a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > 1).count();
    assert!(far * 50 < a.len(), "{far} of {} values differ", a.len());
    let software = facts["adapters"][0]["software"].as_bool().unwrap();
    let stderr = cif(path, "render scene.cif --camera views.json -o auto").succeeds().stderr;
    assert!(stderr.contains(if software { "software" } else { "a view" }), "{stderr}");
    cif(path, "render scene.cif --camera views.json --exr --backend wgpu -o exr").fails(2, &["EXR"]);
}

#[test]
fn a_step_is_reported_by_stage_with_its_floor_and_the_processor() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let Some(facts) = gpu(path) else { return };
    cif_test::capture::write(&path.join("table"), 4);
    let line = "bench step table --backend wgpu --steps 2 --warm-up 1 --set model.spatial_resolution=[8,8,8]";
    let stdout = cif(path, &format!("{line} --json -")).succeeds().stdout;
    let report: Value = serde_json::from_str(&stdout).expect("JSON on stdout");
    let device = &report["device"];
    for key in ["bytes_per_second", "flops_per_second", "step_ms", "processor_step_ms"] {
        assert!(device[key].as_f64().unwrap_or_default() > 0.0, "{key}: {device:#}");
    }
    let ratio = device["processor_step_ms"].as_f64().unwrap() / device["step_ms"].as_f64().unwrap();
    assert!((device["times_as_fast_as_processor"].as_f64().unwrap() / ratio - 1.0).abs() < 1e-9);
    assert!(device["subgroups"].is_string(), "{device:#}");
    let stages = device["stages"].as_array().unwrap();
    if facts["adapters"][0]["timestamps"].as_bool().unwrap() {
        for name in ["deform", "project", "sort by depth", "rasterize", "losses", "optimiser: planes"] {
            let stage = stages.iter().find(|stage| stage["name"] == name);
            let stage = stage.unwrap_or_else(|| panic!("{name}: {device:#}"));
            for key in ["ms", "floor_ms", "share_of_floor", "bytes"] {
                assert!(stage[key].as_f64().unwrap_or_default() > 0.0, "{name}, {key}: {stage:#}");
            }
            assert!(stage["floor_by"] == "memory" || stage["floor_by"] == "arithmetic", "{stage:#}");
        }
        let blended = stages.iter().find(|stage| stage["name"] == "rasterize").unwrap();
        assert!(blended["flops"].as_f64().unwrap() > 0.0, "pairs are counted on the processor: {blended:#}");
    }
    let table = cif(path, line).succeeds().stdout;
    assert!(table.contains("GB/s by a copy") && table.contains("the processor does such a step"), "{table}");
}

/// Steps differ in their constants, for which a driver may keep what it compiled.
#[test]
fn memory_does_not_grow_with_the_steps() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    if gpu(path).is_none() {
        return;
    }
    cif_test::capture::write(&path.join("table"), 4);
    let peak_mb = |steps: u32| {
        let line = format!(
            "train table -o {steps}.cif --backend wgpu --preset draft --log {steps}.jsonl \
             --set stages.coarse={steps} --set stages.fine=1 --set stages.instance=0 --set densify.until=1"
        );
        cif(path, &line).succeeds();
        let log = std::fs::read_to_string(path.join(format!("{steps}.jsonl"))).unwrap();
        let events = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        events.filter_map(|event| event["peak_rss_mb"].as_f64()).next_back()
    };
    let Some((few, many)) = peak_mb(40).zip(peak_mb(190)) else {
        eprintln!("skipped: this system does not report how much memory a process takes");
        return;
    };
    // A megabyte that each of 150 more steps keeps would show.
    assert!(many < few + 50.0, "{few} MB after 40 steps, {many} MB after 190");
}

#[test]
fn features_that_are_held_back_change_no_picture_and_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let Some(facts) = gpu(path) else { return };
    write_scene(path);
    let with = |features: &str, line: &str| {
        let mut command = std::process::Command::new(CIF);
        command.args(line.split_whitespace()).current_dir(path);
        command.env("CIF_GPU_FEATURES", features).env("NO_COLOR", "1").output().unwrap()
    };
    for features in ["all", "none"] {
        let line = format!("render scene.cif --camera views.json --backend wgpu -o {features}");
        let rendered = with(features, &line);
        assert!(rendered.status.success(), "{}", String::from_utf8_lossy(&rendered.stderr));
    }
    let picture = |features: &str| std::fs::read(path.join(features).join("rgb/a.png")).unwrap();
    assert_eq!(picture("all"), picture("none"));
    let text = String::from_utf8(with("none", "info --gpu").stdout).unwrap();
    assert!(text.contains("CIF_GPU_FEATURES") && !text.contains("times of stages"), "{text}");
    if !facts["adapters"][0]["subgroups"].is_null() {
        let all = String::from_utf8(with("all", "info --gpu").stdout).unwrap();
        assert!(all.contains("its subgroups are") && all.contains("known numbers"), "{all}");
        assert!(text.contains("its subgroups are not used"), "{text}");
    }
    let refused = with("tensors", "info --gpu");
    let text = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && text.contains("subgroups, timestamps"), "{text}");
}

#[test]
fn a_gpu_that_is_not_there_is_said_clearly() {
    let folder = tempfile::tempdir().unwrap();
    write_scene(folder.path());
    let line = "render scene.cif --camera views.json -o out --backend";
    let with = |backend: &str| {
        let mut command = std::process::Command::new(CIF);
        command.args(line.split_whitespace()).arg(backend).current_dir(folder.path());
        command.env("WGPU_ADAPTER_NAME", "no such GPU").env("NO_COLOR", "1");
        command.output().unwrap()
    };
    let refused = with("wgpu");
    let text = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{text}");
    assert!(text.contains("WGPU_ADAPTER_NAME") && text.contains("--backend"), "{text}");
    assert!(!folder.path().join("out/rgb").exists(), "nothing is written");
    let fine = with("auto");
    assert!(fine.status.success() && folder.path().join("out/rgb/a.png").exists());
}
