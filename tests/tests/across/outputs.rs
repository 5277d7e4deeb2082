//! Nothing of the user's is ever overwritten: inputs, photographs, devices, links; and nothing unfinished stays.

use std::fs;
use std::path::Path;

use cif_field::Field;
use cif_render::synthetic::{SyntheticConfig, generate};
use cif_test::capture;
use cif_test::command::{Run, run};
use serde_json::{Value, json};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

/// A folder with a scene of a few Gaussians, `t.cif`.
fn with_scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    generate(&SyntheticConfig::default()).field.save(folder.path().join("t.cif")).unwrap();
    folder
}

/// Adds a capture in the D-NeRF layout, `cap`, whose files name their images by absolute paths.
fn add_absolute_capture(folder: &Path) {
    capture::write(&folder.join("table"), 4);
    let cap = folder.join("cap");
    let pose = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]);
    for (split, frame) in [("train", 0), ("test", 2)] {
        fs::create_dir_all(cap.join(split)).unwrap();
        let image = cap.join(format!("{split}/r_0.png"));
        fs::copy(folder.join(format!("table/rgb/1x/{frame:06}.png")), &image).unwrap();
        let frames = json!([{ "file_path": image, "time": 0, "transform_matrix": pose }]);
        let file = json!({ "camera_angle_x": 0.9, "frames": frames });
        fs::write(cap.join(format!("transforms_{split}.json")), file.to_string()).unwrap();
    }
}

fn camera_file(path: &Path, names: &[Option<&str>]) {
    let views: Vec<Value> = names
        .iter()
        .map(|name| {
            json!({
                "name": name, "width": 8, "height": 6, "focal_px": [8, 8],
                "position": [0, -2, 1], "look_at": [0, 0, 0],
            })
        })
        .collect();
    fs::write(path, json!(views).to_string()).unwrap();
}

/// Files that were begun and not finished.
fn unfinished(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned());
    names.filter(|name| name.starts_with(".cif-")).collect()
}

#[cfg(unix)]
fn make_pipe(path: &Path) {
    assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
}

#[test]
fn photographs_are_never_written() {
    let folder = with_scene();
    let path = folder.path();
    add_absolute_capture(path);
    let photographs = ["cap/train/r_0.png", "cap/test/r_0.png"].map(|name| path.join(name));
    let before = photographs.each_ref().map(|photograph| fs::read(photograph).unwrap());
    cif(path, "render t.cif --capture cap -o out --exr --what rgb").succeeds();
    assert!(path.join("out/rgb/test/r_0.png").is_file());
    assert!(path.join("out/exr/test/r_0.exr").is_file());
    cif(path, "eval t.cif cap --images pictures").succeeds();
    assert!(path.join("pictures/test/r_0.png").is_file());
    // Into the capture itself: the names fit those of the photographs.
    cif(path, "eval t.cif cap --images cap --force").fails(2, &["r_0.png is read by this command"]);
    assert_eq!(photographs.each_ref().map(|photograph| fs::read(photograph).unwrap()), before);
}

#[test]
fn views_of_one_name_are_refused() {
    let folder = with_scene();
    let path = folder.path();
    for names in [[Some("a"), Some("a")], [Some("0001"), None], [Some("a"), Some("A")]] {
        camera_file(&path.join("views.json"), &names);
        cif(path, "render t.cif --camera views.json -o out").fails(1, &["view 1", "view 0 has this name"]);
    }
    camera_file(&path.join("views.json"), &[Some("/tmp/a")]);
    cif(path, "render t.cif --camera views.json -o out").fails(1, &["is an absolute path"]);
    assert!(!path.join("out").exists());
    camera_file(&path.join("views.json"), &[Some("0000"), None]);
    cif(path, "render t.cif --camera views.json -o out").succeeds();
    assert_eq!(fs::read_dir(path.join("out/rgb")).unwrap().count(), 2);
}

#[test]
fn inputs_are_kept_whatever_is_forced() {
    let folder = with_scene();
    let path = folder.path();
    capture::write(&path.join("table"), 4);
    cif(path, "export t.cif --ply t.ply").succeeds();
    let before = fs::read(path.join("t.cif")).unwrap();
    let kept = "t.cif is read by this command";
    let read = "motion.json is read by this command";
    fs::copy(path.join("t.cif"), path.join("motion.json")).unwrap();
    cif(path, "import t.ply --base t.cif -o t.cif --force").fails(2, &[kept]);
    cif(path, "import t.ply --base t.cif -o ./t.cif --force").fails(2, &[kept]);
    let line = "export t.cif --ground-truth motion.json --json motion.json --force";
    cif(path, line).fails(2, &[read]);
    cif(path, "export t.cif --json t.cif --force").fails(2, &[".usda"]);
    cif(path, "export t.cif --json=t.cif --force").fails(2, &["t.json"]);
    cif(path, "train table -o t.cif --from t.cif --force").fails(2, &[kept]);
    cif(path, "train table -o a.cif --log a.cif --force").fails(2, &["a.jsonl"]);
    cif(path, "train table -o a.cif --log a.train.toml --force").fails(1, &["a.train.toml would be"]);
    cif(path, "export t.cif a.glb ./a.glb").fails(1, &["are one file, which would be written twice"]);
    cif(path, "label t.cif --instance 1 x -o t.usda").fails(2, &["t.usda", "ending"]);
    cif(path, "label t.cif --instance 1 x -o t.cif --force").fails(2, &[kept]);
    let image = path.join("table/masks/000002.png");
    let mask = fs::read(&image).unwrap();
    cif(path, "eval t.cif table --images table/masks --force").fails(2, &["is read by this command"]);
    assert_eq!(fs::read(&image).unwrap(), mask);
    assert_eq!(fs::read(path.join("t.cif")).unwrap(), before);
    assert!(!path.join("t.usda").exists() && !path.join("a.cif").exists());
}

