//! Pictures and texts in one space: CLIP and alike.
//!
//! Source: "Learning Transferable Visual Models From Natural Language Supervision" (2021): embeddings are compared by
//! the cosine of their angle.

use std::path::Path;

use crate::models::Models;
use crate::picture::{self, CLIP, Filter};
use crate::runtime::{Part, Session, Tokenizer};
use crate::{Error, Picture, Tensor};

/// Makes embeddings of pictures.
#[derive(Debug)]
pub struct PictureEmbedder {
    size: u32,
    session: Session,
}

/// Makes embeddings of texts.
#[derive(Debug)]
pub struct TextEmbedder {
    session: Session,
    tokenizer: Tokenizer,
}

const EMBEDDING: [Part<'static>; 1] = [Part::needed("embedding", &[2])];

impl PictureEmbedder {
    /// Opens the model of pictures.
    ///
    /// # Errors
    /// When the folder has none, or one whose tensors do not fit.
    pub fn open(library: &Path, models: &Models) -> Result<Self, Error> {
        let (_, size, network, _) = models.embedder()?;
        Ok(Self {
            size,
            session: Session::open(library, network, &[Part::needed("image", &[4])], &EMBEDDING)?,
        })
    }

    /// The embedding of a picture, of length 1; a picture that is not square is stretched.
    ///
    /// # Errors
    /// When the model fails, or gives no direction.
    pub fn embed(&mut self, picture: &Picture) -> Result<Vec<f32>, Error> {
        let size = (self.size, self.size);
        let image = picture::tensor(&picture::resize(picture, size, Filter::Bicubic), CLIP, size);
        embedding(&mut self.session, vec![("image", image)])
    }
}

impl TextEmbedder {
    /// Opens the model of texts and its tokenizer.
    ///
    /// # Errors
    /// When the folder has none, or one whose tensors do not fit.
    pub fn open(library: &Path, models: &Models) -> Result<Self, Error> {
        let (_, _, _, network) = models.embedder()?;
        let inputs = [Part::needed("tokens", &[2]), Part::known("attention", &[2])];
        Ok(Self {
            tokenizer: Tokenizer::open(network.tokenizer()?)?,
            session: Session::open(library, network, &inputs, &EMBEDDING)?,
        })
    }

    /// The embedding of a text, of length 1.
    ///
    /// # Errors
    /// When the text cannot be tokenised, the model fails, or gives no direction.
    pub fn embed(&mut self, text: &str) -> Result<Vec<f32>, Error> {
        let length = self.session.input_shape("tokens").last().copied().flatten();
        let tokens = self.tokenizer.encode(text, length)?;
        let row = |values: Vec<i64>| Tensor::integers([1, values.len()], values);
        let mut inputs = vec![("tokens", row(tokens.ids))];
        if self.session.has_input("attention") {
            inputs.push(("attention", row(tokens.attention)));
        }
        embedding(&mut self.session, inputs)
    }
}

/// Runs a model whose answer is one direction.
fn embedding(session: &mut Session, inputs: Vec<(&str, Tensor)>) -> Result<Vec<f32>, Error> {
    let outputs = session.run(inputs)?;
    let answer = &outputs["embedding"];
    direction(answer).ok_or_else(|| {
        let problem = format!("{:?} came out, where one direction, [1, length], is expected", answer.shape());
        session.refuse("embedding", &problem)
    })
}

/// The direction of an answer of one row.
fn direction(answer: &Tensor) -> Option<Vec<f32>> {
    answer.as_floats().filter(|_| answer.shape().first() == Some(&1)).and_then(unit)
}

/// A vector of length 1 in the same direction; `None` where there is no direction.
#[must_use]
pub fn unit(vector: &[f32]) -> Option<Vec<f32>> {
    let length = vector.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt();
    (length.is_finite() && length > 0.0)
        .then(|| vector.iter().map(|value| (f64::from(*value) / length) as f32).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_one_direction() {
        let answer = |shape: &[usize], values: &[f32]| direction(&Tensor::floats(shape, values.to_vec()));
        assert_eq!(answer(&[1, 2], &[3.0, 4.0]), Some(vec![0.6, 0.8]));
        // Not one row, or no direction.
        assert_eq!(answer(&[], &[1.0]), None);
        assert_eq!(answer(&[2, 1], &[1.0, 1.0]), None);
        assert_eq!(answer(&[1, 2], &[0.0, 0.0]), None);
    }
}
