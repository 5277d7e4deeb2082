//! A folder of models that know the colours of the test capture: a detector in the manner of Grounding DINO, a
//! segmenter in that of SAM, and an embedder in that of CLIP, of a few operators each.

use std::fs;
use std::path::Path;

use cif_system::environment::TEST_ONNX;
use serde_json::json;

use crate::onnx::{Attribute, Element, Model};

/// Words that the models know, by their numbers.
pub const WORDS: [&str; 11] =
    ["[UNK]", "[CLS]", "[SEP]", ".", "red", "blue", "ball", "thing", "drink", "object", "texture"];

/// Description of the files of the folder.
pub const MANIFEST: &str = r#"
[detector]
model = "boxes.onnx"
tokenizer = "words.json"
inputs = { image = "pixel_values", mask = "pixel_mask", tokens = "input_ids", attention = "attention_mask" }
outputs = { logits = "logits", boxes = "pred_boxes" }

[segmenter.encoder]
model = "encoder.onnx"
inputs = { image = "images" }
outputs = { embeddings = "image_embeddings", detail = "colors" }

[segmenter.decoder]
model = "decoder.onnx"
inputs = { embeddings = "image_embeddings", detail = "colors", points = "point_coords", labels = "point_labels" }
outputs = { masks = "masks", scores = "iou_predictions" }

[embedder]
name = "colours"
size = 32

[embedder.image]
model = "picture.onnx"
inputs = { image = "pixel_values" }
outputs = { embedding = "image_embeds" }

[embedder.text]
model = "text.onnx"
tokenizer = "words.json"
inputs = { tokens = "input_ids" }
outputs = { embedding = "text_embeds" }
"#;

/// Cells along a side of what the encoder makes, and pixels of each.
const CELLS: i64 = 64;
const CELL: i64 = 16;

/// True where models can be run. `CIF_TEST_ONNX` says what tests do: `off` skips, `auto` (the default) runs them where
/// this is built with the feature `onnx` and the library of ONNX Runtime is there, and `require` insists.
///
/// # Panics
/// Under `require` where they cannot be run, and for other values.
#[must_use]
pub fn can_run() -> bool {
    let wish = TEST_ONNX.text().unwrap_or_else(|| "auto".to_owned());
    assert!(
        ["off", "auto", "require"].contains(&wish.as_str()),
        "CIF_TEST_ONNX is {wish}; it may be off, auto or require"
    );
    let missing = if wish == "off" {
        Some("CIF_TEST_ONNX=off".to_owned())
    } else if cif_vision::runtime::IS_BUILT {
        cif_vision::library::find(&cif::pythons()).err().map(|error| error.to_string())
    } else {
        Some("built without the feature cif-vision/onnx".to_owned())
    };
    if let Some(missing) = &missing {
        assert!(wish != "require", "CIF_TEST_ONNX=require: {missing}");
        eprintln!("skipped: {missing}");
    }
    missing.is_none()
}

/// Writes the folder.
///
/// # Panics
/// When it cannot be written.
pub fn write(folder: &Path) {
    fs::create_dir_all(folder).expect("the folder can be made");
    let files = [
        ("models.toml", MANIFEST.as_bytes().to_vec()),
        ("words.json", tokenizer()),
        ("boxes.onnx", detector().file()),
        ("encoder.onnx", encoder().file()),
        ("decoder.onnx", decoder().file()),
        ("picture.onnx", picture().file()),
        ("text.onnx", text().file()),
    ];
    for (name, bytes) in files {
        fs::write(folder.join(name), bytes).expect("the file can be written");
    }
}

