//! Splats of one prim: single or half precision, checked.

use cif_geometry::Bounds;
use cif_geometry::spherical_harmonics::{BAND_0, COEFFICIENTS, coefficient_count};
use cif_scene::assemble::{Shape, color_range, origin_of};
use cif_scene::{IdentityShare, IdentityShares, Splats};
use glam::DVec3;
use pyo3::prelude::*;

use super::arrays::ArrayError;
use super::colors;
use super::reading::Reading;
use super::values::{attribute, plain, samples, value};
use crate::{UsdError, primvars, tokens};

/// Deviation of a squared norm from 1 below which a quaternion is taken as it is.
const UNIT: f32 = 1e-5;

/// A splat prim, its arrays not read yet.
pub(super) struct SplatPrim<'py> {
    pub(super) prim: Bound<'py, PyAny>,
    pub(super) path: String,
}

/// Indices, widths and colours of a proxy.
pub(super) type ProxyArrays = (Vec<u32>, Vec<f32>, Vec<[f32; 3]>);

/// A value per splat by name, or the half-precision one.
const SHAPES: [&str; 3] = ["positions", "orientations", "scales"];

impl<'py> SplatPrim<'py> {
    /// The attribute that counts: single precision where it has a value, else half.
    fn source(&self, name: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
        match attribute(&self.prim, name)? {
            Some(attribute) => Ok(Some(attribute)),
            None => attribute(&self.prim, &format!("{name}h")),
        }
    }

