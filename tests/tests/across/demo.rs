//! `cif demo`, and the scene of the example that comes with the command.

use std::collections::BTreeMap;
use std::fs;
#[cfg(unix)]
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
#[cfg(unix)]
use std::process::{Child, Command, Stdio};

use cif_field::Checkpoint;
use cif_test::command::{Run, json, run, run_line};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");
const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples");

/// A run whose quality does not matter.
const SHORT: &str = "demo --no-view --budget 2s";

fn cif(folder: &Path, line: &str) -> Run {
    run_line(CIF, folder, line)
}

/// Files below a folder, by their names from it.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Commands that a demo showed, without their arguments.
fn steps(run: &Run) -> Vec<&str> {
    let shown = run.stderr.lines().filter_map(|line| line.strip_prefix("$ cif "));
    shown.filter_map(|line| line.split(' ').next()).collect()
}

/// Names in a folder, in their order.
fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_demo_is_run_once_and_looked_at_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let demo = path.join("cif-demo");
    let first = cif(path, SHORT).succeeds();
    assert_eq!(steps(&first), ["info", "train", "eval", "export", "query"]);
    assert!(first.stdout.contains("red mug"), "{}", first.stdout);
    assert!(first.stdout.contains("next: cif view cif-demo/scene.cif --capture cif-demo/tabletop-mini"));
    // This command has no USD.
    assert_eq!(names(&demo), ["scene.cif", "scene.glb", "scene.train.toml", "tabletop-mini"]);
    let example = contents(&Path::new(EXAMPLES).join("tabletop-mini"));
    assert!(example.len() > 200);
    assert!(contents(&demo.join("tabletop-mini")) == example, "the capture is that of the repository");

    let made = contents(&demo);
    let again = cif(path, SHORT).succeeds();
    assert_eq!(steps(&again), ["info", "eval", "query"]);
    assert!(again.stderr.contains("scene.cif is trained already; --force"), "{}", again.stderr);
    assert!(contents(&demo) == made, "nothing is replaced");

    // A scene that was trained by hand since is not that of the exported file.
    let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
    fs::File::options().write(true).open(demo.join("scene.cif")).unwrap().set_modified(later).unwrap();
    cif(path, SHORT).fails(1, &["scene.glb is older than cif-demo/scene.cif", "cif-demo/scene.glb --force"]);
    assert!(contents(&demo) == made, "nothing is replaced");
    let anew = cif(path, &format!("{SHORT} --force -q")).succeeds();
    assert_eq!(steps(&anew), ["info", "train", "eval", "export", "query"]);
    assert!(anew.stderr.contains("--preset draft --force"), "{}", anew.stderr);
    assert!(fs::read(demo.join("scene.cif")).unwrap() != made[Path::new("scene.cif")]);
}

#[test]
fn other_files_are_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    fs::create_dir(path.join("thesis")).unwrap();
    fs::write(path.join("thesis/thesis.tex"), "x").unwrap();
    cif(path, &format!("{SHORT} -o thesis")).fails(1, &["thesis holds other files", "thesis.tex", "-o DIR"]);
    cif(path, &format!("{SHORT} -o thesis --force")).fails(1, &["thesis holds other files"]);
    cif(path, &format!("{SHORT} -o thesis/thesis.tex")).fails(1, &["thesis.tex is a file"]);
    assert_eq!(names(&path.join("thesis")), ["thesis.tex"]);

    fs::create_dir_all(path.join("cif-demo/tabletop-mini")).unwrap();
    fs::write(path.join("cif-demo/tabletop-mini/dataset.json"), "{}").unwrap();
    cif(path, SHORT).fails(1, &["is not the file of the example", "it is kept"]);
    assert_eq!(names(&path.join("cif-demo")), ["tabletop-mini"]);

    cif(path, "demo -o demo.json").fails(2, &["without .json: demo"]);
    cif(path, "demo --budget soon").fails(2, &["--budget", "soon"]);
    cif(path, "demo --trained --budget 5s").fails(2, &["--trained", "--budget"]);
    cif(path, "demo --no-view --no-open").fails(2, &["--no-view", "--no-open"]);
}

