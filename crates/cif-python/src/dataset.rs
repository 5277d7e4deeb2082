//! Captures.

use std::path::PathBuf;

use cif_dataset::TimeWindow;
use numpy::PyArray2;
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::camera::Camera;
use crate::error::cif_error;
use crate::picture::Picture;
use crate::{arrays, picture, process, tables};

/// A capture, understood: frames, cameras, times, masks, instances, initial points.
#[pyclass(frozen, module = "cif")]
pub(crate) struct Dataset {
    pub(crate) inner: cif_dataset::Dataset,
    /// Reduction that it was opened with.
    pub(crate) downscale: Option<u32>,
}

/// Open a capture.
///
/// masks names a folder inside it or anywhere, by default "masks" where it has one; downscale reduces images
/// by 1, 2, 4 and so on, by default to the largest stored. window takes one of several windows of time of a long
/// capture, "2/4" the second of four.
#[pyfunction]
#[pyo3(signature = (path, masks=None, downscale=None, window=None))]
pub(crate) fn open_dataset(
    py: Python<'_>,
    path: PathBuf,
    masks: Option<PathBuf>,
    downscale: Option<u32>,
    window: Option<&str>,
) -> PyResult<Dataset> {
    let window = window_of(window)?;
    let options =
        cif_dataset::OpenOptions { masks, downscale, window, ..cif_dataset::OpenOptions::default() };
    let inner = process::detach(py, || cif_dataset::Dataset::open(&path, &options))?.map_err(cif_error)?;
    Ok(Dataset { inner, downscale })
}

/// A window of time by its text.
pub(crate) fn window_of(text: Option<&str>) -> PyResult<Option<TimeWindow>> {
    text.map(|text| text.parse().map_err(PyValueError::new_err)).transpose()
}

impl Dataset {
    fn frame_at(&self, index: usize) -> PyResult<&cif_dataset::Frame> {
        self.inner.frames.get(index).ok_or_else(|| {
            PyIndexError::new_err(format!("frame {index} of {} frames", self.inner.frames.len()))
        })
    }
}

#[pymethods]
impl Dataset {
    /// Folder of the capture.
    #[getter]
    fn root(&self) -> PathBuf {
        self.inner.root.clone()
    }

    /// Layout that the folder was read as.
    #[getter]
    fn layout<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.layout)
    }

    /// Captured times, normalised to [0, 1].
    #[getter]
    fn times(&self) -> Vec<f64> {
        self.inner.times.clone()
    }

    /// id (value in the masks), label and category of every instance.
    #[getter]
    fn instances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.instances)
    }

    /// Oddities that were met when the capture was read.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.inner.warnings.clone()
    }

    /// Findings and decisions of reading, such as what is left out, one sentence each.
    #[getter]
    fn notes(&self) -> Vec<String> {
        self.inner.notes.clone()
    }

    /// name, camera_name, time, time_index, split, group, image and mask of every frame.
    #[getter]
    fn frames<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let frames = PyList::empty(py);
        for frame in &self.inner.frames {
            let entry = PyDict::new(py);
            entry.set_item("name", &frame.name)?;
            entry.set_item("camera_name", &frame.camera_name)?;
            entry.set_item("time", frame.time)?;
            entry.set_item("time_index", frame.time_index)?;
            entry.set_item("split", arrays::to_python(py, &frame.split)?)?;
            entry.set_item("group", frame.group.as_deref())?;
            entry.set_item("image", &frame.image)?;
            entry.set_item("mask", frame.mask.as_deref())?;
            frames.append(entry)?;
        }
        Ok(frames)
    }

    fn __len__(&self) -> usize {
        self.inner.frames.len()
    }

    /// Return the camera of a frame.
    fn camera(&self, index: usize) -> PyResult<Camera> {
        Ok(Camera { inner: self.frame_at(index)?.camera })
    }

    /// Load image, uint8 `[H, W, 3]`, and mask, uint16 `[H, W]` (None without one), of a frame.
    ///
    /// Transparent pixels show the background.
    #[pyo3(signature = (index, background=(1.0, 1.0, 1.0)))]
    fn load_frame<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        background: (f32, f32, f32),
    ) -> PyResult<Bound<'py, PyDict>> {
        self.frame_at(index)?;
        let background = [background.0, background.1, background.2];
        let data = process::detach(py, || self.inner.load_frame(index, background))?.map_err(cif_error)?;
        let out = PyDict::new(py);
        out.set_item("image", arrays::color_image(py, data.image)?)?;
        out.set_item("mask", data.mask.map(|mask| arrays::image(py, mask)).transpose()?)?;
        Ok(out)
    }

    /// Draw a frame as a picture, which notebooks show.
    ///
    /// what is "rgb" or "instance-color" (the mask in the colours of its instances).
    #[pyo3(signature = (index=0, *, what="rgb"))]
    fn show(&self, py: Python<'_>, index: usize, what: &str) -> PyResult<Picture> {
        self.frame_at(index)?;
        picture::of_frame(py, &self.inner, index, what)
    }

    /// The first frame and the counts as a table, for notebooks.
    fn _repr_html_(&self, py: Python<'_>) -> PyResult<String> {
        // An image that cannot be read is an error of what needs it.
        let frame = self.show(py, 0, "rgb");
        let still = frame.ok().map(|frame| frame.as_html(py)).transpose()?.unwrap_or_default();
        Ok(still + &tables::of_summary(&self.__repr__(), &self.summary(py)?)?)
    }

    /// Initial points, float32 `[P, 3]`; read-only.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &self.inner.points.positions).map(arrays::read_only)
    }

    /// Colours of the initial points, uint8 `[P, 3]`; read-only.
    #[getter]
    fn point_colors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u8>>> {
        arrays::matrix(py, &self.inner.points.colors).map(arrays::read_only)
    }

    /// Return counts of everything, for a first look.
    fn summary<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let frames = &self.inner.frames;
        let count = |split| frames.iter().filter(|frame| frame.split == split).count();
        let mut cameras: Vec<&str> = frames.iter().map(|frame| frame.camera_name.as_str()).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let summary = PyDict::new(py);
        summary.set_item("layout", arrays::to_python(py, &self.inner.layout)?)?;
        summary.set_item("frames", frames.len())?;
        summary.set_item("train", count(cif_dataset::Split::Train))?;
        summary.set_item("val", count(cif_dataset::Split::Val))?;
        summary.set_item("cameras", cameras.len())?;
        summary.set_item("times", self.inner.times.len())?;
        let size = frames.first().map(|frame| (frame.camera.width, frame.camera.height));
        summary.set_item("resolution", size)?;
        summary.set_item("masks", frames.iter().filter(|frame| frame.mask.is_some()).count())?;
        summary.set_item("instances", self.inner.instances.len())?;
        summary.set_item("points", self.inner.points.positions.len())?;
        Ok(summary)
    }

    fn __repr__(&self) -> String {
        format!("Dataset({}, {} frames)", self.inner.root.display(), self.inner.frames.len())
    }
}
