//! The native half of the Python package `cif`.
//!
//! | module | answers |
//! |---|---|
//! | `arrays` | numpy arrays in and out |
//! | `beside` | long work, while the interpreter answers signals and callbacks |
//! | `camera` | pinhole cameras |
//! | `dataset` | captures |
//! | `field` | trained scenes: arrays, rendering, queries |
//! | `export` | scenes as USD, and stages by label |
//! | `import` | files as scenes, edits coming home, differences |
//! | `train` | training with a callback |
//! | `error` | `cif.CifError` |
//!
//! Everything is documented for its users in `python/cif/_native.pyi`. Work in Rust runs without the lock of the
//! interpreter; the USD writer takes it when it needs usd-core.

mod arrays;
mod beside;
mod camera;
mod dataset;
mod error;
mod export;
mod field;
mod import;
mod train;

use std::ffi::OsString;
use std::path::PathBuf;

use pyo3::prelude::*;

/// Python that the command runs pycolmap in: this one.
fn name_python(py: Python<'_>) -> PyResult<()> {
    if let Some(program) = py.import("sys")?.getattr("executable")?.extract::<Option<PathBuf>>()? {
        cif::set_python(program);
    }
    Ok(())
}

/// Runs the command line in this process, whose signals stay with it, and returns its exit code. `arguments` start
/// with the name of the program.
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

/// Runs the command line in a process that is nothing but the command, which takes its signals.
#[pyfunction]
fn main(py: Python<'_>, arguments: Vec<OsString>) -> PyResult<i32> {
    name_python(py)?;
    cif::own_process();
    Ok(py.detach(|| cif::run(arguments)))
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("CifError", module.py().get_type::<error::CifError>())?;
    module.add_class::<camera::Camera>()?;
    module.add_class::<dataset::Dataset>()?;
    module.add_class::<field::Field>()?;
    module.add_class::<export::LabelPattern>()?;
    module.add_function(wrap_pyfunction!(run, module)?)?;
    module.add_function(wrap_pyfunction!(main, module)?)?;
    module.add_function(wrap_pyfunction!(train::train, module)?)?;
    module.add_function(wrap_pyfunction!(dataset::open_dataset, module)?)?;
    module.add_function(wrap_pyfunction!(export::query_stage, module)?)?;
    module.add_function(wrap_pyfunction!(import::import_scene, module)?)?;
    module.add_function(wrap_pyfunction!(import::diff, module)?)?;
    module.add_function(wrap_pyfunction!(export::usd_version, module)?)?;
    Ok(())
}
