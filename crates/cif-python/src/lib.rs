//! The native half of the Python package `cif`.
//!
//! | module | answers |
//! |---|---|
//! | `arrays` | numpy arrays in and out |
//! | `beside` | long work, while the interpreter answers signals and callbacks |
//! | `camera` | pinhole cameras |
//! | `dataset` | captures |
//! | `field` | trained scenes: arrays, rendering, queries |
//! | `from_arrays` | fields of numpy arrays |
//! | `objects` | objects by label, and their paths |
//! | `rendering` | views of fields |
//! | `picture`, `tables` | what notebooks show |
//! | `evaluate` | scores on a capture |
//! | `export` | scenes as files |
//! | `import` | files as scenes, edits coming home, differences |
//! | `train` | training with a callback |
//! | `process` | that work runs in the process that began it |
//! | `error` | `cif.CifError` |
//!
//! Doc comments of what Python sees are its docstrings, and are written for its users: `make stubs` takes them into
//! `python/cif/_native.pyi`, and a test holds the two together. Work in Rust runs without the lock of the
//! interpreter; the USD writer takes it when it needs usd-core.

mod arrays;
mod beside;
mod camera;
mod dataset;
mod error;
mod evaluate;
mod export;
mod field;
mod from_arrays;
mod import;
mod objects;
mod picture;
mod process;
mod rendering;
mod tables;
mod train;

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use pyo3::prelude::*;

/// Python that the command runs pycolmap and models in: this one.
fn name_python(py: Python<'_>) -> PyResult<()> {
    let program: Option<PathBuf> = py.import("sys")?.getattr("executable")?.extract()?;
    let module: PathBuf = py.import("cif")?.getattr("__file__")?.extract()?;
    let packages = module.ancestors().nth(2).map(Path::to_owned);
    // Programs that Python is built into have none, or an empty name.
    let program = program.filter(|program| !program.as_os_str().is_empty());
    if let (Some(program), Some(packages)) = (program, packages) {
        cif::set_python(program, packages);
    }
    Ok(())
}

/// Run a command line, whose first word is the name of the program, and return its exit code.
///
/// Signals stay with the process.
#[pyfunction]
fn run(py: Python<'_>, arguments: Vec<OsString>) -> PyResult<i32> {
    name_python(py)?;
    let session = cif::interrupt::Session::begin();
    // A command asks nothing; that it ends shows by the end of its questions.
    let work = |questions: beside::Questions<(), ()>| {
        let code = cif::run(arguments);
        drop(questions);
        code
    };
    beside::run(py, || session.request(), |()| Ok(()), work)
}

/// Run a command line in a process that is nothing but the command, which takes its signals.
#[pyfunction]
fn main(py: Python<'_>, arguments: Vec<OsString>) -> PyResult<i32> {
    name_python(py)?;
    cif::own_process();
    process::detach(py, || cif::run(arguments))
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("CifError", module.py().get_type::<error::CifError>())?;
    module.add_class::<camera::Camera>()?;
    module.add_class::<dataset::Dataset>()?;
    module.add_class::<field::Field>()?;
    module.add_class::<picture::Picture>()?;
    module.add_class::<objects::LabelPattern>()?;
    module.add_function(wrap_pyfunction!(run, module)?)?;
    module.add_function(wrap_pyfunction!(main, module)?)?;
    module.add_function(wrap_pyfunction!(train::train, module)?)?;
    module.add_function(wrap_pyfunction!(dataset::open_dataset, module)?)?;
    module.add_function(wrap_pyfunction!(evaluate::evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(objects::query_stage, module)?)?;
    module.add_function(wrap_pyfunction!(import::import_scene, module)?)?;
    module.add_function(wrap_pyfunction!(import::diff, module)?)?;
    module.add_function(wrap_pyfunction!(export::usd_version, module)?)?;
    Ok(())
}
