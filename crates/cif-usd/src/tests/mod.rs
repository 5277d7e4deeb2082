//! Stages written, read back, edited and damaged; with a Python that has usd-core (`make test-usd`).

#![expect(clippy::unwrap_used, reason = "tests; clippy knows only plain cfg(test)")]

mod damaged;
mod edited;
mod foreign;
mod fuzz;
mod outputs;
mod recorded;
mod round_trip;
mod scenes;
mod schema;
mod search_path;
mod windows;

use std::path::Path;

use pyo3::prelude::*;
use pyo3::types::PyDict;

/// One test at a time: usd-core loads its modules on first use, and two threads that do so wait for each other.
fn session() -> std::sync::MutexGuard<'static, ()> {
    static ONE: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let guard = ONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    Python::initialize();
    guard
}

/// Runs a Python program with `path` (a string) in its globals.
fn python(path: &Path, program: &str) {
    Python::attach(|py| {
        let globals = PyDict::new(py);
        globals.set_item("path", path.to_string_lossy()).unwrap();
        let program = std::ffi::CString::new(program).unwrap();
        if let Err(error) = py.run(&program, Some(&globals), None) {
            error.print(py);
            panic!("{error}");
        }
    });
}
