//! The command as people meet it: help, exit codes, and what it says to wrong input.

use std::fs;
use std::path::Path;

#[path = "../../../crates/cif-dataset/tests/support/mod.rs"]
mod captures;

use cif_field::{Field, Gaussians, RecordedCamera, SortMetric, Timeline};
use cif_test::capture;
use cif_test::command::{Run, run};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Runs the command in a folder; arguments are split at blanks.
fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// A folder with a capture of four frames in `table/`.
fn with_capture() -> tempfile::TempDir {
    let folder = folder();
    capture::write(&folder.path().join("table"), 4);
    folder
}

/// Everything in a folder and below, for proofs that nothing was written.
fn listing(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(&folder).expect("the folder can be read") {
            let path = entry.expect("the folder can be read").path();
            if path.is_dir() {
                open.push(path.clone());
            }
            found.push(path.display().to_string());
        }
    }
    found.sort();
    found
}

#[test]
fn help_teaches_the_tool() {
    let folder = folder();
    let help = cif(folder.path(), "--help").succeeds().stdout;
    for word in [
        "demo",
        "capture",
        "train",
        "eval",
        "render",
        "export",
        "import",
        "diff",
        "query",
        "label",
        "info",
        "masks",
        "bench",
        "A short tour",
        "Exit code",
    ] {
        assert!(help.contains(word), "{word} in {help}");
    }
    let commands = [
        "demo",
        "train",
        "eval",
        "render",
        "export",
        "import",
        "diff",
        "query",
        "label",
        "info",
        "masks import",
        "masks propagate",
        "masks zigzag",
        "masks split",
    ];
    for command in commands.into_iter().chain(["bench step", "bench accuracy"]) {
        let help = cif(folder.path(), &format!("{command} --help")).succeeds().stdout;
        assert!(help.contains("Usage: cif"), "{help}");
    }
    let short = cif(folder.path(), "-V").succeeds().stdout;
    assert_eq!(short, concat!("cif ", env!("CARGO_PKG_VERSION"), "\n"));
    let long = cif(folder.path(), "--version").succeeds().stdout;
    let rows: Vec<&str> = long.strip_prefix(&short).expect("the same first line").lines().collect();
    let named = |name: &str| rows.iter().find_map(|row| row.strip_prefix(name)).map(str::trim);
    assert!(named("features").is_some_and(|value| !value.is_empty()), "{long}");
    assert!(named("SIMD").is_some_and(|value| !value.is_empty()), "{long}");
    if let Some(commit) = named("commit") {
        let hash = commit.strip_suffix("-dirty").unwrap_or(commit);
        assert!(hash.len() >= 7 && hash.chars().all(|letter| letter.is_ascii_hexdigit()), "{long}");
    }
}

#[test]
fn what_is_not_understood_ends_with_2() {
    let folder = folder();
    cif(folder.path(), "tran").fails(2, &["train"]);
    cif(folder.path(), "").fails(2, &["Usage"]);
    cif(folder.path(), "train table").fails(2, &["--output"]);
    cif(folder.path(), "train table -o a.cif --resume --seed 3").fails(2, &["--resume"]);
    cif(folder.path(), "train table -o a.cif --from b.cif --no-masks").fails(2, &["--from", "--no-masks"]);
    cif(folder.path(), "train table -o a.cif --ablate everything").fails(2, &["no-resampling"]);
    cif(folder.path(), "train table -o a.cif --set seed").fails(2, &["KEY=VALUE"]);
    cif(folder.path(), "render a.cif -o out").fails(2, &["--capture"]);
    cif(folder.path(), "render a.cif --capture table -o out --time 3x").fails(2, &["seconds (1.5s)"]);
    cif(folder.path(), "train table -o a.cif --simd widest").fails(2, &["avx2", "portable"]);
    cif(folder.path(), "query a.cif --at 1,2").fails(2, &["three"]);
    cif(folder.path(), "label a.cif x").fails(2, &["--instance"]);
    cif(folder.path(), "export a.cif").fails(2, &["--usd"]);
    cif(folder.path(), "export a.cif --usd out.glb").fails(2, &[".usda"]);
    cif(folder.path(), "export a.cif --usd out.usda --tolerance much").fails(2, &["1%"]);
    cif(folder.path(), "export a.cif --gltf out.usda").fails(2, &[".glb"]);
    cif(folder.path(), "export a.cif --ply out.splat").fails(2, &[".ply"]);
    cif(folder.path(), "export a.cif --ply out.ply --ply-split").fails(2, &["folder"]);
    cif(folder.path(), "export a.cif --ply out.ply --ply-time two").fails(2, &["seconds (1.5s)"]);
    cif(folder.path(), "export a.cif --report --ply-sequence").fails(2, &["--ply"]);
}

