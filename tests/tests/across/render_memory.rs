//! `cif render` takes the memory of a band of rows, whatever the size of the view.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use cif_render::synthetic::{SyntheticConfig, generate};
use serde_json::json;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// A scene of a few Gaussians with instances in `scene.cif`, and a square view of it in `views.json`.
fn write_scene(folder: &Path, size: u32) {
    let config = SyntheticConfig { gaussians: 30, instances: 2, ..SyntheticConfig::default() };
    let scene = generate(&config);
    let camera = scene.camera.resized(size, size);
    let pose = camera.camera_from_world.inverse();
    let row = |k: usize| {
        let r = pose.rotation.row(k);
        json!([r.x, r.y, r.z, pose.translation[k]])
    };
    let view = json!([{
        "name": "a", "width": size, "height": size,
        "focal_px": camera.focal_px.to_array(), "principal_px": camera.principal_px.to_array(),
        "world_from_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
    }]);
    fs::write(folder.join("views.json"), view.to_string()).expect("the folder can be written");
    scene.field.save(folder.join("scene.cif")).expect("the folder can be written");
}

/// Runs the command and watches the peak of its resident memory, bytes.
fn peak_of(folder: &Path, line: &str) -> u64 {
    let mut command = Command::new(CIF);
    command.args(line.split_whitespace()).current_dir(folder).stderr(Stdio::null());
    let mut child = command.spawn().expect("the command starts");
    let mut peak = 0;
    loop {
        if let Some(status) = child.try_wait().expect("the command is a child") {
            assert!(status.success(), "{line}: {status}");
            return peak * 1024;
        }
        let status = fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
        let line = status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or_default();
        peak = peak.max(line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).unwrap_or(0));
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_large_view_takes_the_memory_of_a_band() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path();
    let line = "render scene.cif --camera views.json --force --backend cpu --what rgb,instance,depth -o";
    write_scene(path, 64);
    let small = peak_of(path, &format!("{line} small"));
    write_scene(path, 2560);
    let large = peak_of(path, &format!("{line} large"));
    // A band takes 256 MiB; drawn at once, the view took 530.
    assert!(large - small < 384 << 20, "{} MiB more than a small view", (large - small) >> 20);
    let read = |name: &str| image::open(path.join(name)).expect("a picture").into_rgb16();
    assert_eq!(read("large/rgb/a.png").dimensions(), (2560, 2560));
    assert_eq!(read("large/instance/a.png").dimensions(), (2560, 2560));
}

#[test]
fn depths_that_memory_does_not_hold_are_refused_before_they_are_drawn() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    write_scene(folder.path(), 16_384);
    let line = format!(
        "ulimit -v 1000000; exec {CIF} --threads 1 render scene.cif --camera views.json --backend cpu --what depth-color \
         -o out"
    );
    let output =
        Command::new("sh").args(["-c", &line]).current_dir(folder.path()).output().expect("sh starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("1.1 GB of memory (16384 x 16384 depths x 4 bytes)"), "{stderr}");
    assert!(!folder.path().join("out").exists());
}
