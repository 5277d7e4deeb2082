//! Questions in words, with models that the tests write themselves. `CIF_TEST_ONNX=off|auto|require` says whether those
//! run that need the library of ONNX Runtime.

use std::fs;
use std::path::Path;

use cif_dataset::{Dataset, OpenOptions};
use cif_geometry::PixelGrid;
use cif_test::capture::{self, ROLLING, STANDING};
use cif_test::command::{Run, json, run};
use cif_test::models;
use cif_test::onnx::{Attribute, Element, Model};
use cif_vision::grounding::Thresholds;
use cif_vision::{Models, Picture, Prompter};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

fn cif(folder: &Path, words: &[&str]) -> Run {
    run(CIF, folder, words)
}

/// Pictures of a small capture, with the true mask of each.
fn pictures(folder: &Path, frames: usize) -> Vec<(Picture, PixelGrid<u16>)> {
    capture::write(folder, frames);
    let dataset = Dataset::open(folder, &OpenOptions::default()).unwrap();
    let frame = |index| {
        let mask = dataset.load_mask(index).unwrap().unwrap();
        (dataset.load_image(index, [1.0; 3]).unwrap(), mask)
    };
    (0..frames).map(frame).collect()
}

/// Asks models once.
fn ask(folder: &Path, picture: &Picture, prompt: &str) -> Result<(PixelGrid<bool>, Vec<String>), String> {
    let models = Models::open(folder).map_err(|error| error.to_string())?;
    let pythons = cif::pythons();
    let mut prompter = Prompter::new(&models, &pythons, Thresholds::default());
    let (mask, boxes) = prompter.mask(picture, prompt).map_err(|error| error.to_string())?;
    Ok((mask, boxes.into_iter().map(|found| found.words).collect()))
}

fn overlap(a: &PixelGrid<bool>, b: &PixelGrid<bool>) -> f64 {
    let count = |of: &dyn Fn(bool, bool) -> bool| {
        a.pixels.iter().zip(&b.pixels).filter(|(a, b)| of(**a, **b)).count() as f64
    };
    count(&|a, b| a && b) / count(&|a, b| a || b)
}

#[test]
fn masks_of_a_prompt_are_those_of_the_picture() {
    if !models::can_run() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    models::write(&path.join("models"));
    let opened = Models::open(&path.join("models")).unwrap();
    let pythons = cif::pythons();
    let mut prompter = Prompter::new(&opened, &pythons, Thresholds::default());
    for (picture, truth) in pictures(&path.join("table"), 4) {
        for (prompt, id, word) in [("Red ball", ROLLING, "red"), ("the blue ball.", STANDING, "blue")] {
            let shown = truth.map(|pixel| *pixel == id);
            let (mask, boxes) = prompter.mask(&picture, prompt).unwrap();
            assert_eq!(boxes.len(), 1, "{boxes:?}");
            assert_eq!(boxes[0].words, word);
            assert!((boxes[0].score - 0.982).abs() < 1e-3);
            let inside: Vec<(usize, usize)> = (0..shown.pixels.len())
                .filter(|at| shown.pixels[*at])
                .map(|at| (at % shown.width as usize, at / shown.width as usize))
                .collect();
            let (xs, ys): (Vec<_>, Vec<_>) = inside.into_iter().unzip();
            let bound = |values: &[usize]| (*values.iter().min().unwrap(), values.iter().max().unwrap() + 1);
            let ((left, right), (top, bottom)) = (bound(&xs), bound(&ys));
            for (found, true_side) in boxes[0].corners.iter().zip([left, top, right, bottom]) {
                assert!((f64::from(*found) - true_side as f64).abs() < 1.5, "{boxes:?} for {left} {top}");
            }
            assert!(overlap(&mask, &shown) > 0.75, "{prompt}: {}", overlap(&mask, &shown));
            // Of the two masks that come out for the box, the other one is all of it.
            let [left, top, right, bottom] = boxes[0].corners;
            let filled = mask.pixels.iter().filter(|inside| **inside).count() as f32;
            let share = filled / ((right - left) * (bottom - top));
            assert!(share < 0.93, "{prompt}: {share} of the box");
            assert_eq!(prompter.mask(&picture, prompt).unwrap().0, mask);
        }
        // Boxes count by their best word, and no word of them is sure.
        let (both, boxes) = prompter.mask(&picture, "thing").unwrap();
        assert!(boxes.len() == 2 && boxes.iter().all(|found| found.words.is_empty()), "{boxes:?}");
        assert!(overlap(&both, &truth.map(|pixel| *pixel != 0)) > 0.75);
        let (none, boxes) = prompter.mask(&picture, "teapot").unwrap();
        assert!(boxes.is_empty() && !none.pixels.contains(&true));
    }
}

