//! The Python modules of usd-core, and arrays handed over as buffers.

use std::path::PathBuf;

use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PySlice};

use crate::messages::Messages;
use crate::{UsdError, conventions, tokens};

/// The modules that stages are written and read with.
pub(crate) struct Pxr<'py> {
    pub(crate) py: Python<'py>,
    pub(crate) ar: Bound<'py, PyModule>,
    pub(crate) gf: Bound<'py, PyModule>,
    pub(crate) sdf: Bound<'py, PyModule>,
    pub(crate) usd: Bound<'py, PyModule>,
    pub(crate) usd_geom: Bound<'py, PyModule>,
    pub(crate) usd_semantics: Bound<'py, PyModule>,
    pub(crate) usd_utils: Bound<'py, PyModule>,
    pub(crate) vt: Bound<'py, PyModule>,
    pub(crate) version: String,
}

/// Runs `body` with usd-core; attaches to the interpreter.
pub(crate) fn with<T>(body: impl FnOnce(&Pxr<'_>) -> Result<T, UsdError>) -> Result<T, UsdError> {
    let attached = Python::try_attach(|py| {
        let pxr = without_current_folder(py, || Pxr::import(py))?;
        let _messages = Messages::of(&pxr.usd_utils);
        body(&pxr)
    });
    attached.unwrap_or(Err(UsdError::NoInterpreter))
}

/// Imports modules of where packages are installed: relative entries of the search path, which are the current folder, are
/// left out meanwhile.
pub(crate) fn without_current_folder<T>(
    py: Python<'_>,
    import: impl FnOnce() -> Result<T, UsdError>,
) -> Result<T, UsdError> {
    let python = |error: PyErr| UsdError::Python { reason: reason(py, &error) };
    let path = py.import("sys").and_then(|sys| sys.getattr("path")).map_err(python)?;
    let before: Vec<Bound<'_, PyAny>> = path.extract().map_err(python)?;
    let set = |entries: Vec<Bound<'_, PyAny>>| path.set_item(PySlice::full(py), PyList::new(py, entries)?);
    let is_absolute =
        |entry: &Bound<'_, PyAny>| entry.extract::<PathBuf>().is_ok_and(|entry| entry.is_absolute());
    set(before.iter().filter(|entry| is_absolute(entry)).cloned().collect()).map_err(python)?;
    let imported = import();
    set(before).map_err(python)?;
    imported
}

/// Message of a Python error, without the source locations of usd-core's messages.
pub(crate) fn reason(py: Python<'_>, error: &PyErr) -> String {
    let text = error.value(py).to_string();
    let messages: Vec<&str> = text
        .split(" : '")
        .skip(1)
        .filter_map(|part| part.split('\n').next())
        .map(|part| part.trim_end().trim_end_matches('\''))
        .filter(|part| !part.is_empty())
        .collect();
    if messages.is_empty() { error.to_string() } else { messages.join("; ") }
}

/// True where USD has a schema of splats, so that it takes them for something that has an extent and can be hidden.
fn knows_splats(usd: &Bound<'_, PyModule>) -> bool {
    let registry = usd.getattr("SchemaRegistry").and_then(|class| class.call0());
    let known = registry
        .and_then(|registry| registry.call_method1("FindConcretePrimDefinition", (tokens::GAUSSIAN_SPLAT,)));
    known.is_ok_and(|definition| !definition.is_none())
}

impl<'py> Pxr<'py> {
    fn import(py: Python<'py>) -> Result<Self, UsdError> {
        let missing = |error: PyErr| UsdError::Missing { reason: reason(py, &error) };
        let usd = py.import("pxr.Usd").map_err(missing)?;
        let parts: Vec<u32> = usd
            .call_method0("GetVersion")
            .and_then(|version| version.extract())
            .map_err(|error| UsdError::Python { reason: reason(py, &error) })?;
        // (0, 26, 8) is release 26.8.
        let (year, month) = match parts[..] {
            [_, year, month, ..] => (year, month),
            _ => (0, 0),
        };
        let version = format!("{year}.{month}");
        if (year, month) < tokens::MINIMUM_USD {
            return Err(UsdError::TooOld { found: version });
        }
        if (year, month) < tokens::SPLATS_USD && !knows_splats(&usd) {
            return Err(UsdError::SplatsUnknown { found: version });
        }
        let module = |name: &str| py.import(name).map_err(missing);
        Ok(Self {
            py,
            ar: module("pxr.Ar")?,
            gf: module("pxr.Gf")?,
            sdf: module("pxr.Sdf")?,
            usd,
            usd_geom: module("pxr.UsdGeom")?,
            usd_semantics: module("pxr.UsdSemantics")?,
            usd_utils: module("pxr.UsdUtils")?,
            vt: module("pxr.Vt")?,
            version,
        })
    }

    fn array(&self, class: &str, flat: &[f32], columns: usize) -> PyResult<Bound<'py, PyAny>> {
        let array = PyArray1::from_slice(self.py, flat);
        let array = if columns == 1 {
            array.into_any()
        } else {
            array.reshape([flat.len() / columns, columns])?.into_any()
        };
        self.vt.getattr(class)?.call_method1("FromNumpy", (array,))
    }

    /// `VtVec3fArray`.
    pub(crate) fn vec3f_array(&self, values: &[[f32; 3]]) -> PyResult<Bound<'py, PyAny>> {
        self.array("Vec3fArray", values.as_flattened(), 3)
    }

    /// `VtVec3fArray` of flat triples.
    pub(crate) fn vec3f_array_flat(&self, values: &[f32]) -> PyResult<Bound<'py, PyAny>> {
        self.array("Vec3fArray", values, 3)
    }

    /// `VtFloatArray`.
    pub(crate) fn float_array(&self, values: &[f32]) -> PyResult<Bound<'py, PyAny>> {
        self.array("FloatArray", values, 1)
    }

    /// `VtIntArray`.
    pub(crate) fn int_array(&self, values: &[i32]) -> PyResult<Bound<'py, PyAny>> {
        let array = PyArray1::from_slice(self.py, values);
        self.vt.getattr("IntArray")?.call_method1("FromNumpy", (array,))
    }

    /// `VtQuatfArray` of (w, x, y, z) quaternions.
    pub(crate) fn quatf_array(&self, values: &[[f32; 4]]) -> PyResult<Bound<'py, PyAny>> {
        self.array("QuatfArray", conventions::quaternion_memory_order(values).as_flattened(), 4)
    }

    /// `GfVec3d`.
    pub(crate) fn vec3d(&self, v: glam::DVec3) -> PyResult<Bound<'py, PyAny>> {
        self.gf.call_method1("Vec3d", (v.x, v.y, v.z))
    }

    /// `GfQuatf`.
    pub(crate) fn quatf(&self, q: glam::DQuat) -> PyResult<Bound<'py, PyAny>> {
        self.gf.call_method1("Quatf", (q.w, q.x, q.y, q.z))
    }

    /// `UsdTimeCode`; the default time for `None`.
    pub(crate) fn time_code(&self, time_code: Option<f64>) -> PyResult<Bound<'py, PyAny>> {
        let class = self.usd.getattr("TimeCode")?;
        match time_code {
            Some(value) => class.call1((value,)),
            None => class.call_method0("Default"),
        }
    }

    /// The time at which a value without samples is itself, and a sampled one is its first sample.
    pub(crate) fn earliest(&self) -> PyResult<Bound<'py, PyAny>> {
        self.usd.getattr("TimeCode")?.call_method0("EarliestTime")
    }

    /// `SdfValueTypeNames.<name>`.
    pub(crate) fn value_type(&self, name: &str) -> PyResult<Bound<'py, PyAny>> {
        self.sdf.getattr("ValueTypeNames")?.getattr(name)
    }

    /// A dictionary of simple values.
    pub(crate) fn dictionary(&self) -> Bound<'py, PyDict> {
        PyDict::new(self.py)
    }
}
