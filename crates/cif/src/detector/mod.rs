//! Masks of a prompt on frames: by a command of the user's own, or by models that cif runs itself.

mod asked;
mod command;
mod models;

use std::path::PathBuf;

use cif_vision::Models;

pub use self::asked::{Asked, Detected};
use crate::error::Error;

/// Answers prompts.
#[derive(Debug)]
pub enum Detector {
    /// A command that reads frames and writes masks.
    Command(String),
    /// Models of a folder, and the folder that keeps their masks.
    Models(Box<Models>, PathBuf),
}

impl Detector {
    /// Asks for a prompt.
    ///
    /// # Errors
    /// When the detector cannot be run or fails, or the command is asked to stop.
    pub fn detect(&self, asked: &Asked<'_>, prompt: &str) -> Result<Detected, Error> {
        match self {
            Self::Command(command) => command::detect(asked, command, prompt),
            Self::Models(models, cache) => models::detect(asked, models, cache, prompt),
        }
    }
}
