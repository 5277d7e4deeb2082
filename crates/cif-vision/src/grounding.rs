//! Boxes of a prompt: Grounding DINO.
//!
//! Source: `groundingdino.util.inference` of its authors. The picture's short side becomes 800 pixels, its long side at
//! most 1 333; the prompt is in lower case and ends with a dot; a box counts when the greatest of its scores over all
//! tokens exceeds a threshold. Words whose own score exceeds another threshold name what the box holds; they do not
//! decide whether it counts.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::models::Models;
use crate::picture::{self, Filter, IMAGENET};
use crate::runtime::{Part, Session, Tokenizer, Tokens};
use crate::{Error, Picture, Tensor};

/// Side lengths of pictures, pixels.
const SHORT_SIDE: u32 = 800;
const LONG_SIDE: u32 = 1333;

const INPUTS: [Part<'static>; 7] = [
    Part::needed("image", &[4]),
    Part::known("mask", &[3]),
    Part::needed("tokens", &[2]),
    Part::known("types", &[2]),
    Part::known("attention", &[2]),
    Part::known("positions", &[2]),
    Part::known("phrases", &[3]),
];
const OUTPUTS: [Part<'static>; 2] = [Part::needed("logits", &[3]), Part::needed("boxes", &[3])];

/// Scores from which on something counts, in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thresholds {
    /// Of a box.
    pub boxes: f32,
    /// Of a word for a box.
    pub text: f32,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self { boxes: 0.3, text: 0.45 }
    }
}

/// A box in a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FoundBox {
    /// Left, top, right, bottom in pixels of the picture.
    pub corners: [f32; 4],
    /// Greatest score over all tokens, in [0, 1].
    pub score: f32,
    /// The words of the prompt that it is for.
    pub words: String,
}

/// The detector of a folder of models.
#[derive(Debug)]
pub struct Detector {
    session: Session,
    tokenizer: Tokenizer,
}

impl Detector {
    /// Opens model and tokenizer.
    ///
    /// # Errors
    /// When the folder has no detector, or one whose tensors do not fit.
    pub fn open(library: &Path, models: &Models) -> Result<Self, Error> {
        let network = models.detector()?;
        let tokenizer = network.tokenizer()?;
        Ok(Self {
            session: Session::open(library, network, &INPUTS, &OUTPUTS)?,
            tokenizer: Tokenizer::open(tokenizer)?,
        })
    }

    /// Boxes of a prompt in a picture, best first.
    ///
    /// # Errors
    /// When the prompt cannot be tokenised or the model fails.
    pub fn boxes(
        &mut self,
        picture: &Picture,
        prompt: &str,
        thresholds: Thresholds,
    ) -> Result<Vec<FoundBox>, Error> {
        let text = caption(prompt);
        let length = self.session.input_shape("tokens").last().copied().flatten();
        let tokens = self.tokenizer.encode(&text, length)?;
        let size = picture::short_side((picture.width, picture.height), SHORT_SIDE, LONG_SIDE);
        let resized = picture::resize(picture, size, Filter::Bilinear);
        let image = picture::tensor(&resized, IMAGENET, size);
        let (positions, phrases) = phrases(&text, &tokens);
        let (width, height, count) = (size.0 as usize, size.1 as usize, tokens.ids.len());
        let row = |values: &[i64]| Tensor::integers([1, count], values.to_vec());
        let mut inputs = vec![("image", image), ("tokens", row(&tokens.ids))];
        let others = [
            ("mask", Tensor::integers([1, height, width], vec![1; height * width])),
            ("types", row(&tokens.types)),
            ("attention", row(&tokens.attention)),
            ("positions", row(&positions)),
            ("phrases", Tensor::integers([1, count, count], phrases)),
        ];
        inputs.extend(others.into_iter().filter(|(part, _)| self.session.has_input(part)));
        let outputs = self.session.run(inputs)?;
        let (logits, boxes) = (&outputs["logits"], &outputs["boxes"]);
        let (&[1, queries, columns], &[1, other, 4]) = (logits.shape(), boxes.shape()) else {
            return Err(self.misfit(logits, boxes));
        };
        match (logits.as_floats(), boxes.as_floats()) {
            (Some(logits), Some(boxes)) if queries == other && columns > 0 => Ok(found(
                logits.chunks(columns).zip(boxes.chunks(4)),
                &text,
                &tokens,
                (picture.width, picture.height),
                thresholds,
            )),
            _ => Err(self.misfit(logits, boxes)),
        }
    }

    fn misfit(&self, logits: &Tensor, boxes: &Tensor) -> Error {
        let expected = "[1, boxes, tokens], and `boxes` of [1, boxes, 4]";
        let problem =
            format!("{:?} and {:?} came out, where {expected} is expected", logits.shape(), boxes.shape());
        self.session.refuse("logits", &problem)
    }
}

/// A prompt as the model was trained with.
fn caption(prompt: &str) -> String {
    let prompt = prompt.trim().to_lowercase();
    if prompt.ends_with('.') { prompt } else { format!("{prompt}.") }
}

/// Position of every token in its phrase `[tokens]`, and which tokens belong to one phrase `[tokens, tokens]`: phrases
/// end with a dot or a question mark. Source: `generate_masks_with_special_tokens_and_transfer_map`.
fn phrases(text: &str, tokens: &Tokens) -> (Vec<i64>, Vec<i64>) {
    let count = tokens.ids.len();
    let ends = |at: usize| match tokens.spans[at] {
        Some((from, to)) => matches!(text.get(from..to), Some("." | "?")),
        // Padding is no end.
        None => tokens.attention[at] != 0,
    };
    let mut positions = vec![0; count];
    let mut together = vec![0; count * count];
    for at in 0..count {
        together[at * count + at] = 1;
    }
    let mut previous = 0;
    for at in (0..count).filter(|at| ends(*at)) {
        if at != 0 && at != count - 1 {
            for row in previous + 1..=at {
                positions[row] = (row - previous - 1) as i64;
                together[row * count + previous + 1..=row * count + at].fill(1);
            }
        }
        previous = at;
    }
    (positions, together)
}

