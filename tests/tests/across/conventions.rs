//! One convention each: reports as JSON, times, names of outputs, names that were meant, quiet, completions.

use std::fs;
use std::path::Path;

use cif_field::Field;
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, generate};
use cif_test::capture;
use cif_test::command::{Run, json, run, run_line};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// A camera file of one view.
const VIEWS: &str = r#"[{"name": "a", "width": 8, "height": 6, "vertical_fov_deg": 50,
    "position": [0, -2, 1], "look_at": [0, 0, 0]}]"#;

fn cif(folder: &Path, line: &str) -> Run {
    run_line(CIF, folder, line)
}

/// A folder with a moving scene of 11 frames, 20 a second, in `t.cif`: a red mug, a blue mug and a box.
fn with_scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let config = SyntheticConfig { gaussians: 40, heads: Some(ALL_HEADS), ..SyntheticConfig::default() };
    let mut field: Field = generate(&config).field;
    field.timeline.times = (0..11).map(|frame| f64::from(frame) / 10.0).collect();
    field.timeline.frames_per_second = 20.0;
    for (instance, (label, category)) in
        field.instances.iter_mut().zip([("red mug", "mug"), ("blue mug", "mug"), ("box", "box")])
    {
        (instance.label, instance.category) = (label.to_owned(), category.to_owned());
    }
    field.save(folder.path().join("t.cif")).unwrap();
    folder
}

#[test]
fn reports_are_printed_or_written() {
    let folder = with_scene();
    let path = folder.path();
    capture::write(&path.join("table"), 4);
    cif(path, "export t.cif t.glb").succeeds();
    for line in [
        "info --json table",
        "info t.cif --json",
        "plan --json table",
        "query --json t.cif",
        "query t.glb --json --label box",
        "query t.cif --point 0,0,0 --json",
        "diff --json t.cif t.glb",
        "check --json t.cif",
        "eval --json t.cif table --no-masks",
        "export t.cif --json",
        "export --json t.cif u.glb",
        "import t.glb -o back.cif --json",
        "import t.glb --base t.cif -o home.cif --json",
        "label --json t.glb --instance 1 cup -o cup.glb",
        "masks import table/masks -o masks-again --capture table --json",
        "masks zigzag --json table -o sequence",
        "bench step table --steps 1 --warm-up 0 --stage coarse --preset draft --json",
        "bench export --json t.cif --no-files --tolerances 1%",
    ] {
        let printed = cif(path, line).succeeds().stdout;
        let report: Value =
            serde_json::from_str(&printed).unwrap_or_else(|e| panic!("{line}: {e}: {printed}"));
        assert!(report.is_object() || report.is_array(), "{line}: {printed}");
    }
    // With a file the tables stay, and the file is kept as any other is.
    let printed = cif(path, "query --json found.json t.cif").succeeds().stdout;
    assert!(printed.contains("red mug") && !printed.starts_with('['), "{printed}");
    let written = fs::read_to_string(path.join("found.json")).unwrap();
    assert_eq!(json(&written), json(&cif(path, "query t.cif --json").succeeds().stdout));
    cif(path, "query t.cif --json found.json --label box").fails(1, &["found.json exists", "--force"]);
    assert_eq!(fs::read_to_string(path.join("found.json")).unwrap(), written);
    cif(path, "query t.cif --json found.json --label box --force").succeeds();
    assert_ne!(fs::read_to_string(path.join("found.json")).unwrap(), written);
    // Of a render that is what lies where.
    fs::write(path.join("views.json"), VIEWS).unwrap();
    let printed =
        cif(path, "render t.cif --camera views.json -o out --what rgb,depth --json").succeeds().stdout;
    let files = &json(&printed)["views"][0]["files"];
    for layer in ["rgb", "depth"] {
        let file = files[layer].as_str().unwrap_or_else(|| panic!("{printed}"));
        assert!(path.join(file).is_file(), "{file}");
    }
    cif(path, "plan table --json no/where.json").fails(1, &["no/where.json"]);
    // A name that no report has is explained, and one that is another file's is refused.
    cif(path, "query t.cif --json found.txt").fails(2, &["--json found.json"]);
    cif(path, "query t.cif --json=t.cif --force").fails(2, &["t.json"]);
    assert!(Field::load(path.join("t.cif")).is_ok());
}

