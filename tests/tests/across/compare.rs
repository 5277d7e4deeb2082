//! Heads of other systems by the command, and the comparison of all. How good any is on so few steps is not tested.

use std::fs;
use std::path::Path;

use cif_test::capture;
use cif_test::command::{Run, SMALL_MODEL, json, run_line};
use serde_json::Value;

/// Short stages before those of the heads.
const SHORT: &str = "--set stages.coarse=10 --set stages.fine=60 --set densify.max_gaussians=600";

fn cif(folder: &Path, line: &str) -> Run {
    run_line(env!("CARGO_BIN_EXE_cif-under-test"), folder, line)
}

fn json_file(path: &Path) -> Value {
    json(&fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
}

#[test]
fn scenes_of_every_head_can_be_scored_drawn_searched_and_exported() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    cif(path, &format!("train table -o base.cif --iterations-instance 10 {SMALL_MODEL} {SHORT}")).succeeds();
    for head in ["dr-splat", "gaussian-grouping", "sa4d", "vlgs", "trace3d"] {
        let line =
            format!("train table -o {head}.cif --from base.cif --head {head} --iterations-instance 25");
        cif(path, &line).succeeds();
        let stdout = cif(path, &format!("eval {head}.cif table --json {head}.json")).succeeds().stdout;
        assert!(stdout.contains(&format!("labels as the head {head} decodes every pixel")), "{stdout}");
        let scores = json_file(&path.join(format!("{head}.json")));
        assert_eq!(scores["labels_by"], head);
        assert!(scores["macc_pix"].is_number() && scores["psnr"].is_number(), "{head}: {scores:#}");
        cif(path, &format!("render {head}.cif --capture table -o {head} --what instance")).succeeds();
        cif(path, &format!("query {head}.cif --label * --json")).succeeds();
        cif(path, &format!("export {head}.cif --gltf {head}.glb")).succeeds();
    }
    let stdout = cif(path, "eval base.cif table --json base.json").succeeds().stdout;
    assert!(!stdout.contains("decodes every pixel"), "{stdout}");
    assert_eq!(json_file(&path.join("base.json"))["labels_by"], "identity rows");
    cif(path, "train table -o x.cif --from base.cif --head lerf").fails(2, &["--head", "gaussian-grouping"]);
    cif(path, "train table -o x.cif --from base.cif --head sa4d --set head.camera=cam16")
        .fails(1, &["head.camera = cam16", "training cameras"]);
}

