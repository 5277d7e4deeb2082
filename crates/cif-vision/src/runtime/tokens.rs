//! Texts as numbers, by a `tokenizer.json` of Hugging Face's `tokenizers`.

use std::path::{Path, PathBuf};

use super::Tokens;
use crate::Error;

/// A tokenizer.
#[derive(Debug)]
pub(crate) struct Tokenizer {
    path: PathBuf,
    tokenizer: tokenizers::Tokenizer,
}

impl Tokenizer {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, or is no tokenizer.
    pub(crate) fn open(path: &Path) -> Result<Self, Error> {
        let bytes = cif_input::read(path).map_err(Error::io("read", path))?;
        let tokenizer = tokenizers::Tokenizer::from_bytes(bytes).map_err(|error| {
            Error::refused(
                format!("{} is no tokenizer: {error}", path.display()),
                "give the tokenizer.json of the model, in the form of Hugging Face's tokenizers",
            )
        })?;
        Ok(Self { path: path.to_owned(), tokenizer })
    }

    /// The tokens of a text, with those that a model expects around it; padded to `length`, where that is fixed.
    ///
    /// # Errors
    /// When the text cannot be tokenised, or has more tokens than `length`.
    pub(crate) fn encode(&self, text: &str, length: Option<usize>) -> Result<Tokens, Error> {
        let encoded = self.tokenizer.encode(text, true).map_err(|error| {
            Error::refused(
                format!("{} does not know how to read {text:?}: {error}", self.path.display()),
                "use other words, or the tokenizer that belongs to the model",
            )
        })?;
        // Padding of the file itself goes; what a model needs is added below.
        let kept: Vec<usize> =
            (0..encoded.len()).filter(|at| encoded.get_attention_mask()[*at] != 0).collect();
        let own = encoded.get_special_tokens_mask();
        let mut tokens = Tokens {
            ids: kept.iter().map(|at| i64::from(encoded.get_ids()[*at])).collect(),
            types: kept.iter().map(|at| i64::from(encoded.get_type_ids()[*at])).collect(),
            attention: vec![1; kept.len()],
            spans: kept.iter().map(|at| (own[*at] == 0).then(|| encoded.get_offsets()[*at])).collect(),
        };
        match length {
            Some(length) if tokens.ids.len() > length => Err(Error::refused(
                format!("{text:?} has {} tokens, and the model takes {length}", tokens.ids.len()),
                "use fewer words",
            )),
            Some(length) => {
                let padding = self.tokenizer.get_padding();
                tokens.ids.resize(length, padding.map_or(0, |padding| i64::from(padding.pad_id)));
                tokens.types.resize(length, 0);
                tokens.attention.resize(length, 0);
                tokens.spans.resize(length, None);
                Ok(tokens)
            }
            None => Ok(tokens),
        }
    }
}