#[test]
fn times_mean_the_same_in_a_scene_and_in_its_files() {
    let folder = with_scene();
    let path = folder.path();
    cif(path, "export t.cif t.glb").succeeds();
    let place = |file: &str, time: &str| -> Vec<f64> {
        let found = json(&cif(path, &format!("query {file} --time {time} --json")).succeeds().stdout);
        let rows =
            |one: &Value| (0..3).map(|row| one["transform"][row][3].as_f64().unwrap()).collect::<Vec<_>>();
        found.as_array().unwrap().iter().flat_map(rows).collect()
    };
    for file in ["t.cif", "t.glb"] {
        let half = place(file, "5");
        assert_eq!(half, place(file, "0.25s"), "{file}");
        assert_eq!(half, place(file, "50%"), "{file}");
        assert_ne!(half, place(file, "10"), "{file}: it moves");
    }
    // The box moves by parts in both, with the same samples; the red mug, whose splats move one by one, does not in glTF.
    let places =
        |file: &str| (0..=10).map(|frame| place(file, &format!("{frame} --label box"))).collect::<Vec<_>>();
    let (scene, exported) = (places("t.cif"), places("t.glb"));
    for (frame, (here, there)) in scene.iter().zip(&exported).enumerate() {
        assert!(
            here.iter().zip(there).all(|(a, b)| (a - b).abs() < 1e-4),
            "frame {frame}: {here:?} {there:?}"
        );
    }
    let step = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(
        scene.windows(2).any(|pair| step(&pair[0], &pair[1]) > 1e-2),
        "frames could not be distinguished"
    );
    // Beyond the end the range is named, in frames and seconds.
    for file in ["t.cif", "t.glb"] {
        for line in [format!("query {file} --time 200"), format!("query {file} --interval 20:30")] {
            cif(path, &line).fails(2, &[file, "frames 0 to 10, 0.50 seconds"]);
        }
        cif(path, &format!("query {file} --time 0.6s")).fails(2, &["0s to 0.50s"]);
        cif(path, &format!("query {file} --interval 5:2")).fails(2, &["the earlier time comes first"]);
    }
    cif(path, "query t.cif --point 0,0,0 --time 11").fails(2, &["frames 0 to 10"]);
    cif(path, "export t.cif t.ply --ply-time 11").fails(2, &["--ply-time 11", "frames 0 to 10"]);
    cif(path, "export t.cif --json --ply-time 1").fails(2, &["--ply-time", "OUT.ply"]);
    fs::write(path.join("views.json"), VIEWS).unwrap();
    cif(path, "render t.cif --camera views.json -o out --time 1s").fails(2, &["frames 0 to 10"]);
    assert!(!path.join("out").exists());
    cif(path, "render t.cif --camera views.json -o out --time 0.5s").succeeds();
    // What was half way once is said to be something else.
    let noted = cif(path, "query t.cif --time 0.5").succeeds().stderr;
    assert!(noted.contains("50% is that share"), "{noted}");
    cif(path, "capture a.mp4 -o c --from 3").fails(2, &["3s"]);
}

#[test]
fn outputs_of_another_kind_are_refused_with_the_fix() {
    let folder = with_scene();
    let path = folder.path();
    capture::write(&path.join("table"), 4);
    for (line, fix) in [
        ("train table -o x.ply", "cif export x.cif x.ply"),
        ("train table -o x", "x.cif"),
        ("train table -o x.cif --log x.json", "x.jsonl"),
        ("import t.glb -o x.usda", "x.cif"),
        ("check t.cif --fix x.glb", "x.cif"),
        ("embed t.cif --capture table --models m -o x.usda", "x.cif"),
        ("render t.cif --capture table --exr -o out.mp4", "-o views"),
        ("render t.cif --capture table -o out.png", "without .png: out"),
        ("eval t.cif table --images look.png", "without .png: look"),
        ("masks import table/masks -o out.json --capture table", "without .json: out"),
        ("masks propagate table --keyframes k -o out.png", "without .png: out"),
        ("masks zigzag table -o out.mp4", "without .mp4: out"),
        ("capture walk.mp4 -o table.cif", "without .cif: table"),
        ("make walk.mp4 -o table.usda", "without .usda: table"),
        ("bench accuracy table -o report.html", "without .html: report"),
        ("bench hardness table -o report.json", "without .json: report"),
        ("bench compare table -o compare.html", "without .html: compare"),
        ("export t.cif x.cif", ".usda"),
        ("export t.cif x.splat", ".ply"),
        ("export t.cif --usd x.glb", ".usda"),
    ] {
        cif(path, line).fails(2, &[fix]);
    }
    let names: Vec<_> = fs::read_dir(path).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names.len(), 2, "nothing was written: {names:?}");
}