#[test]
fn a_comparison_has_the_scores_of_its_scenes_and_goes_on_where_it_stopped() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let line = format!(
        "bench compare table -o out --heads cif,dr-splat,vlgs --seeds 1 --iterations 8 --ablations {SMALL_MODEL} {SHORT}"
    );
    let output = cif(path, &line).succeeds();
    assert!(output.stdout.contains("VLGS (re-implementation)"), "{}", output.stdout);
    let rows = json_file(&path.join("out/panoptic.json"));
    let rows = rows.as_array().unwrap();
    let named: Vec<(&str, u64)> =
        rows.iter().map(|row| (row["head"].as_str().unwrap(), row["seed"].as_u64().unwrap())).collect();
    assert_eq!(named, [("cif", 0), ("vlgs", 0), ("dr-splat", 0)]);
    for row in rows {
        let (head, seed) = (row["head"].as_str().unwrap(), &row["seed"]);
        cif(path, &format!("eval out/runs/table.seed{seed}.{head}.cif table --json {head}{seed}.json"))
            .succeeds();
        let scores = json_file(&path.join(format!("{head}{seed}.json")));
        for key in ["macc_pix", "macc_inst", "miou", "psnr", "ssim", "gaussians"] {
            assert_eq!(row[key], scores[key], "{head} {key}");
        }
        assert!(row["seconds"].as_f64() >= Some(0.0) && row["capture"] == "table");
    }
    // Heads leave the reconstruction as it is.
    assert_eq!(rows[1]["psnr"], rows[2]["psnr"]);
    let parts = json_file(&path.join("out/ablation.json"));
    let parts: Vec<&str> =
        parts.as_array().unwrap().iter().map(|row| row["head"].as_str().unwrap()).collect();
    assert_eq!(parts, ["i", "ii", "iii", "iv", "v"]);
    for file in ["compare.html", "panoptic.md", "panoptic.csv", "panoptic.tex", "ablation.md", "ablation.tex"]
    {
        assert!(path.join("out").join(file).is_file(), "{file}");
    }
    let page = fs::read_to_string(path.join("out/compare.html")).unwrap();
    for part in
        ["Where they differ most", "data:image/png", "taken against other masks", "(ii) opacity as occupancy"]
    {
        assert!(page.contains(part), "{part}");
    }
    let base = fs::read(path.join("out/runs/table.seed0.base.cif")).unwrap();

    // Everything is kept but what is gone, which needs the reconstruction again.
    fs::remove_file(path.join("out/runs/table.seed0.vlgs.json")).unwrap();
    let stderr = cif(path, &line).succeeds().stderr;
    assert_eq!(stderr.matches(": kept, ").count(), 6, "{stderr}");
    assert_eq!(fs::read(path.join("out/runs/table.seed0.base.cif")).unwrap(), base);
    assert_eq!(json_file(&path.join("out/panoptic.json"))[1]["miou"], rows[1]["miou"], "the same run again");
    let stderr = cif(path, &line.replace("--iterations 8", "--iterations 9")).succeeds().stderr;
    assert_eq!(stderr.matches(": kept, ").count(), 0, "{stderr}");

    // Held-out frames have masks in the folder alone that scores are taken on.
    fs::create_dir(path.join("table/masks_rough")).unwrap();
    for frame in (0..8).filter(|frame| frame % 4 != 2) {
        let name = format!("{frame:06}.png");
        fs::copy(path.join("table/masks").join(&name), path.join("table/masks_rough").join(&name)).unwrap();
    }
    let line = format!(
        "bench compare table -o rough --heads dr-splat --seeds 1 --masks masks_rough {SMALL_MODEL} {SHORT}"
    );
    cif(path, &line).fails(1, &["held-out frames have none"]);
    cif(path, &format!("{line} --score-masks masks")).succeeds();
    cif(path, "eval rough/runs/table.seed0.dr-splat.cif table --json rough.json").succeeds();
    let (row, scores) = (json_file(&path.join("rough/panoptic.json")), json_file(&path.join("rough.json")));
    assert!(row[0]["miou"].is_number() && row[0]["miou"] == scores["miou"], "{row:#}");
    let page = fs::read_to_string(path.join("rough/compare.html")).unwrap();
    assert!(page.contains("--masks masks_rough --score-masks masks"));

    cif(path, "bench compare table -o table").fails(1, &["not empty"]);
    cif(path, "bench compare table table -o other").fails(1, &["two captures are called table"]);
    cif(path, "bench compare table -o other --iterations some").fails(2, &["published"]);
    cif(path, "bench compare table -o other --no-masks").fails(1, &["masks"]);
}

#[test]
fn a_comparison_out_of_time_tells_what_is_missing_and_goes_on() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let line = |heads: &str, more: &str| {
        format!(
            "bench compare table -o out --heads {heads} --seeds 2 --iterations 4 {SMALL_MODEL} {SHORT} {more}"
        )
    };
    // Nothing begins, not even the reconstruction.
    let output = cif(path, &line("cif", "--budget 0s")).succeeds();
    assert!(output.stderr.contains("again for the 2 runs"), "{}", output.stderr);
    assert!(
        output.stdout.contains("Missing, and not in the means: table with CIF (seed 0, 1)"),
        "{}",
        output.stdout
    );
    assert_eq!(fs::read_dir(path.join("out/runs")).unwrap().count(), 0);
    assert!(
        !cif(path, &line("cif", "--budget 1h")).succeeds().stdout.contains("Missing, and not in the means")
    );
    // Finished runs are kept and reported; missing ones are named.
    let output = cif(path, &line("cif,dr-splat", "--budget 0s")).succeeds();
    assert_eq!(output.stderr.matches(": kept, ").count(), 2, "{}", output.stderr);
    assert!(output.stdout.contains("table with Dr. Splat (seed 0, 1)"), "{}", output.stdout);
    for file in ["panoptic.tex", "compare.html"] {
        let text = fs::read_to_string(path.join("out").join(file)).unwrap();
        assert!(text.contains("Dr. Splat (seed 0, 1)"), "{file}");
    }
    let output = cif(path, &line("cif,dr-splat", "")).succeeds();
    assert_eq!(output.stderr.matches(": kept, ").count(), 2, "{}", output.stderr);
    assert!(!output.stdout.contains("Missing, and not in the means"), "{}", output.stdout);
    cif(path, &line("cif", "--budget soon")).fails(2, &["--budget"]);
}

