//! Objects of fields and files by label, and their paths.

use std::path::PathBuf;

use cif::formats;
use cif_scene::{LabelQuery, ObjectQuery, ReadOptions, SceneGraph, TrajectorySample};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::cif_error;
use crate::{arrays, process};

/// Name of a field in errors.
const PLACE: &str = "the field";

pub(crate) fn find<'py>(
    py: Python<'py>,
    graph: &SceneGraph,
    label: String,
    time_code: Option<f64>,
) -> PyResult<Bound<'py, PyAny>> {
    let query = LabelQuery { pattern: label, time_code };
    let found = cif_scene::query(graph, &query, PLACE).map_err(cif_error)?;
    arrays::to_python(py, &found)
}

pub(crate) fn trajectory<'py>(
    py: Python<'py>,
    graph: &SceneGraph,
    label: String,
) -> PyResult<Bound<'py, PyDict>> {
    let query = ObjectQuery { label: Some(label.clone()), ..ObjectQuery::default() };
    let found = cif_scene::trajectories(graph, &query, PLACE).map_err(cif_error)?;
    let [path] = found.as_slice() else {
        let names: Vec<&str> = found.iter().map(|path| path.instance.as_str()).collect();
        let names = names.join(", ");
        return Err(cif_error(format!("'{label}' fits {} objects: {names}; name one of them", found.len())));
    };
    let column =
        |value: fn(&TrajectorySample) -> f64| PyArray1::from_iter(py, path.samples.iter().map(value));
    let translations: Vec<[f64; 3]> = path.samples.iter().map(|sample| sample.translation).collect();
    let rotations: Vec<[f64; 4]> = path.samples.iter().map(|sample| sample.rotation).collect();
    let out = PyDict::new(py);
    out.set_item("instance", &path.instance)?;
    out.set_item("label", &path.label)?;
    out.set_item("class", &path.class)?;
    out.set_item("time_codes", column(|sample| sample.time_code))?;
    out.set_item("times", column(|sample| sample.time))?;
    out.set_item("seconds", column(|sample| sample.seconds))?;
    out.set_item("translations", arrays::matrix(py, &translations)?)?;
    out.set_item("rotations", arrays::matrix(py, &rotations)?)?;
    out.set_item("visible", PyArray1::from_iter(py, path.samples.iter().map(|sample| sample.visible)))?;
    Ok(out)
}

/// A label to look for: `*` stands for any characters and `?` for one; case does not matter.
#[pyclass(frozen, module = "cif._native")]
pub(crate) struct LabelPattern {
    inner: cif_scene::LabelPattern,
}

#[pymethods]
impl LabelPattern {
    #[new]
    fn new(text: &str) -> Self {
        Self { inner: cif_scene::LabelPattern::new(text) }
    }

    /// Return True where a label is spelled so.
    fn matches(&self, label: &str) -> bool {
        self.inner.matches(label)
    }
}

/// Return the prims of a stage, or nodes of a glTF file, that carry a label, each as a dictionary.
///
/// label is as in Field.find, and so are the answers; an unknown label lists the known ones. Layers outside
/// the folder of the stage are read with follow_external alone.
#[pyfunction]
#[pyo3(signature = (path, label, time_code=None, *, follow_external=false))]
pub(crate) fn query_stage<'py>(
    py: Python<'py>,
    path: PathBuf,
    label: String,
    time_code: Option<f64>,
    follow_external: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let query = LabelQuery { pattern: label, time_code };
    let format = formats::format_of(&path).map_err(|error| cif_error(error.with_help()))?;
    let read = || format.query(&path, &query, ReadOptions { follow_external });
    let found = process::detach(py, read)?.map_err(cif_error)?;
    arrays::to_python(py, &found)
}