/// A decoder that makes masks of the size of the picture: all of it.
fn decoder_of_pictures() -> Model {
    Model::default()
        .input("image_embeddings", Element::Float, &[1, 3, 64, 64])
        .input("boxes", Element::Float, &[1, 1, 4])
        .input("orig_im_size", Element::Float, &[2])
        .output("masks", Element::Float, &[1, 1, -1, -1])
        .integers("start", &[2], &[1, 1])
        .node_with("Cast", &["orig_im_size"], "size", &[("to", Attribute::Int(7))])
        .node_with("Concat", &["start", "size"], "shape", &[("axis", Attribute::Int(0))])
        .node("ReduceMean", &["image_embeddings"], "mean")
        .node_with("ReduceMean", &["boxes"], "place", &[("keepdims", Attribute::Int(0))])
        .node("Mul", &["mean", "mean"], "square")
        .floats("one", &[1], &[1.0])
        .node("Add", &["square", "place"], "sum")
        .node("Add", &["sum", "one"], "positive")
        .node("Expand", &["positive", "shape"], "masks")
}

#[test]
fn decoders_that_know_the_size_of_the_picture_are_taken_at_their_word() {
    if !models::can_run() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    models::write(path);
    fs::write(path.join("decoder.onnx"), decoder_of_pictures().file()).unwrap();
    let inputs = r#"inputs = { embeddings = "image_embeddings", detail = "colors", points = "point_coords", labels = "point_labels" }
outputs = { masks = "masks", scores = "iou_predictions" }"#;
    let manifest = models::MANIFEST.replace(
        inputs,
        r#"inputs = { embeddings = "image_embeddings", boxes = "boxes", size = "orig_im_size" }
outputs = { masks = "masks" }"#,
    );
    assert_ne!(manifest, models::MANIFEST);
    fs::write(path.join("models.toml"), manifest).unwrap();
    let (picture, _) = pictures(&path.join("table"), 1).remove(0);
    let (mask, _) = ask(path, &picture, "red").unwrap();
    assert!(mask.pixels.iter().all(|inside| *inside), "the decoder says that all is inside");
}