#[test]
fn force_and_reports_that_cannot_be_are_refused_with_the_reason() {
    let folder = with_scene();
    let path = folder.path();
    cif(path, "masks propagate table --keyframes k -o out --force")
        .fails(2, &["--json alone", "there is none"]);
    cif(path, "info t.cif --force").fails(2, &["there is none"]);
    cif(path, "make walk.mp4 -o table --json").fails(2, &["--json make.json"]);
    cif(path, "info t.cif --json t.json").succeeds();
    cif(path, "make walk.mp4 -o table --json t.json").fails(1, &["t.json exists", "--force"]);
}

#[test]
fn endings_of_outputs_decide_their_formats() {
    let folder = with_scene();
    let path = folder.path();
    cif(path, "export t.cif a.glb a.ply").succeeds();
    cif(path, "export t.cif --gltf b.glb --ply b.ply").succeeds();
    for ending in ["glb", "ply"] {
        let read = |name: &str| fs::read(path.join(format!("{name}.{ending}"))).unwrap();
        assert_eq!(read("a"), read("b"), "{ending}");
    }
    cif(path, "export t.cif a.glb").fails(1, &["a.glb exists", "--force"]);
    cif(path, "export t.cif c.glb --gltf c.glb").fails(1, &["written twice"]);
    // The scene of this test records no cameras to look from; what is checked is the file that was named alone.
    cif(path, "export t.cif c.ply --check").fails(1, &["no cameras", "--capture"]);
}

#[test]
fn names_that_were_meant_are_suggested() {
    let folder = with_scene();
    let path = folder.path();
    cif(path, "export t.cif t.glb").succeeds();
    for file in ["t.cif", "t.glb"] {
        cif(path, &format!("query {file} --label red_mug")).fails(1, &["did you mean 'red mug'?"]);
        cif(path, &format!("query {file} --label Boxs")).fails(1, &["did you mean 'box'?", "known labels"]);
        let words = ["label", file, "--instance", "red mug", "cup"];
        let meant = run(CIF, path, words);
        assert!(meant.stderr.contains("red_mug_"), "{}", meant.stderr);
        assert!(meant.stderr.contains("did you mean"), "{}", meant.stderr);
    }
    let none = cif(path, "query t.cif --label teapot");
    assert!(!none.stderr.contains("did you mean"), "{}", none.stderr);
    none.fails(1, &["known labels"]);
}

#[test]
fn quiet_commands_say_what_was_asked_and_no_more() {
    let folder = with_scene();
    let path = folder.path();
    let loud = cif(path, "export t.cif loud.glb").succeeds().stderr;
    assert!(loud.contains("wrote loud.glb"), "{loud}");
    let warnings: String =
        loud.lines().filter(|line| line.starts_with("warning: ")).map(|l| format!("{l}\n")).collect();
    for line in ["-q export t.cif a.glb", "export -q t.cif b.glb", "export t.cif c.glb --quiet"] {
        let run = cif(path, line).succeeds();
        assert_eq!(run.stderr, warnings, "{line}");
        assert!(run.stdout.contains("red mug"), "{line}: tables are what was asked for");
    }
    cif(path, "-q export t.cif a.glb").fails(1, &["a.glb exists"]);
    // Commands with a progress of their own follow the same flag.
    for command in ["train", "capture", "make", "masks import", "masks propagate"] {
        let help = cif(path, &format!("{command} --help")).succeeds().stdout;
        assert_eq!(help.matches("--quiet").count(), 1, "{command}");
    }
}

#[test]
fn shells_and_manuals_know_the_commands() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = cif(path, &format!("completions {shell}")).succeeds().stdout;
        assert!(script.contains("propagate") && script.contains("ply-time"), "{shell}");
    }
    cif(path, "completions tcsh").fails(2, &["bash", "zsh"]);
    cif(path, "man pages").succeeds();
    let page = fs::read_to_string(path.join("pages/cif-masks-propagate.1")).unwrap();
    assert!(page.contains(".TH cif") && page.contains("keyframes"), "{page}");
    let root = fs::read_to_string(path.join("pages/cif.1")).unwrap();
    assert!(root.contains("cif\\-train"));
    assert!(!root.contains("SIMD"), "a page is of no machine: {root}");
    cif(path, "man pages").fails(1, &["exists", "--force"]);
    cif(path, "man pages --force").succeeds();
}
