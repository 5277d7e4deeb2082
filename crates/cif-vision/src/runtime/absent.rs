//! A build without ONNX Runtime: every model is refused when it is opened.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::io::{self, Read, Write};
use std::path::Path;

use super::{Part, Tokens};
use crate::models::Network;
use crate::{Error, Tensor};

/// A model that cannot be there.
#[derive(Debug)]
pub(crate) struct Session(Infallible);

/// A tokenizer that cannot be there.
#[derive(Debug)]
pub(crate) struct Tokenizer(Infallible);

fn refused() -> Error {
    Error::refused(
        "this build of cif does not run models: it has no ONNX Runtime",
        "take the Python wheel, which does, or build with --features cif/onnx",
    )
}

/// Answers no question, since there is no model.
///
/// # Errors
/// None.
pub fn serve(_: impl Read, _: impl Write) -> io::Result<()> {
    Ok(())
}

impl Session {
    pub(crate) fn open(_: &Path, _: &Network, _: &[Part<'_>], _: &[Part<'_>]) -> Result<Self, Error> {
        Err(refused())
    }

    pub(crate) fn has_input(&self, _: &str) -> bool {
        match self.0 {}
    }

    pub(crate) fn input_shape(&self, _: &str) -> &[Option<usize>] {
        match self.0 {}
    }

    pub(crate) fn refuse(&self, _: &str, _: &str) -> Error {
        match self.0 {}
    }

    pub(crate) fn run(&mut self, _: Vec<(&str, Tensor)>) -> Result<BTreeMap<String, Tensor>, Error> {
        match self.0 {}
    }
}

impl Tokenizer {
    pub(crate) fn open(_: &Path) -> Result<Self, Error> {
        Err(refused())
    }

    pub(crate) fn encode(&mut self, _: &str, _: Option<usize>) -> Result<Tokens, Error> {
        match self.0 {}
    }
}
