//! A capture goes in; a scene that shows it and knows its objects comes out.

use std::fs;
use std::path::Path;
use std::process::Command;

use cif_dataset::CaptureFrame;
use cif_field::tracks::{DenseTrack, RotationEvidence, TrackGroup, TrackPose, Tracks, VisibilityStep};
use cif_field::{Checkpoint, Field, Gaussians, Identities, Instance, SortMetric, Timeline};
use cif_test::capture::{self, ROLLING, STANDING};
use cif_test::command::{Background, Run, run};
use glam::DQuat;
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Settings of a run of a few seconds.
const SHORT: &str = "--iterations-coarse 150 --iterations-fine 350 --iterations-instance 100 \
                     --set model.spatial_resolution=[16,16,16] --set densify.until=300 --max-gaussians 2000 \
                     --set motion.parts=false";

/// Settings of a run that learns nothing, for tests of what lies around it.
const TINY: &str = "--iterations-coarse 6 --iterations-fine 6 --iterations-instance 6 \
                    --set model.spatial_resolution=[8,8,8] --set motion.rigid=false --set report.step_every=1";

fn cif(folder: &Path, line: &str) -> Run {
    run(CIF, folder, line.split_whitespace())
}

fn with_capture(frames: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    capture::write(&folder.path().join("table"), frames);
    folder
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

#[test]
fn a_capture_becomes_a_scene_that_is_scored_rendered_and_queried() {
    let folder = with_capture(24);
    let path = folder.path();
    let trained = cif(path, &format!("train table -o scene.cif --seed 1 --log run.jsonl {SHORT}")).succeeds();
    assert!(trained.stderr.contains("saved scene.cif"), "{}", trained.stderr);
    assert!(trained.stdout.is_empty(), "progress belongs on stderr: {}", trained.stdout);

    // The log is JSON lines that end with the result; the settings are those that were typed.
    let log = fs::read_to_string(path.join("run.jsonl")).unwrap();
    let events: Vec<Value> = log.lines().map(json).collect();
    let first = events.iter().find(|event| event["event"] != "warning").expect("there are events");
    assert_eq!((&first["event"], &first["phase"]), (&"phase_started".into(), &"open".into()));
    let finished = events.iter().position(|event| event["event"] == "finished").expect("the run finished");
    let after: Vec<&Value> = events[finished + 1..].iter().map(|event| &event["event"]).collect();
    let is_of_a_phase = |name: &&Value| name.as_str().is_some_and(|name| name.starts_with("phase_"));
    assert!(after.iter().all(is_of_a_phase), "only the last phases end after the run: {after:?}");
    let settings = fs::read_to_string(path.join("scene.train.toml")).unwrap();
    assert!(settings.contains("fine = 350") && settings.contains("seed = 1"), "{settings}");

    // The scene shows the capture and knows its objects.
    let scores = json(&cif(path, "eval scene.cif table --json - --images pictures").succeeds().stdout);
    let number = |key: &str| scores[key].as_f64().unwrap_or_else(|| panic!("{key} in {scores:#}"));
    assert!(number("psnr") > 18.0, "{scores:#}");
    assert!(number("psnr_covisible") > 18.0 && (50.0..=100.0).contains(&number("covisible")), "{scores:#}");
    assert!(number("ssim") > 0.5, "{scores:#}");
    assert!(number("miou") > 60.0, "{scores:#}");
    assert!(number("macc_pix") > 75.0 && number("macc_inst") > 75.0, "{scores:#}");
    assert_eq!(scores["frames"], 6);
    assert_eq!(scores["train"]["iterations"], 600);
    assert_eq!(scores["train"]["preset"], "standard");
    assert_eq!(scores["train"]["seed"], 1);
    assert!(number("gaussians") > 0.0 && number("render_ms_per_frame") > 0.0);
    let instances = scores["instances"].as_array().unwrap();
    assert_eq!(instances.len(), 2);
    assert_eq!((&instances[0]["id"], &instances[0]["label"]), (&3.into(), &"red ball".into()));
    assert!(instances.iter().all(|one| one["iou"].is_number() && one["accuracy"].is_number()));
    // Five pictures of 40 pixels and four gaps of 2.
    let picture = image::open(path.join("pictures/000002.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (208, 30));

    // Layers are written as documented: ids as they are in the masks, depth in millimetres.
    let what = "rgb,instance,depth,alpha,coverage,probability,entropy,instance-color,depth-color";
    cif(path, &format!("render scene.cif --capture table --split val -o views --what {what}")).succeeds();
    let ids = image::open(path.join("views/instance/000002.png")).unwrap();
    assert_eq!(ids.color(), image::ColorType::L16);
    let ids = ids.into_luma16().into_raw();
    assert!(ids.iter().all(|id| [0, capture::ROLLING, capture::STANDING].contains(id)));
    let depth = image::open(path.join("views/depth/000002.png")).unwrap().into_luma16();
    let middle = depth.get_pixel(capture::WIDTH / 2, capture::HEIGHT / 2).0[0];
    assert!((900..3000).contains(&middle), "the scene is about two metres away, not {middle} mm");

    // Views of one's own, at a time of one's own.
    fs::write(
        path.join("views.json"),
        r#"[{"name": "above", "width": 20, "height": 10, "vertical_fov_deg": 50,
             "position": [0, -1, 1.5], "look_at": [0, 0, 0]}]"#,
    )
    .unwrap();
    cif(path, "render scene.cif --camera views.json --time 50% -o own").succeeds();
    assert_eq!(image::open(path.join("own/rgb/above.png")).unwrap().width(), 20);

    // Places and labels.
    let place = capture::centre(capture::STANDING, 0.5) + glam::DVec3::Z * 0.2;
    let at = format!("query scene.cif --at={},{},{} --time 50% --json", place.x, place.y, place.z);
    let answer = json(&cif(path, &at).succeeds().stdout);
    let best = answer["instances"]
        .as_array()
        .unwrap()
        .iter()
        .max_by(|a, b| a["probability"].as_f64().unwrap().total_cmp(&b["probability"].as_f64().unwrap()));
    assert_eq!(best.unwrap()["label"], "blue ball", "{answer:#}");
    let found = json(&cif(path, "query scene.cif --label BLUE* --json").succeeds().stdout);
    assert_eq!(found.as_array().unwrap().len(), 1);
    assert_eq!((&found[0]["label"], &found[0]["class"]), (&"blue ball".into(), &"ball".into()));
    cif(path, "query scene.cif --label teapot").fails(1, &["teapot", "blue ball", "red ball"]);

    // The motion table needs no USD; a build without it says so before any work.
    let table = cif(path, "export scene.cif --report").succeeds().stdout;
    assert!(table.contains("blue ball") && table.contains("background"), "{table}");
    cif(path, "export scene.cif --usd out.usda").fails(1, &["USD"]);
    assert!(!path.join("out.usda").exists());

    // glTF and PLY need nothing else; both come back as scenes with the same objects.
    cif(path, "export scene.cif --gltf out.gltf --ply out.ply").succeeds();
    cif(path, "export scene.cif --gltf out.gltf").fails(1, &["out.gltf exists", "--force"]);

    let facts = json(&cif(path, "info scene.cif --json").succeeds().stdout);
    let motion = &facts["instances"][0]["motion"];
    assert_eq!(motion["model"], "rigid", "{facts:#}");
    let displacement = capture::centre(capture::ROLLING, 1.0) - capture::centre(capture::ROLLING, 0.0);
    let moves = motion["moves"].as_f64().unwrap();
    assert!((moves / displacement.length() - 1.0).abs() < 0.15, "{moves} m for {} m", displacement.length());

    // The loss of a file is measured on held-out images, as `cif eval` scores them.
    let line = "export scene.cif --gltf checked.glb --check --capture table --json";
    let checked = &json(&cif(path, line).succeeds().stdout)["check"][0]["held_out"];
    let (before, after) = (&checked["scene"], &checked["file"]);
    assert_eq!((checked["frames"].as_u64(), before["psnr"].as_f64()), (Some(6), Some(number("psnr"))));
    assert_eq!(before["miou"].as_f64(), Some(number("miou")));
    let lost = before["psnr"].as_f64().unwrap() - after["psnr"].as_f64().unwrap();
    assert_eq!(checked["psnr_lost"].as_f64(), Some(lost));
    assert!((-0.2..3.0).contains(&lost), "{checked:#}");
    let objects = checked["objects"].as_array().unwrap();
    let labels: Vec<&str> = objects.iter().filter_map(|object| object["label"].as_str()).collect();
    assert_eq!(labels, ["everything else", "red ball", "blue ball"]);
    assert!(
        objects[1..].iter().all(|object| object["psnr_lost"].is_number() && object["iou_lost"].is_number())
    );

    let text = fs::read_to_string(path.join("out.gltf")).unwrap();
    assert!(text.contains("KHR_gaussian_splatting:ROTATION") && text.contains("red ball"));
    assert!(path.join("out.bin").metadata().unwrap().len() > 10_000);
    cif(path, "export scene.cif --ply splats --ply-split").succeeds();
    assert!(path.join("splats/background.ply").exists());

    // Nothing is overwritten unasked.
    cif(path, "eval scene.cif table --images pictures").fails(1, &["pictures", "--force"]);
    cif(path, "train table -o scene.cif").fails(1, &["scene.cif exists"]);
    cif(path, "train table -o scene.cif --resume").fails(1, &["finished"]);

    // A scene that was cut short is refused.
    let bytes = fs::read(path.join("scene.cif")).unwrap();
    fs::write(path.join("short.cif"), &bytes[..bytes.len() / 2]).unwrap();
    cif(path, "info short.cif").fails(1, &["short.cif", "cut short"]);
}

/// The command that is printed to go on with can be pasted into a shell, whatever files are called.
#[cfg(unix)]
#[test]
fn all_steps_are_one_command_that_stops_where_frames_have_to_be_painted() {
    let folder = with_capture(8);
    let path = folder.path();
    fs::rename(path.join("table/masks"), path.join("truth")).unwrap();
    let settings = "[stages]\ncoarse = 6\nfine = 6\ninstance = 6\n[model]\nspatial_resolution = [8, 8, 8]\n\
                    [motion]\nrigid = false\n";
    fs::write(path.join("tiny.toml"), settings).unwrap();
    let line = "make table -o out --config tiny.toml --quiet";
    cif(path, line).fails(1, &["table/rgb", "out/keyframes/000000.png", "out/keyframes/000007.png"]);
    assert!(!path.join("out").exists());

    fs::create_dir_all(path.join("out/keyframes")).unwrap();
    for name in ["000000.png", "000007.png", "instances.json"] {
        let from = ["truth", "table"].map(|folder| path.join(folder).join(name));
        let from = from.iter().find(|file| file.exists()).unwrap();
        fs::copy(from, path.join("out/keyframes").join(name)).unwrap();
    }
    // Two of the four frames that were asked for: nothing goes on without a word.
    let missing =
        ["2 of 4 frames are painted", "out/keyframes/000002.png", "out/keyframes/000004.png", "--as-painted"];
    cif(path, line).fails(1, &missing);
    assert!(!path.join("out/masks").exists());
    let made = cif(path, &format!("{line} --as-painted")).succeeds();
    assert!(!made.stderr.contains("training frame"), "{}", made.stderr);
    for step in ["$ cif masks propagate table", "$ cif train table", "$ cif export out/scene.cif"] {
        assert!(made.stderr.contains(step), "{step} in {}", made.stderr);
    }
    let query = cif(path, "query out/scene.glb --label *").succeeds();
    assert!(query.stdout.contains("red ball") && query.stdout.contains("blue ball"), "{}", query.stdout);

    // What is there is not made again, a run that was interrupted goes on, and what is out of date is reported.
    let again = cif(path, line).succeeds();
    assert!(!again.stderr.contains('$'), "{}", again.stderr);
    fs::remove_file(path.join("out/scene.glb")).unwrap();
    cif(path, "train table --masks out/masks -o out/scene.cif --config tiny.toml --force --stop-after 1 -q")
        .succeeds();
    assert!(cif(path, line).succeeds().stderr.contains("--resume"));

    // What follows from a change is made again, with the reason.
    fs::copy(path.join("truth/000003.png"), path.join("out/keyframes/000003.png")).unwrap();
    let stderr = cif(path, &line.replace(" --quiet", "")).succeeds().stderr;
    assert!(stderr.contains("out/masks is made again: the keyframe file 000003.png is new"), "{stderr}");
    for step in ["$ cif masks propagate table", "$ cif export out/scene.cif"] {
        assert!(stderr.contains(step), "{step} in {stderr}");
    }
}

#[test]
fn results_of_other_inputs_are_not_passed_off() {
    let folder = with_capture(4);
    let path = folder.path();
    for file in ["000000.png", "000001.png"] {
        assert!(path.join("table/masks").join(file).is_file());
    }
    let settings = "[stages]\ncoarse = 3\nfine = 3\ninstance = 3\n[model]\nspatial_resolution = [8, 8, 8]\n\
                    [motion]\nrigid = false\n";
    fs::write(path.join("tiny.toml"), settings).unwrap();
    let make = || cif(path, "make table -o out --config tiny.toml").succeeds().stderr;
    make();
    assert!(!make().contains('$'), "nothing is made again");
    // In place, of the same size: another file's content, which is as long as it is padded to.
    fs::write(path.join("tiny.toml"), settings.replace("coarse = 3", "coarse = 4")).unwrap();
    let stderr = make();
    assert!(stderr.contains("out/scene.cif is made again: the settings file has changed"), "{stderr}");
    assert!(
        stderr.contains("$ cif train table") && stderr.contains("$ cif export out/scene.cif"),
        "{stderr}"
    );
    fs::copy(path.join("table/masks/000001.png"), path.join("table/masks/000000.png")).unwrap();
    let stderr = make();
    assert!(stderr.contains("out/scene.cif is made again: the mask of frame 000000 has changed"), "{stderr}");
    // What is made by hand is not replaced, and what follows from it is.
    cif(path, "label out/scene.cif --instance 3 other").succeeds();
    let stderr = make();
    assert!(
        !stderr.contains("$ cif train") && stderr.contains("is made again: the scene has changed"),
        "{stderr}"
    );

    // A run does not go on with other inputs than those it began with.
    let tiny = "--config tiny.toml -q";
    cif(path, &format!("train table -o run.cif {tiny} --stop-after 1")).succeeds();
    fs::copy(path.join("table/masks/000002.png"), path.join("table/masks/000001.png")).unwrap();
    let resume = "train table -o run.cif --resume -q";
    cif(path, resume).fails(1, &["the mask of frame 000001 has changed", "--accept-changes", "--force"]);
    cif(path, &format!("{resume} --accept-changes")).succeeds();
}

#[test]
fn labels_given_at_once_are_all_kept() {
    let folder = with_capture(4);
    let path = folder.path();
    let tiny = "--iterations-coarse 1 --iterations-fine 1 --iterations-instance 1 -q \
                --set model.spatial_resolution=[8,8,8] --set motion.rigid=false";
    cif(path, &format!("train table -o a.cif {tiny}")).succeeds();
    let ids: Vec<u16> =
        Checkpoint::load(path.join("a.cif")).unwrap().field.instances.iter().map(|i| i.id).collect();
    for round in 0..3 {
        std::thread::scope(|scope| {
            for id in &ids {
                scope.spawn(move || {
                    cif(path, &format!("label a.cif --instance {id} round{round}of{id}")).succeeds()
                });
            }
        });
        let named = Checkpoint::load(path.join("a.cif")).unwrap().field.instances;
        for instance in named {
            assert_eq!(instance.label, format!("round{round}of{}", instance.id));
        }
    }
    assert!(!path.join(".a.cif.lock").exists());
}

#[test]
fn the_command_to_go_on_with_can_be_pasted() {
    let folder = with_capture(4);
    let path = folder.path();
    fs::rename(path.join("table"), path.join("my table")).unwrap();
    let start = ["train", "my table", "-o", "it's $HOME.cif", "--stop-after", "1"];
    let stopped = run(CIF, path, start.into_iter().chain(TINY.split_whitespace())).succeeds();
    let (_, line) = stopped.stderr.split_once("continue with: cif ").expect("the command is printed");
    let script = format!("\"$CIF\" {}", line.lines().next().unwrap());
    let status = std::process::Command::new("sh")
        .args(["-c", &script])
        .current_dir(path)
        .env("CIF", CIF)
        .stderr(std::process::Stdio::null())
        .status();
    assert!(status.unwrap().success(), "{script}");
    assert!(Checkpoint::load(path.join("it's $HOME.cif")).unwrap().training.is_none());
}

#[test]
fn an_interrupted_run_resumes_to_the_same_scene() {
    let folder = with_capture(6);
    let path = folder.path();
    cif(path, &format!("train table -o whole.cif {TINY}")).succeeds();
    // Stops inside each of the three stages.
    let mut line = format!("train table -o parts.cif {TINY} --stop-after");
    for limit in [3, 5, 5] {
        let stopped = cif(path, &format!("{line} {limit}")).succeeds();
        assert!(stopped.stderr.contains("--resume"), "{}", stopped.stderr);
        line = "train table -o parts.cif --resume --stop-after".to_owned();
    }
    assert!(Checkpoint::load(path.join("parts.cif")).unwrap().training.is_some());
    cif(path, "train table -o parts.cif --resume").succeeds();

    let whole = Checkpoint::load(path.join("whole.cif")).unwrap();
    let mut parts = Checkpoint::load(path.join("parts.cif")).unwrap();
    assert!(parts.training.is_none());
    // Times and memory differ; everything else may not.
    parts.field.record = whole.field.record.clone();
    assert!(parts == whole, "the resumed scene differs from the uninterrupted one");
}

/// Settings of a run that does not end by itself.
const ENDLESS: &str =
    "--iterations-coarse 10000000 --set model.spatial_resolution=[8,8,8] --set motion.rigid=false --quiet";

#[test]
fn one_run_at_a_time_trains_a_scene_and_a_killed_one_is_no_obstacle() {
    let folder = with_capture(4);
    let path = folder.path();
    let line = format!("train table -o a.cif {ENDLESS}");
    let mut first = Background::start(CIF, path, &line);
    let lock = path.join(".a.cif.lock");
    first.until(|| fs::read_to_string(&lock).is_ok_and(|text| text.contains("since")));
    let process = format!("process {}", first.id());
    cif(path, &format!("{line} --force")).fails(1, &["another command", &process, "a.cif"]);
    // Killed before it has saved: the same command begins anew.
    drop(first);
    assert!(!path.join("a.cif").exists());
    cif(path, &format!("{line} --stop-after 1")).succeeds();
    assert!(path.join("a.train.toml").exists() && !lock.exists());
    // Now there is something to go on with, and the same command says so.
    cif(path, &line).fails(1, &["a.cif exists", "interrupted", "--resume"]);
}

#[cfg(unix)]
#[test]
fn killed_runs_go_on_from_what_was_saved_and_signals_save_first() {
    let folder = with_capture(4);
    let path = folder.path();
    let scene = path.join("a.cif");
    let steps =
        || Checkpoint::load(&scene).unwrap().training.unwrap().json["progress"]["total_steps"].clone();
    let mut run =
        Background::start(CIF, path, &format!("train table -o a.cif {ENDLESS} --checkpoint-seconds 1"));
    run.until(|| scene.exists());
    drop(run);
    let killed_at = steps();
    assert!(killed_at.as_u64() > Some(0), "{killed_at}");
    // It goes on, says at which step it stands, and saves when it is asked to end.
    let mut run = Background::start(CIF, path, "train table -o a.cif --resume --quiet --log run.jsonl");
    let log = path.join("run.jsonl");
    run.until(|| fs::read_to_string(&log).is_ok_and(|text| text.contains("\"step\"")));
    let lines = fs::read_to_string(&log).unwrap();
    let begins = lines.lines().find(|line| line.contains("stage_started")).map(json);
    assert_eq!(begins.unwrap()["iteration"], killed_at);
    let signal = format!("kill -TERM {}", run.id());
    assert!(Command::new("sh").args(["-c", &signal]).status().unwrap().success());
    assert_eq!(run.ends(), Some(130));
    assert!(steps().as_u64() > killed_at.as_u64(), "{} after {killed_at}", steps());
}

#[test]
fn instances_are_trained_on_the_reconstruction_of_another_scene() {
    let folder = with_capture(6);
    let path = folder.path();
    cif(path, &format!("train table -o bare.cif --no-masks {TINY} --set near=0.19")).succeeds();
    cif(path, "train table -o named.cif --from bare.cif --ablate no-resampling").succeeds();
    let named = Checkpoint::load(path.join("named.cif")).unwrap().field;
    assert!(named.identities.is_some());
    let record = named.record.to_json();
    assert_eq!(record["train"]["from"]["scene"], "bare.cif");
    assert!((record["config"]["near"].as_f64().unwrap() - 0.19).abs() < 1e-6, "settings of the scene");
    assert_eq!(record["config"]["instance"]["ablate"][0], "no-resampling");
    cif(path, "train table -o none.cif --from scene.cif --iterations-fine 3").fails(2, &["--from"]);
}

#[test]
fn a_reconstruction_of_images_that_have_changed_is_not_begun_with_unasked() {
    let folder = with_capture(6);
    let path = folder.path();
    cif(path, &format!("train table -o bare.cif --no-masks {TINY}")).succeeds();
    // Other masks are what it is for; a copy of the capture is the same capture.
    let copied = Command::new("cp").args(["-r", "table", "copy"]).current_dir(path).status();
    assert!(copied.unwrap().success());
    fs::rename(path.join("copy/masks/000000.png"), path.join("copy/masks/000001.png")).unwrap();
    cif(path, "train copy -o other.cif --from bare.cif").succeeds();
    let image = path.join("table/rgb/1x/000001.png");
    let mut picture = image::open(&image).unwrap().into_rgb8();
    picture.put_pixel(0, 0, image::Rgb([1, 2, 3]));
    picture.save(&image).unwrap();
    let line = "train table -o next.cif --from bare.cif";
    let expected =
        ["bare.cif", "the image of frame 000001 has changed", "without --from", "--accept-changes"];
    cif(path, line).fails(1, &expected);
    // Of a scene that was itself begun so.
    cif(path, "train table -o next.cif --from other.cif")
        .fails(1, &["the image of frame 000001 has changed"]);
    cif(path, &format!("{line} --accept-changes")).succeeds();
    cif(path, "train table -o again.cif --from next.cif").succeeds();
    cif(path, "train table -o none.cif --accept-changes").fails(2, &["--resume", "--from"]);
}

#[test]
fn threads_do_not_change_the_scene() {
    let folder = with_capture(4);
    for threads in [1, 3] {
        cif(folder.path(), &format!("train table -o {threads}.cif --threads {threads} {TINY}")).succeeds();
    }
    let load = |name: &str| {
        let mut field = Checkpoint::load(folder.path().join(name)).unwrap().field;
        field.record = Default::default();
        field
    };
    assert!(load("1.cif") == load("3.cif"));
}

#[test]
fn without_masks_colour_is_trained_and_nothing_is_invented() {
    let folder = with_capture(4);
    let path = folder.path();
    fs::remove_dir_all(path.join("table/masks")).unwrap();
    let trained = cif(path, &format!("train table -o scene.cif {TINY}")).succeeds();
    assert!(trained.stderr.contains("no masks"), "{}", trained.stderr);
    let scores = json(&cif(path, "eval scene.cif table --json -").succeeds().stdout);
    assert!(scores["psnr"].is_number());
    for key in ["macc_pix", "macc_inst", "miou"] {
        assert!(scores[key].is_null(), "{key} must be undefined: {scores:#}");
    }
    assert!(cif(path, "eval scene.cif table").succeeds().stdout.contains("n/a"));
    cif(path, "render scene.cif --capture table -o out --what instance").fails(1, &["without masks"]);
}

/// A limit on file sizes stands in for a full disk: writing fails half way.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_the_old_scene() {
    let folder = with_capture(4);
    let path = folder.path();
    fs::write(path.join("scene.cif"), "an older scene").unwrap();
    let line = format!("trap '' XFSZ; ulimit -f 40; exec {CIF} train table -o scene.cif --force {TINY}");
    run("bash", path, ["-c", line.as_str()]).fails(1, &["scene.cif", "space"]);
    assert_eq!(fs::read_to_string(path.join("scene.cif")).unwrap(), "an older scene");
}

