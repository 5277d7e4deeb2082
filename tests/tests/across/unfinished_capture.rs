//! Captures whose poses are not believed: nothing has to be done twice. Skipped where there is no ffmpeg.
#![cfg(unix)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use cif_test::command::{Run, run};
use serde_json::{Map, Value, json};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

const FRAMES: u32 = 14;

/// Runs the command with a Python that has an answer for each mapper, whatever the images.
fn cif(folder: &Path, words: &[String]) -> Run {
    let python = format!("CIF_PYTHON={}", folder.join("python").display());
    run("env", folder, [python, CIF.to_owned()].iter().chain(words))
}

fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

/// The command that is printed below a line with these words, without the name of the program.
fn command_of(run: &Run, heading: &str) -> Vec<String> {
    let mut lines = run.stderr.lines().skip_while(|line| !line.contains(heading));
    let line = lines.nth(1).expect("a command below the heading");
    // Words of this test are quoted for shells, but have no blanks.
    line.split_whitespace().skip(1).map(|word| word.trim_matches('\'').to_owned()).collect()
}

/// A video of a picture that moves by, and a Python; false without ffmpeg.
fn prepare(folder: &Path) -> bool {
    let filter =
        format!("testsrc=duration={}:size=96x64:rate=10,scroll=horizontal=0.05", f64::from(FRAMES) / 10.0);
    let made = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", &filter, "-c:v", "ffv1"])
        .arg(folder.join("walk.mkv"))
        .status();
    let Ok(status) = made else {
        eprintln!("skipped: there is no ffmpeg");
        return false;
    };
    assert!(status.success());
    let pose = |k: u32| {
        let pose = json!({ "camera": 1, "rotation": [1.0, 0.0, 0.0, 0.0], "points": 40,
            "translation": [0.1 * f64::from(k), 0.0, 0.0] });
        (format!("{k:06}.png"), pose)
    };
    let model = json!({
        "cameras": { "1": { "model": "SIMPLE_RADIAL", "width": 96, "height": 64, "params": [90.0, 48.0, 32.0, 0.0] } },
        "images": (0..FRAMES).map(pose).collect::<Map<String, Value>>(),
        "points": [], "reprojection_px": 0.5, "fitting": 0.99,
    });
    // The incremental mapper finds nothing, so that nothing confirms the poses of the global one.
    for (name, runs) in [("global", json!([model])), ("incremental", json!([null])), ("none", json!([]))] {
        let answer = json!({ "features": {}, "runs": runs }).to_string();
        fs::write(folder.join(format!("{name}.json")), answer).expect("the folder takes files");
    }
    let python = folder.join("python");
    // One line is read: the input stays open as long as the command lives.
    let script = r#"#!/bin/sh
IFS= read -r job
printf '%s' "$job" > DIR/job.json
case "$job" in
    *'"mapper":"global"'*) cat DIR/global.json ;;
    *'"mapper":"incremental"'*) cat DIR/incremental.json ;;
    *) cat DIR/none.json ;;
esac
"#;
    fs::write(&python, script.replace("DIR", &folder.display().to_string())).expect("the folder takes files");
    fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).expect("the file is there");
    true
}

#[test]
fn frames_and_poses_that_are_not_believed_are_kept_for_the_next_command() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    if !prepare(path) {
        return;
    }
    let first = cif(path, &words("capture walk.mkv -o new --rate 10 --focal 90 --up 0,-1,0"));
    assert_eq!(first.code, Some(1));
    for word in ["not to be believed", "kept: new-unfinished has 14 frames and the poses found"] {
        assert!(first.stderr.contains(word), "{}", first.stderr);
    }
    assert!(!path.join("new").exists());
    fs::remove_file(path.join("walk.mkv")).unwrap();

    // Without the video: the same images in the same order, and poses kept next to the first.
    let job = |name: &str| serde_json::from_slice::<Value>(&fs::read(path.join(name)).unwrap()).unwrap();
    let before = job("job.json");
    let again = command_of(&first, "with other options");
    for expected in ["--order", "--focal", "--up", "walk=new-unfinished/images"] {
        assert!(again.iter().any(|word| word == expected), "{expected}: {again:?}");
    }
    let second = cif(path, &again);
    assert!(second.stderr.contains("kept: new-unfinished-2 has the poses found"), "{}", second.stderr);
    for key in ["names", "pairs", "cameras"] {
        assert_eq!(job("job.json")[key], before[key], "{key}");
    }

    let accepted = cif(path, &command_of(&second, "all the same")).succeeds();
    assert!(accepted.stdout.contains("14 of 14 images of 1 cameras have a pose"), "{}", accepted.stdout);
    assert!(accepted.stdout.contains("times: of every image"), "{}", accepted.stdout);
    let written = job("new/transforms.json");
    assert_eq!(written["frames"][3]["time"], 0.3);
    assert_eq!(written["cif"]["up_known"], true, "--up is given again");
}
