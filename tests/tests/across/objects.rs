//! Objects found again: in EXR files, by place, time and 2D masks, and under another name.

use std::fs;
use std::path::Path;

use cif_dataset::{Dataset, OpenOptions, cryptomatte};
use cif_field::Checkpoint;
use cif_test::capture::{self, ROLLING, STANDING};
use cif_test::command::{Run, run};
use image::{GrayImage, Luma};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Settings of a run of a few seconds, too few for what stands still to settle.
const SHORT: &str = "--iterations-coarse 150 --iterations-fine 350 --iterations-instance 100 \
                     --set model.spatial_resolution=[16,16,16] --set densify.until=300 --max-gaussians 2000 \
                     --set motion.stillness=0";

/// A detector in the shell: what it finds are the masks in `answers/`.
const DETECTOR: &str = r#"test "$1" = "blue ball" || { echo "first words" >&2; echo "never heard of $1" >&2; exit 3; }
for frame in "$2"/*.png; do cp "answers/$(basename "$frame" .png)_0.png" "$3/"; done
"#;

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

fn words(folder: &Path, words: &[&str]) -> Run {
    run(CIF, folder, words)
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// Writes what a detector that finds one instance would: white on black, one file per frame.
fn detections(capture: &Path, folder: &Path, id: u16) {
    fs::create_dir_all(folder).unwrap();
    for entry in fs::read_dir(capture.join("masks")).unwrap() {
        let path = entry.unwrap().path();
        let mask = image::open(&path).unwrap().into_luma8();
        let found = GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
            Luma([if u16::from(mask.get_pixel(x, y).0[0]) == id { 255 } else { 0 }])
        });
        found.save(folder.join(format!("{}_0.png", path.file_stem().unwrap().to_string_lossy()))).unwrap();
    }
}

#[test]
fn a_scene_shows_and_tells_its_objects() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let table = path.join("table");
    capture::write(&table, 16);
    cif(path, &format!("train table -o scene.cif --seed 1 {SHORT}")).succeeds();

    // EXR files, whose Cryptomatte is a mask folder of the capture.
    cif(path, "render scene.cif --capture table --split val -o views --exr").succeeds();
    assert!(!path.join("views/rgb").exists(), "pictures are written only when asked for");
    let file = path.join("views/exr/000002.exr");
    let matte = cryptomatte::read(&file).unwrap();
    let names: Vec<&str> = matte.objects.keys().map(String::as_str).collect();
    assert_eq!(names, ["background", "blue ball", "red ball"]);
    fs::rename(path.join("views/exr"), table.join("mattes")).unwrap();
    let options = |masks: &str| OpenOptions { masks: Some(masks.into()), ..OpenOptions::default() };
    let truth = Dataset::open(&table, &OpenOptions::default()).unwrap();
    let read = Dataset::open(&table, &options("mattes")).unwrap();
    assert_eq!(read.instances, truth.instances);
    let (mut same, mut labelled) = (0, 0);
    for index in truth.val_frames() {
        let (a, b) = (truth.load_mask(index).unwrap().unwrap(), read.load_mask(index).unwrap().unwrap());
        for (a, b) in a.pixels.iter().zip(&b.pixels).filter(|(a, b)| **a != 0 || **b != 0) {
            labelled += 1;
            same += usize::from(a == b);
        }
    }
    assert!(labelled > 200 && same * 10 > labelled * 6, "{same} of {labelled} labelled pixels agree");
    let info = cif(path, "info table --masks mattes").succeeds().stdout;
    assert!(info.contains("blue ball"), "{info}");
    cif(path, "eval scene.cif table --masks mattes").succeeds();
    // A damaged file is named.
    let bytes = fs::read(table.join("mattes/000002.exr")).unwrap();
    fs::write(table.join("mattes/000002.exr"), &bytes[..bytes.len() / 2]).unwrap();
    cif(path, "info table --masks mattes").fails(1, &["000002.exr", "export it again"]);

    // By place and time.
    let all = json(&cif(path, "query scene.cif --json").succeeds().stdout);
    let listed: Vec<&str> = all.as_array().unwrap().iter().filter_map(|one| one["label"].as_str()).collect();
    assert_eq!(listed, ["red ball", "blue ball", "background", "moving background"]);
    // On average over the capture: a scene of seconds of training wavers from frame to frame.
    let line = "query scene.cif --label ball --taxonomy class --interval 0%:100% --json";
    let moving = json(&cif(path, line).succeeds().stdout);
    let speed = |one: &Value| one["speed"].as_f64().unwrap();
    assert!(speed(&moving[0]) > speed(&moving[1]), "{moving:#}");
    assert!(moving.as_array().unwrap().iter().all(|one| one["volume"].as_f64().unwrap() > 0.0));
    let near = |id: u16, time: f64| {
        let at = capture::centre(id, time);
        let (low, high) = (at - 0.02, at + 0.02);
        format!(
            "--box={},{},{},{},{},{} --time {}%",
            low.x,
            low.y,
            low.z,
            high.x,
            high.y,
            high.z,
            100.0 * time
        )
    };
    let hit = |question: &str| -> Vec<String> {
        let found =
            json(&cif(path, &format!("query scene.cif --label *ball {question} --json")).succeeds().stdout);
        found.as_array().unwrap().iter().map(|one| one["label"].as_str().unwrap().to_owned()).collect()
    };
    assert!(hit(&near(STANDING, 0.0)).contains(&"blue ball".to_owned()));
    assert!(hit(&near(ROLLING, 0.0)).contains(&"red ball".to_owned()));
    assert!(hit("--box 5,5,5,6,6,6").is_empty());
    assert_eq!(hit("--interval 0%:100%").len(), 2);
    let elsewhere = cif(path, "query scene.cif --box 5,5,5,6,6,6").succeeds().stdout;
    assert!(elsewhere.contains("scene.cif has no such object"), "{elsewhere}");
    cif(path, "query scene.cif --label ball --taxonomy instance").fails(1, &["ball", "red_ball_003"]);

    // By a name in the vocabulary of others, also in an exported file and in what comes back of it.
    cif(path, "export scene.cif --gltf named.glb").succeeds();
    cif(path, "import named.glb -o back.cif").succeeds();
    for file in ["scene.cif", "named.glb", "back.cif"] {
        let line = format!("query {file} --taxonomy wikidata_qcode=Q18545 --json");
        let found = json(&cif(path, &line).succeeds().stdout);
        let labels: Vec<_> = found.as_array().unwrap().iter().map(|one| one["label"].clone()).collect();
        assert_eq!(labels, ["red ball"], "{file}");
    }
    cif(path, "query scene.cif --taxonomy coco=ball").fails(1, &["ball"]);
    cif(path, "query scene.cif --taxonomy wikidata_qcode=Q18545 --label ball").fails(2, &["--label"]);
    for file in ["table", "scene.cif"] {
        let stdout = cif(path, &format!("info {file}")).succeeds().stdout;
        assert!(stdout.contains("wikidata_qcode Q18545"), "{stdout}");
    }

    // By masks of a detector.
    detections(&table, &path.join("answers"), STANDING);
    let found = json(
        &cif(path, "query scene.cif --masks answers --capture table --eval -o shown --json")
            .succeeds()
            .stdout,
    );
    let best = &found["instances"][0];
    assert_eq!((&best["label"], &best["chosen"]), (&"blue ball".into(), &true.into()), "{found:#}");
    assert!(best["score"].as_f64().unwrap() > 0.6, "{found:#}");
    assert!(found["instances"].as_array().unwrap().iter().skip(1).all(|one| one["chosen"] == false));
    assert_eq!((&found["frames"], &found["eval"]["frames"]), (&12.into(), &4.into()));
    assert!(found["eval"]["miou"].as_f64().unwrap() > 50.0, "{found:#}");
    assert!(found["eval"]["macc"].as_f64().unwrap() > 90.0, "{found:#}");
    let shown = image::open(path.join("shown/000002.png")).unwrap().into_luma16();
    assert!(shown.pixels().any(|pixel| pixel.0[0] == u16::MAX));
    let inside = |gate: &str| {
        let line = format!(
            "query scene.cif --masks answers --capture table --eval -o gate{gate} --foreground {gate} --json"
        );
        cif(path, &line).succeeds();
        let shown = image::open(path.join(format!("gate{gate}/000002.png"))).unwrap().into_luma16();
        shown.pixels().filter(|pixel| pixel.0[0] == u16::MAX).count()
    };
    let default = shown.pixels().filter(|pixel| pixel.0[0] == u16::MAX).count();
    assert_eq!(inside("0.5"), default);
    assert!(inside("0") > default && default > inside("0.95"), "the gate keeps faint occupancy out");
    for select in ["gaussian", "both"] {
        let line = format!("query scene.cif --masks answers --capture table --select {select} --eval --json");
        let found = json(&cif(path, &line).succeeds().stdout);
        assert!(found["eval"]["miou"].as_f64().unwrap() > 30.0, "{select}: {found:#}");
    }

    // By a detector of one's own.
    fs::write(path.join("detect.sh"), DETECTOR).unwrap();
    let ask = |prompt: &str, detector: &str| {
        words(
            path,
            &[
                "query",
                "scene.cif",
                "--prompt",
                prompt,
                "--capture",
                "table",
                "--detector",
                detector,
                "--eval",
            ],
        )
    };
    let table_of = ask("blue ball", "sh detect.sh {prompt} {frames} {masks}").succeeds().stdout;
    assert!(table_of.contains("blue ball") && table_of.contains("mIoU"), "{table_of}");
    ask("teapot", "sh detect.sh {prompt} {frames} {masks}")
        .fails(1, &["exit code 3", "first words", "never heard of teapot"]);
    ask("teapot", "true").fails(1, &["wrote no mask"]);
    ask("teapot", "no-such-detector").fails(1, &["no-such-detector", "cannot be started"]);
    ask("teapot", "sh 'open").fails(2, &["quotes"]);

    // Under another name; the state of the training stays.
    cif(path, "label scene.cif --instance 9 x").fails(1, &["'9'", "3 red ball, 7 blue ball"]);
    words(path, &["label", "scene.cif", "--instance", "7", "green ball", "-o", "renamed.cif"]).succeeds();
    let found =
        json(&words(path, &["query", "renamed.cif", "--label", "green ball", "--json"]).succeeds().stdout);
    assert_eq!((&found[0]["instance"], &found[0]["class"]), (&"green_ball_007".into(), &"ball".into()));
    let before = Checkpoint::load(path.join("scene.cif")).unwrap();
    words(path, &["label", "scene.cif", "--instance", "red_ball_003", "apple", "--category", "fruit"])
        .succeeds();
    let after = Checkpoint::load(path.join("scene.cif")).unwrap();
    let renamed = &after.field.instances[0];
    assert_eq!((renamed.id, renamed.label.as_str(), renamed.category.as_str()), (3, "apple", "fruit"));
    assert_eq!((&after.field.gaussians, &after.training), (&before.field.gaussians, &before.training));
    words(path, &["label", "scene.cif", "--instance", "3", "x", "-o", "renamed.cif"])
        .fails(1, &["renamed.cif exists"]);
    words(path, &["label", "scene.cif", "--instance", "3", "  "]).fails(2, &["empty"]);
}

#[test]
fn questions_that_cannot_be_asked_end_with_2() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    cif(path, "query a.cif --point 1,2").fails(2, &["three"]);
    cif(path, "query a.cif --box 1,2,3").fails(2, &["six"]);
    cif(path, "query a.cif --interval 3").fails(2, &["earlier"]);
    cif(path, "query a.cif --interval 0:x").fails(2, &["seconds (1.5s)"]);
    cif(path, "query a.cif --point 1,2,3 --label x").fails(2, &["without other conditions"]);
    cif(path, "query a.txt").fails(2, &[".cif, .usda"]);
    cif(path, "query a.cif --masks m").fails(2, &["--capture"]);
    cif(path, "query a.cif --masks m --capture c --eval --foreground 2").fails(2, &["0 to 1"]);
    cif(path, "query a.cif --prompt x --capture c").fails(2, &["--detector"]);
    cif(path, "query a.usda --masks m --capture c").fails(2, &["trained scene"]);
    cif(path, "render a.cif --capture c -o out --exr-color display").fails(2, &["--exr"]);
}
