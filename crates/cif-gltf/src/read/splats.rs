//! Splats of meshes.

use std::collections::BTreeMap;

use cif_geometry::quaternion;
use cif_scene::assemble::ColorEncoding;
use cif_scene::{IdentityShare, IdentityShares, Splats};
use gltf::json::accessor::ComponentType::{F32, I8, I16, U8, U16};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked;
use serde_json::Value;

use super::accessor::{ANY, Expected};
use super::source::{Source, unknown_extension};
use crate::{EXTENSION, GltfError};

/// The extension object of a primitive.
pub(crate) fn extension(primitive: &Primitive) -> Option<&Value> {
    primitive.extensions.as_ref()?.others.get(EXTENSION)
}

impl Source {
    /// Number of splats that the positions of a mesh announce; `None` for a mesh without splats.
    pub(crate) fn splat_count(&self, mesh: usize) -> Option<u64> {
        let primitives = &self.root.meshes.get(mesh)?.primitives;
        let mut counts =
            primitives.iter().filter(|primitive| extension(primitive).is_some()).map(|primitive| {
                let position = primitive.attributes.get(&Checked::Valid(Semantic::Positions));
                let accessor = position.and_then(|index| self.root.accessors.get(index.value()));
                accessor.map_or(0, |accessor| accessor.count.0)
            });
        let first = counts.next()?;
        Some(counts.fold(first, u64::saturating_add))
    }

    /// All splats of a mesh, primitive after primitive.
    pub(crate) fn mesh_splats(&self, mesh: usize, warnings: &mut Vec<String>) -> Result<Splats, GltfError> {
        let mut all = Splats::default();
        for (position, primitive) in self.root.meshes[mesh].primitives.iter().enumerate() {
            if let Some(settings) = extension(primitive) {
                let object = match self.root.meshes[mesh].primitives.len() {
                    1 => self.mesh_name(mesh),
                    _ => format!("{}, primitive {position}", self.mesh_name(mesh)),
                };
                let part = Reader { source: self, object, primitive }.read(settings, warnings)?;
                all.append(part);
            }
        }
        Ok(all)
    }
}

/// A splat primitive.
struct Reader<'a> {
    source: &'a Source,
    object: String,
    primitive: &'a Primitive,
}

