//! Pictures as models take them, against Pillow and numpy: `preprocessing.py` made `preprocessing.json`.
#![allow(clippy::unwrap_used)] // Helpers of tests.

use cif_vision::Picture;
use cif_vision::picture::{CLIP, Filter, IMAGENET, long_side, resize, short_side, tensor};
use serde_json::Value;

/// The picture of the reference.
fn picture(width: u32, height: u32) -> Picture {
    let pixel = |at: u32| {
        let (x, y) = (at % width, at / width);
        let green = if (x / 3 + y / 2).is_multiple_of(2) { 255 } else { 0 };
        [(x * 37 + y * 91 + x * y * 13) as u8, green, (x * x * 7 + y * 3) as u8]
    };
    Picture::from_pixels(width, height, (0..width * height).map(pixel).collect())
}

fn reference() -> Value {
    serde_json::from_str(include_str!("preprocessing.json")).unwrap()
}

fn size(value: &Value) -> (u32, u32) {
    serde_json::from_value(value.clone()).unwrap()
}

#[test]
fn pictures_are_resized_as_by_pillow_to_the_bit() {
    let reference = reference();
    let cases = reference["resized"].as_array().unwrap();
    assert_eq!(cases.len(), 10);
    for case in cases {
        let filter = if case["filter"] == "bicubic" { Filter::Bicubic } else { Filter::Bilinear };
        let (width, height) = size(&case["from"]);
        let resized = resize(&picture(width, height), size(&case["to"]), filter);
        let bytes: String = resized.pixels.as_flattened().iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(bytes, case["bytes"].as_str().unwrap(), "{} {}", case["filter"], case["to"]);
    }
}

#[test]
fn sizes_are_those_of_the_authors() {
    for case in reference()["sizes"].as_array().unwrap() {
        let of = size(&case["from"]);
        assert_eq!(short_side(of, 800, 1333), size(&case["short"]), "{of:?}");
        assert_eq!(long_side(of, 1024), size(&case["long"]), "{of:?}");
    }
}

#[test]
fn tensors_equal_the_reference() {
    let reference = reference();
    let small = picture(64, 48);
    let (short, long) = (short_side((64, 48), 800, 1333), long_side((64, 48), 1024));
    let embedded = resize(&picture(300, 300), (224, 224), Filter::Bicubic);
    for (name, made) in [
        ("grounding", tensor(&resize(&small, short, Filter::Bilinear), IMAGENET, short)),
        ("segment", tensor(&resize(&small, long, Filter::Bilinear), IMAGENET, (1024, 1024))),
        ("embedding", tensor(&embedded, CLIP, (224, 224))),
    ] {
        let expected = &reference["tensors"][name];
        let values = made.as_floats().unwrap();
        assert_eq!(values.len() as u64, expected["length"].as_u64().unwrap(), "{name}");
        let every = expected["every"].as_u64().unwrap() as usize;
        let samples = expected["values"].as_array().unwrap();
        assert_eq!(samples.len(), values.len().div_ceil(every));
        for (value, sample) in values.iter().step_by(every).zip(samples) {
            assert!(
                (f64::from(*value) - sample.as_f64().unwrap()).abs() < 1e-4,
                "{name}: {value} for {sample}"
            );
        }
    }
}