/// A tokenizer of whole words.
fn tokenizer() -> Vec<u8> {
    let special = |id: usize| {
        json!({
            "id": id, "content": WORDS[id], "single_word": false, "lstrip": false, "rstrip": false,
            "normalized": false, "special": true,
        })
    };
    let added = |id: usize| json!({ "id": WORDS[id], "ids": [id], "tokens": [WORDS[id]] });
    let vocabulary: serde_json::Map<_, _> =
        WORDS.iter().enumerate().map(|(id, word)| ((*word).to_owned(), json!(id))).collect();
    let around = |text: &str| {
        json!([
            { "SpecialToken": { "id": "[CLS]", "type_id": 0 } },
            { "Sequence": { "id": text, "type_id": 0 } },
            { "SpecialToken": { "id": "[SEP]", "type_id": 0 } },
        ])
    };
    let tokenizer = json!({
        "version": "1.0", "truncation": null, "padding": null, "normalizer": null, "decoder": null,
        "added_tokens": [special(0), special(1), special(2)],
        "pre_tokenizer": { "type": "BertPreTokenizer" },
        "post_processor": {
            "type": "TemplateProcessing", "single": around("A"), "pair": around("A"),
            "special_tokens": { "[CLS]": added(1), "[SEP]": added(2) },
        },
        "model": { "type": "WordLevel", "vocab": vocabulary, "unk_token": "[UNK]" },
    });
    tokenizer.to_string().into_bytes()
}

/// Rows of a table with a value for red and one for blue per word.
fn table(width: usize, default: &[f32], rows: &[(&str, &[f32])]) -> Vec<f32> {
    let row = |word: &&str| rows.iter().find(|(name, _)| name == word).map_or(default, |(_, row)| *row);
    WORDS.iter().flat_map(|word| row(word)[..width].to_vec()).collect()
}

/// From `image` the layers `colors`, above 0 where it is red, and where it is blue, in ImageNet's normalisation.
fn colours(model: Model, image: &str) -> Model {
    model
        .floats("weights", &[2, 3, 1, 1], &[1.0, 0.0, -1.0, -1.0, 0.0, 1.0])
        .floats("bias", &[2], &[-0.8, -1.2])
        .node("Conv", &[image, "weights", "bias"], "signed")
        .node("Relu", &["signed"], "colors")
}