    fn read<T>(
        &self,
        reading: &Reading<'_, 'py>,
        name: &str,
        time: &Bound<'py, PyAny>,
        read: impl Fn(&Bound<'py, PyAny>) -> Result<Vec<T>, ArrayError>,
    ) -> Result<Option<Vec<T>>, UsdError> {
        let python = |error| reading.python(&error);
        let Some(attribute) = self.source(name).map_err(python)? else { return Ok(None) };
        // A value that USD itself refuses to read: claims beyond the end of the file, for one.
        let value = attribute.call_method1("Get", (time,)).map_err(|error| {
            let problem = format!("{name} cannot be read: {}", crate::pxr::reason(reading.pxr.py, &error));
            reading.prim_error(&self.path, problem, "the file is damaged; write it again")
        })?;
        if value.is_none() {
            return Ok(None);
        }
        self.array(reading, name, read(&value)).map(Some)
    }

    pub(super) fn array<T>(
        &self,
        reading: &Reading<'_, 'py>,
        name: &str,
        array: Result<Vec<T>, ArrayError>,
    ) -> Result<Vec<T>, UsdError> {
        array.map_err(|error| match error {
            ArrayError::Python(error) => reading.python(&error),
            ArrayError::Shape(found) => {
                let problem = format!("{name} is {found}");
                reading.prim_error(&self.path, problem, "write it with the type of the schema")
            }
            ArrayError::TooLarge => {
                let problem = format!("{name} claims more values than files of this size hold");
                reading.prim_error(&self.path, problem, "the file is damaged or built to exhaust memory")
            }
        })
    }

    /// True when it has positions at all.
    pub(super) fn has_positions(&self) -> PyResult<bool> {
        Ok(self.source("positions")?.is_some())
    }

    /// Times at which its shape is sampled.
    pub(super) fn times(&self) -> PyResult<Vec<f64>> {
        self.times_of(&SHAPES)
    }

    /// Times at which its opacities are sampled.
    pub(super) fn opacity_times(&self) -> PyResult<Vec<f64>> {
        self.times_of(&["opacities"])
    }

    /// Times at which its coefficients are sampled.
    pub(super) fn color_times(&self) -> PyResult<Vec<f64>> {
        self.times_of(&[tokens::SH_COEFFICIENTS])
    }

    /// Times at which attributes are sampled. One sample is a value and no change, except in what we wrote.
    fn times_of(&self, names: &[&str]) -> PyResult<Vec<f64>> {
        let ours = attribute(&self.prim, tokens::COLOR_CHECKSUM)?.is_some();
        let mut times = Vec::new();
        for name in names {
            if let Some(attribute) = self.source(name)? {
                let own = samples(&attribute)?;
                if ours || own.len() > 1 {
                    times.extend(own);
                }
            }
        }
        times.sort_by(f64::total_cmp);
        times.dedup();
        Ok(times)
    }

    /// True when it holds the probability of its instance.
    pub(super) fn has_identities(&self) -> PyResult<bool> {
        Ok(attribute(&self.prim, tokens::PRIMVAR_IDENTITY)?.is_some())
    }

    /// The prim under `owner` that it moves with: its parent, or itself where that is the owner.
    pub(super) fn carrier(&self, owner: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let parent = self.prim.call_method0("GetParent")?;
        Ok(if self.prim.eq(owner)? || parent.eq(owner)? { self.prim.clone() } else { parent })
    }

    /// Indices, widths and colours, where it is a proxy of ours.
    pub(super) fn proxy(&self, reading: &Reading<'_, 'py>) -> Result<Option<ProxyArrays>, UsdError> {
        let at = reading.pxr.earliest().map_err(|error| reading.python(&error))?;
        let Some(indices) = self.primvar_ints(reading, tokens::PRIMVAR_SPLAT, &at)? else { return Ok(None) };
        let widths = self.primvar(reading, "widths", &at, |value| reading.arrays.scalars(value))?;
        let colors =
            self.primvar(reading, tokens::DISPLAY_COLOR, &at, |value| reading.arrays.floats::<3>(value))?;
        Ok(Some((primvars::from_ints(&indices), widths.unwrap_or_default(), colors.unwrap_or_default())))
    }

    /// True when its scales are sampled.
    pub(super) fn samples_scales(&self) -> PyResult<bool> {
        match self.source("scales")? {
            Some(attribute) => Ok(!samples(&attribute)?.is_empty()),
            None => Ok(false),
        }
    }

    /// The place that its centres are read from on: that of the prim, unless they are doubles which single precision
    /// does not hold.
    pub(super) fn origin(&self, reading: &Reading<'_, 'py>) -> Result<DVec3, UsdError> {
        let at = reading.pxr.earliest().map_err(|error| reading.python(&error))?;
        let doubles =
            |value: &Bound<'py, PyAny>| reading.arrays.doubles(value).map(Option::unwrap_or_default);
        let centres = self.read(reading, "positions", &at, doubles)?.unwrap_or_default();
        let bounds = Bounds::around(centres.into_iter().map(DVec3::from_array));
        // The scene states an origin of its own, of which this becomes a part.
        Ok(origin_of(&bounds, 1.0, &mut Vec::new()).unwrap_or_default())
    }

    /// Centres from `origin` on, orientations and scales at a time, checked.
    pub(super) fn shape(
        &self,
        reading: &Reading<'_, 'py>,
        time: Option<f64>,
        origin: DVec3,
    ) -> Result<Shape, UsdError> {
        let python = |error: PyErr| reading.python(&error);
        let at = match time {
            Some(time) => reading.pxr.time_code(Some(time)),
            None => reading.pxr.earliest(),
        };
        let at = at.map_err(python)?;
        let arrays = &reading.arrays;
        let when = time.map_or(String::new(), |time| format!(" at time code {time}"));
        let bad = |problem: String, fix| reading.prim_error(&self.path, format!("{problem}{when}"), fix);
        let means: Vec<[f32; 3]> = self
            .read(reading, "positions", &at, |value| match arrays.doubles(value)? {
                Some(centres) => {
                    let near = |centre| (DVec3::from_array(centre) - origin).as_vec3().to_array();
                    Ok(centres.into_iter().map(near).collect())
                }
                None => arrays.floats(value),
            })?
            .ok_or_else(|| bad("no positions".into(), "author positions, or deactivate the prim"))?;
        let n = means.len();
        if let Some(index) = means.iter().position(|mean| !mean.iter().all(|value| value.is_finite())) {
            return Err(bad(format!("position {index} is not finite"), "remove that splat"));
        }
        let orientations: Option<Vec<[f32; 4]>> =
            self.read(reading, "orientations", &at, |value| arrays.floats(value))?;
        let scales: Vec<[f32; 3]> = self
            .read(reading, "scales", &at, |value| arrays.floats(value))?
            .ok_or_else(|| bad("no scales".into(), "author one scale per position"))?;
        let counted = |name: &str, count: usize| {
            if count == n {
                Ok(())
            } else {
                Err(bad(format!("{n} positions, but {count} {name}"), "give every splat one value of each"))
            }
        };
        counted("scales", scales.len())?;
        let mut orientations = match orientations {
            Some(orientations) => orientations,
            None => vec![[0.0, 0.0, 0.0, 1.0]; n],
        };
        counted("orientations", orientations.len())?;
        for (index, q) in orientations.iter_mut().enumerate() {
            // From the memory order of GfQuat.
            let [x, y, z, w] = *q;
            let squared = w * w + x * x + y * y + z * z;
            if !(squared.is_finite() && squared > 1e-12) {
                return Err(bad(
                    format!("orientation {index} ({w}, {x}, {y}, {z}) has no direction"),
                    "make it a unit quaternion; (1, 0, 0, 0) is unturned",
                ));
            }
            let factor = if (squared - 1.0).abs() < UNIT { 1.0 } else { squared.sqrt().recip() };
            *q = [w, x, y, z].map(|component| if factor == 1.0 { component } else { component * factor });
        }
        if let Some(index) =
            scales.iter().position(|scale| !scale.iter().all(|value| value.is_finite() && *value >= 0.0))
        {
            return Err(bad(
                format!("scale {index} {:?} is no standard deviation", scales[index]),
                "scales are linear, 0 or more; exp of log-scales",
            ));
        }
        Ok(Shape { means, orientations, scales })
    }

    /// Everything at the earliest time, checked; centres from `origin` on.
    pub(super) fn splats(&self, reading: &Reading<'_, 'py>, origin: DVec3) -> Result<Splats, UsdError> {
        let python = |error: PyErr| reading.python(&error);
        let Shape { means, orientations, scales } = self.shape(reading, None, origin)?;
        let n = means.len();
        let at = reading.pxr.earliest().map_err(python)?;
        let arrays = &reading.arrays;
        let bad = |problem: String, fix| reading.prim_error(&self.path, problem, fix);
        let counted = |name: &str, count: usize| {
            if count == n {
                Ok(())
            } else {
                Err(bad(format!("{n} positions, but {count} {name}"), "give every splat one value of each"))
            }
        };
        // Beside samples stands the opacity for readers of one time, where somebody wrote it.
        let resting = match reading.has_windows || self.opacity_times().map_err(python)?.is_empty() {
            true => None,
            false => self.opacities(reading, &reading.pxr.time_code(None).map_err(python)?, n)?,
        };
        let opacities = match resting {
            Some(opacities) => opacities,
            None => self.opacities(reading, &at, n)?.unwrap_or_else(|| vec![1.0; n]),
        };
        let (mut sh_degree, mut sh_coefficients) = self.harmonics(reading, &at, n)?;
        let rows = self.primvar_ints(reading, tokens::PRIMVAR_ROW, &at)?;
        let rows = match rows {
            Some(rows) => {
                counted("rows", rows.len())?;
                primvars::from_ints(&rows)
            }
            None => vec![Splats::NO_ROW; n],
        };
        let per_splat = |name: &str, otherwise: f32| -> Result<Vec<f32>, UsdError> {
            match self.primvar(reading, name, &at, |value| arrays.scalars(value))? {
                Some(values) => {
                    counted(name, values.len())?;
                    match values.iter().position(|value| !(0.0..=1.0).contains(value)) {
                        Some(index) => Err(bad(
                            format!("{name} {index} is {}", values[index]),
                            "it is a probability from 0 to 1",
                        )),
                        None => Ok(values),
                    }
                }
                None => Ok(vec![otherwise; n]),
            }
        };
        let identities = self.identities(reading, &at, n)?;
        let occupancies = per_splat(tokens::PRIMVAR_OCCUPANCY, 1.0)?;
        let identity_probabilities = per_splat(tokens::PRIMVAR_IDENTITY, 1.0)?;
        self.recolor(reading, &at, n, &mut sh_degree, &mut sh_coefficients)?;
        Ok(Splats {
            means,
            orientations,
            scales,
            opacities,
            sh_degree,
            sh_coefficients,
            occupancies,
            identity_probabilities,
            identities,
            rows,
        })
    }

    /// Opacities at a time, checked; `None` where there are none.
    fn opacities(
        &self,
        reading: &Reading<'_, 'py>,
        at: &Bound<'py, PyAny>,
        n: usize,
    ) -> Result<Option<Vec<f32>>, UsdError> {
        let bad = |problem: String, fix| reading.prim_error(&self.path, problem, fix);
        let read = self.read(reading, "opacities", at, |value| reading.arrays.scalars(value))?;
        let Some(opacities) = read else { return Ok(None) };
        if opacities.len() != n {
            let problem = format!("{n} positions, but {} opacities", opacities.len());
            return Err(bad(problem, "give every splat one value of each"));
        }
        match opacities.iter().position(|opacity| !(0.0..=1.0).contains(opacity)) {
            Some(index) => Err(bad(
                format!("opacity {index} is {}", opacities[index]),
                "opacities are probabilities from 0 to 1; sigmoid of logits",
            )),
            None => Ok(Some(opacities)),
        }
    }

    /// Opacities of `n` splats at a time code, checked; 1 where there are none.
    pub(super) fn opacities_at(
        &self,
        reading: &Reading<'_, 'py>,
        time: f64,
        n: usize,
    ) -> Result<Vec<f32>, UsdError> {
        let at = reading.pxr.time_code(Some(time)).map_err(|error| reading.python(&error))?;
        Ok(self.opacities(reading, &at, n)?.unwrap_or_else(|| vec![1.0; n]))
    }

    /// Degree and coefficients of `n` splats at a time code, checked.
    pub(super) fn harmonics_at(
        &self,
        reading: &Reading<'_, 'py>,
        time: f64,
        n: usize,
    ) -> Result<(u8, Vec<f32>), UsdError> {
        let at = reading.pxr.time_code(Some(time)).map_err(|error| reading.python(&error))?;
        self.harmonics(reading, &at, n)
    }

    /// The instances that every splat may belong to; empty where the prim has none.
    fn identities(
        &self,
        reading: &Reading<'_, 'py>,
        at: &Bound<'py, PyAny>,
        n: usize,
    ) -> Result<Vec<IdentityShares>, UsdError> {
        let arrays = &reading.arrays;
        let ids = self.primvar(reading, tokens::PRIMVAR_INSTANCE_IDS, at, |value| arrays.ints(value))?;
        let shares =
            self.primvar(reading, tokens::PRIMVAR_INSTANCE_SHARES, at, |value| arrays.scalars(value))?;
        let (Some(ids), Some(shares)) = (ids, shares) else { return Ok(Vec::new()) };
        let bad = |problem: String| {
            let fix = "write as many ids as shares for every splat, ids from 0 to 65535, shares from 0 to 1";
            reading.prim_error(&self.path, problem, fix)
        };
        if n == 0 {
            return Ok(Vec::new());
        }
        let places = ids.len() / n;
        if places == 0 || ids.len() % n != 0 || shares.len() != ids.len() {
            return Err(bad(format!(
                "{n} positions, but {} values of {} and {} of {}",
                ids.len(),
                tokens::PRIMVAR_INSTANCE_IDS,
                shares.len(),
                tokens::PRIMVAR_INSTANCE_SHARES
            )));
        }
        let mut identities = Vec::with_capacity(n);
        for (ids, shares) in ids.chunks_exact(places).zip(shares.chunks_exact(places)) {
            let mut entries = IdentityShares::default();
            for (entry, (id, share)) in entries.iter_mut().zip(ids.iter().zip(shares)) {
                let Some(id) = u16::try_from(*id).ok().filter(|_| (0.0..=1.0).contains(share)) else {
                    return Err(bad(format!("an instance id is {id} with the share {share}")));
                };
                *entry = IdentityShare { id, share: *share };
            }
            identities.push(entries);
        }
        Ok(identities)
    }

    /// Degree and coefficients; none where the prim has none.
    fn harmonics(
        &self,
        reading: &Reading<'_, 'py>,
        at: &Bound<'py, PyAny>,
        n: usize,
    ) -> Result<(u8, Vec<f32>), UsdError> {
        let python = |error: PyErr| reading.python(&error);
        let bad = |problem: String, fix| reading.prim_error(&self.path, problem, fix);
        let name = tokens::SH_COEFFICIENTS;
        let read = self.read(reading, name, at, |value| reading.arrays.triples(value))?;
        let Some(mut coefficients) = read else { return Ok((0, Vec::new())) };
        let size = self.source(name).map_err(python)?.map(|attribute| element_size(&attribute)).transpose();
        let size = size.map_err(python)?.flatten();
        let authored = plain::<i64>(&self.prim, tokens::SH_DEGREE, at).map_err(python)?;
        // The schema's fallback is 3; the element size says it too.
        let degree = authored
            .or_else(|| size.and_then(|size| (0..=3).find(|&degree| size == (degree + 1) * (degree + 1))));
        let degree = degree.unwrap_or(3);
        let Some(degree) = u8::try_from(degree).ok().filter(|degree| *degree <= 3) else {
            return Err(bad(
                format!("{} is {degree}", tokens::SH_DEGREE),
                "degrees 0 to 3 are known; cut the coefficients to 16 per splat",
            ));
        };
        let count = coefficient_count(degree);
        if let Some(size) = size.filter(|&size| size != 1 && size != count as i64) {
            return Err(bad(
                format!("elementSize of the coefficients is {size}, and degree {degree} has {count}"),
                "make elementSize (degree + 1)^2",
            ));
        }
        if coefficients.len() != n * count * 3 {
            return Err(bad(
                format!(
                    "{n} positions, but {} coefficients of degree {degree}, which has {count} per splat",
                    coefficients.len() / 3
                ),
                "give every splat (degree + 1)^2 coefficients",
            ));
        }
        if let Some(index) = coefficients.iter().position(|value| !value.is_finite()) {
            let problem = format!("coefficient of splat {} is not finite", index / (3 * count));
            return Err(bad(problem, "remove that splat"));
        }
        debug_assert!(count <= COEFFICIENTS);
        self.to_display(reading, self.source(name).map_err(python)?.as_ref(), degree, &mut coefficients)?;
        Ok((degree, coefficients))
    }

    /// Brings coefficients from the colour space of an attribute to display values.
    fn to_display(
        &self,
        reading: &Reading<'_, 'py>,
        attribute: Option<&Bound<'py, PyAny>>,
        degree: u8,
        coefficients: &mut [f32],
    ) -> Result<(), UsdError> {
        let Some(attribute) = attribute else { return Ok(()) };
        let encoding = colors::encoding(reading, &self.path, attribute);
        if let Some(encoding) = encoding.map_err(|error| reading.python(&error))? {
            encoding.bring_to_display(coefficients, degree);
        }
        Ok(())
    }

    /// Display colours take the place of the DC coefficients where they were changed, or where there are none.
    fn recolor(
        &self,
        reading: &Reading<'_, 'py>,
        at: &Bound<'py, PyAny>,
        n: usize,
        degree: &mut u8,
        coefficients: &mut Vec<f32>,
    ) -> Result<(), UsdError> {
        let python = |error: PyErr| reading.python(&error);
        let written: Option<String> = plain(&self.prim, tokens::COLOR_CHECKSUM, at).map_err(python)?;
        let missing = coefficients.is_empty() && n > 0;
        if written.is_none() && !missing {
            return Ok(());
        }
        if missing {
            *degree = 0;
            *coefficients = vec![0.0; 3 * n];
        }
        let read = |value: &Bound<'py, PyAny>| reading.arrays.floats::<3>(value);
        let Some(mut colors) = self.primvar(reading, tokens::DISPLAY_COLOR, at, read)? else { return Ok(()) };
        if colors.len() == 1 && n > 1 {
            colors = vec![colors[0]; n];
        }
        if colors.len() != n {
            return Err(reading.prim_error(
                &self.path,
                format!("{n} positions, but {} display colours", colors.len()),
                "give every splat one colour, or all of them the same",
            ));
        }
        if let Some(index) = colors.iter().position(|color| !color.iter().all(|value| value.is_finite())) {
            let problem = format!("display colour {index} is not finite");
            return Err(reading.prim_error(&self.path, problem, "give it a colour"));
        }
        if written.is_some_and(|written| written == primvars::checksum(&colors)) && !missing {
            return Ok(());
        }
        if missing {
            let mut warnings = Vec::new();
            let white = color_range(colors.as_flattened().iter().copied(), &self.path, &mut warnings);
            warnings.into_iter().for_each(|warning| reading.warn(warning));
            for (sh, color) in coefficients.iter_mut().zip(colors.as_flattened()) {
                *sh = ((f64::from(color / white) - 0.5) / BAND_0) as f32;
            }
            let attribute = attribute(&self.prim, tokens::DISPLAY_COLOR).map_err(python)?;
            return self.to_display(reading, attribute.as_ref(), 0, coefficients);
        }
        let before = primvars::base_colors(coefficients, *degree);
        let stride = 3 * coefficient_count(*degree);
        let splats = coefficients.chunks_exact_mut(stride);
        let mut changed = 0_usize;
        for ((sh, color), before) in splats.zip(&colors).zip(&before) {
            if color != before {
                changed += 1;
                for channel in 0..3 {
                    if color[channel] != before[channel] {
                        sh[channel] = ((f64::from(color[channel]) - 0.5) / BAND_0) as f32;
                    }
                }
            }
        }
        if changed > 0 {
            reading.warn(format!("{}: {changed} splats were recoloured", self.path));
        }
        Ok(())
    }

    /// Values of a primvar, repeated ones expanded.
    fn primvar<T: Copy>(
        &self,
        reading: &Reading<'_, 'py>,
        name: &str,
        at: &Bound<'py, PyAny>,
        read: impl Fn(&Bound<'py, PyAny>) -> Result<Vec<T>, ArrayError>,
    ) -> Result<Option<Vec<T>>, UsdError> {
        let python = |error: PyErr| reading.python(&error);
        let Some(found) = value(&self.prim, name, at).map_err(python)? else { return Ok(None) };
        let values = self.array(reading, name, read(&found))?;
        let indices = value(&self.prim, &format!("{name}:indices"), at).map_err(python)?;
        let Some(indices) = indices else { return Ok(Some(values)) };
        let indices = self.array(reading, name, reading.arrays.ints(&indices))?;
        let picked: Option<Vec<T>> = indices
            .iter()
            .map(|&index| usize::try_from(index).ok().and_then(|index| values.get(index).copied()))
            .collect();
        picked.map(Some).ok_or_else(|| {
            let problem = format!("an index of {name} is outside its {} values", values.len());
            reading.prim_error(&self.path, problem, "indices count from 0 to one less than the values")
        })
    }

    fn primvar_ints(
        &self,
        reading: &Reading<'_, 'py>,
        name: &str,
        at: &Bound<'py, PyAny>,
    ) -> Result<Option<Vec<i32>>, UsdError> {
        self.primvar(reading, name, at, |value| reading.arrays.ints(value))
    }
}

/// Values per element, where the attribute says so.
fn element_size(attribute: &Bound<'_, PyAny>) -> PyResult<Option<i64>> {
    let size = attribute.call_method1("GetMetadata", ("elementSize",))?;
    if size.is_none() { Ok(None) } else { size.extract().map(Some) }
}
