//! Where a model or a tokenizer is run: in a process of its own, or in this one where no such process can be started.

use std::path::Path;

use super::messages::{Answer, Question};
use super::runner::{self, Runner};
use super::signature::Declared;
use super::worker::Worker;
use super::{Reading, START};
use crate::{Error, Tensor};

/// A process with at most one model and one tokenizer.
#[derive(Debug)]
pub(super) enum Place {
    /// Another one.
    Apart(Worker),
    /// This one.
    Here { model: Option<Runner>, tokenizer: Option<Box<tokenizers::Tokenizer>> },
}

impl Place {
    /// A place without model.
    ///
    /// # Errors
    /// When the process cannot be started.
    pub(super) fn new() -> Result<Self, Error> {
        match START.get() {
            Some(start) => Worker::start(&mut start()).map(Self::Apart).map_err(|error| {
                Error::refused(
                    format!("the process that runs models cannot be started: {error}"),
                    "try again",
                )
            }),
            None => Ok(Self::here()),
        }
    }

    /// This process.
    pub(super) fn here() -> Self {
        Self::Here { model: None, tokenizer: None }
    }

    /// Loads the library of ONNX Runtime.
    ///
    /// # Errors
    /// When it does not fit, in words.
    pub(super) fn load_library(&mut self, library: &Path) -> Result<(), String> {
        match self {
            Self::Apart(worker) => match worker.ask(&Question::Library(library.to_owned()), Vec::new())? {
                (Answer::Ready, _) => Ok(()),
                other => Err(unexpected(&other.0)),
            },
            Self::Here { .. } => runner::load_library(library),
        }
    }

    /// Opens the model; its inputs and outputs.
    ///
    /// # Errors
    /// When it cannot be loaded, in words.
    pub(super) fn open(&mut self, file: &Path) -> Result<[Vec<Declared>; 2], String> {
        self.open_with(file, rayon::current_num_threads())
    }

    /// As [`Place::open`], for as many threads.
    pub(super) fn open_with(&mut self, file: &Path, threads: usize) -> Result<[Vec<Declared>; 2], String> {
        match self {
            Self::Apart(worker) => {
                match worker.ask(&Question::Model { file: file.to_owned(), threads }, Vec::new())? {
                    (Answer::Declared(sides), _) => Ok(sides),
                    other => Err(unexpected(&other.0)),
                }
            }
            Self::Here { model, .. } => Ok(model.insert(Runner::open(file, threads)?).declared()),
        }
    }

    /// The requested outputs of the model.
    ///
    /// # Errors
    /// When it fails, in words.
    pub(super) fn run(
        &mut self,
        given: Vec<(String, Tensor)>,
        requested: &[String],
    ) -> Result<Vec<Tensor>, String> {
        match self {
            Self::Apart(worker) => {
                let (names, tensors) = given.into_iter().unzip();
                match worker.ask(&Question::Run { names, wanted: requested.to_vec() }, tensors)? {
                    (Answer::Outputs, outputs) if outputs.len() == requested.len() => Ok(outputs),
                    other => Err(unexpected(&other.0)),
                }
            }
            Self::Here { model, .. } => model.as_mut().ok_or("no model is open")?.run(given, requested),
        }
    }

    /// Reads the tokenizer.
    ///
    /// # Errors
    /// When it is none, in words.
    pub(super) fn open_tokenizer(&mut self, text: String) -> Result<(), String> {
        match self {
            Self::Apart(worker) => match worker.ask(&Question::Tokenizer(text), Vec::new())? {
                (Answer::Ready, _) => Ok(()),
                other => Err(unexpected(&other.0)),
            },
            Self::Here { tokenizer, .. } => {
                let read = tokenizers::Tokenizer::from_bytes(text).map_err(|error| error.to_string())?;
                *tokenizer = Some(Box::new(read));
                Ok(())
            }
        }
    }

    /// Reads a text by the tokenizer.
    ///
    /// # Errors
    /// When it cannot, in words.
    pub(super) fn read(&mut self, text: &str) -> Result<Reading, String> {
        match self {
            Self::Apart(worker) => match worker.ask(&Question::Read(text.to_owned()), Vec::new())? {
                (Answer::Reading(reading), _) => Ok(reading),
                other => Err(unexpected(&other.0)),
            },
            Self::Here { tokenizer, .. } => {
                let tokenizer = tokenizer.as_ref().ok_or("no tokenizer is open")?;
                let encoded = tokenizer.encode(text, true).map_err(|error| error.to_string())?;
                Ok(Reading {
                    ids: encoded.get_ids().to_vec(),
                    types: encoded.get_type_ids().to_vec(),
                    attention: encoded.get_attention_mask().to_vec(),
                    special: encoded.get_special_tokens_mask().to_vec(),
                    offsets: encoded.get_offsets().to_vec(),
                    padding: tokenizer.get_padding().map_or(0, |padding| padding.pad_id),
                })
            }
        }
    }
}

fn unexpected(answer: &Answer) -> String {
    format!("the process that runs it gave another answer, {answer:?}")
}