impl Reader<'_> {
    fn read(&self, settings: &Value, warnings: &mut Vec<String>) -> Result<Splats, GltfError> {
        self.check_settings(settings, warnings)?;
        let positions = self.required("POSITION")?;
        // Positions of other types need KHR_mesh_quantization, which needs nothing else.
        let means: Vec<[f32; 3]> = self.attribute("POSITION", positions, None, &ANY)?;
        let n = means.len();
        self.check("POSITION", &means, "is not finite", |v| v.is_finite())?;
        let signed = [(F32, false), (I8, true), (I16, true)];
        let unsigned = [(F32, false), (U8, false), (U8, true), (U16, false), (U16, true)];
        let shares = [(F32, false), (U8, true), (U16, true)];

        let quaternions: Vec<[f32; 4]> = self.extended("ROTATION", n, &signed)?;
        self.check("ROTATION", &quaternions, "is not finite", |v| v.is_finite())?;
        let mut orientations = Vec::with_capacity(n);
        for (row, &[x, y, z, w]) in quaternions.iter().enumerate() {
            let length = quaternion::norm([w, x, y, z]);
            orientations.push(if (length - 1.0).abs() < 1e-6 {
                [w, x, y, z]
            } else {
                quaternion::try_normalize([w, x, y, z]).ok_or_else(|| {
                    let what = format!("the rotation of splat {row} has no length; give it (0, 0, 0, 1)");
                    self.invalid("ROTATION", what)
                })?
            });
        }
        drop(quaternions);
        let mut scales: Vec<[f32; 3]> = self.extended("SCALE", n, &unsigned)?;
        self.linear(&mut scales, warnings)?;
        self.check("SCALE", &scales, "is negative or not finite", |v| v.is_finite() && v >= 0.0)?;
        let opacities: Vec<[f32; 1]> = self.extended("OPACITY", n, &shares)?;
        self.check("OPACITY", &opacities, "is not between 0 and 1", |v| (-1e-3..=1.001).contains(&v))?;
        let opacities = opacities.into_flattened().into_iter().map(|v| v.clamp(0.0, 1.0)).collect();
        let (sh_degree, sh_coefficients) = self.harmonics(n)?;
        let mut splats = Splats {
            means,
            orientations,
            scales,
            opacities,
            sh_degree,
            sh_coefficients,
            ..Splats::default()
        };
        if settings.get("colorSpace").and_then(Value::as_str) == Some("lin_rec709_display") {
            warnings.push(format!(
                "{}: its colours are linear; they were brought to display values to first order",
                self.object
            ));
            ColorEncoding::LINEAR.bring_to_display(&mut splats.sh_coefficients, splats.sh_degree);
        }
        let share = |name: &str| -> Result<Vec<f32>, GltfError> {
            match self.accessor(&format!("_{name}")) {
                Some(index) => {
                    let values: Vec<[f32; 1]> = self.attribute(name, index, Some(n), &shares)?;
                    self.check(name, &values, "is not between 0 and 1", |v| (0.0..=1.0).contains(&v))?;
                    Ok(values.into_flattened())
                }
                None => Ok(vec![1.0; n]),
            }
        };
        splats.occupancies = share(&crate::OCCUPANCY[1..])?;
        splats.identity_probabilities = share(&crate::IDENTITY[1..])?;
        splats.identities = self.identities(n)?;
        splats.rows = match self.accessor(crate::ROW) {
            Some(index) => {
                let halves: Vec<[f32; 2]> = self.attribute(crate::ROW, index, Some(n), &[(U16, false)])?;
                halves.into_iter().map(|[low, high]| low as u32 | ((high as u32) << 16)).collect()
            }
            None => vec![Splats::NO_ROW; n],
        };
        Ok(splats)
    }

    /// Scales of drafts of the extension, and of what exported by them, are logarithms.
    fn linear(&self, scales: &mut [[f32; 3]], warnings: &mut Vec<String>) -> Result<(), GltfError> {
        let values = scales.as_flattened_mut();
        let below = values.iter().filter(|value| **value < 0.0).count();
        let by_draft = self.source.has_logarithmic_scales();
        if below == 0 && !by_draft {
            return Ok(());
        }
        // Splats are mostly smaller than a metre.
        if !by_draft && 2 * below < values.len() {
            let what = format!(
                "{below} of {} values are negative: they are damaged, or logarithms as in drafts of {EXTENSION}; \
                 export linear scales",
                values.len()
            );
            return Err(self.invalid("SCALE", what));
        }
        warnings.push(format!(
            "{}: its scales are logarithms, as in drafts of {EXTENSION}; they were read as such",
            self.object
        ));
        values.iter_mut().for_each(|value| *value = value.exp());
        Ok(())
    }

    /// The instances that every splat may belong to; empty where the file has none.
    fn identities(&self, n: usize) -> Result<Vec<IdentityShares>, GltfError> {
        let accessors = (self.accessor(crate::INSTANCE_IDS), self.accessor(crate::INSTANCE_SHARES));
        let (Some(ids), Some(shares)) = accessors else { return Ok(Vec::new()) };
        let ids: Vec<[f32; 4]> = self.attribute(crate::INSTANCE_IDS, ids, Some(n), &[(U16, false)])?;
        let shares: Vec<[f32; 4]> =
            self.attribute(crate::INSTANCE_SHARES, shares, Some(n), &[(F32, false)])?;
        let outside = "is not between 0 and 1";
        self.check(&crate::INSTANCE_SHARES[1..], &shares, outside, |v| (0.0..=1.0).contains(&v))?;
        let entry = |(id, share): (f32, f32)| IdentityShare { id: id as u16, share };
        Ok(ids
            .into_iter()
            .zip(shares)
            .map(|(ids, shares)| std::array::from_fn(|place| entry((ids[place], shares[place]))))
            .collect())
    }

    fn check_settings(&self, settings: &Value, warnings: &mut Vec<String>) -> Result<(), GltfError> {
        if self.accessor("POSITION").is_none() || self.accessor(&format!("_{EXTENSION}:ROTATION")).is_none() {
            let packed = settings.get("extensions").and_then(Value::as_object);
            if let Some((name, _)) = packed.and_then(|packed| packed.iter().next()) {
                return Err(unknown_extension(&self.source.path, name));
            }
        }
        if self.accessor(&format!("_{EXTENSION}:SCALE")).is_none() && self.accessor("_SCALE").is_some() {
            let what = format!(
                "its attributes are those of an early draft of {EXTENSION} (_ROTATION, _SCALE), in which their \
                 meaning changed; export it again by the ratified extension"
            );
            return Err(self.source.invalid(self.object.clone(), what));
        }
        for key in ["kernel", "colorSpace"] {
            if settings.get(key).and_then(Value::as_str).is_none() {
                let taken = if key == "kernel" { "ellipse" } else { "srgb_rec709_display" };
                warnings.push(format!("{}: it has no {key}; taken as '{taken}'", self.object));
            }
        }
        let known = [
            ("kernel", ["ellipse", ""]),
            ("colorSpace", ["srgb_rec709_display", "lin_rec709_display"]),
            ("projection", ["perspective", ""]),
            ("sortingMethod", ["cameraDistance", ""]),
        ];
        for (key, values) in known {
            if let Some(value) = settings.get(key).and_then(Value::as_str)
                && !values.contains(&value)
            {
                let taken = values[0];
                warnings.push(format!("{}: {key} '{value}' is not known; taken as '{taken}'", self.object));
            }
        }
        if self.primitive.mode != Checked::Valid(Mode::Points) {
            warnings.push(format!(
                "{}: its mode is not POINTS (0), as splats need; read all the same",
                self.object
            ));
        }
        if self.primitive.indices.is_some() {
            warnings.push(format!("{}: its indices do not count for splats", self.object));
        }
        if self.primitive.targets.is_some() {
            warnings.push(format!("{}: its morph targets do not count for splats", self.object));
        }
        Ok(())
    }

    /// Accessor of an attribute by its name in the JSON after renaming.
    fn accessor(&self, name: &str) -> Option<usize> {
        let semantic = match name.strip_prefix('_') {
            Some(rest) => Semantic::Extras(rest.to_owned()),
            None => Semantic::Positions,
        };
        self.primitive.attributes.get(&Checked::Valid(semantic)).map(gltf::json::Index::value)
    }

    fn required(&self, name: &str) -> Result<usize, GltfError> {
        self.accessor(name).ok_or_else(|| {
            let shown = name.trim_start_matches('_');
            self.source.invalid(
                self.object.clone(),
                format!("the attribute {shown} is missing; export the splats whole"),
            )
        })
    }

    fn attribute<const N: usize>(
        &self,
        name: &str,
        accessor: usize,
        count: Option<usize>,
        types: &[(gltf::json::accessor::ComponentType, bool)],
    ) -> Result<Vec<[f32; N]>, GltfError> {
        let object = format!("{}, {name}", self.object);
        self.source.numbers(accessor, &Expected { object: &object, count, types })
    }

    /// A required attribute of the extension.
    fn extended<const N: usize>(
        &self,
        name: &str,
        count: usize,
        types: &[(gltf::json::accessor::ComponentType, bool)],
    ) -> Result<Vec<[f32; N]>, GltfError> {
        let accessor = self.required(&format!("_{EXTENSION}:{name}"))?;
        self.attribute(&format!("{EXTENSION}:{name}"), accessor, Some(count), types)
    }

    fn invalid(&self, name: &str, what: String) -> GltfError {
        self.source.invalid(format!("{}, {name}", self.object), what)
    }

    fn check<const N: usize>(
        &self,
        name: &str,
        values: &[[f32; N]],
        what: &str,
        fine: impl Fn(f32) -> bool,
    ) -> Result<(), GltfError> {
        match values.as_flattened().iter().position(|value| !fine(*value)) {
            Some(at) => {
                let value = values.as_flattened()[at];
                Err(self.invalid(
                    name,
                    format!("the value {value} of splat {} {what}; leave that splat out", at / N),
                ))
            }
            None => Ok(()),
        }
    }

    /// Degree, and coefficients splat by splat.
    fn harmonics(&self, n: usize) -> Result<(u8, Vec<f32>), GltfError> {
        let mut accessors: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        for degree in 0..=3 {
            for order in 0..2 * degree + 1 {
                let name = format!("_{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}");
                if let Some(accessor) = self.accessor(&name) {
                    accessors.insert((degree, order), accessor);
                }
            }
        }
        let highest = accessors.keys().map(|(degree, _)| *degree).max().unwrap_or(0);
        let stride = 3 * (highest + 1) * (highest + 1);
        let mut coefficients = vec![0.0; n * stride];
        for degree in 0..=highest {
            for order in 0..2 * degree + 1 {
                let name = format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}");
                let Some(&accessor) = accessors.get(&(degree, order)) else {
                    let what =
                        format!("it is missing, but the splats have degree {highest}; degrees must be whole");
                    return Err(self.invalid(&name, what));
                };
                let values: Vec<[f32; 3]> = self.attribute(&name, accessor, Some(n), &[(F32, false)])?;
                self.check(&name, &values, "is not finite", |v| v.is_finite())?;
                let at = 3 * (degree * degree + order);
                for (row, value) in coefficients.chunks_exact_mut(stride).zip(&values) {
                    row[at..at + 3].copy_from_slice(value);
                }
            }
        }
        Ok((highest as u8, coefficients))
    }
}
