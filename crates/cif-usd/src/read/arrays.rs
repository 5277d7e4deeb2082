//! Arrays as buffers.

use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

use crate::pxr::Pxr;

/// Times the size of its files that a stage may claim in memory. Arrays of a file compress a little, and one payload
/// may serve many prims; claims beyond that are mistakes or attacks.
const EXPANSION: u64 = 256;
/// Bytes that a stage may claim in any case, on top of the multiple of its files.
const ALLOWANCE: u64 = 64 << 20;

/// Reads arrays, and keeps the sum of them inside a bound.
pub(super) struct Arrays<'a, 'py> {
    pxr: &'a Pxr<'py>,
    numpy: Bound<'py, PyModule>,
    left: std::cell::Cell<u64>,
}

/// Why an array cannot be read.
pub(super) enum ArrayError {
    /// Not an array of this many columns; what it is instead.
    Shape(String),
    /// More than the files can hold.
    TooLarge,
    /// Python.
    Python(PyErr),
}

impl From<PyErr> for ArrayError {
    fn from(error: PyErr) -> Self {
        Self::Python(error)
    }
}

impl<'a, 'py> Arrays<'a, 'py> {
    /// For a stage whose files have this size.
    pub(super) fn new(pxr: &'a Pxr<'py>, file_bytes: u64) -> PyResult<Self> {
        let left = std::cell::Cell::new(file_bytes.saturating_mul(EXPANSION).saturating_add(ALLOWANCE));
        Ok(Self { pxr, numpy: pxr.py.import("numpy")?, left })
    }

    fn claim(&self, bytes: usize) -> Result<(), ArrayError> {
        let left = self.left.get().checked_sub(bytes as u64).ok_or(ArrayError::TooLarge)?;
        self.left.set(left);
        Ok(())
    }

    fn flat<T: numpy::Element + Copy>(
        &self,
        value: &Bound<'py, PyAny>,
        columns: usize,
        dtype: &str,
    ) -> Result<Vec<T>, ArrayError> {
        let count = value.len().map_err(|_| ArrayError::Shape("no array".to_owned()))?;
        self.claim(count.saturating_mul(columns * size_of::<T>()))?;
        let dtype = [("dtype", dtype)].into_py_dict(self.pxr.py)?;
        let array = self.numpy.call_method("ascontiguousarray", (value,), Some(&dtype));
        let array = array.map_err(|_| ArrayError::Shape("no array of numbers".to_owned()))?;
        let array: PyReadonlyArrayDyn<'py, T> =
            array.extract().map_err(|_| ArrayError::Shape("no array of numbers".to_owned()))?;
        let shape = array.shape();
        let fits = match shape {
            [_] => columns == 1,
            [_, found] => *found == columns,
            _ => false,
        };
        if count > 0 && !fits {
            return Err(ArrayError::Shape(format!("an array of shape {shape:?}")));
        }
        array
            .as_array()
            .to_slice()
            .map(<[T]>::to_vec)
            .ok_or_else(|| ArrayError::Shape("no flat array".into()))
    }

    /// Floats of any precision, in rows of `C`.
    pub(super) fn floats<const C: usize>(
        &self,
        value: &Bound<'py, PyAny>,
    ) -> Result<Vec<[f32; C]>, ArrayError> {
        let flat: Vec<f32> = self.flat(value, C, "float32")?;
        Ok(flat.as_chunks::<C>().0.to_vec())
    }

    /// Doubles in rows of three; `None` for an array of another type.
    pub(super) fn doubles(&self, value: &Bound<'py, PyAny>) -> Result<Option<Vec<[f64; 3]>>, ArrayError> {
        if value.get_type().name()? != "Vec3dArray" {
            return Ok(None);
        }
        let flat: Vec<f64> = self.flat(value, 3, "float64")?;
        Ok(Some(flat.as_chunks::<3>().0.to_vec()))
    }

    /// Scalars.
    pub(super) fn scalars(&self, value: &Bound<'py, PyAny>) -> Result<Vec<f32>, ArrayError> {
        self.flat(value, 1, "float32")
    }

    /// Triples, without their boundaries.
    pub(super) fn triples(&self, value: &Bound<'py, PyAny>) -> Result<Vec<f32>, ArrayError> {
        self.flat(value, 3, "float32")
    }

    /// Integers.
    pub(super) fn ints(&self, value: &Bound<'py, PyAny>) -> Result<Vec<i32>, ArrayError> {
        self.flat(value, 1, "int32")
    }
}