#[test]
fn missing_captures_and_scenes_are_named() {
    let folder = folder();
    cif(folder.path(), "train nowhere -o a.cif").fails(1, &["nowhere"]);
    cif(folder.path(), "info nowhere").fails(1, &["nowhere"]);
    cif(folder.path(), "info nowhere.cif").fails(1, &["nowhere.cif"]);
    cif(folder.path(), "eval nowhere.cif table").fails(1, &["nowhere.cif"]);
    fs::create_dir(folder.path().join("empty")).unwrap();
    cif(folder.path(), "train empty -o a.cif").fails(1, &["empty", "dataset.json"]);
    cif(folder.path(), "eval empty empty").fails(1, &["cif train"]);
    assert_eq!(listing(folder.path()).len(), 1, "nothing was written");
}

#[test]
fn presets_follow_the_layout_of_the_capture() {
    let folder = captures::dnerf(2, 1);
    let path = folder.path();
    let steps = "--preset paper --set stages.coarse=1 --set stages.fine=1 --set stages.instance=0";
    cif(path.parent().unwrap(), &format!("train {} -o {}/a.cif {steps}", path.display(), path.display()))
        .succeeds();
    let settings = fs::read_to_string(path.join("a.train.toml")).unwrap().replace(char::is_whitespace, "");
    assert!(settings.contains("multipliers=[1,2,]"), "{settings}");
    assert!(!settings.contains("downscale=2"), "images of D-NeRF are trained as they are: {settings}");
}

#[test]
fn settings_of_published_scenes_are_taken() {
    let settings = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/settings");
    let (neu3d, hypernerf) = (captures::neu3d(2, 2), captures::hypernerf(4));
    for (file, folder, expected) in [
        ("hypernerf-chickchicken.toml", &hypernerf, ["time_resolution=80", "batch=2", "rate=0.01"]),
        ("neu3d-batch-2.toml", &neu3d, ["time_resolution=150", "batch=2", "rate=0.05"]),
    ] {
        let (path, file) = (folder.path().display(), settings.join(file));
        let steps = "--set stages.coarse=1 --set stages.fine=1 --set stages.instance=0";
        let line = format!("train {path} -o {path}/a.cif --config {} {steps}", file.display());
        cif(folder.path().parent().unwrap(), &line).succeeds();
        let settings = fs::read_to_string(folder.path().join("a.train.toml")).unwrap();
        for key in expected {
            let (name, value) = key.split_once('=').unwrap();
            assert!(settings.contains(&format!("{name} = {value}")), "{key}: {settings}");
        }
    }
    let files = listing(&settings).len();
    assert_eq!(files, 2, "every file has a row here and in examples/README.md");
}

#[test]
fn settings_that_cannot_be_are_refused_before_anything_is_read() {
    let folder = folder();
    let path = folder.path();
    cif(path, "train nowhere -o a.cif --preset fast").fails(1, &["fast", "draft, standard, best, paper"]);
    cif(path, "train nowhere -o a.cif --set stages.fien=3").fails(1, &["stages.fien", "stages.fine"]);
    cif(path, "train nowhere -o a.cif --set stages.fine=many").fails(1, &["stages.fine"]);
    cif(path, "train nowhere -o a.cif --batch 0").fails(1, &["stages.batch"]);
    cif(path, "train nowhere -o a.cif --batch 4294967295").fails(1, &["stages.batch", "1 to 1024"]);
    cif(path, "train nowhere -o a.cif --config none.toml").fails(1, &["none.toml"]);
    fs::write(path.join("mine.toml"), "seed = 3\n\n[stages]\nfien = 20\n").unwrap();
    cif(path, "train nowhere -o a.cif --config mine.toml").fails(1, &["mine.toml:4", "fien", "stages.fine"]);
    fs::write(path.join("mine.toml"), "seed = 3\n[stages\n").unwrap();
    cif(path, "train nowhere -o a.cif --config mine.toml").fails(1, &["mine.toml:2"]);
    fs::write(path.join("mine.toml"), "preset = \"quick\"\n").unwrap();
    cif(path, "train nowhere -o a.cif --config mine.toml").fails(1, &["quick", "standard"]);
    assert_eq!(listing(path).len(), 1, "nothing was written");
}

