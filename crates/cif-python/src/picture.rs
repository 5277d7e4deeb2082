//! Pictures that notebooks show.

use std::path::PathBuf;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use cif::output::check_file;
use cif::pictures::{depth_picture, instance_color, instance_picture, png_bytes, rgb_picture, save_rgb};
use cif_dataset::Dataset;
use cif_field::Field;
use cif_render::Channels;
use cif_train::metrics::mask_ids;
use numpy::PyArray3;
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::camera::Camera;
use crate::error::cif_error;
use crate::{arrays, process, rendering};

/// An 8-bit RGB picture, as drawn by `show`; notebooks show it.
#[pyclass(frozen, module = "cif")]
pub(crate) struct Picture {
    inner: cif::pictures::Picture,
}

impl Picture {
    fn png(&self, py: Python<'_>) -> PyResult<Vec<u8>> {
        process::detach(py, || png_bytes(&self.inner).map_err(|error| error.with_help()))?.map_err(cif_error)
    }

    /// The picture as an element that needs nothing else.
    pub(crate) fn as_html(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("<img src=\"data:image/png;base64,{}\">", BASE64_STANDARD.encode(self.png(py)?)))
    }
}

#[pymethods]
impl Picture {
    /// Colours, uint8 `[H, W, 3]`; read-only.
    #[getter]
    fn pixels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        arrays::color_image(py, self.inner.clone()).map(arrays::read_only)
    }

    /// Write a PNG file; one that exists is only replaced with force.
    #[pyo3(signature = (path, *, force=false))]
    fn save(&self, path: PathBuf, force: bool) -> PyResult<()> {
        if path.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("png")) {
            let problem = format!("{}: pictures are written as PNG; end the name in .png", path.display());
            return Err(cif_error(problem));
        }
        let written = check_file(&path, force).and_then(|()| save_rgb(&path, &self.inner));
        written.map_err(|error| cif_error(error.with_help()))
    }

    fn _repr_png_<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.png(py)?))
    }

    fn __repr__(&self) -> String {
        format!("Picture({} x {})", self.inner.width, self.inner.height)
    }
}

/// A view to draw.
#[derive(FromPyObject)]
pub(crate) enum View {
    /// A captured one, by its place among the cameras.
    Captured(usize),
    /// Any other.
    Camera(Camera),
}

fn unknown(what: &str, known: &str) -> PyErr {
    PyValueError::new_err(format!("what '{what}': choose {known}"))
}

/// A view of a field.
pub(crate) fn of_field(
    py: Python<'_>,
    field: &Field,
    view: View,
    time: Option<f64>,
    what: &str,
) -> PyResult<Picture> {
    let recorded = &field.cameras;
    let (camera, own) = match view {
        View::Camera(camera) => (camera, 0.0),
        View::Captured(index) => {
            let Some(view) = recorded.get(index) else {
                let count = recorded.len();
                return Err(PyIndexError::new_err(format!("view {index} of {count}; or give a camera")));
            };
            (Camera { inner: view.camera }, field.timeline.times[view.time_index])
        }
    };
    let channels = Channels { depth: what == "depth-color", instances: what == "instance-color" };
    if what != "rgb" && !channels.depth && !channels.instances {
        return Err(unknown(what, "rgb, instance-color or depth-color"));
    }
    let image = rendering::render(py, field, &camera, time.unwrap_or(own), channels)?;
    let inner = match (&image.instances, &image.depth) {
        (Some(layers), _) => instance_picture(&mask_ids(field, &layers.label), &layers.foreground),
        (None, Some(depth)) => depth_picture(depth),
        (None, None) if channels.instances => {
            return Err(cif_error("the field has no instances to show: it was made without masks"));
        }
        (None, None) => rgb_picture(&image.color),
    };
    Ok(Picture { inner })
}

/// A frame of a capture, which has it.
pub(crate) fn of_frame(py: Python<'_>, dataset: &Dataset, index: usize, what: &str) -> PyResult<Picture> {
    let name = &dataset.frames[index].name;
    if !matches!(what, "rgb" | "instance-color") {
        return Err(unknown(what, "rgb or instance-color"));
    }
    let data = process::detach(py, || dataset.load_frame(index, [1.0; 3]))?.map_err(cif_error)?;
    if what == "rgb" {
        return Ok(Picture { inner: data.image });
    }
    let mask = data.mask.ok_or_else(|| cif_error(format!("frame {name} has no mask")))?;
    Ok(Picture { inner: mask.map(|&id| instance_color(id)) })
}
