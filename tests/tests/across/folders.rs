//! Folders that take no files, disks that are full, and folders that are written a second time: one clear error before the
//! work, and results of before stay as they are.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use cif_render::synthetic::{SyntheticConfig, generate};
use cif_test::capture;
use cif_test::command::{Run, run};
use serde_json::json;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Settings of a run that learns nothing.
const TINY: &str = "--iterations-coarse 2 --iterations-fine 2 --iterations-instance 2 \
                    --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";

/// Commands that write into the folder `shut`, where results are already: those that would work for long name inputs that
/// are not there, so that their refusal comes before.
const WRITERS: [&str; 30] = [
    "train nowhere -o shut/new.cif",
    "train nowhere -o shut/t.cif --force",
    "train table -o shut/t.cif --force TINY",
    "make nowhere -o shut/new",
    "capture nowhere.mp4 -o shut/new",
    "capture nowhere.mp4 -o shut/far/new",
    "masks import table/masks -o shut/new --capture table",
    "masks propagate nowhere --keyframes table/masks -o shut/new",
    "masks zigzag table -o shut/new",
    "export t.cif shut/new.glb shut/new.ply",
    "export t.cif --ply shut/s.ply --force",
    "export t.cif --gltf shut/new.glb",
    "export t.cif --gltf shut/s.glb --force",
    "export t.cif --ply shut/new.ply",
    "import s.glb -o shut/new.cif",
    "import s.glb -o shut/t.cif --force",
    "render t.cif --capture table -o shut/new",
    "render t.cif --capture table -o shut --force",
    "eval t.cif table --images shut/new",
    "eval t.cif table --json shut/new.json",
    "eval t.cif table --json shut/r.json --force",
    "query t.cif --label * --json shut/new.json",
    "label shut/t.cif --instance 1 cup",
    "label t.cif --instance 1 cup -o shut/new.cif",
    "label shut/s.glb --instance 1 cup",
    "check t.cif --json shut/new.json",
    "check t.cif --fix shut/new.cif",
    "info table --json shut/new.json",
    "bench accuracy table -o shut/new",
    "bench compare nowhere -o shut/new",
];

fn words(line: &str) -> Vec<String> {
    line.replace("TINY", TINY).split_whitespace().map(str::to_owned).collect()
}

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, words(line))
}

/// Files and folders below one by their paths, with the content of files.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().to_owned();
            if path.is_dir() {
                found.insert(name, None);
                folders.push(path);
            } else {
                found.insert(name, Some(fs::read(&path).unwrap()));
            }
        }
    }
    found
}

/// A folder with a capture, a scene, exports of it, and `shut` with results.
fn prepare() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("table"), 4);
    let scene = generate(&SyntheticConfig { instances: 2, ..SyntheticConfig::default() }).field;
    scene.save(path.join("t.cif")).unwrap();
    cif(path, "export t.cif --gltf s.glb").succeeds();
    fill(path, &path.join("shut"));
    folder
}

/// Puts results into a folder.
fn fill(path: &Path, shut: &Path) {
    fs::create_dir_all(shut).unwrap();
    fs::copy(path.join("t.cif"), shut.join("t.cif")).unwrap();
    let target = shut.display();
    cif(path, &format!("export t.cif --ply {target}/s.ply --gltf {target}/s.glb")).succeeds();
    fs::write(shut.join("r.json"), "{}").unwrap();
}

/// Words before a command by which permissions bind it; `None` where nothing binds this user.
fn bound(folder: &Path) -> Option<Vec<&'static str>> {
    let probe = folder.join("probe");
    fs::create_dir(&probe).unwrap();
    fs::set_permissions(&probe, fs::Permissions::from_mode(0o555)).unwrap();
    // Permissions do not bind root, unless it gives up the capability.
    let without: [&[&str]; 2] = [&["env"], &["setpriv", "--bounding-set=-dac_override", "--inh-caps=-all"]];
    let found = without.into_iter().find(|words| {
        let mut touch = Command::new(words[0]);
        touch.args(&words[1..]).arg("touch").arg(probe.join("x"));
        let started = touch.output();
        started.is_ok_and(|output| {
            let is_refused = !output.status.success() && !probe.join("x").exists();
            let _ = fs::remove_file(probe.join("x"));
            // A setpriv that does not know its options fails, too.
            is_refused && String::from_utf8_lossy(&output.stderr).contains("touch")
        })
    });
    fs::set_permissions(&probe, fs::Permissions::from_mode(0o755)).unwrap();
    found.map(<[_]>::to_vec)
}

/// Asserts one error that says where nothing can be written.
#[track_caller]
fn refused(run: &Run, line: &str, place: &str) {
    assert_eq!(run.code, Some(1), "{line}: {}\n{}", run.stdout, run.stderr);
    assert_eq!(run.stderr.matches("Error:").count(), 1, "{line}: {}", run.stderr);
    assert!(!run.stderr.contains("panicked"), "{line}: {}", run.stderr);
    assert!(run.stderr.contains(place), "{line}: {}", run.stderr);
}

