//! Fields of numpy arrays.

use std::collections::BTreeMap;

use cif_field::{Gaussians, Identities, Instance, RecordedCamera, SortMetric, Timeline};
use cif_geometry::spherical_harmonics::{BAND_0, COEFFICIENTS};
use glam::DVec3;
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::arrays;
use crate::camera::Camera;
use crate::error::cif_error;

/// Opacities and occupancies are kept this far from 0 and 1, where logits end.
const UNIT_MARGIN: f32 = 1e-6;

/// Everything that a static field is made of, as it was given.
pub(crate) struct FromArrays<'py> {
    pub(crate) means: PyReadonlyArrayDyn<'py, f32>,
    pub(crate) scales: PyReadonlyArrayDyn<'py, f32>,
    pub(crate) quaternions: PyReadonlyArrayDyn<'py, f32>,
    pub(crate) opacities: PyReadonlyArrayDyn<'py, f32>,
    pub(crate) colors: PyReadonlyArrayDyn<'py, f32>,
    pub(crate) occupancies: Option<PyReadonlyArrayDyn<'py, f32>>,
    pub(crate) identities: Option<PyReadonlyArrayDyn<'py, f32>>,
    pub(crate) instances: Option<Bound<'py, PyList>>,
    pub(crate) times: Vec<f64>,
    pub(crate) frames_per_second: f64,
    pub(crate) cameras: Option<Vec<(String, usize, Camera)>>,
    pub(crate) background: (f32, f32, f32),
}

impl FromArrays<'_> {
    /// The field, checked.
    pub(crate) fn field(self) -> PyResult<cif_field::Field> {
        let means = arrays::rows::<f32, 3>("means", &self.means)?;
        let scales = arrays::rows::<f32, 3>("scales", &self.scales)?;
        if !scales.as_flattened().iter().all(|scale| *scale > 0.0) {
            return Err(PyValueError::new_err("scales must be above 0"));
        }
        let opacity_logits = logits("opacities", &arrays::column("opacities", &self.opacities)?)?;
        let occupancy_logits = match self.occupancies {
            Some(values) => logits("occupancies", &arrays::column("occupancies", &values)?)?,
            None => opacity_logits.clone(),
        };
        let sh_coefficients = arrays::rows::<f32, 3>("colors", &self.colors)?
            .iter()
            .map(|color| {
                let mut sh = [0.0; COEFFICIENTS * 3];
                for (coefficient, value) in sh.iter_mut().zip(color) {
                    *coefficient = (value - 0.5) / BAND_0 as f32;
                }
                sh
            })
            .collect();
        let instances =
            self.instances.map(|entries| instance_table(&entries)).transpose()?.unwrap_or_default();
        let identities = self.identities.map(|rows| sparse_identities(&rows, instances.len())).transpose()?;
        let cameras: Vec<RecordedCamera> = self
            .cameras
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
                quaternions: arrays::rows::<f32, 4>("quaternions", &self.quaternions)?,
                means,
                opacity_logits,
                occupancy_logits,
                sh_coefficients,
            },
            deformation: None,
            tracks: None,
            identities,
            instances,
            timeline: Timeline { times: self.times, frames_per_second: self.frames_per_second },
            cameras,
            sh_degree: 0,
            background: self.background.into(),
            sort_metric: SortMetric::Z,
            record: cif_field::Record {
                notes: serde_json::Map::from_iter([("source".to_owned(), "arrays".into())]),
                ..cif_field::Record::default()
            },
        };
        inner.validate().map_err(cif_error)?;
        Ok(inner)
    }
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
    let mut identities = Identities::default();
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

/// Half the diagonal of the box of the centres: the scale of a scene that has no cameras.
fn extent(means: &[[f32; 3]]) -> f32 {
    let points = means.iter().map(|mean| DVec3::from_array(mean.map(f64::from)));
    let size = cif_geometry::Bounds::around(points).size().length() as f32 / 2.0;
    if size > 0.0 { size } else { 1.0 }
}
