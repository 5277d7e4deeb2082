//! `cif render --look recorded` shows what the cameras of a capture make of colours.

use std::path::Path;
use std::process::Command;

use cif_dataset::{Dataset, OpenOptions};
use cif_field::{Exposure, TimedExposure};
use cif_render::synthetic::{SyntheticConfig, generate};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");
const CAPTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/tabletop-mini");

/// Error output of the command, and whether it succeeded.
fn cif(folder: &Path, arguments: &[&str]) -> (bool, String) {
    let output = Command::new(CIF).args(arguments).current_dir(folder).output().expect("the command starts");
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn pictures_have_the_exposure_of_their_camera_where_they_are_to() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path();
    let dataset = Dataset::open(CAPTURE, &OpenOptions::default()).expect("the example is there");
    let config = SyntheticConfig { gaussians: 40, instances: 2, ..SyntheticConfig::default() };
    let mut field = generate(&config).field;
    field.save(path.join("plain.cif")).expect("the folder can be written");
    // A quarter as bright as the scene.
    let timed = |time: f64, gain: f32| TimedExposure {
        time,
        exposure: Exposure { gain: [gain; 3], offset: [0.0; 3] },
    };
    for frame in &dataset.frames {
        let series = vec![timed(0.0, 0.25), timed(1.0, 0.25)];
        field.record.drawing.exposures_in_time.insert(frame.camera_name.clone(), series);
    }
    field.save(path.join("scene.cif")).expect("the folder can be written");
    let brightness = |look: &str| -> f64 {
        let line =
            ["render", "scene.cif", "--capture", CAPTURE, "--backend", "cpu", "--look", look, "-o", look];
        let (succeeded, message) = cif(path, &line);
        assert!(succeeded, "{message}");
        let folder = path.join(look).join("rgb");
        let pictures =
            std::fs::read_dir(folder).expect("pictures").map(|entry| entry.expect("an entry").path());
        let pixels = pictures.flat_map(|path| image::open(path).expect("a picture").into_rgb8().into_raw());
        pixels.map(f64::from).sum()
    };
    let share = brightness("recorded") / brightness("mean");
    assert!((share - 0.25).abs() < 0.02, "{share}");
    // A camera of which training saw nothing has no recorded look.
    let series = field.record.drawing.exposures_in_time.values().next().cloned().expect("a camera");
    field.record.drawing.exposures_in_time = [("elsewhere".to_owned(), series)].into();
    field.save(path.join("others.cif")).expect("the folder can be written");
    let line = ["render", "others.cif", "--capture", CAPTURE, "--look", "recorded", "-o", "others"];
    let (succeeded, message) = cif(path, &line);
    assert!(succeeded && message.contains("views have the mean look"), "{message}");
    for (scene, views, why) in [
        ("plain.cif", ["--capture", CAPTURE], "learnt no exposures"),
        ("scene.cif", ["--camera", "views.json"], "--look recorded is that of a camera of a capture"),
    ] {
        let line = ["render", scene, views[0], views[1], "--look", "recorded", "-o", "refused"];
        let (succeeded, message) = cif(path, &line);
        assert!(!succeeded && message.contains(why), "{message}");
        assert!(!path.join("refused").exists());
    }
}