#[test]
fn folders_without_permission_are_refused_and_results_in_them_stay() {
    let folder = prepare();
    let path = folder.path();
    let Some(binding) = bound(path) else {
        eprintln!("skipped: permissions do not bind this user");
        return;
    };
    let shut = path.join("shut");
    let before = contents(&shut);
    fs::set_permissions(&shut, fs::Permissions::from_mode(0o555)).unwrap();
    for line in WRITERS {
        let started = binding[1..].iter().map(|word| (*word).to_owned()).chain([CIF.to_owned()]);
        let output = run(binding[0], path, started.chain(words(line)));
        refused(&output, line, "shut");
        assert!(output.stderr.contains("Permission denied"), "{line}: {}", output.stderr);
        assert!(
            !output.stderr.contains("nowhere"),
            "{line} is refused before its input is looked at: {}",
            output.stderr
        );
    }
    fs::set_permissions(&shut, fs::Permissions::from_mode(0o755)).unwrap();
    assert_eq!(contents(&shut), before);
}

#[test]
fn files_in_the_place_of_folders_are_refused_and_stay() {
    let folder = prepare();
    let path = folder.path();
    fs::rename(path.join("shut"), path.join("open")).unwrap();
    fs::write(path.join("shut"), "mine").unwrap();
    for line in WRITERS {
        // Of files in it, nobody can ask for the replacement.
        refused(&cif(path, line), line, "shut");
    }
    assert_eq!(fs::read(path.join("shut")).unwrap(), b"mine");
}

/// A small disk, which is taken off again.
struct Disk(PathBuf);

impl Disk {
    /// Needs the right to mount; `None` without.
    fn mount(place: &Path, size: &str) -> Option<Self> {
        fs::create_dir(place).unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"]).arg(place);
        let is_mounted = mount.output().is_ok_and(|output| output.status.success());
        is_mounted.then(|| Self(place.to_owned()))
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}

#[test]
fn full_disks_are_one_error_and_results_on_them_stay() {
    let folder = prepare();
    let path = folder.path();
    let shut = path.join("full");
    let Some(_disk) = Disk::mount(&shut, "4m") else {
        eprintln!("skipped: nothing can be mounted");
        return;
    };
    fill(path, &shut);
    let mut filler = fs::File::create(shut.join("filler")).unwrap();
    while std::io::Write::write(&mut filler, &[0; 4096]).is_ok() {}
    drop(filler);
    let before = contents(&shut);
    // Those of which the work is done all the same are tried with an end: the disk may have been full only then.
    for line in WRITERS.iter().filter(|line| !line.contains("nowhere")) {
        let line = line.replace("shut", "full");
        let output = cif(path, &line);
        refused(&output, &line, "full");
        assert!(output.stderr.contains("No space left"), "{line}: {}", output.stderr);
    }
    assert!(contents(&shut) == before, "{:?}", contents(&shut).keys());
}

/// Photographs of the small capture and their poses, as another tool has them.
fn photographs(folder: &Path) {
    capture::write(&folder.join("table"), 4);
    fs::create_dir(folder.join("photos")).unwrap();
    let mut frames = Vec::new();
    for frame in 0..4 {
        let name = format!("{frame:06}.png");
        fs::copy(folder.join("table/rgb/1x").join(&name), folder.join("photos").join(&name)).unwrap();
        let at = 0.2 * f64::from(frame);
        frames.push(json!({
            "file_path": format!("photos/{name}"),
            "transform_matrix":
                [[1.0, 0.0, 0.0, at], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]],
        }));
    }
    let poses = json!({ "fl_x": 42.0, "w": capture::WIDTH, "h": capture::HEIGHT, "frames": frames });
    fs::write(folder.join("transforms.json"), poses.to_string()).unwrap();
}

#[test]
fn a_second_capture_makes_the_same_folder_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    photographs(path);
    // No pycolmap is asked for points.
    let capture = || {
        let line = "capture photos -o new --poses transforms.json";
        run(
            "env",
            path,
            ["CIF_PYTHON=/no/python", CIF].iter().map(|word| (*word).to_owned()).chain(words(line)),
        )
    };
    let around =
        |path: &Path| contents(path).into_keys().filter(|name| !name.starts_with("new")).collect::<Vec<_>>();
    let before = around(path);
    capture().succeeds();
    let first = contents(&path.join("new"));
    assert!(first.contains_key(Path::new("images/000003.png")), "{:?}", first.keys());
    // Into the same folder: nothing is mixed, and nothing written.
    refused(&capture(), "capture", "new exists");
    assert!(contents(&path.join("new")) == first);
    assert_eq!(around(path), before, "nothing else lies about");
    // Of an empty folder, and of none.
    for remains in [true, false] {
        fs::remove_dir_all(path.join("new")).unwrap();
        if remains {
            fs::create_dir(path.join("new")).unwrap();
        }
        capture().succeeds();
        assert!(contents(&path.join("new")) == first, "{:?}", contents(&path.join("new")).keys());
        assert_eq!(around(path), before);
    }
    // Of fewer photographs, no frame of before is left.
    fs::remove_dir_all(path.join("new")).unwrap();
    fs::remove_file(path.join("photos/000003.png")).unwrap();
    capture().succeeds();
    let fewer = contents(&path.join("new"));
    assert_eq!(fewer.len(), first.len() - 1, "{:?}", fewer.keys());
    assert!(!fewer.contains_key(Path::new("images/000003.png")));
}