/// Boxes around what is red and what is blue; a prompt with `red` or `blue` asks for one, `thing` for both without a
/// word that is sure.
fn detector() -> Model {
    let scores =
        [("red", [4.0, -6.0]), ("blue", [-6.0, 4.0]), ("ball", [-1.5, -1.5]), ("thing", [-0.5, -0.5])];
    let scores: Vec<(&str, &[f32])> = scores.iter().map(|(word, row)| (*word, row.as_slice())).collect();
    let mut model = Model::default()
        .input("pixel_values", Element::Float, &[1, 3, -1, -1])
        .input("pixel_mask", Element::Int64, &[1, -1, -1])
        .input("input_ids", Element::Int64, &[1, -1])
        .input("attention_mask", Element::Int64, &[1, -1])
        .output("logits", Element::Float, &[1, 2, -1])
        .output("pred_boxes", Element::Float, &[1, 2, 4])
        .floats("one", &[1], &[1.0])
        .floats("zero", &[1], &[0.0])
        .floats("half", &[1], &[0.5])
        .floats("much", &[1], &[20.0]);
    model = colours(model, "pixel_values")
        .node_with("Cast", &["pixel_mask"], "valid", &[("to", Attribute::Int(1))])
        .node_with("Unsqueeze", &["valid"], "valid_pixels", &[("axes", Attribute::Ints(&[1]))])
        .node("Mul", &["colors", "valid_pixels"], "shown");
    // First and last column and row of each colour.
    for (along, across, axis) in [("x", 2, 2), ("y", 3, 2)] {
        let name = |part: &str| format!("{along}_{part}");
        let last = [("axes", Attribute::Ints(&[2])), ("keepdims", Attribute::Int(1))];
        model = model
            .integers(&name("axis"), &[], &[axis])
            .node_with(
                "ReduceMax",
                &["shown"],
                &name("profile"),
                &[("axes", Attribute::Ints(&[across])), ("keepdims", Attribute::Int(0))],
            )
            .node("Greater", &[&name("profile"), "zero"], &name("is"))
            .node("Mul", &[&name("profile"), "zero"], &name("zeros"))
            .node("Add", &[&name("zeros"), "one"], &name("ones"))
            .node("CumSum", &[&name("ones"), &name("axis")], &name("count"))
            .node_with("ReduceMax", &[&name("count")], &name("length"), &last)
            .node("Sub", &[&name("count"), "half"], &name("centres"))
            .node("Div", &[&name("centres"), &name("length")], &name("place"))
            .node("Sub", &["one", &name("place")], &name("rest"))
            .node("Where", &[&name("is"), &name("place"), "zero"], &name("forwards"))
            .node("Where", &[&name("is"), &name("rest"), "zero"], &name("backwards"))
            .node_with("ReduceMax", &[&name("forwards")], &name("high"), &last)
            .node_with("ReduceMax", &[&name("backwards")], &name("low_rest"), &last)
            .node("Sub", &["one", &name("low_rest")], &name("low"))
            .node("Add", &[&name("low"), &name("high")], &name("twice"))
            .node("Mul", &[&name("twice"), "half"], &name("middle"))
            .node("Sub", &[&name("high"), &name("low")], &name("size"));
    }
    model
        .node_with(
            "Concat",
            &["x_middle", "y_middle", "x_size", "y_size"],
            "pred_boxes",
            &[("axis", Attribute::Int(2))],
        )
        // Scores by word; none for colours that are not there, and for padding.
        .floats("table", &[WORDS.len() as i64, 2], &table(2, &[-6.0, -6.0], &scores))
        .node("Gather", &["table", "input_ids"], "by_word")
        .node_with("Transpose", &["by_word"], "by_colour", &[("perm", Attribute::Ints(&[0, 2, 1]))])
        .node_with(
            "ReduceMax",
            &["x_profile"],
            "most",
            &[("axes", Attribute::Ints(&[2])), ("keepdims", Attribute::Int(1))],
        )
        .node("Greater", &["most", "zero"], "is_there")
        .node_with("Cast", &["is_there"], "there", &[("to", Attribute::Int(1))])
        .node("Sub", &["one", "there"], "absent")
        .node("Mul", &["absent", "much"], "malus")
        .node("Sub", &["by_colour", "malus"], "scored")
        .node_with("Cast", &["attention_mask"], "attended", &[("to", Attribute::Int(1))])
        .node("Sub", &["one", "attended"], "padding")
        .node("Mul", &["padding", "much"], "padding_malus")
        .node_with("Unsqueeze", &["padding_malus"], "padding_row", &[("axes", Attribute::Ints(&[1]))])
        .node("Sub", &["scored", "padding_row"], "logits")
}

/// Means over cells of the picture, and colours in them.
fn encoder() -> Model {
    let model = Model::default()
        .input("images", Element::Float, &[1, 3, 1024, 1024])
        .output("image_embeddings", Element::Float, &[1, 3, CELLS, CELLS])
        .output("colors", Element::Float, &[1, 2, CELLS, CELLS])
        .node_with(
            "AveragePool",
            &["images"],
            "image_embeddings",
            &[("kernel_shape", Attribute::Ints(&[CELL, CELL])), ("strides", Attribute::Ints(&[CELL, CELL]))],
        );
    colours(model, "image_embeddings")
}