/// The two balls of a capture of eight images, each of which stays, or follows its true path.
fn balls(follows: bool) -> Field {
    let times: Vec<f64> = (0..8).map(|frame| f64::from(frame) / 7.0).collect();
    let (mut positions, mut identities, mut tracks) = (Vec::new(), Identities::empty(), Tracks::default());
    for (owner, id) in [ROLLING, STANDING].into_iter().enumerate() {
        for point in capture::surface(id, 0.0, 100) {
            positions.push(point.as_vec3().to_array());
            identities.push_certain(Some(owner as u16));
            tracks.group_of.push(owner as u32);
        }
        let pose = |time: &f64| TrackPose {
            time: *time,
            translation: capture::centre(id, *time),
            rotation: DQuat::IDENTITY,
        };
        let poses = if follows { times.iter().map(pose).collect() } else { Vec::new() };
        tracks.groups.push(TrackGroup { poses, ..TrackGroup::still("ball", capture::centre(id, 0.0)) });
    }
    let mut gaussians =
        Gaussians::from_points(&positions, &[[0.5; 3]; 200]).expect("as many colours as points");
    gaussians.log_scales.fill([0.002_f32.ln(); 3]);
    gaussians.opacity_logits.fill(3.0);
    gaussians.occupancy_logits.fill(3.0);
    let instance = |id| Instance {
        id,
        label: format!("ball {id}"),
        category: "ball".to_owned(),
        taxonomies: Default::default(),
    };
    Field {
        gaussians,
        deformation: None,
        tracks: Some(tracks),
        identities: Some(identities),
        instances: [ROLLING, STANDING].map(instance).to_vec(),
        timeline: Timeline { times, frames_per_second: 24.0 },
        cameras: Vec::new(),
        sh_degree: 0,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

#[test]
fn motion_is_measured_against_followed_points() {
    let folder = with_capture(8);
    let path = folder.path();
    capture::write_motion(&path.join("table"), 8);
    balls(true).save(path.join("rolls.cif")).unwrap();
    balls(false).save(path.join("still.cif")).unwrap();
    let motion = |line: &str| json(&cif(path, line).succeeds().stdout)["motion"].clone();
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{value} is no number"));

    // Pairs of eight times are three steps apart in the mean, and the ball rolls half a metre in seven.
    let rest = 500.0 * 3.0 / 7.0;
    let rolls = motion("eval rolls.cif table --json -");
    let red = &rolls["instances"][0];
    assert_eq!((&red["id"], &red["label"], &red["truth"]), (&3.into(), &"red ball".into(), &"rigid".into()));
    assert_eq!((&red["model"], &red["moves"], &red["times"]), (&"rigid".into(), &true.into(), &8.into()));
    // The tolerance of an export is 0.2 % of a ball of half a metre.
    assert!(number(&red["error_mm"]) < 1.0 && number(&red["rotation_deg"]) < 0.1, "{red:#}");
    assert!((number(&red["rest_mm"]) - rest).abs() < 0.01, "{red:#}");
    assert_eq!((&red["within_10_mm"], &red["within_50_mm"]), (&100.0.into(), &100.0.into()));
    // The box of a ball without its outermost splats.
    assert!(number(&red["box_iou"]) > 75.0, "{red:#}");
    // The recorded poses have no evidence with them, and the true ball is carried without a turn.
    assert_eq!((&red["claim"], &rolls["claims"]["none"]["right"]), (&Value::Null, &0.into()));
    let blue = &rolls["instances"][1];
    assert_eq!((&blue["model"], &blue["moves"]), (&"static".into(), &false.into()));
    assert!(number(&blue["error_mm"]) < 1e-3 && blue["rotation_deg"].is_null(), "{blue:#}");
    assert_eq!((&rolls["moving"]["instances"], &rolls["resting"]["instances"]), (&1.into(), &1.into()));
    assert_eq!(rolls["moving"]["error_mm"], red["error_mm"]);
    assert!(number(&rolls["seconds"]) > 0.0);

    let still = motion("eval still.cif table --json -");
    let red = &still["instances"][0];
    assert!((number(&red["error_mm"]) - rest).abs() < 0.01, "{red:#}");
    assert_eq!((&red["within_50_mm"], &red["error_mm"]), (&0.0.into(), &still["moving"]["error_mm"]));
    let table = cif(path, "eval still.cif table").succeeds().stdout;
    for words in [
        "unmoved, mm",
        "214.3",
        "of size, %",
        "rotation wrong, objects",
        "moving, mean of 1",
        "resting, mean of 1",
        "measured in",
    ] {
        assert!(table.contains(words), "{words} in {table}");
    }

    // Known motion is read, not written; damage is reported before anything is rendered.
    cif(path, "eval still.cif table --json table/motion.json --force").fails(2, &["is read by this command"]);
    assert!(motion("eval still.cif table --no-masks --json -").is_null(), "nobody knows what is seen");
    let tracks = path.join("table/tracks.npz");
    let bytes = fs::read(&tracks).unwrap();
    fs::write(&tracks, &bytes[..bytes.len() / 2]).unwrap();
    cif(path, "eval still.cif table --images pictures").fails(1, &["tracks.npz", "copy it again"]);
    assert!(!path.join("pictures").exists());
    fs::remove_file(&tracks).unwrap();
    assert!(motion("eval still.cif table --json -").is_null());
    assert!(!cif(path, "eval still.cif table").succeeds().stdout.contains("unmoved"));
}

#[test]
fn objects_tell_how_they_move() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let mut field = balls(true);
    let groups = &mut field.tracks.as_mut().unwrap().groups;
    for (k, pose) in groups[0].poses.iter_mut().enumerate() {
        pose.rotation = DQuat::from_rotation_y(0.25 * k as f64);
    }
    groups[0].rotation = Some(RotationEvidence::Assumed);
    groups[0].visibility =
        vec![VisibilityStep { time: 0.0, visible: false }, VisibilityStep { time: 0.4, visible: true }];
    groups[1].poses.clear();
    field.save(path.join("scene.cif")).unwrap();
    let facts = json(&cif(path, "info scene.cif --json").succeeds().stdout);
    let [rolling, standing] = [0, 1].map(|k| &facts["instances"][k]);
    assert_eq!(rolling["gaussians"], 100);
    let motion = &rolling["motion"];
    assert_eq!((&motion["model"], &motion["poses"]), (&"rigid".into(), &8.into()), "{facts:#}");
    assert_eq!((&motion["rotation"], &motion["hidden"]), (&"assumed".into(), &true.into()));
    let travel = capture::centre(ROLLING, 1.0).distance(capture::centre(ROLLING, 0.0));
    assert!((motion["moves"].as_f64().unwrap() - travel).abs() < 1e-9, "{motion}");
    assert!((motion["turns_deg"].as_f64().unwrap() - 1.75_f64.to_degrees()).abs() < 1e-3, "{motion}");
    assert_eq!(standing["motion"], serde_json::json!({ "model": "static" }));
    let text = cif(path, "info scene.cif").succeeds().stdout;
    assert!(
        text.contains("100 Gaussians  rigid, 8 poses, moves 0.500, turns 100.3 deg, rotation assumed, hidden at some times"),
        "{text}"
    );
    assert!(text.contains("100 Gaussians  static"), "{text}");
    // Distances are those of the capture's world.
    field.record.frame = CaptureFrame { offset: [1e6, 0.0, 0.0], scale: 0.1 };
    let groups = &mut field.tracks.as_mut().unwrap().groups;
    groups[1].dense = Some(DenseTrack {
        times: vec![0.0, 1.0],
        means: vec![[0.0; 3]; 200],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 200],
        log_scales: None,
    });
    field.save(path.join("far.cif")).unwrap();
    let text = cif(path, "info far.cif").succeeds().stdout;
    assert!(text.contains("moves 5.000") && text.contains("dense, 2 samples"), "{text}");
}