/// Boxes that count, from logits and boxes (centre and size as shares of the picture) of every query.
fn found<'a>(
    queries: impl Iterator<Item = (&'a [f32], &'a [f32])>,
    text: &str,
    tokens: &Tokens,
    (width, height): (u32, u32),
    thresholds: Thresholds,
) -> Vec<FoundBox> {
    let (width, height) = (width as f32, height as f32);
    let mut boxes: Vec<FoundBox> = queries
        .filter_map(|(logits, corners)| {
            let scores: Vec<f32> = logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect();
            let score = scores.iter().copied().fold(0.0, f32::max);
            let &[x, y, w, h] = corners else { return None };
            let corners = [
                (x - w / 2.0).clamp(0.0, 1.0) * width,
                (y - h / 2.0).clamp(0.0, 1.0) * height,
                (x + w / 2.0).clamp(0.0, 1.0) * width,
                (y + h / 2.0).clamp(0.0, 1.0) * height,
            ];
            let counts = score > thresholds.boxes && corners.iter().all(|corner| corner.is_finite());
            counts.then(|| FoundBox { corners, score, words: words(&scores, text, tokens, thresholds.text) })
        })
        .collect();
    boxes.sort_by(|a, b| b.score.total_cmp(&a.score));
    boxes
}

/// The words whose score exceeds a threshold, as they stand in the text.
fn words(scores: &[f32], text: &str, tokens: &Tokens, threshold: f32) -> String {
    let mut words = String::new();
    let mut end = None;
    for (span, _) in tokens.spans.iter().zip(scores).filter(|(_, score)| **score > threshold) {
        let Some(&(from, to)) = span.as_ref() else { continue };
        let Some(word) = text.get(from..to).filter(|word| !matches!(*word, "." | "?")) else { continue };
        if end.is_some_and(|end| end != from) {
            words.push(' ');
        }
        words.push_str(word.trim());
        end = Some(to);
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[CLS] red mug . spoon . [SEP]`, and padding.
    const TEXT: &str = "red mug. spoon.";

    fn tokens(padding: usize) -> Tokens {
        let mut spans =
            vec![None, Some((0, 3)), Some((4, 7)), Some((7, 8)), Some((9, 14)), Some((14, 15)), None];
        let attention = [vec![1; spans.len()], vec![0; padding]].concat();
        spans.extend(vec![None; padding]);
        Tokens { ids: vec![0; spans.len()], types: vec![0; spans.len()], attention, spans }
    }

    #[test]
    fn prompts_end_with_a_dot() {
        assert_eq!(caption("  Steel Jug "), "steel jug.");
        assert_eq!(caption("mug. spoon."), "mug. spoon.");
    }

    #[test]
    fn phrases_stay_among_themselves() {
        for padding in [0, 2] {
            let (positions, together) = phrases(TEXT, &tokens(padding));
            let count = 7 + padding;
            assert_eq!(positions[..6], [0, 0, 1, 2, 0, 1]);
            let row = |at: usize| &together[at * count..][..7];
            assert_eq!(row(0), [1, 0, 0, 0, 0, 0, 0]);
            for at in 1..=3 {
                assert_eq!(row(at), [0, 1, 1, 1, 0, 0, 0]);
            }
            assert_eq!(row(4), [0, 0, 0, 0, 1, 1, 0]);
            assert_eq!(row(6)[6], 1);
        }
    }

    #[test]
    fn boxes_count_by_their_best_token_and_words_by_their_own() {
        let logit = |score: f32| (score / (1.0 - score)).ln();
        let low = logit(0.01);
        let logits = [
            // Below the threshold of boxes.
            [low, logit(0.29), low, low, low, low, low, f32::NEG_INFINITY],
            // A box for two words, one of which is below the threshold of words.
            [low, logit(0.5), logit(0.44), low, low, low, low, f32::NEG_INFINITY],
            // Above that of boxes, but no word is named.
            [low, low, low, logit(0.4), low, low, low, f32::NEG_INFINITY],
            [low, logit(0.9), logit(0.8), logit(0.7), low, low, low, f32::NEG_INFINITY],
            [f32::NAN; 8],
        ];
        let boxes = [
            [0.5, 0.5, 0.5, 0.5],
            [0.5, 0.5, 0.5, 0.25],
            [0.0, 0.0, 0.2, 0.2],
            [0.75, 0.5, 1.0, 1.0],
            [0.5; 4],
        ];
        let queries = logits.iter().map(<[f32; 8]>::as_slice).zip(boxes.iter().map(<[f32; 4]>::as_slice));
        let found = found(queries, TEXT, &tokens(0), (200, 100), Thresholds::default());
        let named: Vec<(&str, [f32; 4])> =
            found.iter().map(|one| (one.words.as_str(), one.corners)).collect();
        assert_eq!(
            named,
            [
                ("red mug", [50.0, 0.0, 200.0, 100.0]),
                ("red", [50.0, 37.5, 150.0, 62.5]),
                ("", [0.0, 0.0, 20.0, 10.0]),
            ]
        );
        assert!((found[0].score - 0.9).abs() < 1e-6);
    }
}