/// Two masks of a box: all of it, which is no good, and what is coloured in it.
fn decoder() -> Model {
    let centre = |cell: i64| ((cell * CELL + CELL / 2) as f32).to_owned();
    let cells = || (0..CELLS * CELLS).map(|at| (at % CELLS, at / CELLS));
    let columns: Vec<f32> = cells().map(|(x, _)| centre(x)).collect();
    let rows: Vec<f32> = cells().map(|(_, y)| centre(y)).collect();
    let mut model = Model::default()
        .input("image_embeddings", Element::Float, &[1, 3, CELLS, CELLS])
        .input("colors", Element::Float, &[1, 2, CELLS, CELLS])
        .input("point_coords", Element::Float, &[1, -1, 2])
        .input("point_labels", Element::Float, &[1, -1])
        .output("masks", Element::Float, &[1, 2, CELLS, CELLS])
        .output("iou_predictions", Element::Float, &[1, 2])
        .floats("columns", &[1, 1, CELLS, CELLS], &columns)
        .floats("rows", &[1, 1, CELLS, CELLS], &rows)
        .floats("outside", &[1], &[-5.0])
        .floats("inside", &[1], &[5.0])
        .floats("zero", &[1], &[0.0])
        .floats("faint", &[1], &[0.05])
        .floats("corner_labels", &[1, 2], &[2.0, 3.0])
        .floats("ious", &[1, 2], &[0.3, 0.9])
        .integers("first", &[], &[0])
        .integers("second", &[], &[1]);
    for (corner, axis) in [("first", "first"), ("first", "second"), ("second", "first"), ("second", "second")]
    {
        let (point, number) = (format!("point_{corner}_{axis}"), format!("{corner}_{axis}"));
        model = model
            .node_with("Gather", &["point_coords", corner], &point, &[("axis", Attribute::Int(1))])
            .node_with("Gather", &[&point, axis], &number, &[("axis", Attribute::Int(1))]);
    }
    model
        .node("Greater", &["columns", "first_first"], "right_of")
        .node("Less", &["columns", "second_first"], "left_of")
        .node("Greater", &["rows", "first_second"], "below")
        .node("Less", &["rows", "second_second"], "above")
        .node("And", &["right_of", "left_of"], "across")
        .node("And", &["below", "above"], "along")
        .node("And", &["across", "along"], "in_box")
        .node("Where", &["in_box", "inside", "outside"], "whole")
        .node_with(
            "ReduceMax",
            &["colors"],
            "colour",
            &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(1))],
        )
        .node("Sub", &["colour", "faint"], "coloured")
        .node("Where", &["in_box", "coloured", "outside"], "part")
        // Nothing for points that are not the corners of a box.
        .node("Sub", &["point_labels", "corner_labels"], "other_labels")
        .node("Abs", &["other_labels"], "distance")
        .node_with("ReduceSum", &["distance"], "wrong", &[("keepdims", Attribute::Int(0))])
        .node("Mul", &["wrong", "outside"], "malus")
        .node_with("Concat", &["whole", "part"], "both", &[("axis", Attribute::Int(1))])
        .node("Add", &["both", "malus"], "marked")
        // The means themselves only have to arrive.
        .node_with("ReduceMean", &["image_embeddings"], "mean", &[("keepdims", Attribute::Int(0))])
        .node("Mul", &["mean", "zero"], "nothing")
        .node("Add", &["marked", "nothing"], "masks")
        .node("Add", &["ious", "nothing"], "iou_predictions")
}

/// Amounts of red and of blue in a picture, in CLIP's normalisation.
fn picture() -> Model {
    colours(
        Model::default()
            .input("pixel_values", Element::Float, &[1, 3, 32, 32])
            .output("image_embeds", Element::Float, &[1, 3])
            .floats("little", &[1, 1], &[0.01]),
        "pixel_values",
    )
    .node("GlobalAveragePool", &["colors"], "mean")
    .node("Flatten", &["mean"], "means")
    .node_with("Concat", &["means", "little"], "image_embeds", &[("axis", Attribute::Int(1))])
}

/// The same of a text: `red`, and `blue` or what one drinks from; all other words are neither.
fn text() -> Model {
    let rows: [(&str, &[f32]); 6] = [
        ("red", &[1.0, 0.0, 0.0]),
        ("blue", &[0.0, 1.0, 0.0]),
        ("drink", &[0.0, 1.0, 0.0]),
        ("[CLS]", &[0.0, 0.0, 0.1]),
        ("[SEP]", &[0.0, 0.0, 0.1]),
        (".", &[0.0, 0.0, 0.0]),
    ];
    Model::default()
        .input("input_ids", Element::Int64, &[1, -1])
        .output("text_embeds", Element::Float, &[1, 3])
        .floats("table", &[WORDS.len() as i64, 3], &table(3, &[0.1, 0.1, 0.1], &rows))
        .node("Gather", &["table", "input_ids"], "by_word")
        .node_with(
            "ReduceSum",
            &["by_word"],
            "text_embeds",
            &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(0))],
        )
}
