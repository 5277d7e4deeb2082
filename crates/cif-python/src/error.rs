//! `cif.CifError`: every error that cif reports about files, captures, fields and stages.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(
    cif,
    CifError,
    PyException,
    "A file, capture, field or stage is invalid; the message names it and the remedy."
);

/// The error of a library as a Python exception.
pub(crate) fn cif_error(error: impl std::fmt::Display) -> PyErr {
    CifError::new_err(error.to_string())
}