#[test]
fn settings_out_of_range_name_the_line_or_the_flag() {
    let folder = folder();
    let path = folder.path();
    fs::write(path.join("mine.toml"), "seed = 3\n\n[stages]\nbatch = 0\n").unwrap();
    cif(path, "train nowhere -o a.cif --config mine.toml").fails(1, &["mine.toml:4", "stages.batch", "is 0"]);
    cif(path, "train nowhere -o a.cif --set rates.opacity=-1").fails(1, &["--set rates.opacity", "is -1"]);
    cif(path, "train nowhere -o a.cif --config mine.toml --batch 0").fails(1, &["--batch", "is 0"]);
    cif(path, "train nowhere -o a.cif --motion-of mug=stiff").fails(1, &["--motion-of", "stiff", "rigid"]);
    cif(path, "train nowhere -o a.cif --motion-of mug").fails(2, &["--motion-of mug", "LABEL=MOTION"]);
    cif(path, "bench step nowhere --set stages.batch=0").fails(1, &["--set stages.batch", "is 0"]);
}

/// Nothing waits for a pipe that nobody writes to, or reads a device without an end.
#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused() {
    let folder = folder();
    let path = folder.path();
    let kinds = ["cif", "glb", "ply", "toml"];
    for kind in kinds {
        let pipe = path.join(format!("pipe.{kind}"));
        assert!(std::process::Command::new("mkfifo").arg(pipe).status().unwrap().success());
        std::os::unix::fs::symlink("/dev/zero", path.join(format!("zero.{kind}"))).unwrap();
    }
    for (name, words) in [("pipe", "a named pipe"), ("zero", "a device")] {
        for (line, kind) in [
            ("info {}.cif", "cif"),
            ("check {}.cif", "cif"),
            ("query {}.cif --label mug", "cif"),
            ("query {}.glb --label mug", "glb"),
            ("label {}.glb --instance 1 mug", "glb"),
            ("import {}.ply -o a.cif", "ply"),
            ("train nowhere -o a.cif --config {}.toml", "toml"),
        ] {
            cif(path, &line.replace("{}", name)).fails(1, &[&format!("{name}.{kind}"), words]);
        }
    }
}

#[test]
fn outputs_are_checked_before_training() {
    let folder = with_capture();
    let path = folder.path();
    cif(path, "train table -o no/where/a.cif").fails(1, &["no/where", "mkdir -p"]);
    cif(path, "train table -o table").fails(2, &["end its name in .cif: table/scene.cif"]);
    cif(path, "train table -o a.cif --resume").fails(1, &["a.cif", "nothing to resume"]);
    cif(path, "train table -o a.cif --from b.cif").fails(1, &["b.cif", "no such scene"]);
    fs::write(path.join("kept.cif"), "precious").unwrap();
    cif(path, "train table -o a.cif --from kept.cif").fails(1, &["kept.cif"]);
    cif(path, "train table -o kept.cif").fails(1, &["kept.cif exists", "--force"]);
    cif(path, "train table -o a.cif --log kept.cif").fails(2, &["kept.jsonl"]);
    fs::write(path.join("kept.jsonl"), "precious").unwrap();
    cif(path, "train table -o a.cif --log kept.jsonl").fails(1, &["kept.jsonl exists"]);
    assert_eq!(fs::read_to_string(path.join("kept.jsonl")).unwrap(), "precious");
    fs::write(path.join("b.train.toml"), "# mine").unwrap();
    cif(path, "train table -o b.cif").fails(1, &["b.train.toml exists"]);
    assert_eq!(fs::read_to_string(path.join("kept.cif")).unwrap(), "precious");
    assert_eq!(fs::read_to_string(path.join("b.train.toml")).unwrap(), "# mine");
}

#[cfg(target_os = "linux")]
#[test]
fn a_folder_that_cannot_be_written_is_refused_before_training() {
    // /proc refuses new files even to the superuser.
    let folder = with_capture();
    cif(folder.path(), "train table -o /proc/a.cif").fails(1, &["/proc"]);
}

#[test]
fn files_that_are_no_scenes_are_refused() {
    let folder = with_capture();
    let path = folder.path();
    fs::write(path.join("text.cif"), "hello").unwrap();
    cif(path, "eval text.cif table").fails(1, &["text.cif", "not a cif scene"]);
    // A header that announces more than there is must not be believed.
    let mut bytes = u64::MAX.to_le_bytes().to_vec();
    bytes.extend(b"{}");
    fs::write(path.join("large.cif"), &bytes).unwrap();
    cif(path, "info large.cif").fails(1, &["large.cif"]);
    // A foreign safetensors file.
    let header = br#"{"__metadata__":{"format":"pt"}}"#;
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header);
    fs::write(path.join("foreign.cif"), &bytes).unwrap();
    cif(path, "query foreign.cif --label x").fails(1, &["foreign.cif", "cif.format"]);
}