#[cfg(unix)]
#[test]
fn links_and_devices_stay_what_they_are() {
    use std::os::unix::fs::symlink;

    let folder = with_scene();
    let path = folder.path();
    fs::create_dir(path.join("disk")).unwrap();
    for (link, target) in [
        ("labelled.cif", "disk/labelled.cif"),
        ("report.json", "disk/report.json"),
        ("t.ply", "disk/t.ply"),
        ("t.glb", "disk/t.glb"),
        ("t.gltf", "disk/t.gltf"),
    ] {
        symlink(target, path.join(link)).unwrap();
    }
    // A link to nothing yet is as good a name as any; a second time the file behind it is there.
    cif(path, "label t.cif --instance 1 mug -o labelled.cif").succeeds();
    cif(path, "label t.cif --instance 1 cup -o labelled.cif").fails(1, &["labelled.cif exists"]);
    cif(path, "label t.cif --instance 1 cup -o labelled.cif --force").succeeds();
    assert_eq!(Field::load(path.join("disk/labelled.cif")).unwrap().instances[0].label, "cup");
    for _ in 0..2 {
        cif(path, "export t.cif --ply t.ply --gltf t.glb --report-json report.json --force").succeeds();
    }
    for link in ["labelled.cif", "report.json", "t.ply", "t.glb"] {
        let link = path.join(link);
        assert!(link.is_symlink() && link.is_file(), "{}", link.display());
    }
    // The .bin would lie where the link is not.
    cif(path, "export t.cif --gltf t.gltf").fails(1, &["t.gltf is a link", "name the target itself"]);

    // A pipe of our own stands for devices, which a broken command would destroy.
    let pipe = path.join("pipe.cif");
    make_pipe(&pipe);
    let reader = std::thread::spawn({
        let pipe = pipe.clone();
        move || fs::read_to_string(pipe).unwrap()
    });
    cif(path, "export t.cif --report-json pipe.cif --force").succeeds();
    assert!(reader.join().unwrap().contains("motion"));
    cif(path, "label t.cif --instance 1 x -o pipe.cif --force").fails(1, &["not a regular file"]);
    assert!(std::os::unix::fs::FileTypeExt::is_fifo(&fs::metadata(&pipe).unwrap().file_type()));
    let printed = cif(path, "export t.cif --report-json /dev/stdout").succeeds().stdout;
    let report: Value = serde_json::from_str(&printed).unwrap();
    assert!(report["motion"].is_array(), "{printed}");
    assert!(unfinished(path).is_empty());
}

#[cfg(target_os = "linux")]
#[test]
fn signals_end_a_command_and_leave_nothing_unfinished() {
    use std::process::{Child, Command, Stdio};

    let folder = with_scene();
    let path = folder.path();
    // What a killed command left is gone once the next one has written into the folder.
    fs::write(path.join(".cif-tmp-leftover"), "half of a scene").unwrap();
    make_pipe(&path.join("pipe"));
    // Nobody reads the pipe, so that the command waits there once it has written the rest.
    let line = ["export", "t.cif", "--ply", "a.ply", "--report-json", "pipe", "--force"];
    let begin = |command: &mut Command| {
        let command = command.args(line).current_dir(path).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        while !path.join("a.ply").exists() {
            assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        fs::remove_file(path.join("a.ply")).unwrap();
        child
    };
    let send = |signal: &str, child: &Child| {
        assert!(Command::new("kill").arg(signal).arg(child.id().to_string()).status().unwrap().success());
    };
    for signal in ["-INT", "-TERM"] {
        // Tests in the background are started to ignore SIGINT.
        let mut child = begin(Command::new("env").args(["--default-signal=INT", CIF]));
        send(signal, &child);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{signal}");
        assert!(unfinished(path).is_empty(), "{signal}");
    }
    // As under nohup: the signal stays ignored, and the command ends by what it waits for.
    let mut child = begin(Command::new("sh").args(["-c", "trap '' HUP; exec \"$0\" \"$@\"", CIF]));
    send("-HUP", &child);
    std::thread::sleep(std::time::Duration::from_millis(100));
    assert!(child.try_wait().unwrap().is_none(), "it was ended");
    assert!(fs::read_to_string(path.join("pipe")).unwrap().contains("motion"));
    assert!(child.wait().unwrap().success());
}
