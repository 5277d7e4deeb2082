//! Pinhole cameras.

use cif_geometry::camera::check_image_size;
use cif_geometry::{PinholeCamera, RigidTransform};
use glam::{DMat3, DVec2, DVec3};
use numpy::{PyArray2, PyReadonlyArrayDyn};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays;

/// Largest deviation of a given rotation from orthonormal.
const ORTHONORMAL: f64 = 1e-4;

/// A pinhole camera: x right, y down, z forward; the centre of the first pixel is (0.5, 0.5).
///
/// Width, height, focal lengths and principal point are in pixels; camera_from_world is a `[4, 4]` pose. By
/// default the principal point is the middle of the image, and the pose the identity.
#[pyclass(frozen, from_py_object, module = "cif")]
#[derive(Clone)]
pub(crate) struct Camera {
    pub(crate) inner: PinholeCamera,
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (width, height, focal, principal=None, camera_from_world=None))]
    fn new(
        width: u32,
        height: u32,
        focal: (f64, f64),
        principal: Option<(f64, f64)>,
        camera_from_world: Option<PyReadonlyArrayDyn<'_, f64>>,
    ) -> PyResult<Self> {
        check_image_size(width, height).map_err(PyValueError::new_err)?;
        if !(focal.0 > 0.0 && focal.1 > 0.0) {
            return Err(PyValueError::new_err("both focal lengths must be above 0"));
        }
        let centre = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        let principal = principal.unwrap_or(centre);
        let camera_from_world = match camera_from_world {
            None => RigidTransform::IDENTITY,
            Some(matrix) => transform(&arrays::rows::<f64, 4>("camera_from_world", &matrix)?)?,
        };
        let inner = PinholeCamera {
            width,
            height,
            focal_px: DVec2::new(focal.0, focal.1),
            principal_px: DVec2::new(principal.0, principal.1),
            camera_from_world,
        };
        Ok(Self { inner })
    }

    /// Width, pixels.
    #[getter]
    fn width(&self) -> u32 {
        self.inner.width
    }

    /// Height, pixels.
    #[getter]
    fn height(&self) -> u32 {
        self.inner.height
    }

    /// Focal lengths (x, y), pixels.
    #[getter]
    fn focal(&self) -> (f64, f64) {
        self.inner.focal_px.into()
    }

    /// Principal point (x, y), pixels.
    #[getter]
    fn principal(&self) -> (f64, f64) {
        self.inner.principal_px.into()
    }

    /// Pose, float64 `[4, 4]`: takes column vectors of the world to the camera; read-only.
    #[getter]
    fn camera_from_world<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let RigidTransform { rotation, translation } = self.inner.camera_from_world;
        let rows: [[f64; 4]; 4] = std::array::from_fn(|row| match row {
            3 => [0.0, 0.0, 0.0, 1.0],
            _ => {
                let r = rotation.row(row);
                [r.x, r.y, r.z, translation[row]]
            }
        });
        arrays::matrix(py, &rows).map(arrays::read_only)
    }

    /// Return the same view at another resolution.
    fn resized(&self, width: u32, height: u32) -> PyResult<Self> {
        check_image_size(width, height).map_err(PyValueError::new_err)?;
        Ok(Self { inner: self.inner.resized(width, height) })
    }

    fn __repr__(&self) -> String {
        let PinholeCamera { width, height, focal_px, .. } = self.inner;
        format!("Camera({width} x {height}, focal ({:.1}, {:.1}))", focal_px.x, focal_px.y)
    }
}

fn transform(rows: &[[f64; 4]]) -> PyResult<RigidTransform> {
    let [a, b, c, last] = rows else {
        return Err(PyValueError::new_err("camera_from_world must be [4, 4]"));
    };
    let row = |r: &[f64; 4]| DVec3::new(r[0], r[1], r[2]);
    let rotation = DMat3::from_cols(row(a), row(b), row(c)).transpose();
    let transform = RigidTransform { rotation, translation: DVec3::new(a[3], b[3], c[3]) };
    let error = transform.orthonormality_error();
    if !(error <= ORTHONORMAL && transform.translation.is_finite()) || *last != [0.0, 0.0, 0.0, 1.0] {
        return Err(PyValueError::new_err(
            "camera_from_world must be a rotation and a translation, last row (0, 0, 0, 1)",
        ));
    }
    Ok(transform)
}