#[test]
fn captures_are_described() {
    let folder = with_capture();
    let text = cif(folder.path(), "info table").succeeds().stdout;
    for word in ["hyper-nerf", "40 x 30", "red ball", "blue ball", "points.npy"] {
        assert!(text.contains(word), "{word} in {text}");
    }
    let json = cif(folder.path(), "info table --json").succeeds().stdout;
    let facts: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&facts["frames"], &facts["train"], &facts["val"]), (&4.into(), &3.into(), &1.into()));
    assert_eq!(facts["instances"][0]["id"], capture::ROLLING);
}

#[test]
fn damaged_captures_are_refused_with_the_file() {
    let folder = with_capture();
    let table = folder.path().join("table");
    let train = |words: &[&str]| {
        cif(folder.path(), "train table -o a.cif --iterations-coarse 1 --iterations-fine 1").fails(1, words);
        assert!(!folder.path().join("a.cif").exists());
        // The settings are written only once the run can begin.
        let _ = fs::remove_file(folder.path().join("a.train.toml"));
    };
    let camera = table.join("camera/000001.json");
    let good = fs::read_to_string(&camera).unwrap();
    capture::edit(&camera, |camera| camera["focal_length"] = (-3.0).into());
    train(&["000001.json", "focal"]);
    fs::write(&camera, &good).unwrap();
    capture::edit(&camera, |camera| camera["orientation"][0][0] = 7.0.into());
    train(&["000001.json"]);
    fs::write(&camera, "{").unwrap();
    train(&["000001.json"]);
    fs::write(&camera, &good).unwrap();

    let image = table.join("rgb/1x/000001.png");
    let bytes = fs::read(&image).unwrap();
    fs::write(&image, &bytes[..bytes.len() / 2]).unwrap();
    train(&["000001.png"]);
    fs::write(&image, &bytes).unwrap();
    // Without its image a training frame is left out; scores need all that are held out.
    fs::remove_file(table.join("rgb/1x/000002.png")).unwrap();
    train(&["000002"]);
}

#[test]
fn colours_of_a_tracker_are_imported_and_read() {
    let folder = with_capture();
    let path = folder.path();
    let tracked = path.join("tracked");
    fs::create_dir(&tracked).unwrap();
    for (index, name) in ["000000", "000001"].iter().enumerate() {
        let image = image::open(path.join(format!("table/rgb/1x/{name}.png"))).unwrap();
        let color = |x: u32, _| image::Rgb(if x < 5 { [250, 20, 30 + 100 * index as u8] } else { [0; 3] });
        image::RgbImage::from_fn(image.width(), image.height(), color)
            .save(tracked.join(format!("{name}.png")))
            .unwrap();
    }
    let run = cif(path, "masks import tracked -o imported --capture table").succeeds();
    for words in ["read as a tracker", "2 objects in 2 masks", "instance_2", "cif train table --masks"] {
        assert!(run.stdout.contains(words), "{words}: {}", run.stdout);
    }
    let facts = cif(path, "info table --masks ../imported").succeeds();
    assert!(facts.stdout.contains("instance_2"), "{}", facts.stdout);
    cif(path, "masks import tracked -o imported --capture table").fails(1, &["imported", "new folder"]);
    cif(path, "masks import tracked -o other --capture table --from coco").fails(1, &["tracked"]);
    cif(path, "masks import nowhere -o other --capture table").fails(1, &["nowhere", "no such file"]);
    assert!(!path.join("other").exists());
}

#[test]
fn masks_go_through_a_tracker_and_come_back() {
    let folder = with_capture();
    let path = folder.path();
    let text = cif(path, "masks zigzag table -o sequence").succeeds().stdout;
    assert!(text.contains("4 images"), "{text}");
    // A tracker that answers with the true masks, numbered as the sequence is.
    fs::create_dir(path.join("tracked")).unwrap();
    for frame in 0..4 {
        let name = format!("{frame:06}.png");
        assert!(path.join("sequence").join(&name).exists());
        fs::copy(path.join("table/masks").join(&name), path.join("tracked").join(&name)).unwrap();
    }
    let text = cif(path, "masks split sequence tracked -o masks").succeeds().stdout;
    assert!(text.contains("4 masks of 2 instances"), "{text}");
    // Ids are dense now: 3 and 7 became 1 and 2.
    let mask = |file: &str| image::open(path.join(file)).unwrap().into_luma16().into_raw();
    let before = mask("table/masks/000001.png");
    let after = mask("masks/000001.png");
    let dense = |id: &u16| [0, 1, 2][[0, 3 * 257, 7 * 257].iter().position(|known| known == id).unwrap()];
    assert_eq!(
        after,
        before.iter().map(dense).collect::<Vec<u16>>().iter().map(|id| id * 257).collect::<Vec<_>>()
    );
    let facts = cif(path, "info table --masks ../masks").succeeds();
    assert!(facts.stdout.contains("instance_1"), "{}", facts.stdout);
    cif(path, "masks zigzag table -o sequence").fails(1, &["sequence"]);
    cif(path, "masks split tracked tracked -o other").fails(1, &["cif masks zigzag"]);
}