#[test]
fn paths_of_moving_objects_are_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let mut field = balls(true);
    field.background = [0.0; 3];
    field.save(path.join("scene.cif")).unwrap();
    fs::write(
        path.join("views.json"),
        r#"[{"name": "above", "width": 320, "height": 240, "vertical_fov_deg": 50,
             "position": [0, -1, 1.5], "look_at": [0, 0, 0]}]"#,
    )
    .unwrap();
    let picture = |what: &str, time: f64| {
        cif(
            path,
            &format!(
                "render scene.cif --camera views.json --what {what} --time {}% -o out --force",
                100.0 * time
            ),
        )
        .succeeds();
        image::open(path.join(format!("out/{what}/above.png"))).unwrap().into_rgb8()
    };
    // Edges are soft: most of a colour counts.
    let is_mostly = |pixel: [u8; 3], color: [u8; 3]| {
        pixel
            .iter()
            .zip(color)
            .all(|(value, color)| *value <= color && 10 * u32::from(*value) >= 7 * u32::from(color))
    };
    let count = |what: &str, time: f64, color: [u8; 3]| {
        picture(what, time).pixels().filter(|pixel| is_mostly(pixel.0, color)).count()
    };
    let [rolling, standing] = [ROLLING, STANDING].map(cif::pictures::instance_color);
    // All of the way is behind at the end; at the start it is fainter, and to come.
    let (start, end) = (count("tracks", 0.0, rolling), count("tracks", 1.0, rolling));
    assert!(start > 5 && end > start + 20, "{start} {end}");
    assert_eq!((count("rgb", 1.0, rolling), count("tracks", 1.0, standing)), (0, 0));
    // Axes turn with the object.
    let axes = |field: &Field| {
        field.save(path.join("scene.cif")).unwrap();
        let picture = picture("tracks", 1.0);
        let of_x = picture.enumerate_pixels().filter(|(.., pixel)| is_mostly(pixel.0, [230, 60, 60]));
        of_x.map(|(x, y, _)| (x, y)).collect::<Vec<_>>()
    };
    let unturned = axes(&field);
    assert!(unturned.len() > 3, "{unturned:?}");
    for pose in &mut field.tracks.as_mut().unwrap().groups[0].poses {
        pose.rotation = DQuat::from_rotation_z(pose.time * 2.0);
    }
    let turned = axes(&field);
    let same = turned.iter().filter(|pixel| unturned.contains(pixel)).count();
    assert!(turned.len() > 3 && 2 * same < turned.len(), "{same} of {}", turned.len());
    field.identities = None;
    field.save(path.join("scene.cif")).unwrap();
    cif(path, "render scene.cif --camera views.json --what tracks -o none").fails(1, &["without masks"]);
}

