//! Running models: ONNX Runtime and tokenizers behind the feature `onnx`, and a refusal without it.

#[cfg(not(feature = "onnx"))]
mod absent;
#[cfg(feature = "onnx")]
mod onnx;
#[cfg(feature = "onnx")]
mod signature;
#[cfg(feature = "onnx")]
mod tokens;

#[cfg(not(feature = "onnx"))]
pub(crate) use absent::{Session, Tokenizer};
#[cfg(feature = "onnx")]
pub(crate) use onnx::Session;
#[cfg(feature = "onnx")]
pub(crate) use tokens::Tokenizer;

/// True where this build can run models.
pub const IS_BUILT: bool = cfg!(feature = "onnx");

/// A tensor by the part that it plays for us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Part<'a> {
    /// Key in `models.toml`.
    pub(crate) name: &'a str,
    /// Numbers of axes that it may have; none for any.
    pub(crate) ranks: &'a [usize],
    /// True where a model without it is of no use.
    pub(crate) needed: bool,
}

impl<'a> Part<'a> {
    /// A part that every model has.
    pub(crate) const fn needed(name: &'a str, ranks: &'a [usize]) -> Self {
        Self { name, ranks, needed: true }
    }

    /// A part that only some models have.
    pub(crate) const fn known(name: &'a str, ranks: &'a [usize]) -> Self {
        Self { name, ranks, needed: false }
    }
}

/// A text as numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Tokens {
    /// Numbers of the tokens.
    pub(crate) ids: Vec<i64>,
    /// Segment of every token.
    pub(crate) types: Vec<i64>,
    /// 1 for tokens of the text, 0 for padding.
    pub(crate) attention: Vec<i64>,
    /// Bytes of the text that a token stands for; `None` for those that the tokenizer adds.
    pub(crate) spans: Vec<Option<(usize, usize)>>,
}
