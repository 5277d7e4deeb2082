//! JSON files, with the line of a mistake in its message.

use std::path::Path;

use serde::de::DeserializeOwned;

use crate::Error;

/// Larger JSON files are not captures; the bound keeps a stray file from filling memory.
const MAX_BYTES: u64 = 1 << 30;

/// Reads a JSON file.
///
/// # Errors
/// When it cannot be read, or its text does not fit `T`; the message has line and column.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<T, Error> {
    let size = cif_input::check(path).map_err(Error::read(path))?;
    if size > MAX_BYTES {
        return Err(Error::invalid(path, format!("{size} bytes are too many for a JSON file of a capture")));
    }
    let text = cif_input::read_text(path).map_err(Error::read(path))?;
    serde_json::from_slice(&text).map_err(|error| Error::Json {
        path: path.to_owned(),
        line: error.line(),
        column: error.column(),
        problem: {
            let text = error.to_string();
            let end = text.rfind(" at line").unwrap_or(text.len());
            text[..end].to_owned()
        },
    })
}

/// Writes a JSON file, indented.
///
/// # Errors
/// When it cannot be written.
pub(crate) fn write<T: serde::Serialize>(path: &Path, value: &T) -> Result<(), Error> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|error| Error::Write { path: path.to_owned(), source: error.into() })?;
    text.push('\n');
    std::fs::write(path, text).map_err(Error::write(path))
}