#[test]
fn a_comparison_has_a_video_of_its_runs() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let line = format!(
        "bench compare table -o out --heads cif,vlgs --seeds 1 --iterations 4 --video {SMALL_MODEL} {SHORT}"
    );
    let encoders = std::process::Command::new("ffmpeg").arg("-encoders").output();
    if !encoders.is_ok_and(|listed| String::from_utf8_lossy(&listed.stdout).contains("libx264")) {
        cif(path, &line).fails(1, &["--video", "ffmpeg"]);
        eprintln!("skipped: no ffmpeg with libx264");
        return;
    }
    cif(path, &line).succeeds();
    let page = fs::read_to_string(path.join("out/compare.html")).unwrap();
    assert!(page.contains("From left to right: colours, CIF, VLGS (re-implementation)."));
    assert!(page.contains("data:video/mp4;base64,"));
    let probed = std::process::Command::new("ffprobe")
        .args([
            "-v",
            "error",
            "-count_frames",
            "-show_entries",
            "stream=width,height,nb_read_frames",
            "-of",
            "csv=p=0",
        ])
        .arg(path.join("out/table.mp4"))
        .output()
        .unwrap();
    let size = String::from_utf8_lossy(&probed.stdout).trim().to_owned();
    let numbers: Vec<u32> = size.split(',').map(|number| number.parse().unwrap()).collect();
    assert!(numbers[0] >= 3 * capture::WIDTH && numbers[1] >= capture::HEIGHT, "{size}: three parts");
    assert!(numbers[2] >= 61, "{size}: between two held-out frames there are sixty pictures");
}

/// Questions about the small capture.
const QUESTIONS: &str = r#"
[[capture]]
name = "table"

[[capture.question]]
text = "the Red thing"
answer = ["red ball"]

[[capture.question]]
text = "a ball"
answer = ["Ball"]

[[capture.question]]
text = "steel jug"
answer = [7]

[[capture]]
name = "elsewhere"

[[capture.question]]
text = "mug"
answer = [1]
"#;

