//! Prims by label, time and place, in any stage with semantic labels.

use std::collections::BTreeMap;
use std::path::Path;

use cif_geometry::Bounds;
use cif_scene::search::{TAXONOMY_CLASS, TAXONOMY_INSTANCE, sampled_codes, speed, volume};
use cif_scene::{CodeRange, ConvexHull, LabelMatch, LabelQuery, ObjectMatch, ObjectQuery, When};
use glam::{DMat4, DVec3};
use pyo3::prelude::*;

use crate::pxr::{self, Pxr, reason};
use crate::read::labels::{DirectLabels, all_prims};
use crate::read::open::open_for_labels;
use crate::read::query::{USE_EXTENTS_HINTS, drawn};
use crate::{ReadOptions, UsdError, conventions, tokens};

pub(crate) fn search(
    path: &Path,
    query: &ObjectQuery,
    options: ReadOptions,
) -> Result<Vec<ObjectMatch>, UsdError> {
    let label_query = query.label_query();
    let matcher = label_query.as_ref().map(LabelQuery::matcher);
    pxr::with(|pxr| {
        let (stage, instances) = open_for_labels(pxr, path, options)?;
        let python =
            |error: PyErr| UsdError::Unusable { path: path.to_owned(), reason: reason(pxr.py, &error) };
        let search = Search::new(pxr, &stage, query).map_err(python)?;
        let (mut known, mut labelled, mut found) = (Vec::new(), false, Vec::new());
        for prim in all_prims(pxr, &stage, instances).map_err(python)? {
            let prim = prim.map_err(python)?;
            let by_taxonomy = search.labels.of(&prim).map_err(python)?;
            let counted =
                by_taxonomy.iter().filter(|(taxonomy, labels)| query.counts(taxonomy) && !labels.is_empty());
            let labels: Vec<String> = counted.flat_map(|(_, labels)| labels.clone()).collect();
            let carries = match &matcher {
                Some(pattern) => labels.iter().any(|label| pattern.matches(label)),
                None => !labels.is_empty(),
            };
            known.extend(labels);
            labelled |= carries;
            if carries && let Some(object) = search.describe(&prim, &by_taxonomy, query).map_err(python)? {
                found.push(object);
            }
        }
        match label_query {
            Some(label_query) if !labelled => {
                Err(label_query.unknown(&path.display().to_string(), known).into())
            }
            _ => Ok(found),
        }
    })
}

/// Range of the time codes of a stage.
pub(crate) fn code_range(path: &Path, options: ReadOptions) -> Result<CodeRange, UsdError> {
    pxr::with(|pxr| {
        let stage = crate::read::open::open(pxr, path, options)?;
        let range = || -> PyResult<CodeRange> {
            let number = |name: &str| -> PyResult<f64> { stage.call_method0(name)?.extract() };
            let has_ends = stage.call_method0("HasAuthoredTimeCodeRange")?.is_truthy()?;
            let ends =
                if has_ends { Some((number("GetStartTimeCode")?, number("GetEndTimeCode")?)) } else { None };
            Ok(CodeRange { ends, per_second: number("GetTimeCodesPerSecond")? })
        };
        range().map_err(|error| UsdError::Unusable { path: path.to_owned(), reason: reason(pxr.py, &error) })
    })
}

/// Search of a stage for prims, with the objects of `pxr` that it needs for each, made once.
struct Search<'a, 'py> {
    pxr: &'a Pxr<'py>,
    labels_api: Bound<'py, PyAny>,
    labels: DirectLabels<'a, 'py>,
    time: Bound<'py, PyAny>,
    /// Caches of transforms and boxes at every sampled time code.
    codes: Vec<f64>,
    transforms: Vec<Bound<'py, PyAny>>,
    boxes: Vec<Bound<'py, PyAny>>,
    /// The same at the time itself.
    transform: Bound<'py, PyAny>,
    bounds: Bound<'py, PyAny>,
    codes_per_second: f64,
}

