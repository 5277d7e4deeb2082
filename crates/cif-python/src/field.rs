//! Trained scenes: arrays, rendering, queries.

use std::path::PathBuf;
use std::sync::OnceLock;

use cif::lock::Lock;
use cif::output;
use cif_field::{Gaussians, RecordedCamera};
use cif_geometry::scalar::sigmoid;
use cif_geometry::spherical_harmonics::COEFFICIENTS;
use cif_render::Channels;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_scene::{SceneGraph, SceneOptions};
use cif_system::memory::Need;
use glam::DVec3;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::camera::Camera;
use crate::error::cif_error;
use crate::from_arrays::FromArrays;
use crate::picture::{Picture, View};
use crate::{arrays, export, objects, picture, process, rendering, tables};

/// A dynamic Gaussian field with instances: N Gaussians, K instances, T captured times.
///
/// A field does not change: its arrays are copies that numpy refuses to write to. To change one, copy it, and
/// make a field of arrays with `from_arrays`.
#[pyclass(frozen, module = "cif")]
pub(crate) struct Field {
    pub(crate) inner: cif_field::Field,
    /// The scene graph that objects are looked up in, made by the first question.
    graph: OnceLock<Result<SceneGraph, String>>,
}

impl Field {
    pub(crate) fn new(inner: cif_field::Field) -> Self {
        Self { inner, graph: OnceLock::new() }
    }

    /// The scene graph, without stand-ins and colliders.
    fn graph(&self, py: Python<'_>) -> PyResult<&SceneGraph> {
        let build = || {
            let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
            cif_scene::build(&self.inner, &options).map_err(|error| error.to_string())
        };
        process::detach(py, || self.graph.get_or_init(build))?.as_ref().map_err(cif_error)
    }
}

/// Memory of the probabilities of every instance in each of some rows.
fn memory_of_rows(rows: usize, name: &str, instances: usize, item: usize) -> Need {
    let bytes = (rows as u64).saturating_mul(instances as u64).saturating_mul(item as u64);
    Need { bytes, arithmetic: format!("{rows} {name} x {instances} instances x {item} bytes") }
}