#[test]
fn a_plan_looks_for_points_as_training_does() {
    let folder = with_capture(4);
    let path = folder.path();
    let plan = cif(path, "plan table").succeeds();
    assert!(!plan.stderr.contains("no points"));
    assert!(plan.stdout.contains("\nexpected: ") && plan.stdout.contains(" of memory"), "{}", plan.stdout);
    let report = cif(path, "plan table --preset draft --json").succeeds().stdout;
    let report: Value = serde_json::from_str(&report).unwrap();
    let expected = |key: &str| report["expected"][key].as_f64().unwrap();
    assert!(expected("steps_s") > 0.0 && expected("memory_bytes") > 1e7, "{report}");
    assert!(expected("measured_steps") >= 3.0 && report["threads"].as_u64() >= Some(1), "{report}");
    // A run says the same before its first step; a short one, and one that is quiet, say nothing.
    let long = "train table -o run.cif --force --preset draft --set motion.rigid=false --stop-after 1";
    for (line, says) in
        [("", true), (" -q", false), (" --iterations-fine 300 --iterations-instance 100", false)]
    {
        let trained = cif(path, &format!("{long}{line}")).succeeds();
        assert_eq!(trained.stderr.contains("expected: "), says, "{line}: {}", trained.stderr);
    }
    fs::remove_file(path.join("table/points.npy")).unwrap();
    let plan = cif(path, "plan table").succeeds();
    assert!(plan.stderr.contains("it has no points"), "{}", plan.stderr);
}