impl<'a, 'py> Search<'a, 'py> {
    fn new(pxr: &'a Pxr<'py>, stage: &Bound<'py, PyAny>, query: &ObjectQuery) -> PyResult<Self> {
        let number = |name: &str| -> PyResult<f64> { stage.call_method0(name)?.extract() };
        let (start, end) = (number("GetStartTimeCode")?, number("GetEndTimeCode")?);
        let codes = sampled_codes(query.when, start, end);
        let code = |code: Option<f64>| pxr.time_code(code);
        let time = match query.when {
            When::Default => code(None)?,
            When::At(at) | When::Over(at, _) => code(Some(at))?,
        };
        let span = match query.when {
            When::Over(first, last) => pxr.gf.getattr("Interval")?.call1((first, last))?,
            _ => time.clone(),
        };
        let purposes = drawn(pxr)?;
        let transform_at = |time: &Bound<'py, PyAny>| pxr.usd_geom.getattr("XformCache")?.call1((time,));
        let box_at = |time: &Bound<'py, PyAny>| {
            pxr.usd_geom.getattr("BBoxCache")?.call1((time, purposes.clone(), USE_EXTENTS_HINTS))
        };
        let times: Vec<_> = codes.iter().map(|at| code(Some(*at))).collect::<PyResult<_>>()?;
        Ok(Self {
            pxr,
            labels_api: pxr.usd_semantics.getattr("LabelsAPI")?,
            transforms: times.iter().map(transform_at).collect::<PyResult<_>>()?,
            boxes: match query.when {
                When::Over(..) => times.iter().map(box_at).collect::<PyResult<_>>()?,
                _ => Vec::new(),
            },
            transform: transform_at(&time)?,
            bounds: box_at(&time)?,
            labels: DirectLabels::new(pxr, span)?,
            time,
            codes,
            codes_per_second: number("GetTimeCodesPerSecond")?,
        })
    }

    /// The prim, unless it is elsewhere or hidden throughout.
    fn describe(
        &self,
        prim: &Bound<'py, PyAny>,
        by_taxonomy: &BTreeMap<String, Vec<String>>,
        query: &ObjectQuery,
    ) -> PyResult<Option<ObjectMatch>> {
        if !self.visible(prim)? {
            return Ok(None);
        }
        // A box cache leaves out what is hidden at its time.
        let caches = if self.boxes.is_empty() { std::slice::from_ref(&self.bounds) } else { &self.boxes };
        let mut bounds = Bounds::EMPTY;
        for cache in caches {
            bounds = bounds.union(world_box(cache, prim)?);
        }
        if !query.is_at(&bounds) {
            return Ok(None);
        }
        let first = |taxonomy: &str| {
            by_taxonomy.get(taxonomy).and_then(|labels| labels.first()).cloned().unwrap_or_default()
        };
        // The class stands first in the attribute, before the human label; the query itself gives a set.
        let authored = self
            .labels_api
            .call_method1("Get", (prim, tokens::TAXONOMY_CLASS))?
            .call_method0("GetLabelsAttr")?
            .call_method1("Get", (&self.time,));
        let class = match authored {
            Ok(labels) if labels.is_truthy()? => labels.get_item(0)?.str()?.extract()?,
            _ => first(TAXONOMY_CLASS),
        };
        let attribute = prim.call_method1("GetAttribute", (tokens::USER_LABEL,))?;
        let label = if attribute.is_truthy()? {
            attribute.call_method1("Get", (&self.time,))?.extract::<Option<String>>()?
        } else {
            None
        };
        let transform = matrix(&self.transform, prim)?;
        let mut path = Vec::with_capacity(self.transforms.len());
        for cache in &self.transforms {
            let rows = matrix(cache, prim)?;
            path.push(DVec3::new(rows[0][3], rows[1][3], rows[2][3]));
        }
        let (volume, volume_of) = volume(self.hull_volume(prim)?, &bounds);
        let mut names: Vec<String> = by_taxonomy.values().flatten().cloned().collect();
        names.extend(label.clone());
        // Foreign stages may use any taxonomy: whatever label there is names the object.
        let any = by_taxonomy.values().flatten().next().cloned().unwrap_or_default();
        let class = if class.is_empty() { any } else { class };
        Ok(Some(ObjectMatch {
            found: LabelMatch {
                path: prim.call_method0("GetPath")?.str()?.extract()?,
                label: label.unwrap_or_else(|| class.clone()),
                class,
                instance: first(TAXONOMY_INSTANCE),
                transform,
                low: (!bounds.is_empty()).then_some(bounds.low.to_array()),
                high: (!bounds.is_empty()).then_some(bounds.high.to_array()),
            },
            volume,
            volume_of,
            speed: speed(&self.codes, &path, self.codes_per_second),
            names,
            embedding: crate::read::labels::embedding(self.pxr, prim)?,
        }))
    }

    /// True when a prim is visible at the time, or at any sampled time of the interval.
    fn visible(&self, prim: &Bound<'py, PyAny>) -> PyResult<bool> {
        let imageable = self.pxr.usd_geom.getattr("Imageable")?.call1((prim,))?;
        if !imageable.is_truthy()? {
            return Ok(true);
        }
        let hidden = self.pxr.usd_geom.getattr("Tokens")?.getattr("invisible")?;
        let mut times = vec![self.time.clone()];
        if !self.boxes.is_empty() {
            for code in &self.codes {
                times.push(self.pxr.time_code(Some(*code))?);
            }
        }
        for time in times {
            if !imageable.call_method1("ComputeVisibility", (time,))?.eq(&hidden)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Volume of the collision meshes below a prim, world units.
    fn hull_volume(&self, prim: &Bound<'py, PyAny>) -> PyResult<f64> {
        let range = self.pxr.usd.getattr("PrimRange")?.call1((prim,))?;
        let mut hulls = Vec::new();
        for inner in range.try_iter()? {
            let inner = inner?;
            let applied: Vec<String> = inner
                .call_method0("GetAppliedSchemas")?
                .try_iter()?
                .map(|schema| schema?.str()?.extract())
                .collect::<PyResult<_>>()?;
            let is_hull = applied.iter().any(|schema| schema == "PhysicsMeshCollisionAPI");
            if !is_hull || !inner.call_method1("IsA", (self.pxr.usd_geom.getattr("Mesh")?,))?.is_truthy()? {
                continue;
            }
            let value = |name: &str| -> PyResult<Bound<'py, PyAny>> {
                inner.call_method1("GetAttribute", (name,))?.call_method1("Get", (&self.time,))
            };
            // Arrays of usd-core are no sequences to Python: they are walked item by item. A hull has few.
            let (points, counts, indices) =
                (value("points")?, value("faceVertexCounts")?, value("faceVertexIndices")?);
            if points.is_none() || counts.is_none() || indices.is_none() {
                continue;
            }
            let points: Vec<[f64; 3]> =
                points.try_iter()?.map(|point| numbers(&point?)).collect::<PyResult<_>>()?;
            let integers = |array: Bound<'py, PyAny>| -> PyResult<Vec<u32>> {
                // A negative count or index makes no face.
                array
                    .try_iter()?
                    .map(|item| Ok(u32::try_from(item?.extract::<i64>()?).unwrap_or(u32::MAX)))
                    .collect()
            };
            let (counts, indices) = (integers(counts)?, integers(indices)?);
            let world = DMat4::from_cols_array_2d(&matrix(&self.transform, &inner)?).transpose();
            let points = points
                .iter()
                .map(|p| {
                    // Volumes do not depend on the place, which may be far from the origin.
                    let turned = world.transform_vector3(DVec3::from_array(*p));
                    turned.to_array().map(|v| v as f32)
                })
                .collect();
            hulls.push(ConvexHull { points, triangles: fans(&counts, &indices), part: None });
        }
        Ok(cif_scene::search::hull_volume(&hulls))
    }
}