#[test]
fn scenes_of_a_comparison_answer_questions_in_words() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    fs::write(path.join("q.toml"), QUESTIONS).unwrap();
    let line = |more: &str| {
        format!(
            "bench compare table -o out --heads cif,dr-splat --seeds 1 --iterations 8 {SMALL_MODEL} \
             {SHORT} --queries q.toml {more}"
        )
    };
    let output = cif(path, &line("")).succeeds();
    assert!(output.stderr.contains("elsewhere is not compared here"), "{}", output.stderr);
    assert!(output.stdout.contains("| Dr. Splat | labels | "), "{}", output.stdout);
    let answers = json_file(&path.join("out/queries.json"));
    let answers = answers.as_array().unwrap();
    let named = |answer: &Value| {
        let text = |key: &str| answer[key].as_str().unwrap().to_owned();
        (text("head"), text("question"), text("by"), answer["chosen"].clone())
    };
    let expected = ["cif", "dr-splat"].map(|head| {
        [("the Red thing", vec![3]), ("a ball", vec![3, 7]), ("steel jug", vec![])].map(
            |(question, chosen)| {
                (head.to_owned(), question.to_owned(), "labels".to_owned(), serde_json::json!(chosen))
            },
        )
    });
    assert_eq!(answers.iter().map(named).collect::<Vec<_>>(), expected.concat());

    // Numbers are those of the masks of the held-out frames, by hand.
    let dataset =
        cif_dataset::Dataset::open(path.join("table"), &cif_dataset::OpenOptions::default()).unwrap();
    let masks: Vec<_> =
        dataset.val_frames().into_iter().map(|index| dataset.load_mask(index).unwrap().unwrap()).collect();
    let of = |head: &str, question: &str| {
        answers.iter().find(|answer| answer["head"] == head && answer["question"] == question).unwrap()
    };
    let scene = path.join("out/runs/table.seed0.cif.cif");
    let field = cif_field::Field::load(&scene).unwrap();
    let options = cif_train::metrics::EvaluationOptions::held_out(&field);
    let mut both = Vec::new();
    cif_train::metrics::evaluate::<cif_train::metrics::EvaluationError>(&field, &dataset, &options, |view| {
        let shown = view.rendered.instances.as_ref().unwrap().foreground_label();
        let shown = cif_train::metrics::mask_ids(&field, &shown).pixels;
        let truth = &view.truth.mask.as_ref().unwrap().pixels;
        let count = |of: &dyn Fn(bool, bool) -> bool| {
            truth.iter().zip(&shown).filter(|(truth, shown)| of(**truth == 3, **shown == 3)).count() as f64
        };
        let pixels = truth.len() as f64;
        both.push((count(&|a, b| a == b) / pixels, count(&|a, b| a && b) / count(&|a, b| a || b)));
        Ok(())
    })
    .unwrap();
    let frames = both.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| 100.0 * both.iter().map(of).sum::<f64>() / frames;
    let red = of("cif", "the Red thing");
    let close = |value: &Value, expected: f64| (value.as_f64().unwrap() - expected).abs() < 1e-9;
    assert!(
        close(&red["macc"], mean(|frame| frame.0)) && close(&red["miou"], mean(|frame| frame.1)),
        "{red:#}"
    );
    // No label has a word of this one: nothing is shown, and what is not the ball agrees.
    let blue = |mask: &cif_geometry::PixelGrid<u16>| {
        mask.pixels.iter().filter(|id| **id == 7).count() as f64 / mask.pixels.len() as f64
    };
    let rest = 100.0 * masks.iter().map(|mask| 1.0 - blue(mask)).sum::<f64>() / frames;
    for head in ["cif", "dr-splat"] {
        let jug = of(head, "steel jug");
        assert!(close(&jug["macc"], rest) && close(&jug["miou"], 0.0), "{jug:#}");
        assert_eq!((&jug["frames"], &jug["empty_frames"]), (&masks.len().into(), &0.into()));
    }
    for extension in ["md", "csv", "tex"] {
        let text = fs::read_to_string(path.join(format!("out/queries.{extension}"))).unwrap();
        assert!(text.contains("steel jug"), "{extension}");
    }
    let page = fs::read_to_string(path.join("out/compare.html")).unwrap();
    for part in ["Questions in words", "No models were given", "&#39;a ball&#39; mIoU %"] {
        assert!(page.contains(part) || page.contains(&part.replace("&#39;", "'")), "{part}");
    }

    // Answers are kept until a question changes; without time nobody is asked.
    let stderr = cif(path, &line("")).succeeds().stderr;
    assert_eq!(stderr.matches("questions: kept, ").count(), 2, "{stderr}");
    fs::write(path.join("q.toml"), QUESTIONS.replace("steel jug", "steel pot")).unwrap();
    let output = cif(path, &line("--budget 0s")).succeeds();
    assert!(output.stderr.contains("questions that 2 scenes have not answered"), "{}", output.stderr);
    assert!(
        output.stdout.contains("Missing, and not in the means: table with CIF (seed 0)"),
        "{}",
        output.stdout
    );
    assert_eq!(json_file(&path.join("out/queries.json")), serde_json::json!([]));

    let asked = |text: &str, words: &[&str]| {
        fs::write(path.join("q.toml"), text).unwrap();
        cif(path, "bench compare table -o other --queries q.toml").fails(1, words);
    };
    asked(&QUESTIONS.replace("[7]", "[8]"), &["q.toml", "'steel jug'", "no instance is 8", "7 blue ball"]);
    asked(&QUESTIONS.replace("answer = [7]", "anser = [7]"), &["q.toml:15", "anser"]);
    asked(&QUESTIONS.replace("\"table\"", "\"tabel\""), &["tabel, elsewhere", "table"]);
    cif(path, "bench compare table -o other --queries no.toml").fails(1, &["no.toml"]);
    cif(path, "bench compare table -o other --models m").fails(2, &["--queries"]);
    fs::write(path.join("q.toml"), QUESTIONS).unwrap();
    cif(path, "bench compare table -o other --queries q.toml --models table").fails(1, &["models.toml"]);
    assert!(!path.join("other/runs").exists(), "nothing is begun");
    let help = cif(path, "bench compare --help").succeeds().stdout;
    assert!(help.contains("[[capture.question]]"), "{help}");
}

