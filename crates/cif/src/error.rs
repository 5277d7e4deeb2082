//! Errors of the command line, and its exit codes.

use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use miette::{Diagnostic, NamedSource, SourceSpan};

use crate::messages::plain;

/// Any failure of a command.
#[derive(Debug, thiserror::Error, Diagnostic)]
#[non_exhaustive]
pub enum Error {
    /// The arguments do not fit together (exit code 2).
    #[error("{message}")]
    Usage {
        /// Message, with the arguments that do not fit.
        message: String,
        /// Advice on valid arguments.
        #[help]
        help: Option<String>,
    },
    /// A failure that one sentence and one piece of advice describe.
    #[error("{message}")]
    Failed {
        /// Message, naming the file or object.
        message: String,
        /// Remedy.
        #[help]
        help: Option<String>,
    },
    /// A place in a text file.
    #[error(transparent)]
    #[diagnostic(transparent)]
    InText(Box<TextError>),
    /// Ctrl-C, after saving (exit code 130).
    #[error("{message}")]
    Interrupted {
        /// Message, with what was saved.
        message: String,
        /// Advice on how to go on.
        #[help]
        help: Option<String>,
    },
}

#[cfg(feature = "wgpu")]
impl From<cif_render::wgpu::GpuError> for Error {
    fn from(error: cif_render::wgpu::GpuError) -> Self {
        Self::plain(error)
    }
}

impl From<cif_bench::Error> for Error {
    fn from(error: cif_bench::Error) -> Self {
        match error {
            cif_bench::Error::Io { action, path, source } => Self::io(action, &path)(source),
            other => Self::plain(other),
        }
    }
}

impl From<cif_exr::ExrError> for Error {
    fn from(error: cif_exr::ExrError) -> Self {
        Self::plain(error)
    }
}

impl From<cif_system::Error> for Error {
    fn from(error: cif_system::Error) -> Self {
        match error {
            cif_system::Error::Io { action, path, source } => Self::io(action, &path)(source),
            cif_system::Error::Refused { problem, fix } => Self::failed(problem, fix),
            other => Self::plain(other),
        }
    }
}

/// Error at a place in a text file.
#[derive(Debug, thiserror::Error, Diagnostic)]
#[error("{}:{line}: {message}", path.display())]
pub struct TextError {
    path: PathBuf,
    line: usize,
    message: String,
    #[help]
    help: Option<String>,
    #[source_code]
    source_code: NamedSource<String>,
    #[label("here")]
    span: SourceSpan,
}

impl Error {
    /// A failure with advice.
    pub fn failed(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Failed { message: plain(&message.into()).into_owned(), help: Some(help.into()) }
    }

    /// A failure whose message carries its own advice.
    pub fn plain(error: impl std::fmt::Display) -> Self {
        Self::Failed { message: plain(&error.to_string()).into_owned(), help: None }
    }

    /// Arguments that do not fit together.
    pub fn usage(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Usage { message: plain(&message.into()).into_owned(), help: Some(help.into()) }
    }

    /// Turns an I/O error into one that names the file, with advice where the system says enough.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| {
            let message = format!("cannot {action} {}: {source}", path.display());
            let help = match source.kind() {
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
                    "make space there, or choose another place"
                }
                ErrorKind::ReadOnlyFilesystem => "nothing can be written there; choose another place",
                ErrorKind::PermissionDenied => "check the permissions of the file and of its folder",
                _ => return Self::plain(message),
            };
            Self::failed(message, help)
        }
    }

    /// A place in a text file, given as a byte range.
    pub fn in_text(
        path: &Path,
        text: &str,
        span: std::ops::Range<usize>,
        message: impl Into<String>,
        help: Option<String>,
    ) -> Self {
        let start = span.start.min(text.len());
        Self::InText(Box::new(TextError {
            path: path.to_owned(),
            line: text.as_bytes()[..start].iter().filter(|byte| **byte == b'\n').count() + 1,
            message: message.into(),
            help,
            source_code: NamedSource::new(path.display().to_string(), text.to_owned()),
            span: (start, span.end.clamp(start, text.len()) - start).into(),
        }))
    }

    /// The message with the advice behind it, where there is some.
    #[must_use]
    pub fn with_help(&self) -> String {
        match Diagnostic::help(self) {
            Some(help) => format!("{self}; {help}"),
            None => self.to_string(),
        }
    }

    /// Exit code of the process.
    #[must_use]
    pub fn exit_code(&self) -> i32 {
        match self {
            Self::Usage { .. } => 2,
            Self::Interrupted { .. } => 130,
            _ => 1,
        }
    }
}