#[pymethods]
impl Field {
    /// Read a .cif file.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let inner = process::detach(py, || cif_field::Field::load(&path))?.map_err(cif_error)?;
        Ok(Self::new(inner))
    }

    /// Write a .cif file, replacing an older one only once the new one is complete.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        process::detach(py, || {
            output::check_file(&path, true)?;
            let _lock = Lock::wait(&path)?;
            self.inner.save(&path).map_err(cif::Error::plain)
        })?
        .map_err(|error| cif_error(error.with_help()))
    }

    /// Make a static field.
    ///
    /// means, scales (standard deviations) and colors are float32 `[N, 3]`, quaternions `[N, 4]`, opacities and
    /// occupancies (opacities by default) `[N]`, identities `[N, K]` probabilities, where what a row lacks of 1
    /// belongs to no instance. instances have id, label and category; cameras are (name, index into times,
    /// camera).
    #[staticmethod]
    #[pyo3(signature = (*, means, scales, quaternions, opacities, colors, occupancies=None, identities=None,
                        instances=None, times=vec![0.0], frames_per_second=24.0, cameras=None,
                        background=(1.0, 1.0, 1.0)))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments of a constructor")]
    fn from_arrays(
        means: PyReadonlyArrayDyn<'_, f32>,
        scales: PyReadonlyArrayDyn<'_, f32>,
        quaternions: PyReadonlyArrayDyn<'_, f32>,
        opacities: PyReadonlyArrayDyn<'_, f32>,
        colors: PyReadonlyArrayDyn<'_, f32>,
        occupancies: Option<PyReadonlyArrayDyn<'_, f32>>,
        identities: Option<PyReadonlyArrayDyn<'_, f32>>,
        instances: Option<Bound<'_, PyList>>,
        times: Vec<f64>,
        frames_per_second: f64,
        cameras: Option<Vec<(String, usize, Camera)>>,
        background: (f32, f32, f32),
    ) -> PyResult<Self> {
        let arrays = FromArrays {
            means,
            scales,
            quaternions,
            opacities,
            colors,
            occupancies,
            identities,
            instances,
            times,
            frames_per_second,
            cameras,
            background,
        };
        Ok(Self::new(arrays.field()?))
    }

    fn __len__(&self) -> usize {
        self.inner.gaussians.len()
    }

    fn __repr__(&self) -> String {
        let (n, k) = (self.inner.gaussians.len(), self.inner.instances.len());
        format!("Field({n} Gaussians, {k} instances, {} times)", self.inner.timeline.times.len())
    }

    /// The first view and the objects as a table, for notebooks.
    fn _repr_html_(&self, py: Python<'_>) -> PyResult<String> {
        // A view that memory does not hold is none to fail for.
        let view = picture::of_field(py, &self.inner, View::Captured(0), None, "rgb");
        let still = view.ok().map(|view| view.as_html(py)).transpose()?.unwrap_or_default();
        Ok(still + &tables::of_field(&self.inner))
    }

    /// Centres before any motion, float32 `[N, 3]`, in the frame of the field; read-only.
    #[getter]
    fn means<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &self.inner.gaussians.means).map(arrays::read_only)
    }

    /// Standard deviations along the axes before any motion, float32 `[N, 3]`; read-only.
    #[getter]
    fn scales<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &scales_of(&self.inner.gaussians)).map(arrays::read_only)
    }

    /// Quaternions (w, x, y, z) before any motion, not normalised, float32 `[N, 4]`; read-only.
    #[getter]
    fn quaternions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &self.inner.gaussians.quaternions).map(arrays::read_only)
    }

    /// Opacities in [0, 1], float32 `[N]`; read-only.
    #[getter]
    fn opacities<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let logits = self.inner.gaussians.opacity_logits.iter().copied();
        arrays::read_only(PyArray1::from_iter(py, logits.map(sigmoid)))
    }

    /// Probabilities to exist, in [0, 1], float32 `[N]`; read-only.
    #[getter]
    fn occupancies<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let logits = self.inner.gaussians.occupancy_logits.iter().copied();
        arrays::read_only(PyArray1::from_iter(py, logits.map(sigmoid)))
    }

    /// Spherical harmonics, float32 `[N, 16, 3]`; those above sh_degree are not in use; read-only.
    #[getter]
    fn sh_coefficients<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let sh = &self.inner.gaussians.sh_coefficients;
        let flat = PyArray1::from_slice(py, sh.as_flattened());
        flat.reshape([sh.len(), COEFFICIENTS, 3]).map(arrays::read_only)
    }

    /// Degree of the spherical harmonics in use, 0 to 3.
    #[getter]
    fn sh_degree(&self) -> u8 {
        self.inner.sh_degree
    }

    /// Probability of every instance, float32 `[N, K]`, read-only; None before identities were estimated.
    #[getter]
    fn identities<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let Some(rows) = &self.inner.identities else { return Ok(None) };
        let instances = self.inner.instances.len();
        memory_of_rows(rows.len(), "Gaussians", instances, size_of::<f32>()).check().map_err(cif_error)?;
        let probabilities = rows.probabilities();
        let mut dense = vec![0.0_f32; rows.len() * instances];
        for row in 0..rows.len() {
            for entry in rows.range(row) {
                dense[row * instances + usize::from(rows.labels[entry])] = probabilities[entry];
            }
        }
        let dense = PyArray1::from_vec(py, dense).reshape([rows.len(), instances])?;
        Ok(Some(arrays::read_only(dense)))
    }

    /// id (value in the masks), label and category of every instance, in the order of identities.
    #[getter]
    fn instances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.instances)
    }

    /// Captured times, normalised to [0, 1].
    #[getter]
    fn times(&self) -> Vec<f64> {
        self.inner.timeline.times.clone()
    }

    /// Captured frames per second; the time code of frame k is k.
    #[getter]
    fn frames_per_second(&self) -> f64 {
        self.inner.timeline.frames_per_second
    }

    /// (name, index into times, camera) of every captured view.
    #[getter]
    fn cameras(&self) -> Vec<(String, usize, Camera)> {
        let of = |recorded: &RecordedCamera| {
            (recorded.name.clone(), recorded.time_index, Camera { inner: recorded.camera })
        };
        self.inner.cameras.iter().map(of).collect()
    }

    /// How the field came about: its run, settings and notes.
    #[getter]
    fn provenance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.record.to_json())
    }

    /// Return means, scales, quaternions and opacities as they are at a normalised time.
    fn at<'py>(&self, py: Python<'py>, time: f64) -> PyResult<Bound<'py, PyDict>> {
        check_time(time)?;
        let moved = process::detach(py, || Renderer::new(SimdLevel::Auto).deform(&self.inner, time))?;
        let out = PyDict::new(py);
        out.set_item("means", arrays::matrix(py, &moved.means)?)?;
        out.set_item("scales", arrays::matrix(py, &scales_of(&moved))?)?;
        out.set_item("quaternions", arrays::matrix(py, &moved.quaternions)?)?;
        let opacities = moved.opacity_logits.iter().copied().map(sigmoid);
        out.set_item("opacities", PyArray1::from_iter(py, opacities))?;
        Ok(out)
    }

    /// Render a view at a normalised time, as arrays.
    ///
    /// color is float32 `[H, W, 3]` in [0, 1], alpha `[H, W]`, depth `[H, W]` in units of the field; where the
    /// field has identities also label (index into instances plus 1, 0 for none), probability, coverage,
    /// foreground and entropy, `[H, W]` each.
    #[pyo3(signature = (camera, time=0.0, *, depth=true, instances=true))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        camera: Camera,
        time: f64,
        depth: bool,
        instances: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        check_time(time)?;
        let image = rendering::render(py, &self.inner, &camera, time, Channels { depth, instances })?;
        let out = PyDict::new(py);
        out.set_item("color", arrays::color_image(py, image.color)?)?;
        out.set_item("alpha", arrays::image(py, image.alpha)?)?;
        if let Some(depth) = image.depth {
            out.set_item("depth", arrays::image(py, depth)?)?;
        }
        if let Some(instances) = image.instances {
            out.set_item("label", arrays::image(py, instances.label)?)?;
            out.set_item("probability", arrays::image(py, instances.probability)?)?;
            out.set_item("coverage", arrays::image(py, instances.coverage)?)?;
            out.set_item("foreground", arrays::image(py, instances.foreground)?)?;
            out.set_item("entropy", arrays::image(py, instances.entropy)?)?;
        }
        Ok(out)
    }

    /// Render a view as a picture, which notebooks show.
    ///
    /// view is an index into cameras (by default the first), or a camera; time is normalised, by default that
    /// of the view, or 0. what is "rgb", "instance-color" (the most probable instance of each pixel) or
    /// "depth-color" (near is bright).
    #[pyo3(signature = (view=None, time=None, *, what="rgb"))]
    fn show(&self, py: Python<'_>, view: Option<View>, time: Option<f64>, what: &str) -> PyResult<Picture> {
        time.map_or(Ok(()), check_time)?;
        picture::of_field(py, &self.inner, view.unwrap_or(View::Captured(0)), time, what)
    }

    /// Answer what is at points at a normalised time.
    ///
    /// points are float64 `[P, 3]` in the frame of the field. existence is `[P]`, instance `[P]` (index into
    /// instances, -1 for none), probabilities `[P, K]`.
    #[pyo3(signature = (points, time=0.0))]
    fn query<'py>(
        &self,
        py: Python<'py>,
        points: PyReadonlyArrayDyn<'py, f64>,
        time: f64,
    ) -> PyResult<Bound<'py, PyDict>> {
        check_time(time)?;
        let (count, instances) = (points.shape().first().copied().unwrap_or(0), self.inner.instances.len());
        memory_of_rows(count, "points", instances, size_of::<f64>()).check().map_err(cif_error)?;
        let points: Vec<DVec3> =
            arrays::rows::<f64, 3>("points", &points)?.into_iter().map(DVec3::from_array).collect();
        let answers = process::detach(py, || self.inner.query(&points, time))?;
        let mut probabilities = vec![0.0_f64; answers.len() * instances];
        for (answer, row) in answers.iter().zip(probabilities.chunks_exact_mut(instances.max(1))) {
            for (label, probability) in &answer.identity {
                row[usize::from(*label)] = *probability;
            }
        }
        let out = PyDict::new(py);
        out.set_item("existence", PyArray1::from_iter(py, answers.iter().map(|a| a.existence)))?;
        let best = answers.iter().map(|answer| answer.instance().map_or(-1, i32::from));
        out.set_item("instance", PyArray1::from_iter(py, best))?;
        let probabilities = PyArray1::from_vec(py, probabilities).reshape([answers.len(), instances])?;
        out.set_item("probabilities", probabilities)?;
        Ok(out)
    }

    /// Return the objects that carry a label, each as a dictionary.
    ///
    /// label is a label, class or unique name; `*` stands for any characters, `?` for one, and case does not
    /// matter. Each has path, class, instance (unique name), label, transform (`[4][4]`, world from object, for
    /// column vectors) and low and high, the corners of its box in the world of the capture, at a time code
    /// (captured frame number, by default the first). The first call builds the scene graph, which the field
    /// keeps. Raises CifError, with the labels there are, where nothing carries it.
    #[pyo3(signature = (label, time_code=None))]
    fn find<'py>(
        &self,
        py: Python<'py>,
        label: String,
        time_code: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        objects::find(py, self.graph(py)?, label, time_code)
    }

    /// Return the path of an object over all captured frames, as arrays.
    ///
    /// label is as in find, and has to fit one object. The answer has instance (unique name), label and class;
    /// time_codes (captured frame numbers), times (normalised) and seconds (time codes over frames_per_second),
    /// float64 `[T]`; translations, float64 `[T, 3]`, the origin of the object's frame in the world of the
    /// capture, in its units: at the first frame the middle of the object; rotations, float64 `[T, 4]`, unit
    /// quaternions (w, x, y, z) from the object's frame to the world, the identity while it is turned as at the
    /// first frame, and without jumps of sign; visible, bool `[T]`. An object of parts goes with its largest
    /// part, one that bends with the rigid body that fits it best. Raises CifError where no object, or more
    /// than one, carries the label.
    fn trajectory<'py>(&self, py: Python<'py>, label: String) -> PyResult<Bound<'py, PyDict>> {
        objects::trajectory(py, self.graph(py)?, label)
    }

    /// Write the scene with one prim or node per object.
    ///
    /// The ending decides the format: .usda, .usdc, .usdz (USD), .glb, .gltf (glTF) or .ply (splats). glTF
    /// holds rigid motion only: what deforms leaves as a few rigid parts; the motion table says what that
    /// misses. PLY holds all splats as they stand at one frame.
    ///
    /// motion replaces the trained deformation by a function of time that returns means `[N, 3]` and
    /// quaternions `[N, 4]`. options are those of the format, as in {"payloads": "separate"}; other keyword
    /// arguments are options of the scene, whatever the format, as in tolerance="0.5%". Unknown ones raise
    /// ValueError. The answer holds the motion table, sizes and warnings. A file that cif did not write is only
    /// replaced with force.
    #[pyo3(signature = (path, *, motion=None, options=None, force=false, **scene))]
    fn export<'py>(
        &self,
        py: Python<'py>,
        path: PathBuf,
        motion: Option<Bound<'py, PyAny>>,
        options: Option<Bound<'py, PyDict>>,
        force: bool,
        scene: Option<Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        export::export(py, &self.inner, &path, motion, options.as_ref(), force, scene.as_ref())
    }
}

fn check_time(time: f64) -> PyResult<()> {
    if (0.0..=1.0).contains(&time) {
        Ok(())
    } else {
        Err(PyValueError::new_err(format!("time {time}: times run from 0 to 1")))
    }
}

fn scales_of(gaussians: &Gaussians) -> Vec<[f32; 3]> {
    gaussians.log_scales.iter().map(|scale| scale.map(f32::exp)).collect()
}