/// Starts the command with pipes.
#[cfg(unix)]
fn start(folder: &Path, line: &str) -> Child {
    Command::new(CIF)
        .args(line.split(' '))
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Presses Ctrl-C once a line is printed, and returns the exit code and what follows that line.
#[cfg(unix)]
fn interrupted(
    child: &mut Child,
    output: impl std::io::Read,
    is_time: impl Fn(&str) -> bool,
) -> (Option<i32>, String) {
    let mut lines = BufReader::new(output).lines().map(|line| line.unwrap());
    assert!(lines.any(|line| is_time(&line)), "it ended before");
    let id = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    let rest: Vec<String> = lines.collect();
    (child.wait().unwrap().code(), rest.join("\n"))
}

#[cfg(unix)]
#[test]
fn a_demo_that_is_interrupted_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let mut run = start(path, "demo -o demo --no-view --budget 10m");
    let stderr = run.stderr.take().unwrap();
    let (code, said) =
        interrupted(&mut run, stderr, |line| line.starts_with("coarse ") && line.contains("it/s"));
    assert_eq!(code, Some(130), "{said}");
    assert!(said.contains("continue with: cif demo -o demo"), "{said}");
    assert!(Checkpoint::load(path.join("demo/scene.cif")).unwrap().training.is_some());
    let rest = cif(path, &format!("{SHORT} -o demo")).succeeds();
    assert!(rest.stderr.contains("--resume --budget 2s"), "{}", rest.stderr);
    assert_eq!(steps(&rest), ["info", "train", "eval", "export", "query"]);
    assert!(Checkpoint::load(path.join("demo/scene.cif")).unwrap().training.is_none());
}

#[cfg(unix)]
#[test]
fn a_scene_is_looked_at_without_training() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let mut run = start(path, "demo --trained --no-open");
    let (stdout, stderr) = (run.stdout.take().unwrap(), run.stderr.take().unwrap());
    let said = std::thread::spawn(move || std::io::read_to_string(stderr).unwrap());
    let (code, _) = interrupted(&mut run, stdout, |line| line.starts_with("http://127.0.0.1:"));
    let said = said.join().unwrap();
    assert_eq!(code, Some(0), "Ctrl-C is how the page ends: {said}");
    assert!(
        said.contains("$ cif view cif-demo/tabletop-mini.cif --capture cif-demo/tabletop-mini"),
        "{said}"
    );
    assert!(!said.contains("$ cif train") && said.contains("the page is closed"), "{said}");
    assert_eq!(names(&path.join("cif-demo")), ["tabletop-mini", "tabletop-mini.cif", "tabletop-mini.glb"]);
    let example = fs::read(Path::new(EXAMPLES).join("tabletop-mini.cif")).unwrap();
    assert!(fs::read(path.join("cif-demo/tabletop-mini.cif")).unwrap() == example);

    fs::write(path.join("cif-demo/tabletop-mini.cif"), "mine").unwrap();
    cif(path, "demo --trained --no-view")
        .fails(1, &["tabletop-mini.cif is not the scene of the example", "it is kept"]);
}

#[test]
fn the_scene_of_the_example_is_finished_and_scores_as_stated() {
    let place = Path::new(EXAMPLES).join("tabletop-mini.cif");
    let checkpoint = Checkpoint::load(&place).unwrap();
    assert!(checkpoint.training.is_none(), "no state of the training");
    let labels: Vec<&str> =
        checkpoint.field.instances.iter().map(|instance| instance.label.as_str()).collect();
    let known = json(&fs::read_to_string(Path::new(EXAMPLES).join("tabletop-mini/instances.json")).unwrap());
    let known: Vec<&str> =
        known.as_array().unwrap().iter().map(|instance| instance["label"].as_str().unwrap()).collect();
    assert_eq!(labels, known);
    let bytes = fs::read(&place).unwrap();
    assert!(bytes.len() < 4_000_000, "{} bytes", bytes.len());
    // What it records about its run is text before the numbers; no path of a machine is in it.
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header = std::str::from_utf8(&bytes[8..8 + length]).unwrap();
    for part_of_path in ["/", ":\\\\"] {
        assert!(!header.contains(part_of_path), "{header}");
    }

    let folder = tempfile::tempdir().unwrap();
    let report = |words: &[&str]| json(&run(CIF, folder.path(), words).succeeds().stdout);
    let (scene, capture) = (place.to_str().unwrap(), format!("{EXAMPLES}/tabletop-mini"));
    let scores = report(&["eval", scene, &capture, "--json"]);
    let at_least = |key: &str, bound: f64| {
        let value = scores[key].as_f64().unwrap_or_else(|| panic!("{key} in {scores}"));
        assert!(value >= bound, "{key} is {value}, at least {bound} is stated in examples/README.md");
    };
    at_least("psnr", 31.0);
    at_least("miou", 97.0);
    let found = report(&["query", scene, "--label", "*", "--json"]);
    let found: Vec<&str> = found.as_array().unwrap().iter().filter_map(|one| one["label"].as_str()).collect();
    assert!(known.iter().all(|label| found.contains(label)), "each has splats: {found:?}");
}
