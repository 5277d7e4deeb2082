//! Files of other tools as scenes, edits coming home, and differences.

use std::path::{Path, PathBuf};

use cif::formats;
use cif_scene::ReadOptions;
use pyo3::prelude::*;

use crate::dataset::window_of;
use crate::error::cif_error;
use crate::field::Field;
use crate::{arrays, process};

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Read a USD, glTF or PLY file as a field.
///
/// With base, the field that the file was exported from, what was changed in the file is applied to it, and
/// the second value lists the edits as diff does; otherwise it is None. force_base takes a base that the file
/// was not exported from. window takes one of several windows of time of a stage, as "2/4".
#[pyfunction]
#[pyo3(signature = (path, *, base=None, force_base=false, window=None))]
pub(crate) fn import_scene<'py>(
    py: Python<'py>,
    path: PathBuf,
    base: Option<PyRef<'py, Field>>,
    force_base: bool,
    window: Option<&str>,
) -> PyResult<(Field, Bound<'py, PyAny>)> {
    let window = window_of(window)?;
    let base = base.as_deref();
    let (inner, changes) = process::detach(py, || {
        let graph =
            formats::read(&path, ReadOptions::default(), window).map_err(|error| error.to_string())?;
        let source = name_of(&path);
        match base {
            Some(base) => cif_scene::import_edits(&base.inner, &graph, &source, force_base)
                .map(|(field, changes)| (field, Some(changes))),
            None => cif_scene::field_from_graph(&graph, &source).map(|field| (field, None)),
        }
        .map_err(|error| error.to_string())
    })?
    .map_err(cif_error)?;
    Ok((Field::new(inner), arrays::to_python(py, &changes)?))
}

/// Compare two scenes, stages or glTF files object by object.
///
/// objects lists those that differ: what happened (kind), how far they moved over time, names, labels,
/// visibility, and counts of splats; unchanged counts the others.
#[pyfunction]
pub(crate) fn diff<'py>(py: Python<'py>, before: PathBuf, after: PathBuf) -> PyResult<Bound<'py, PyAny>> {
    let changes = process::detach(py, || {
        formats::read_both(&before, &after)
            .map(|[before, after]| cif_scene::diff::diff(&before, &after))
            .map_err(|error| error.to_string())
    })?
    .map_err(cif_error)?;
    arrays::to_python(py, &changes)
}