#[test]
fn a_few_painted_frames_become_masks_of_all() {
    let folder = folder();
    let path = folder.path();
    cif_test::capture::write(&path.join("table"), 8);
    let masks = path.join("table/masks");
    fs::create_dir(path.join("painted")).unwrap();
    for name in ["000000.png", "000007.png"] {
        fs::copy(masks.join(name), path.join("painted").join(name)).unwrap();
    }
    let run = cif(path, "masks propagate table --keyframes painted -o made").succeeds();
    for words in [
        "8 masks of 2 instances from 2 keyframes in made",
        "label this frame next: 00000",
        "next: cif train table --masks",
    ] {
        assert!(run.stdout.contains(words), "{words} in {}", run.stdout);
    }
    let mask = |file: &Path| image::open(file).unwrap().into_luma8().into_raw();
    let (mut right, mut all) = (0, 0);
    for frame in 0..8 {
        let name = format!("{frame:06}.png");
        let (made, truth) = (mask(&path.join("made").join(&name)), mask(&masks.join(&name)));
        right += made.iter().zip(&truth).filter(|(made, truth)| made == truth).count();
        all += truth.len();
        let confidence = mask(&path.join("made/confidence").join(&name));
        assert_eq!(confidence.iter().all(|value| *value == 255), [0, 7].contains(&frame), "frame {frame}");
    }
    assert!(right * 100 > all * 97, "{right} of {all} pixels");
    assert!(path.join("made/contact_sheet.jpg").exists());
    // The folder is read as masks, and nothing in it is a stranger.
    let facts = cif(path, "info table --masks ../made").succeeds();
    assert!(facts.stdout.contains("red ball"), "{}", facts.stdout);
    assert!(!facts.stderr.contains("belong to no frame"), "{}", facts.stderr);
    assert!(!facts.stdout.contains("belong to no frame"), "{}", facts.stdout);

    // Mistakes are reported, and nothing is left behind.
    let paint = |folder: &str, file: &str, width: u32, height: u32, id: u8| {
        fs::create_dir_all(path.join(folder)).unwrap();
        let grey = image::GrayImage::from_pixel(width, height, image::Luma([id]));
        grey.save(path.join(folder).join(file)).unwrap();
    };
    paint("size", "000001.png", 30, 40, 3);
    paint("ids", "000001.png", 40, 30, 9);
    paint("blank", "000001.png", 40, 30, 0);
    paint("names", "first.png", 40, 30, 3);
    fs::create_dir(path.join("none")).unwrap();
    for (folder, words) in [
        ("size", ["size/000001.png", "30 x 40", "40 x 30"]),
        ("ids", ["instances.json", "does not name: 9", "add them there"]),
        ("blank", ["blank", "no keyframe shows an object", "1 to 65535"]),
        ("names", ["names", "no mask in it belongs to a frame", "000000.png"]),
        ("none", ["none", "no mask in it belongs to a frame", "000000.png"]),
        ("missing", ["missing", "no such folder of keyframes", "painted masks"]),
    ] {
        cif(path, &format!("masks propagate table --keyframes {folder} -o other")).fails(1, &words);
        assert!(!path.join("other").exists(), "{folder}");
    }
    cif(path, "masks propagate table --keyframes painted -o made")
        .fails(1, &["made", "something is there already"]);
}