/// Polygons as triangles.
fn fans(counts: &[u32], indices: &[u32]) -> Vec<[u32; 3]> {
    let (mut start, mut triangles) = (0_usize, Vec::new());
    for count in counts {
        let Some(face) = indices.get(start..start.saturating_add(*count as usize)) else { break };
        triangles.extend((1..face.len().max(2) - 1).map(|k| [face[0], face[k], face[k + 1]]));
        start += face.len();
    }
    triangles
}

/// `world_from_local` for column vectors.
fn matrix(cache: &Bound<'_, PyAny>, prim: &Bound<'_, PyAny>) -> PyResult<[[f64; 4]; 4]> {
    let matrix = cache.call_method1("GetLocalToWorldTransform", (prim,))?;
    let mut rows = [[0.0; 4]; 4];
    for (index, row) in rows.iter_mut().enumerate() {
        *row = numbers(&matrix.call_method1("GetRow", (index,))?)?;
    }
    Ok(conventions::column_vector_matrix(rows))
}

fn world_box(cache: &Bound<'_, PyAny>, prim: &Bound<'_, PyAny>) -> PyResult<Bounds> {
    let range = cache.call_method1("ComputeWorldBound", (prim,))?.call_method0("ComputeAlignedRange")?;
    if range.call_method0("IsEmpty")?.is_truthy()? {
        return Ok(Bounds::EMPTY);
    }
    let corner =
        |name: &str| -> PyResult<DVec3> { Ok(DVec3::from_array(numbers(&range.call_method0(name)?)?)) };
    Ok(Bounds { low: corner("GetMin")?, high: corner("GetMax")? })
}

fn numbers<const N: usize>(vector: &Bound<'_, PyAny>) -> PyResult<[f64; N]> {
    let mut values = [0.0; N];
    for (index, value) in values.iter_mut().enumerate() {
        *value = vector.get_item(index)?.extract()?;
    }
    Ok(values)
}
