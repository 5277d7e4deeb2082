//! Trained scenes: arrays, rendering, queries.

use std::collections::BTreeMap;

use std::path::PathBuf;

use cif_field::{Gaussians, Identities, Instance, RecordedCamera, SortMetric, Timeline};
use cif_geometry::scalar::sigmoid;
use cif_geometry::spherical_harmonics::{BAND_0, COEFFICIENTS};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use glam::DVec3;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::camera::Camera;
use crate::error::cif_error;
use crate::{arrays, export};

/// Opacities and occupancies are kept this far from 0 and 1, where logits end.
const UNIT_MARGIN: f32 = 1e-6;

/// A dynamic Gaussian field with instances.
#[pyclass(frozen, module = "cif")]
pub(crate) struct Field {
    pub(crate) inner: cif_field::Field,
}

fn logits(name: &str, probabilities: &[f32]) -> PyResult<Vec<f32>> {
    if !probabilities.iter().all(|p| (0.0..=1.0).contains(p)) {
        return Err(PyValueError::new_err(format!("{name} must lie in [0, 1]")));
    }
    let logit = |p: &f32| {
        let p = p.clamp(UNIT_MARGIN, 1.0 - UNIT_MARGIN);
        (p / (1.0 - p)).ln()
    };
    Ok(probabilities.iter().map(logit).collect())
}

/// `[N, K]` probabilities as sparse rows; what a row lacks of one belongs to no instance.
fn sparse_identities(probabilities: &PyReadonlyArrayDyn<'_, f32>, instances: usize) -> PyResult<Identities> {
    let shape = probabilities.shape();
    if shape.len() != 2 || shape[1] != instances || instances == 0 {
        return Err(PyValueError::new_err(format!(
            "identities have the shape {shape:?}, but must be [N, {instances}]: one column per instance"
        )));
    }
    let mut identities = Identities {
        row_offsets: vec![0],
        labels: Vec::new(),
        log_estimates: Vec::new(),
        log_calibrations: Vec::new(),
        owners: Vec::new(),
    };
    for (index, row) in arrays::values(probabilities).chunks_exact(instances).enumerate() {
        if let Some(column) = row.iter().position(|value| !(value.is_finite() && *value >= 0.0)) {
            return Err(PyValueError::new_err(format!(
                "identities hold {} at row {index}, column {column}: probabilities are finite and at least 0",
                row[column]
            )));
        }
        // What a row lacks of one belongs to no instance.
        let sum: f32 = row.iter().sum();
        if sum <= 0.0 {
            identities.push_certain(None);
            continue;
        }
        for (label, &probability) in row.iter().enumerate() {
            let probability = probability / sum.max(1.0);
            if probability > 0.0 {
                identities.labels.push(u16::try_from(label).map_err(cif_error)?);
                identities.log_estimates.push(probability.ln());
                identities.log_calibrations.push(0.0);
            }
        }
        identities.row_offsets.push(u32::try_from(identities.labels.len()).map_err(cif_error)?);
    }
    Ok(identities)
}

fn instance_table(entries: &Bound<'_, PyList>) -> PyResult<Vec<Instance>> {
    entries
        .iter()
        .map(|entry| {
            let text = |key: &str| entry.get_item(key)?.extract::<String>();
            let label = text("label")?;
            let category = if entry.contains("category")? { text("category")? } else { label.clone() };
            let taxonomies = if entry.contains("taxonomies")? {
                entry.get_item("taxonomies")?.extract()?
            } else {
                BTreeMap::new()
            };
            Ok(Instance { id: entry.get_item("id")?.extract()?, label, category, taxonomies })
        })
        .collect()
}

