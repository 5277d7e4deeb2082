//! Texts as numbers, by a `tokenizer.json` of Hugging Face's `tokenizers`.

use std::path::{Path, PathBuf};

use super::Tokens;
use super::place::Place;
use crate::Error;

/// Most tokens that a model may ask for: those of texts are a few hundred at the most.
const MOST_TOKENS: usize = 4096;

/// A tokenizer.
#[derive(Debug)]
pub(crate) struct Tokenizer {
    path: PathBuf,
    place: Place,
}

impl Tokenizer {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, or is no tokenizer.
    pub(crate) fn open(path: &Path) -> Result<Self, Error> {
        let bytes = cif_input::read(path).map_err(Error::io("read", path))?;
        let mut place = Place::new()?;
        let text = String::from_utf8(bytes).map_err(|error| error.to_string());
        text.and_then(|text| place.open_tokenizer(text)).map_err(|problem| {
            Error::refused(
                format!("{} is no tokenizer: {problem}", path.display()),
                "give the tokenizer.json of the model, in the form of Hugging Face's tokenizers",
            )
        })?;
        Ok(Self { path: path.to_owned(), place })
    }

    /// The tokens of a text, with those that a model expects around it; padded to `length`, where that is fixed.
    ///
    /// # Errors
    /// When the text cannot be tokenised, or has more tokens than `length`, or that is no length of texts.
    pub(crate) fn encode(&mut self, text: &str, length: Option<usize>) -> Result<Tokens, Error> {
        if let Some(length) = length.filter(|length| *length > MOST_TOKENS) {
            return Err(Error::refused(
                format!("the model takes {length} tokens at once, more than {MOST_TOKENS}"),
                "export it for texts of any length, or for a few hundred tokens",
            ));
        }
        let reading = self.place.read(text).map_err(|problem| {
            Error::refused(
                format!("{} does not know how to read {text:?}: {problem}", self.path.display()),
                "use other words, or the tokenizer that belongs to the model",
            )
        })?;
        // Padding of the file itself goes; what a model needs is added below.
        let kept: Vec<usize> = (0..reading.ids.len())
            .filter(|at| reading.attention.get(*at).is_some_and(|one| *one != 0))
            .collect();
        let mut tokens = Tokens {
            ids: kept.iter().map(|at| i64::from(reading.ids[*at])).collect(),
            types: kept.iter().map(|at| i64::from(reading.types[*at])).collect(),
            attention: vec![1; kept.len()],
            spans: kept.iter().map(|at| (reading.special[*at] == 0).then(|| reading.offsets[*at])).collect(),
        };
        match length {
            Some(length) if tokens.ids.len() > length => Err(Error::refused(
                format!("{text:?} has {} tokens, and the model takes {length}", tokens.ids.len()),
                "use fewer words",
            )),
            Some(length) => {
                tokens.ids.resize(length, i64::from(reading.padding));
                tokens.types.resize(length, 0);
                tokens.attention.resize(length, 0);
                tokens.spans.resize(length, None);
                Ok(tokens)
            }
            None => Ok(tokens),
        }
    }
}