/// A scene of points that stand still and hide what is behind them.
fn scene_of(dataset: &cif_dataset::Dataset, cameras: Vec<RecordedCamera>) -> Field {
    let points = &dataset.points.positions;
    let mut gaussians =
        Gaussians::from_points(points, &vec![[0.5; 3]; points.len()]).expect("as many colours as points");
    gaussians.opacity_logits.fill(2.0);
    Field {
        gaussians,
        deformation: None,
        tracks: None,
        identities: None,
        instances: Vec::new(),
        timeline: Timeline { times: dataset.times.clone(), frames_per_second: 24.0 },
        cameras,
        sh_degree: 1,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

#[test]
fn a_scene_brings_masks_to_a_camera_without_keyframes() {
    let folder = folder();
    let path = folder.path();
    cif_test::capture::write(&path.join("table"), 8);
    // The last frame is that of a second camera, at the moment of the fourth.
    captures::edit_json(&path.join("table/metadata.json"), |frames| {
        frames["000007"] =
            serde_json::json!({ "warp_id": 3, "appearance_id": 3, "camera_id": 1, "time_id": 3 });
    });
    let dataset = cif_dataset::Dataset::open(path.join("table"), &Default::default()).unwrap();
    let mut cameras: Vec<RecordedCamera> = Vec::new();
    for frame in &dataset.frames {
        let (name, time_index) = (frame.camera_name.clone(), frame.time_index);
        cameras.push(RecordedCamera { name, time_index, trained: true, camera: frame.camera });
    }
    scene_of(&dataset, cameras.clone()).save(path.join("scene.cif")).unwrap();
    cameras.iter_mut().for_each(|recorded| recorded.camera.camera_from_world.translation.x += 0.5);
    scene_of(&dataset, cameras).save(path.join("other.cif")).unwrap();
    fs::remove_file(path.join("table/points.npy")).unwrap();
    let masks = path.join("table/masks");
    let paint = |folder: &str, names: &[&str]| {
        fs::create_dir(path.join(folder)).unwrap();
        for name in names {
            fs::copy(masks.join(name), path.join(folder).join(name)).unwrap();
        }
    };
    paint("painted", &["000000.png", "000003.png", "000006.png"]);
    paint("all", &["000000.png", "000007.png"]);

    let propagate = "masks propagate table --keyframes painted -o made";
    cif(path, propagate).fails(1, &["has no keyframe", "--scene"]);
    let other = ["other.cif", "another capture", "table", "cif train CAPTURE"];
    cif(path, &format!("{propagate} --scene other.cif")).fails(1, &other);
    cif(path, &format!("{propagate} --scene nowhere.cif")).fails(1, &["nowhere.cif"]);
    assert!(!path.join("made").exists());

    let run = cif(path, &format!("{propagate} --scene scene.cif")).succeeds();
    assert!(run.stdout.contains("8 masks of 2 instances from 3 keyframes"), "{}", run.stdout);
    // Held-out frames, 000002 and 000006 among them, are not what to paint next.
    assert!(!run.stdout.contains("label this frame next: 000002"), "{}", run.stdout);
    assert!(!run.stderr.contains("nothing is taken"), "{}", run.stderr);
    let mask = |file: &Path| image::open(file).unwrap().into_luma8().into_raw();
    let (made, truth) = (mask(&path.join("made/000007.png")), mask(&masks.join("000007.png")));
    // The ball that stands: the other one is elsewhere in that image.
    let is = |id: &u8| u16::from(*id) == capture::STANDING;
    let both = made.iter().zip(&truth).filter(|(made, truth)| is(made) && is(truth)).count();
    let either = made.iter().zip(&truth).filter(|(made, truth)| is(made) || is(truth)).count();
    assert!(either > 20 && both * 10 > either * 6, "{both} of {either} pixels");

    let unused = "masks propagate table --keyframes all -o again --scene scene.cif";
    let run = cif(path, unused).succeeds();
    assert!(run.stderr.contains("nothing is taken from scene.cif"), "{}", run.stderr);
}

#[cfg(unix)]
#[test]
fn a_reader_that_leaves_is_no_fault() {
    use std::os::unix::process::ExitStatusExt;

    let folder = with_capture();
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let mut command = std::process::Command::new(CIF);
    command.args(["info", "table"]).current_dir(folder.path()).stdout(writer);
    let ended = command.output().expect("the command starts");
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert!(!stderr.contains("panicked"), "{stderr}");
    // SIGPIPE
    assert_eq!(ended.status.signal(), Some(13), "{stderr}");
}

#[cfg(unix)]
#[test]
fn work_goes_on_when_the_reader_of_its_messages_leaves() {
    let folder = with_capture();
    let path = folder.path();
    // Both streams are pipes without a reader, as when `tee` dies by the Ctrl-C of the terminal.
    let unread = |line: &str| {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        drop(reader);
        let mut command = std::process::Command::new(CIF);
        command.args(line.split_whitespace()).current_dir(path);
        command.stdout(writer.try_clone().expect("a pipe")).stderr(writer);
        command.status().expect("the command starts")
    };
    let tiny = "--iterations-coarse 2 --iterations-fine 2 --iterations-instance 2 \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    assert_eq!(unread(&format!("train table -o a.cif --log /dev/stderr {tiny}")).code(), Some(0));
    assert!(Field::load(path.join("a.cif")).is_ok());
    assert_eq!(unread("export a.cif --gltf a.glb --check").code(), Some(0));
    assert!(path.join("a.glb").is_file());
    // Reports in files are written, whoever reads the tables.
    for line in
        ["eval a.cif table --json eval.json", "info table --json info.json", "check a.cif --json check.json"]
    {
        assert_eq!(unread(line).code(), Some(0), "{line}");
    }
    for name in ["eval.json", "info.json", "check.json"] {
        assert!(fs::read_to_string(path.join(name)).unwrap().starts_with('{'), "{name}");
    }
}

#[test]
fn an_output_that_cannot_be_written_is_refused_before_the_work() {
    let folder = with_capture();
    let path = folder.path();
    fs::write(path.join("file"), "x").unwrap();
    // Neither frames nor poses are looked for.
    for line in [
        "capture nowhere.mp4 -o file/table",
        "make table -o file/out",
        "masks propagate table --keyframes table/masks -o file/masks",
    ] {
        let run = cif(path, line);
        assert_eq!(run.code, Some(1), "{line}: {}", run.stderr);
        assert!(run.stderr.contains("cannot write to the folder"), "{line}: {}", run.stderr);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn an_answer_that_is_lost_is_a_failure() {
    let folder = with_capture();
    let full = fs::OpenOptions::new().write(true).open("/dev/full").expect("the device");
    let mut command = std::process::Command::new(CIF);
    command.args(["info", "table"]).current_dir(folder.path()).stdout(full);
    let ended = command.output().expect("the command starts");
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("cannot write to stdout") && !stderr.contains("panicked"), "{stderr}");
}

/// The warnings or notes of a command, a line each.
fn messages<'a>(run: &'a Run, kind: &str) -> Vec<&'a str> {
    run.stderr.lines().filter(|line| line.starts_with(kind)).collect()
}

#[test]
fn captures_that_a_scene_does_not_know_are_reported() {
    let folder = with_capture();
    let path = folder.path();
    let tiny = "--iterations-coarse 2 --iterations-fine 2 --iterations-instance 2 -q \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    cif(path, &format!("train table -o table.cif {tiny}")).succeeds();
    for line in ["eval table.cif table", "eval table.cif table --split train --downscale 2"] {
        let run = cif(path, line).succeeds();
        assert!(
            messages(&run, "warning:").is_empty() && messages(&run, "note:").is_empty(),
            "{}",
            run.stderr
        );
    }

    // Another place, with other things in it.
    capture::write(&path.join("other"), 4);
    for frame in 0..4 {
        capture::edit(&path.join(format!("other/camera/{frame:06}.json")), |camera| {
            camera["position"][0] = serde_json::json!(camera["position"][0].as_f64().unwrap() + 4.0);
        });
    }
    capture::edit(&path.join("other/instances.json"), |instances| {
        instances[0]["label"] = "grey dog".into();
    });
    let run = cif(path, "eval table.cif other").succeeds();
    let warnings = messages(&run, "warning:").join("\n");
    for word in ["1 of 1 views", "`table`", "3 is grey dog in the masks and red ball in the scene"] {
        assert!(warnings.contains(word), "{word} in {}", run.stderr);
    }
    let run = cif(path, "render table.cif --capture other -o out").succeeds();
    assert!(messages(&run, "warning:").join("\n").contains("1 of 1 views"), "{}", run.stderr);
}

#[test]
fn points_behind_all_cameras_are_reported() {
    let folder = with_capture();
    let path = folder.path();
    let info = cif(path, "info table").succeeds().stdout;
    assert!(!info.contains("lie behind"), "{info}");
    for frame in 0..4 {
        // The camera looks back over its shoulder.
        capture::edit(&path.join(format!("table/camera/{frame:06}.json")), |camera| {
            for row in [0, 2] {
                for column in 0..3 {
                    let value = camera["orientation"][row][column].as_f64().unwrap();
                    camera["orientation"][row][column] = serde_json::json!(-value);
                }
            }
        });
    }
    let info = cif(path, "info table").succeeds().stdout;
    assert!(info.contains("points.npy: 0 of its 640 points") && info.contains("640 lie behind"), "{info}");
}

#[test]
fn captures_are_refused_with_a_reason_and_nothing_is_written() {
    let folder = folder();
    let photographs = folder.path().join("photos");
    fs::create_dir(&photographs).unwrap();
    let image = |name: &str, width: u32, height: u32, shift: u32| {
        let is_light = |x: u32, y: u32| ((x + shift) / 9 + y / 7).is_multiple_of(2);
        let pixel = |x, y| image::Luma([if is_light(x, y) { 220 } else { 20 }]);
        image::GrayImage::from_fn(width, height, pixel).save(photographs.join(name)).unwrap();
    };
    image("a.png", 64, 48, 0);
    image("b.png", 64, 48, 4);
    fs::create_dir(folder.path().join("taken")).unwrap();
    fs::write(folder.path().join("taken/x"), b"x").unwrap();
    fs::write(folder.path().join("notes.txt"), b"x").unwrap();
    for (line, message) in [
        ("capture photos -o new", "2 usable images are too few"),
        ("capture none.mp4 -o new", "no such file or folder"),
        ("capture photos -o taken", "taken exists"),
        ("capture photos photos -o new", "another camera is called"),
        ("capture photos -o new --masks none", "no such folder of masks"),
        ("capture photos -o new --poses notes.txt", "no poses of a tool that is known"),
    ] {
        cif(folder.path(), line).fails(1, &[message]);
    }
    for k in 0..4 {
        image(&format!("c{k}.png"), 64, 48, 4 * k);
    }
    image("upright.png", 48, 64, 0);
    cif(folder.path(), "capture photos -o new").fails(1, &["1 upright and 6 lying"]);
    fs::remove_file(photographs.join("upright.png")).unwrap();
    for k in 0..4 {
        image(&format!("c{k}.png"), 64, 48, 0);
    }
    image("b.png", 64, 48, 0);
    cif(folder.path(), "capture photos -o new").fails(1, &["stands still"]);
    for line in ["capture photos -o new --rate 0", "capture photos -o new --up z", "capture -o new"] {
        cif(folder.path(), line).fails(2, &[]);
    }
    assert!(!folder.path().join("new").exists());
    assert!(listing(folder.path()).iter().all(|path| !path.contains("cif-tmp")));
}

#[test]
fn poses_of_other_tools_become_a_capture_with_times() {
    let folder = folder();
    let photographs = folder.path().join("photos");
    fs::create_dir(&photographs).unwrap();
    let mut frames = Vec::new();
    let mut times = String::from("image,seconds\n");
    for k in 0..4_u32 {
        let name = format!("view {k}.png");
        let pixel = |x: u32, y: u32| image::Luma([((x * 7 + y * 3 + 11 * k) % 256) as u8]);
        image::GrayImage::from_fn(64, 48, pixel).save(photographs.join(&name)).unwrap();
        let x = f64::from(k);
        frames.push(serde_json::json!({ "file_path": format!("elsewhere/{name}"),
            "transform_matrix": [[1.0, 0.0, 0.0, x], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]] }));
        times += &format!("{name},{}\n", 0.5 * x + 2.0);
    }
    let poses = serde_json::json!({ "fl_x": 60.0, "w": 64, "h": 48, "frames": frames });
    fs::write(folder.path().join("poses.json"), poses.to_string()).unwrap();
    fs::write(folder.path().join("times.csv"), times).unwrap();
    let line = "capture photos -o table --poses poses.json --times times.csv";
    let made = cif(folder.path(), line).succeeds();
    for expected in
        ["4 of 4 images", "+z is up", "metre is not known", "cif masks propagate table", "cif train table"]
    {
        assert!(made.stdout.contains(expected), "{expected}: {}", made.stdout);
    }
    let info = cif(folder.path(), "info table").succeeds();
    assert!(info.stdout.contains("does not know the metre"), "{}", info.stdout);
    let written: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.path().join("table/transforms.json")).unwrap()).unwrap();
    assert_eq!(written["frames"][3]["time"], 1.5);
    assert_eq!(written["frames"][3]["file_path"], "images/view 3.png");
    // The first and the last camera are three units apart: 0.3 m, as both ends of a stick are measured.
    let pixel = |camera: f64, place: f64| 32.0 + 60.0 * (place - camera) / 4.0;
    let point =
        |place: f64| format!("view 0.png:{},24/view 3.png:{},24", pixel(0.0, place), pixel(3.0, place));
    let arguments = [
        "capture",
        "photos",
        "-o",
        "metres",
        "--poses",
        "poses.json",
        "--measured",
        &point(1.0),
        &point(2.0),
        "0.1",
    ];
    let metric = run(CIF, folder.path(), arguments).succeeds();
    assert!(metric.stdout.contains("a unit is a metre"), "{}", metric.stdout);
    let written: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.path().join("metres/transforms.json")).unwrap()).unwrap();
    let x = |k: usize| written["frames"][k]["transform_matrix"][0][3].as_f64().unwrap();
    assert!((x(3) - x(0) - 0.3).abs() < 1e-9, "{} {}", x(3), x(0));
    assert_eq!(written["cif"]["metres_known"], true);
}