#[pymethods]
impl Field {
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let inner = py.detach(|| cif_field::Field::load(&path)).map_err(cif_error)?;
        Ok(Self { inner })
    }

    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.inner.save(&path)).map_err(cif_error)
    }

    /// A static field from arrays.
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
        let means = arrays::rows::<f32, 3>("means", &means)?;
        let scales = arrays::rows::<f32, 3>("scales", &scales)?;
        if !scales.as_flattened().iter().all(|scale| *scale > 0.0) {
            return Err(PyValueError::new_err("scales must be above 0"));
        }
        let opacity_logits = logits("opacities", &arrays::column("opacities", &opacities)?)?;
        let occupancy_logits = match occupancies {
            Some(values) => logits("occupancies", &arrays::column("occupancies", &values)?)?,
            None => opacity_logits.clone(),
        };
        let sh_coefficients = arrays::rows::<f32, 3>("colors", &colors)?
            .iter()
            .map(|color| {
                let mut sh = [0.0; COEFFICIENTS * 3];
                for (coefficient, value) in sh.iter_mut().zip(color) {
                    *coefficient = (value - 0.5) / BAND_0 as f32;
                }
                sh
            })
            .collect();
        let instances = instances.map(|entries| instance_table(&entries)).transpose()?.unwrap_or_default();
        let identities = identities.map(|rows| sparse_identities(&rows, instances.len())).transpose()?;
        let cameras: Vec<RecordedCamera> = cameras
            .unwrap_or_default()
            .into_iter()
            .map(|(name, time_index, camera)| RecordedCamera {
                name,
                time_index,
                trained: true,
                camera: camera.inner,
            })
            .collect();
        let inner = cif_field::Field {
            extent: extent(&means),
            gaussians: Gaussians {
                log_scales: scales.iter().map(|scale| scale.map(f32::ln)).collect(),
                quaternions: arrays::rows::<f32, 4>("quaternions", &quaternions)?,
                means,
                opacity_logits,
                occupancy_logits,
                sh_coefficients,
            },
            deformation: None,
            tracks: None,
            identities,
            instances,
            timeline: Timeline { times, frames_per_second },
            cameras,
            sh_degree: 0,
            background: background.into(),
            sort_metric: SortMetric::Z,
            record: cif_field::Record {
                notes: serde_json::Map::from_iter([("source".to_owned(), "arrays".into())]),
                ..cif_field::Record::default()
            },
        };
        inner.validate().map_err(cif_error)?;
        Ok(Self { inner })
    }

    fn __len__(&self) -> usize {
        self.inner.gaussians.len()
    }

    fn __repr__(&self) -> String {
        let (n, k) = (self.inner.gaussians.len(), self.inner.instances.len());
        format!("Field({n} Gaussians, {k} instances, {} times)", self.inner.timeline.times.len())
    }

    #[getter]
    fn means<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &self.inner.gaussians.means)
    }

    #[getter]
    fn scales<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &scales_of(&self.inner.gaussians))
    }

    #[getter]
    fn quaternions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::matrix(py, &self.inner.gaussians.quaternions)
    }

    #[getter]
    fn opacities<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_iter(py, self.inner.gaussians.opacity_logits.iter().copied().map(sigmoid))
    }

    #[getter]
    fn occupancies<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_iter(py, self.inner.gaussians.occupancy_logits.iter().copied().map(sigmoid))
    }

    #[getter]
    fn sh_coefficients<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let sh = &self.inner.gaussians.sh_coefficients;
        PyArray1::from_slice(py, sh.as_flattened()).reshape([sh.len(), COEFFICIENTS, 3])
    }

    #[getter]
    fn sh_degree(&self) -> u8 {
        self.inner.sh_degree
    }

    /// `[N, K]`, or `None` without identities.
    #[getter]
    fn identities<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let Some(rows) = &self.inner.identities else { return Ok(None) };
        let instances = self.inner.instances.len();
        let probabilities = rows.probabilities();
        let mut dense = vec![0.0_f32; rows.len() * instances];
        for row in 0..rows.len() {
            for entry in rows.range(row) {
                dense[row * instances + usize::from(rows.labels[entry])] = probabilities[entry];
            }
        }
        Ok(Some(PyArray1::from_vec(py, dense).reshape([rows.len(), instances])?))
    }

    #[getter]
    fn instances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.instances)
    }

    #[getter]
    fn times(&self) -> Vec<f64> {
        self.inner.timeline.times.clone()
    }

    #[getter]
    fn frames_per_second(&self) -> f64 {
        self.inner.timeline.frames_per_second
    }

    #[getter]
    fn cameras(&self) -> Vec<(String, usize, Camera)> {
        let of = |recorded: &RecordedCamera| {
            (recorded.name.clone(), recorded.time_index, Camera { inner: recorded.camera })
        };
        self.inner.cameras.iter().map(of).collect()
    }

    #[getter]
    fn provenance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::to_python(py, &self.inner.record.to_json())
    }

    fn at<'py>(&self, py: Python<'py>, time: f64) -> PyResult<Bound<'py, PyDict>> {
        check_time(time)?;
        let moved = py.detach(|| Renderer::new(SimdLevel::Auto).deform(&self.inner, time));
        let out = PyDict::new(py);
        out.set_item("means", arrays::matrix(py, &moved.means)?)?;
        out.set_item("scales", arrays::matrix(py, &scales_of(&moved))?)?;
        out.set_item("quaternions", arrays::matrix(py, &moved.quaternions)?)?;
        let opacities = moved.opacity_logits.iter().copied().map(sigmoid);
        out.set_item("opacities", PyArray1::from_iter(py, opacities))?;
        Ok(out)
    }

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
        let settings = RenderSettings::of_field(&self.inner);
        let channels = Channels { depth, instances: instances && self.inner.identities.is_some() };
        let image = py.detach(|| {
            Renderer::new(SimdLevel::Auto).render(&self.inner, &camera.inner, time, &settings, channels)
        });
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

    #[pyo3(signature = (points, time=0.0))]
    fn query<'py>(
        &self,
        py: Python<'py>,
        points: PyReadonlyArrayDyn<'py, f64>,
        time: f64,
    ) -> PyResult<Bound<'py, PyDict>> {
        check_time(time)?;
        let points: Vec<DVec3> =
            arrays::rows::<f64, 3>("points", &points)?.into_iter().map(DVec3::from_array).collect();
        let answers = py.detach(|| self.inner.query(&points, time));
        let instances = self.inner.instances.len();
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

    #[pyo3(signature = (label, time_code=None))]
    fn find<'py>(
        &self,
        py: Python<'py>,
        label: String,
        time_code: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        export::find(py, self, label, time_code)
    }

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
        export::export(py, self, &path, motion, options.as_ref(), force, scene.as_ref())
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

/// Half the diagonal of the box of the centres: the scale of a scene that has no cameras.
fn extent(means: &[[f32; 3]]) -> f32 {
    let points = means.iter().map(|mean| DVec3::from_array(mean.map(f64::from)));
    let size = cif_geometry::Bounds::around(points).size().length() as f32 / 2.0;
    if size > 0.0 { size } else { 1.0 }
}
