//! The tensors that a model declares against those that `models.toml` names and we know.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::Part;
use crate::models::MANIFEST;
use crate::{Error, Tensor};

/// Type of the values of a tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Element {
    Float,
    Int64,
    Int32,
    Bool,
    /// One that is not passed.
    Other,
}

/// A tensor as a model declares it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Declared {
    pub(super) name: String,
    pub(super) element: Element,
    /// Its type as the runtime writes it.
    pub(super) type_name: String,
    /// Lengths of the axes; `None` where they vary.
    pub(super) shape: Vec<Option<usize>>,
}

impl Declared {
    /// The shape for people: `[1, 3, ?, ?]`.
    pub(super) fn shape_text(&self) -> String {
        let lengths = self.shape.iter().map(|length| length.map_or("?".to_owned(), |n| n.to_string()));
        format!("[{}]", lengths.collect::<Vec<_>>().join(", "))
    }

    /// True where a tensor may be given for it.
    pub(super) fn takes(&self, given: &Tensor) -> bool {
        let fits =
            |(declared, given): (&Option<usize>, &usize)| declared.is_none_or(|length| length == *given);
        self.shape.len() == given.shape().len() && self.shape.iter().zip(given.shape()).all(fits)
    }
}

/// Declared tensors by part.
pub(super) type Bound = BTreeMap<String, Declared>;

/// Inputs or outputs of a model.
#[derive(Clone, Copy, Debug)]
pub(super) struct Side<'a> {
    /// `input` or `output`.
    pub(super) word: &'static str,
    /// Those of the model.
    pub(super) declared: &'a [Declared],
    /// Names by part, from the manifest.
    pub(super) named: &'a BTreeMap<String, String>,
    /// The parts that we know.
    pub(super) parts: &'a [Part<'a>],
}

/// Finds the tensor of every part.
///
/// # Errors
/// When the manifest names a part that there is not, a tensor that the model has not, or one of another type or rank;
/// when it leaves a needed part out, or an input that the model cannot do without.
pub(super) fn bind(file: &Path, side: Side<'_>) -> Result<Bound, Error> {
    let Side { word, declared, named, parts } = side;
    let file = file.display();
    let has: Vec<String> =
        declared.iter().map(|one| format!("{} {} {}", one.name, one.type_name, one.shape_text())).collect();
    let has = if has.is_empty() { "none".to_owned() } else { has.join(", ") };
    let fix = format!("{word}s of {file}: {has}; correct {MANIFEST}, or export the model with them");
    let refuse = |problem: String| Err(Error::refused(problem, fix.clone()));
    if let Some(part) = parts.iter().find(|part| part.needed && !named.contains_key(part.name)) {
        return refuse(format!("{MANIFEST} does not say which {word} of {file} is `{}`", part.name));
    }
    let mut bound = Bound::new();
    for (part, name) in named {
        let Some(known) = parts.iter().find(|known| known.name == part) else {
            let known: Vec<&str> = parts.iter().map(|part| part.name).collect();
            return refuse(format!(
                "{MANIFEST} names the {word} `{part}` of {file}, which cif does not know; it knows {}",
                known.join(", ")
            ));
        };
        let Some(tensor) = declared.iter().find(|one| one.name == *name) else {
            return refuse(format!("{file} has no {word} `{name}`, which {MANIFEST} names for `{part}`"));
        };
        if tensor.element == Element::Other || (word == "output" && tensor.element != Element::Float) {
            let expected = if word == "output" { "f32" } else { "f32, i64, i32 or bool" };
            return refuse(format!(
                "the {word} `{name}` of {file} is of type {}, where {expected} is expected",
                tensor.type_name
            ));
        }
        if !known.ranks.is_empty() && !known.ranks.contains(&tensor.shape.len()) {
            let ranks: Vec<String> = known.ranks.iter().map(usize::to_string).collect();
            return refuse(format!(
                "the {word} `{name}` of {file} has the shape {}, where `{part}` has {} axes",
                tensor.shape_text(),
                ranks.join(" or ")
            ));
        }
        bound.insert(part.clone(), tensor.clone());
    }
    if word == "input" {
        let left_out = declared.iter().find(|one| !named.values().any(|name| *name == one.name));
        if let Some(tensor) = left_out {
            return refuse(format!("{MANIFEST} names no part for the input `{}` of {file}", tensor.name));
        }
    }
    Ok(bound)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn declared(name: &str, element: Element, shape: &[Option<usize>]) -> Declared {
        Declared { name: name.to_owned(), element, type_name: "x".to_owned(), shape: shape.to_vec() }
    }

    const PARTS: [Part<'static>; 2] = [Part::needed("image", &[4]), Part::known("mask", &[3])];

    fn bound(declared: &[Declared], named: &[(&str, &str)], word: &'static str) -> Result<Bound, String> {
        let named = named.iter().map(|(part, name)| ((*part).to_owned(), (*name).to_owned())).collect();
        let side = Side { word, declared, named: &named, parts: &PARTS };
        bind(Path::new("m.onnx"), side).map_err(|error| error.to_string())
    }

    #[test]
    fn tensors_that_do_not_fit_are_named() {
        let pixels = declared("pixels", Element::Float, &[None, Some(3), None, None]);
        let mask = declared("mask", Element::Int64, &[None; 3]);
        let both = [pixels.clone(), mask.clone()];
        let named = [("image", "pixels"), ("mask", "mask")];
        assert_eq!(bound(&both, &named, "input").unwrap()["image"], pixels);
        let refuses = |declared: &[Declared], named: &[(&str, &str)], word, words: &[&str]| {
            let problem = bound(declared, named, word).unwrap_err();
            assert!(words.iter().all(|word| problem.contains(word)), "{problem}");
        };
        refuses(&both, &named[..1], "input", &["no part for the input `mask`"]);
        refuses(&both, &named[1..], "input", &["which input", "`image`"]);
        refuses(&both, &[("image", "pixel"), named[1]], "input", &["no input `pixel`", "for `image`"]);
        refuses(&both, &[("image", "pixels"), ("masks", "mask")], "input", &["`masks`", "knows image, mask"]);
        refuses(
            &[declared("pixels", Element::Other, &[None; 4])],
            &named[..1],
            "input",
            &["`pixels`", "f32, i64"],
        );
        refuses(
            &[declared("pixels", Element::Int64, &[None; 4])],
            &named[..1],
            "output",
            &["`pixels`", "where f32"],
        );
        refuses(
            &[declared("pixels", Element::Float, &[None, Some(3)])],
            &named[..1],
            "input",
            &["[?, 3]", "4 axes"],
        );
        // Outputs that nobody asks for do not matter.
        assert!(bound(&both, &named[..1], "output").is_ok());
    }

    #[test]
    fn fixed_lengths_are_kept_to() {
        let pixels = declared("pixels", Element::Float, &[Some(1), Some(3), None, Some(2)]);
        assert!(pixels.takes(&Tensor::floats([1, 3, 7, 2], vec![0.0; 42])));
        assert!(!pixels.takes(&Tensor::floats([1, 3, 2, 7], vec![0.0; 42])));
        assert!(!pixels.takes(&Tensor::floats([3, 7, 2], vec![0.0; 42])));
        assert_eq!(pixels.shape_text(), "[1, 3, ?, 2]");
    }
}
