//! numpy arrays, lists and dictionaries in and out.

use numpy::ndarray::Dimension;
use numpy::{
    Element, PyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyFloat, PyList};

/// Rows of an `[N, C]` array; other shapes are refused by name.
pub(crate) fn rows<T: Element + Copy, const C: usize>(
    name: &str,
    array: &PyReadonlyArrayDyn<'_, T>,
) -> PyResult<Vec<[T; C]>> {
    let shape = array.shape();
    if shape.len() != 2 || shape[1] != C {
        return Err(PyValueError::new_err(format!("{name} has the shape {shape:?}, but must be [N, {C}]")));
    }
    let flat = values(array);
    Ok(flat.as_chunks().0.to_vec())
}

/// Values of an `[N]` array.
pub(crate) fn column<T: Element + Copy>(name: &str, array: &PyReadonlyArrayDyn<'_, T>) -> PyResult<Vec<T>> {
    if array.shape().len() != 1 {
        let shape = array.shape();
        return Err(PyValueError::new_err(format!("{name} has the shape {shape:?}, but must be [N]")));
    }
    Ok(values(array))
}

/// Values in row-major order, whatever the strides.
pub(crate) fn values<T: Element + Copy>(array: &PyReadonlyArrayDyn<'_, T>) -> Vec<T> {
    array.as_array().iter().copied().collect()
}

/// The array, which numpy then refuses to change: a copy of what stays as it is, so that a change would be
/// lost.
pub(crate) fn read_only<T: Element, D: Dimension>(
    array: Bound<'_, PyArray<T, D>>,
) -> Bound<'_, PyArray<T, D>> {
    array.readwrite().make_nonwriteable();
    array
}

/// `[N, C]`.
pub(crate) fn matrix<'py, T: Element + Copy, const C: usize>(
    py: Python<'py>,
    rows: &[[T; C]],
) -> PyResult<Bound<'py, PyArray2<T>>> {
    PyArray1::from_slice(py, rows.as_flattened()).reshape([rows.len(), C])
}

/// `[height, width]`; nothing is copied.
pub(crate) fn image<T: Element>(
    py: Python<'_>,
    grid: cif_geometry::PixelGrid<T>,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    PyArray1::from_vec(py, grid.pixels).reshape([grid.height as usize, grid.width as usize])
}

/// `[height, width, C]`; nothing is copied.
pub(crate) fn color_image<T: Element, const C: usize>(
    py: Python<'_>,
    grid: cif_geometry::PixelGrid<[T; C]>,
) -> PyResult<Bound<'_, PyArray3<T>>> {
    let shape = [grid.height as usize, grid.width as usize, C];
    PyArray1::from_vec(py, grid.pixels.into_flattened()).reshape(shape)
}

/// A value as Python lists and dictionaries.
pub(crate) fn to_python<'py>(py: Python<'py>, value: &impl serde::Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(crate::error::cif_error)?;
    py.import("json")?.call_method1("loads", (text,))
}

/// Refuses numbers that JSON does not have, by their keys.
fn check_finite(name: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
    if let Ok(dictionary) = value.cast::<PyDict>() {
        return dictionary
            .iter()
            .try_for_each(|(key, value)| check_finite(&format!("{name}: {key}"), &value));
    }
    if let Ok(list) = value.cast::<PyList>() {
        return list.iter().try_for_each(|value| check_finite(name, &value));
    }
    match value.cast::<PyFloat>() {
        Ok(number) if !number.value().is_finite() => {
            Err(PyValueError::new_err(format!("{name} is {number}; a finite number is expected")))
        }
        _ => Ok(()),
    }
}

/// A dictionary as a value.
pub(crate) fn from_python<T: serde::de::DeserializeOwned>(
    name: &str,
    dictionary: &Bound<'_, PyDict>,
) -> PyResult<T> {
    check_finite(name, dictionary.as_any())?;
    let text: String = dictionary.py().import("json")?.call_method1("dumps", (dictionary,))?.extract()?;
    serde_json::from_str(&text).map_err(|error| PyValueError::new_err(format!("{name}: {error}")))
}
