//! Values of properties and metadata.

use glam::{DMat4, DQuat, DVec3};
use pyo3::prelude::*;
use pyo3::types::PyString;

use crate::conventions;

/// An attribute that has a value.
pub(super) fn attribute<'py>(prim: &Bound<'py, PyAny>, name: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
    let attribute = prim.call_method1("GetAttribute", (name,))?;
    let authored = attribute.is_truthy()? && attribute.call_method0("HasAuthoredValue")?.is_truthy()?;
    Ok(authored.then_some(attribute))
}

/// Value of an authored attribute at a time; `None` where there is none, or it is blocked.
pub(super) fn value<'py>(
    prim: &Bound<'py, PyAny>,
    name: &str,
    time: &Bound<'py, PyAny>,
) -> PyResult<Option<Bound<'py, PyAny>>> {
    let Some(attribute) = attribute(prim, name)? else { return Ok(None) };
    let value = attribute.call_method1("Get", (time,))?;
    Ok((!value.is_none()).then_some(value))
}

/// As [`value`], of a type that Python knows; another type counts as no value.
pub(super) fn plain<'py, T: for<'a> FromPyObject<'a, 'py>>(
    prim: &Bound<'py, PyAny>,
    name: &str,
    time: &Bound<'py, PyAny>,
) -> PyResult<Option<T>> {
    Ok(value(prim, name, time)?.and_then(|value| value.extract().ok()))
}

/// Text of a token, string or path.
pub(super) fn text(value: &Bound<'_, PyAny>) -> PyResult<String> {
    match value.cast::<PyString>() {
        Ok(text) => text.extract(),
        Err(_) => value.str()?.extract(),
    }
}

/// Path of a prim.
pub(super) fn path(prim: &Bound<'_, PyAny>) -> PyResult<String> {
    text(&prim.call_method0("GetPath")?)
}

/// Sampled time codes of an attribute, ascending.
pub(super) fn samples(attribute: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    attribute.call_method0("GetTimeSamples")?.extract()
}

/// Components of a vector.
pub(super) fn vector<const N: usize>(value: &Bound<'_, PyAny>) -> PyResult<[f64; N]> {
    let mut components = [0.0; N];
    for (index, component) in components.iter_mut().enumerate() {
        *component = value.get_item(index)?.extract()?;
    }
    Ok(components)
}

/// `GfVec3` of any precision.
pub(super) fn vec3(value: &Bound<'_, PyAny>) -> PyResult<DVec3> {
    vector(value).map(DVec3::from_array)
}

/// `GfQuat` of any precision.
pub(super) fn quaternion(value: &Bound<'_, PyAny>) -> PyResult<DQuat> {
    let real: f64 = value.call_method0("GetReal")?.extract()?;
    let imaginary = vec3(&value.call_method0("GetImaginary")?)?;
    Ok(DQuat::from_xyzw(imaginary.x, imaginary.y, imaginary.z, real))
}

/// `GfMatrix4d`, for column vectors.
pub(super) fn matrix(value: &Bound<'_, PyAny>) -> PyResult<DMat4> {
    let mut rows = [[0.0; 4]; 4];
    for (index, row) in rows.iter_mut().enumerate() {
        *row = vector(&value.call_method1("GetRow", (index,))?)?;
    }
    // glam keeps columns, so that the rows of the transpose go in as they are.
    let columns = conventions::column_vector_matrix(rows);
    Ok(DMat4::from_cols_array_2d(&columns).transpose())
}