#[test]
fn feature_maps_are_learnt_and_asked() {
    let folder = capture::in_folder(8);
    let path = folder.path();
    let code = |id: u8| match u16::from(id) {
        capture::ROLLING => [1.0, 0.0, 0.0],
        capture::STANDING => [0.0, 2.0, 0.0],
        _ => [0.0, 0.0, 1.0],
    };
    capture::write_maps(&path.join("table"), 8, &path.join("maps"), code);
    let questions = "anything = [[0.0, 0.1, 1.0]]\n[[capture]]\nname = \"table\"\nmaps = \"maps\"\n\
                     [[capture.question]]\ntext = \"blue\"\nanswer = [7]\ncode = [0.0, 1.0, 0.0]\n";
    fs::write(path.join("q.toml"), questions).unwrap();
    let line = format!(
        "bench compare table -o out --heads dr-splat,4d-langsplat --seeds 1 --iterations 60 --queries q.toml \
         {SMALL_MODEL} --set stages.coarse=60 --set stages.fine=150 --set densify.max_gaussians=600"
    );
    let output = cif(path, &line).succeeds();
    assert!(output.stdout.contains("| 4D LangSplat (time-agnostic) | relevance | "), "{}", output.stdout);
    let answers = json_file(&path.join("out/queries.json"));
    let by: Vec<(&str, &str)> = answers
        .as_array()
        .unwrap()
        .iter()
        .map(|answer| (answer["head"].as_str().unwrap(), answer["by"].as_str().unwrap()))
        .collect();
    assert_eq!(by, [("dr-splat", "labels"), ("4d-langsplat", "relevance")]);
    assert!(answers[1]["miou"].as_f64() > Some(30.0) && answers[1]["frames"] == 2, "{answers:#}");
    // It has no labels, and so no row among those that are scored by them.
    let rows = json_file(&path.join("out/panoptic.json"));
    assert_eq!(rows.as_array().unwrap().iter().map(|row| &row["head"]).collect::<Vec<_>>(), ["dr-splat"]);
    let page = fs::read_to_string(path.join("out/compare.html")).unwrap();
    assert!(page.contains("<td>relevance</td>") && page.contains("features that it learnt"));

    let scene = "out/runs/table.seed0.4d-langsplat.cif";
    cif(path, &format!("eval {scene} table --json scores.json")).succeeds();
    let scores = json_file(&path.join("scores.json"));
    assert!(scores["psnr"].is_number() && scores["macc_pix"].is_null(), "{scores:#}");
    cif(path, &format!("export {scene} --gltf scene.glb")).succeeds();
    cif(path, &format!("info {scene}")).succeeds();
    let base = "out/runs/table.seed0.base.cif";
    cif(path, &format!("train table -o x.cif --from {base} --head 4d-langsplat")).fails(1, &["head.maps"]);

    fs::remove_file(path.join("maps/000004.npy")).unwrap();
    let other = line.replace("-o out", "-o other");
    cif(path, &other).fails(1, &["maps", "000004", "[height, width, 3]"]);
    fs::write(path.join("q.toml"), questions.replace("maps = \"maps\"\n", "")).unwrap();
    cif(path, &other).fails(1, &["'blue'", "no maps"]);
    fs::write(path.join("q.toml"), questions.replace("code = [0.0, 1.0, 0.0]\n", "")).unwrap();
    cif(path, &other).fails(1, &["'blue'", "no code"]);
    cif(path, "bench compare table -o other --heads 4d-langsplat").fails(2, &["--queries"]);
    assert!(!path.join("other/runs").exists(), "nothing is begun");
}
