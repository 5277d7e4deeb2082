//! The process that works: threads and GPUs of a process do not live on in one that is forked from it, where work would wait
//! for them for ever.

use std::sync::atomic::{AtomicU32, Ordering};

use pyo3::marker::Ungil;
use pyo3::prelude::*;

use crate::error::cif_error;

/// Id of the process that worked first; 0 before.
static WORKS: AtomicU32 = AtomicU32::new(0);

/// Begins work: threads may be started from here on.
///
/// # Errors
/// When this process was forked from one that has worked.
pub(crate) fn enter() -> PyResult<()> {
    let this = std::process::id();
    match WORKS.compare_exchange(0, this, Ordering::Relaxed, Ordering::Relaxed) {
        Err(other) if other != this => Err(cif_error(format!(
            "process {this} was forked from process {other} after cif had worked there, whose threads do not live on in \
             it; start processes with multiprocessing.get_context(\"spawn\"), or before cif does any work"
        ))),
        _ => Ok(()),
    }
}

/// Works without the lock of the interpreter.
///
/// # Errors
/// As [`enter`].
pub(crate) fn detach<T: Ungil>(py: Python<'_>, work: impl Ungil + FnOnce() -> T) -> PyResult<T> {
    enter()?;
    Ok(py.detach(work))
}
