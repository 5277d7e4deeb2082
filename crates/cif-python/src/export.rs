//! Scenes as USD, glTF and PLY.

use std::path::Path;

use cif::formats;
use cif_field::{Field, Gaussians};
use cif_scene::{ExportOptions, FrameRange, MotionSource, SceneFormat, SceneGraph, SceneOptions, Tolerance};
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::cif_error;
use crate::{arrays, process};

/// Motion from a Python function `time -> (means, quaternions)`. The first error stops the export.
struct CallableMotion<'a> {
    field: &'a Field,
    function: Py<PyAny>,
    error: Option<PyErr>,
}

impl CallableMotion<'_> {
    fn call(&self, time: f64) -> PyResult<Gaussians> {
        Python::attach(|py| {
            let answer = self.function.call1(py, (time,))?;
            let (means, quaternions): (PyReadonlyArrayDyn<'_, f32>, PyReadonlyArrayDyn<'_, f32>) =
                answer.extract(py)?;
            let n = self.field.gaussians.len();
            if means.shape() != [n, 3] || quaternions.shape() != [n, 4] {
                let message = format!("motion({time}) must return float32 arrays [{n}, 3] and [{n}, 4]");
                return Err(PyValueError::new_err(message));
            }
            let mut moved = self.field.gaussians.clone();
            moved.means = arrays::rows("means", &means)?;
            moved.quaternions = arrays::rows("quaternions", &quaternions)?;
            Ok(moved)
        })
    }
}

impl MotionSource for CallableMotion<'_> {
    fn gaussians_at(&mut self, time: f64) -> Gaussians {
        if self.error.is_none() {
            match self.call(time) {
                Ok(moved) => return moved,
                Err(error) => self.error = Some(error),
            }
        }
        self.field.gaussians.clone()
    }
}

/// Options of a scene by their names; a tolerance is spelled as for the command, frames are (first, last).
fn scene_options(py: Python<'_>, options: Option<&Bound<'_, PyDict>>) -> PyResult<SceneOptions> {
    let Some(options) = options else { return Ok(SceneOptions::default()) };
    if let Some(tolerance) = options.get_item("tolerance")? {
        let tolerance: Tolerance = tolerance.str()?.to_str()?.parse().map_err(cif_error)?;
        options.set_item("tolerance", arrays::to_python(py, &tolerance)?)?;
    }
    if let Some(frames) = options.get_item("frames")?.filter(|frames| !frames.is_none()) {
        let (first, last) = frames.extract()?;
        options.set_item("frames", arrays::to_python(py, &FrameRange { first, last })?)?;
    }
    arrays::from_python("export", options)
}

/// Options of a file by their names; those of other formats are refused.
fn export_options(
    format: &dyn SceneFormat,
    options: Option<&Bound<'_, PyDict>>,
    force: bool,
) -> PyResult<ExportOptions> {
    let Some(options) = options else { return Ok(ExportOptions { force, ..ExportOptions::default() }) };
    for key in options.keys() {
        let key = key.str()?;
        if !format.about().options.contains(&key.to_str()?) {
            let known = match format.about().options {
                [] => "none".to_owned(),
                known => known.join(", "),
            };
            let message = format!("options: '{key}' is no option of {}; known: {known}", format.about().name);
            return Err(PyValueError::new_err(message));
        }
    }
    Ok(ExportOptions { force, ..arrays::from_python("options", options)? })
}

fn build(
    py: Python<'_>,
    field: &Field,
    options: &SceneOptions,
    motion: Option<Bound<'_, PyAny>>,
) -> PyResult<SceneGraph> {
    let Some(function) = motion else {
        return process::detach(py, || cif_scene::build(field, options))?.map_err(cif_error);
    };
    let mut source = CallableMotion { field, function: function.unbind(), error: None };
    let graph = process::detach(py, || cif_scene::build_from(field, &mut source, options))?;
    match source.error {
        Some(error) => Err(error),
        None => graph.map_err(cif_error),
    }
}

/// Writes a field in the format of the ending; returns a summary of the files.
pub(crate) fn export<'py>(
    py: Python<'py>,
    field: &Field,
    path: &Path,
    motion: Option<Bound<'py, PyAny>>,
    options: Option<&Bound<'py, PyDict>>,
    force: bool,
    scene: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let format = formats::format_of(path).map_err(|error| cif_error(error.with_help()))?;
    let writing = export_options(format, options, force)?;
    let scene = scene_options(py, scene)?;
    format.check_target(path, &writing).map_err(cif_error)?;
    let graph = build(py, field, &format.held(&scene), motion)?;
    let summary = process::detach(py, || formats::write(format, &graph, path, &writing))?
        .map_err(|error| cif_error(error.with_help()))?;
    let out = PyDict::new(py);
    out.set_item("path", summary.path)?;
    out.set_item("files", summary.files)?;
    out.set_item("bytes", summary.bytes)?;
    out.set_item("splats", summary.splats)?;
    out.set_item("samples", summary.samples)?;
    out.set_item("library", summary.library)?;
    out.set_item("not_held", summary.not_held)?;
    out.set_item("warnings", &graph.warnings)?;
    out.set_item("motion", arrays::to_python(py, &graph.motion_table())?)?;
    Ok(out)
}

/// Return the version of the USD in use, e.g. 26.11.
///
/// Raises CifError where there is none, or one older than 25.11.
#[pyfunction]
pub(crate) fn usd_version() -> PyResult<String> {
    cif_usd::usd_version().map_err(cif_error)
}
