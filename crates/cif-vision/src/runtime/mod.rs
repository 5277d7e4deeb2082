//! Running models: ONNX Runtime and tokenizers behind the feature `onnx`, and a refusal without it.

#[cfg(not(feature = "onnx"))]
mod absent;
#[cfg(feature = "onnx")]
mod messages;
#[cfg(feature = "onnx")]
mod onnx;
#[cfg(feature = "onnx")]
mod place;
#[cfg(feature = "onnx")]
mod runner;
#[cfg(feature = "onnx")]
mod serve;
#[cfg(feature = "onnx")]
mod signature;
#[cfg(feature = "onnx")]
mod tokens;
#[cfg(feature = "onnx")]
mod worker;

use std::process::Command;
use std::sync::OnceLock;

#[cfg(not(feature = "onnx"))]
pub use absent::serve;
#[cfg(not(feature = "onnx"))]
pub(crate) use absent::{Session, Tokenizer};
#[cfg(feature = "onnx")]
pub(crate) use onnx::Session;
#[cfg(feature = "onnx")]
pub use serve::serve;
#[cfg(feature = "onnx")]
pub(crate) use tokens::Tokenizer;

type Start = Box<dyn Fn() -> Command + Send + Sync>;

static START: OnceLock<Start> = OnceLock::new();

/// Runs every model and tokenizer in a process of its own from here on: files of others may end ONNX Runtime, and the
/// process with it. The command has to do nothing but [`serve`] on its standard input and output; the first call counts.
pub fn run_apart(start: impl Fn() -> Command + Send + Sync + 'static) {
    let _ = START.set(Box::new(start));
}

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

/// A text as a tokenizer reads it, padding of its own included: an entry per token.
#[cfg(feature = "onnx")]
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
struct Reading {
    ids: Vec<u32>,
    types: Vec<u32>,
    attention: Vec<u32>,
    /// 1 for tokens that the tokenizer adds.
    special: Vec<u32>,
    /// Bytes of the text.
    offsets: Vec<(usize, usize)>,
    /// Number of the token that fills up.
    padding: u32,
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