#[test]
fn tensors_that_are_missing_or_do_not_fit_are_named() {
    if !models::can_run() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let picture = Picture::filled(16, 12, [9, 9, 9]);
    let refused_with = |words: &[&str]| {
        let problem = ask(path, &picture, "red ball").unwrap_err();
        assert!(words.iter().all(|word| problem.contains(word)), "{words:?} in: {problem}");
    };
    for (old, new, words) in [
        (
            r#"image = "pixel_values", mask"#,
            r#"image = "pixels", mask"#,
            vec!["boxes.onnx", "no input `pixels`"],
        ),
        (r#"mask = "pixel_mask", "#, "", vec!["boxes.onnx", "input `pixel_mask`"]),
        (r#"mask = "pixel_mask", "#, r#"valid = "pixel_mask", "#, vec!["`valid`", "it knows image, mask"]),
        (r#"logits = "logits", "#, "", vec!["which output of", "`logits`"]),
        (r#"logits = "logits""#, r#"logits = "scores""#, vec!["no output `scores`"]),
        (r#"masks = "masks""#, r#"masks = "mask""#, vec!["decoder.onnx", "no output `mask`"]),
        (r#", detail = "colors" }"#, " }", vec!["decoder.onnx", "`detail`"]),
        (
            r#"points = "point_coords", "#,
            r#"points = "image_embeddings", "#,
            vec!["decoder.onnx", "point_coords"],
        ),
        (
            r#"boxes = "pred_boxes""#,
            r#"boxes = "logits""#,
            vec!["output `logits`", "came out", "[1, boxes, 4]"],
        ),
        ("tokenizer = \"words.json\"", "", vec!["no tokenizer", "boxes.onnx"]),
        ("tokenizer = \"words.json\"", "tokenizer = \"boxes.onnx\"", vec!["boxes.onnx is no tokenizer"]),
        ("\"encoder.onnx\"", "\"words.json\"", vec!["words.json cannot be loaded"]),
        ("\"encoder.onnx\"", "\"nowhere.onnx\"", vec!["models.toml", "nowhere.onnx"]),
    ] {
        models::write(path);
        let manifest = models::MANIFEST.replacen(old, new, 1);
        assert_ne!(manifest, models::MANIFEST, "{old}");
        fs::write(path.join("models.toml"), manifest).unwrap();
        refused_with(&words);
    }

    // Types and shapes of the models themselves.
    let scores = |element, shape: &[i64]| {
        let known = [
            ("pixel_values", element, shape),
            ("pixel_mask", Element::Int64, &[1, -1, -1]),
            ("input_ids", Element::Int64, &[1, -1]),
            ("attention_mask", Element::Int64, &[1, -1]),
        ];
        let model =
            Model::default().floats("logits", &[1, 1, 1], &[0.0]).floats("pred_boxes", &[1, 1, 4], &[0.5; 4]);
        let model =
            known.iter().fold(model, |model, (name, element, shape)| model.input(name, *element, shape));
        model
            .node("Identity", &["logits"], "l")
            .node("Identity", &["pred_boxes"], "b")
            .output("l", Element::Float, &[1, 1, 1])
            .output("b", Element::Float, &[1, 1, 4])
            .file()
    };
    models::write(path);
    let manifest = models::MANIFEST
        .replace(r#"logits = "logits", boxes = "pred_boxes""#, r#"logits = "l", boxes = "b""#);
    fs::write(path.join("models.toml"), manifest).unwrap();
    fs::write(path.join("boxes.onnx"), scores(Element::Double, &[1, 3, -1, -1])).unwrap();
    refused_with(&["`pixel_values`", "of type f64"]);
    fs::write(path.join("boxes.onnx"), scores(Element::Float, &[-1, 3])).unwrap();
    refused_with(&["`pixel_values`", "[?, 3]", "4 axes"]);
    fs::write(path.join("boxes.onnx"), scores(Element::Float, &[1, 3, 100, 200])).unwrap();
    refused_with(&["`pixel_values`", "[1, 3, 100, 200]", "[1, 3, 800, 1066]"]);
    fs::write(path.join("boxes.onnx"), scores(Element::Float, &[1, 3, -1, -1])).unwrap();
    assert_eq!(ask(path, &picture, "red").unwrap().1.len(), 1);
}

/// Settings of a run of a few seconds.
const SHORT: &str = "--iterations-coarse 150 --iterations-fine 350 --iterations-instance 100 \
                     --set model.spatial_resolution=[16,16,16] --set densify.until=300 --max-gaussians 2000 \
                     --set motion.stillness=0";

#[test]
fn a_scene_is_asked_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("table"), 16);
    let line = format!("train table -o scene.cif --seed 1 {SHORT}");
    run(CIF, path, line.split_whitespace()).succeeds();
    models::write(&path.join("models"));
    let question = ["query", "scene.cif", "--capture", "table", "--models", "models", "--json"];
    let ask = |more: &[&str]| cif(path, &[&question[..], more].concat());
    // Words of labels need no models, and those of a taxonomy are words too.
    for (text, label, others) in
        [("a Red thing", "red ball", 0), ("red ball", "red ball", 1), ("q18545", "red ball", 0)]
    {
        let run = cif(path, &["query", "scene.cif", "--text", text, "--json"]);
        assert!(run.stderr.contains("labels, classes and taxonomies"), "{}", run.stderr);
        let found = json(&run.succeeds().stdout);
        assert_eq!((&found[0]["label"], &found[0]["chosen"]), (&label.into(), &true.into()), "{found:#}");
        assert_eq!(found.as_array().unwrap().len(), 1 + others, "{found:#}");
        assert!(found.as_array().unwrap().iter().skip(1).all(|one| one["chosen"] == false));
    }
    cif(path, &["query", "scene.cif", "--text", "kettle"]).fails(1, &["'kettle'", "blue ball", "red ball"]);
    if !models::can_run() {
        let without = ask(&["--prompt", "blue ball"]);
        assert!(without.code == Some(1) && without.stderr.contains("ONNX Runtime"), "{}", without.stderr);
        return;
    }

    // Where the masks of training frames lie.
    let blue = json(&ask(&["--prompt", "blue ball", "--eval"]).succeeds().stdout);
    assert_eq!(
        (&blue["instances"][0]["label"], &blue["instances"][0]["chosen"]),
        (&"blue ball".into(), &true.into())
    );
    assert!(
        blue["instances"].as_array().unwrap().iter().skip(1).all(|one| one["chosen"] == false),
        "{blue:#}"
    );
    assert_eq!((&blue["protocol"], &blue["frames"]), (&"reproject".into(), &12.into()));
    assert!(blue["eval"]["miou"].as_f64().unwrap() > 50.0, "{blue:#}");
    assert_eq!(blue["boxes"].as_object().unwrap().len(), 16);
    assert_eq!(blue["boxes"]["000003"][0]["words"], "blue");

    // Masks are kept next to the capture, which is read as before; broken ones are made anew.
    let kept = || -> Vec<_> {
        let prompt = fs::read_dir(path.join("table/.cif-cache")).unwrap().map(|entry| entry.unwrap().path());
        let mut files: Vec<_> =
            prompt.flat_map(|folder| fs::read_dir(folder).unwrap()).map(|f| f.unwrap().path()).collect();
        files.sort();
        files
    };
    let files = kept();
    assert_eq!(files.len(), 16);
    cif(path, &["info", "table"]).succeeds();
    let first = fs::read(&files[0]).unwrap();
    fs::write(&files[0], &first[..first.len() / 2]).unwrap();
    // Models that are not needed are not opened: what is kept answers, but for the broken one.
    assert_eq!(json(&ask(&["--prompt", "blue ball", "--eval"]).succeeds().stdout), blue);
    assert_eq!(fs::read(&files[0]).unwrap(), first);
    assert_eq!(kept(), files);
    let without = run(
        "env",
        path,
        [
            "ORT_DYLIB_PATH=/no/library.so",
            CIF,
            "query",
            "scene.cif",
            "--capture",
            "table",
            "--models",
            "models",
            "--json",
            "--prompt",
            "blue ball",
            "--eval",
        ],
    );
    assert_eq!(json(&without.succeeds().stdout), blue);
    // Other models, other masks.
    let folders = |place: &str| fs::read_dir(path.join(place)).unwrap().count();
    assert_eq!(folders("table/.cif-cache"), 1);
    let model = fs::read(path.join("models/boxes.onnx")).unwrap();
    fs::write(path.join("models/boxes.onnx"), [model.as_slice(), &[0x9a, 0x06, 0]].concat()).unwrap();
    ask(&["--prompt", "blue ball", "--protocol", "grouping"]).succeeds();
    assert_eq!((kept().len(), folders("table/.cif-cache")), (17, 2));
    let nothing = ["--prompt", "teapot", "--protocol", "grouping", "--cache", "elsewhere"];
    let stdout = cif(path, &[&question[..6], &nothing].concat()).succeeds().stdout;
    assert!(stdout.contains("in 0 of 1 pictures") && stdout.contains("no instance"), "{stdout}");
    assert_eq!((kept().len(), folders("elsewhere")), (17, 1));
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;

        // Anybody may have put masks there.
        fs::set_permissions(path.join("elsewhere"), fs::Permissions::from_mode(0o777)).unwrap();
        fs::remove_dir_all(fs::read_dir(path.join("elsewhere")).unwrap().next().unwrap().unwrap().path())
            .unwrap();
        let run = cif(path, &[&question[..6], &nothing].concat()).succeeds();
        assert!(run.stderr.contains("elsewhere: other users may write into it"), "{}", run.stderr);
        assert_eq!(folders("elsewhere"), 0);
    }

    // Where the mask of the first view lies as it is rendered.
    let red = json(
        &ask(&["--prompt", "red ball", "--protocol", "grouping", "--eval", "-o", "answer"]).succeeds().stdout,
    );
    assert_eq!(
        (&red["instances"][0]["label"], &red["instances"][0]["chosen"]),
        (&"red ball".into(), &true.into())
    );
    assert_eq!((&red["protocol"], &red["frames"]), (&"grouping".into(), &1.into()));
    assert_eq!(red["boxes"].as_object().unwrap().keys().collect::<Vec<_>>(), ["000002"]);
    assert!(red["eval"]["miou"].as_f64().unwrap() > 40.0, "{red:#}");
    assert!(path.join("answer/000002.png").exists());

    // By meaning, of which an exported file knows too.
    let text = |file: &str, text: &str, more: &[&str]| {
        cif(path, &[&["query", file, "--text", text, "--json"], more].concat())
    };
    let with = ["--models", "models"];
    let labels = |run: Run, chosen: bool| -> Vec<String> {
        let found = json(&run.succeeds().stdout);
        let rows = found.as_array().unwrap().iter().filter(|one| !chosen || one["chosen"] == true);
        rows.map(|one| one["label"].as_str().unwrap().to_owned()).collect()
    };
    let without = text("scene.cif", "something to drink from", &with);
    assert!(
        without.stderr.contains("no embeddings") && without.stderr.contains("cif embed"),
        "{}",
        without.stderr
    );
    without.fails(1, &["no object", "blue ball"]);
    let embed = ["embed", "scene.cif", "--capture", "table", "--models", "models", "-o", "seen.cif"];
    let stdout = cif(path, &embed).succeeds().stdout;
    assert!(stdout.contains("red ball") && stdout.contains("embeddings by colours"), "{stdout}");
    cif(path, &embed).fails(1, &["seen.cif exists"]);
    cif(path, &["export", "seen.cif", "--gltf", "seen.glb"]).succeeds();
    cif(path, &["import", "seen.glb", "-o", "back.cif"]).succeeds();
    let about = json(&cif(path, &["info", "seen.cif", "--json"]).succeeds().stdout);
    assert_eq!(about["embeddings"], serde_json::json!({ "model": "colours", "instances": 2 }));
    for file in ["seen.cif", "seen.glb", "back.cif"] {
        assert_eq!(labels(text(file, "something to drink from", &with), true), ["blue ball"], "{file}");
        assert_eq!(labels(text(file, "red", &with), false), ["red ball", "blue ball"], "{file}");
        assert!(labels(text(file, "texture", &with), true).is_empty(), "{file}");
    }
    let renamed = models::MANIFEST.replace("\"colours\"", "\"shapes\"");
    fs::write(path.join("models/models.toml"), renamed).unwrap();
    text("seen.glb", "red", &with).fails(1, &["embeddings of colours", "shapes", "cif embed"]);
    let without_embedder = models::MANIFEST.split("[embedder]").next().unwrap();
    fs::write(path.join("models/models.toml"), without_embedder).unwrap();
    text("seen.glb", "red", &with).fails(1, &["no [embedder]"]);
    // Without models, by words.
    let by_words = text("seen.glb", "the RED one", &[]);
    assert!(
        by_words.stderr.contains("word by word") && by_words.stderr.contains("--models"),
        "{}",
        by_words.stderr
    );
    assert_eq!(labels(by_words, true), ["red ball"]);

    // Arguments that do not go together.
    let refused = |more: &[&str], word: &str| ask(more).fails(2, &[word]);
    refused(&["--masks", "m", "--protocol", "grouping"], "rendered view");
    refused(&["--prompt", "x", "--protocol", "grouping", "--select", "both"], "--select");
    refused(&["--prompt", "x", "--detector", "true"], "--models");
    refused(&["--prompt", " "], "names nothing");
    cif(path, &["query", "scene.cif", "--models", "models"]).fails(2, &["--prompt", "--text"]);
    cif(path, &["query", "scene.cif", "--text", "?"]).fails(2, &["no words"]);
    cif(path, &["query", "scene.cif", "--text", "red", "--label", "x"]).fails(2, &["--label"]);

    // What ends the process that runs it is one error: here a panic of the library of tokenizers, which cannot cut texts
    // to pieces that overlap by more than their length.
    models::write(&path.join("models"));
    let words = path.join("models/words.json");
    let mut tokenizer: serde_json::Value = serde_json::from_slice(&fs::read(&words).unwrap()).unwrap();
    tokenizer["truncation"] =
        serde_json::json!({ "direction": "Right", "max_length": 3, "strategy": "LongestFirst", "stride": 5 });
    fs::write(&words, tokenizer.to_string()).unwrap();
    let prompt = ["query", "scene.cif", "--capture", "table", "--prompt", "blue ball", "--cache", "new"];
    let text = ["query", "seen.cif", "--text", "blue ball"];
    for asked in [&prompt[..], &text] {
        let output = cif(path, &[asked, &["--models", "models"]].concat());
        assert!(!output.stderr.contains("panicked"), "{}", output.stderr);
        output.fails(1, &["words.json", "ended the process that ran it", "101"]);
    }
    // A file that is no library does not hold the command up.
    let library = format!("ORT_DYLIB_PATH={}", words.display());
    let ask = [&library, CIF, "query", "seen.cif", "--models", "models", "--text", "blue ball"];
    run("env", path, ask).fails(1, &["ORT_DYLIB_PATH", "words.json", "no library"]);
}

/// Builds a library that ends the process; `None`, with a word, where there is no C compiler.
#[cfg(unix)]
fn ending_runtime(library: &Path, more: &[&str]) -> Option<()> {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/src/ending_runtime.c");
    let mut compiler = std::process::Command::new("cc");
    compiler.args(["-shared", "-fPIC", source, "-o"]).arg(library).args(more);
    let Ok(status) = compiler.status() else {
        eprintln!("skipped: no C compiler");
        return None;
    };
    assert!(status.success());
    Some(())
}

#[cfg(unix)]
#[test]
fn a_model_that_ends_the_runtime_is_one_error_that_names_it() {
    if !cif_vision::runtime::IS_BUILT {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    models::write(&path.join("models"));
    let ask = |library: &str| {
        let library = format!("ORT_DYLIB_PATH={}", path.join(library).display());
        let embed = ["embed", "scene.cif", "--capture", "table", "--models", "models"];
        run("env", path, [&[library.as_str(), CIF][..], &embed].concat())
    };
    if ending_runtime(&path.join("model.so"), &[]).is_none() {
        return;
    }
    let output = ask("model.so");
    assert_eq!(output.stderr.matches("Error").count(), 1, "{}", output.stderr);
    output.fails(1, &["models/picture.onnx cannot be loaded", "ended the process that ran it", "SIGABRT"]);
    // One that ends with the library itself is not blamed on the model.
    ending_runtime(&path.join("library.so"), &["-DENDS_AT_ONCE"]);
    let output = ask("library.so");
    assert!(!output.stderr.contains("picture.onnx"), "{}", output.stderr);
    output.fails(1, &["library.so is no library of ONNX Runtime that fits", "ended the process", "SIGABRT"]);
}

#[test]
fn folders_without_models_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let ask = || cif(path, &["query", "a.cif", "--prompt", "x", "--capture", "c", "--models", "models"]);
    ask().fails(1, &["models", "no models.toml"]);
    models::write(&path.join("models"));
    fs::remove_file(path.join("models/decoder.onnx")).unwrap();
    ask().fails(1, &["models.toml", "decoder.onnx", "nothing is downloaded"]);
}

#[test]
fn scenes_of_a_comparison_are_asked_by_both_protocols() {
    if !models::can_run() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    capture::write(&path.join("table"), 8);
    models::write(&path.join("models"));
    let questions = serde_json::json!({ "capture": [{ "name": "table", "question": [
        { "text": "red", "answer": ["red ball"] }, { "text": "blue", "answer": [STANDING] },
    ] }] });
    fs::write(path.join("q.json"), questions.to_string()).unwrap();
    let settings = "--set stages.coarse=100 --set stages.fine=200 --set model.spatial_resolution=[16,16,16] --set motion.rigid=false \
                    --set densify.until=150 --set densify.max_gaussians=1500";
    let line = format!(
        "bench compare table -o out --heads cif --seeds 1 --iterations 60 --queries q.json --models models {settings}"
    );
    let output = run(CIF, path, line.split_whitespace()).succeeds();
    assert!(
        output.stdout.contains("Grounding DINO") && !output.stdout.contains("No models"),
        "{}",
        output.stdout
    );
    assert!(path.join("table/.cif-cache").is_dir(), "masks are kept for the next question");
    let answers = json(&fs::read_to_string(path.join("out/queries.json")).unwrap());
    let answers = answers.as_array().unwrap();
    assert_eq!(answers.len(), 2 * 3);
    for answer in answers {
        let id = if answer["question"] == "red" { ROLLING } else { STANDING };
        let wrong = answer["chosen"] != serde_json::json!([id]);
        assert!(!wrong && answer["miou"].as_f64() > Some(30.0), "{answer:#}");
        let (head, by) = (answer["head"].as_str().unwrap(), answer["by"].as_str().unwrap());
        if by == "labels" || id == STANDING {
            continue;
        }
        // Their instances are those that `cif query` finds in the scene.
        let scene = format!("out/runs/table.seed0.{head}.cif");
        let prompt = answer["question"].as_str().unwrap();
        let question =
            ["query", &scene, "--capture", "table", "--models", "models", "--json", "--prompt", prompt];
        let found = cif(path, &[&question[..], &["--protocol", by]].concat()).succeeds().stdout;
        let found = json(&found);
        let chosen: Vec<_> =
            found["instances"].as_array().unwrap().iter().filter(|one| one["chosen"] == true).collect();
        assert_eq!(chosen.iter().map(|one| one["id"].clone()).collect::<Vec<_>>(), [serde_json::json!(id)]);
    }
    let page = fs::read_to_string(path.join("out/compare.html")).unwrap();
    assert!(page.contains("<td>grouping</td>") && page.contains("<td>reproject</td>"));
    let stderr = run(CIF, path, line.split_whitespace()).succeeds().stderr;
    assert_eq!(stderr.matches("questions: kept, ").count(), 1, "{stderr}");
}
