//! Animation curves of nodes.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3, DVec4};
use gltf::json::accessor::ComponentType::{F32, I8, I16, U8, U16};
use gltf::json::animation::{Interpolation, Property, Sampler};
use gltf::json::validation::Checked;

use super::accessor::Expected;
use super::hierarchy::{Local, vector};
use super::pointers::Pointed;
use super::source::Source;
use crate::rotation_keys::{SamplerExtras, drop_inserted};
use crate::{GltfError, conventions};

/// A value over time.
pub(crate) struct Curve {
    /// Seconds, ascending.
    pub(crate) times: Vec<f32>,
    /// One value per time; w is 0 for vectors.
    values: Vec<DVec4>,
    /// Tangents in and out of every key, for splines.
    tangents: Vec<[DVec4; 2]>,
    pub(crate) interpolation: Interpolation,
    path: Path,
}

/// Property of a node that an animation channel drives.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Path {
    Translation,
    Rotation,
    Scale,
}

/// Curves of a node.
#[derive(Default)]
pub(crate) struct NodeCurves {
    pub(crate) translation: Option<Curve>,
    pub(crate) rotation: Option<Curve>,
    pub(crate) scale: Option<Curve>,
    pub(crate) visibility: Option<Steps>,
}

impl NodeCurves {
    /// Keys of all curves together.
    pub(crate) fn keys(&self) -> usize {
        let curves = [&self.translation, &self.rotation, &self.scale].into_iter().flatten();
        let steps = self.visibility.as_ref().map_or(0, |steps| steps.times.len());
        curves.map(|curve| curve.times.len()).sum::<usize>() + steps
    }
}

/// Shown or hidden over time; a key holds until the next.
pub(crate) struct Steps {
    /// Seconds, ascending.
    pub(crate) times: Vec<f32>,
    /// One value per time.
    visible: Vec<bool>,
}

impl Steps {
    /// True when it can be seen at a time; before the first key as at that.
    pub(crate) fn at(&self, seconds: f32) -> bool {
        self.visible[self.times.partition_point(|time| *time <= seconds).saturating_sub(1)]
    }
}

/// Key times of a sampler.
fn key_times(source: &Source, object: &str, sampler: &Sampler) -> Result<Vec<f32>, GltfError> {
    let expected = Expected { object, count: None, types: &[(F32, false)] };
    let times: Vec<f32> = source.numbers::<1>(sampler.input.value(), &expected)?.into_flattened();
    let ascending = times.windows(2).all(|pair| pair[0] < pair[1]);
    if times.is_empty() || !ascending || !times.iter().all(|time| time.is_finite() && *time >= 0.0) {
        let what = "its key times must be finite, ascending and not before 0";
        return Err(source.invalid(object.to_owned(), what));
    }
    Ok(times)
}

/// Curves of the first animation, by node.
pub(crate) struct Curves(BTreeMap<usize, NodeCurves>);

impl Curves {
    pub(crate) fn read(
        source: &Source,
        locals: &[Local],
        warnings: &mut Vec<String>,
    ) -> Result<Self, GltfError> {
        let mut curves: BTreeMap<usize, NodeCurves> = BTreeMap::new();
        let animations = &source.root.animations;
        if animations.len() > 1 {
            let count = animations.len();
            warnings.push(format!("the first of {count} animations is read; put all motion into one"));
        }
        let Some(animation) = animations.first() else { return Ok(Self(curves)) };
        for (number, channel) in animation.channels.iter().enumerate() {
            let object = || format!("animation 0, channel {number}");
            let node = channel.target.node.value();
            let Some(local) = locals.get(node) else {
                return Err(source.invalid(object(), format!("its node {node} is not in the file")));
            };
            let Checked::Valid(property) = channel.target.path.as_ref() else {
                return Err(
                    source.invalid(object(), "its path is none of translation, rotation, scale, weights")
                );
            };
            if *property == Property::MorphTargetWeights {
                warnings.push(format!("{}: morph targets do not move splats", source.node_name(node)));
                continue;
            }
            if matches!(local, Local::Matrix(_)) {
                let what = format!(
                    "its target, {}, has a matrix; only translation, rotation and scale can be animated",
                    source.node_name(node)
                );
                return Err(source.invalid(object(), what));
            }
            let sampler = animation.samplers.get(channel.sampler.value()).ok_or_else(|| {
                source
                    .invalid(object(), format!("its sampler {} is not in the file", channel.sampler.value()))
            })?;
            let path = match property {
                Property::Translation => Path::Translation,
                Property::Rotation => Path::Rotation,
                _ => Path::Scale,
            };
            let curve = Curve::read(source, &object(), sampler, path)?;
            let of_node = curves.entry(node).or_default();
            let slot = match path {
                Path::Translation => &mut of_node.translation,
                Path::Rotation => &mut of_node.rotation,
                Path::Scale => &mut of_node.scale,
            };
            if slot.replace(curve).is_some() {
                return Err(source.invalid(object(), format!("{} is animated twice", source.node_name(node))));
            }
        }
        for &Pointed { channel, sampler, node } in &source.pointed {
            let object = format!("animation 0, channel {channel}");
            let Some(sampler) = animation.samplers.get(sampler).filter(|_| node < locals.len()) else {
                return Err(
                    source.invalid(object, "its sampler, or the node that it points to, is not in the file")
                );
            };
            let times = key_times(source, &object, sampler)?;
            let types = [(U8, false), (F32, false)];
            let expected = Expected { object: &object, count: Some(times.len()), types: &types };
            let values = source.numbers::<1>(sampler.output.value(), &expected)?;
            let visible = values.into_flattened().into_iter().map(|value| value != 0.0).collect();
            curves.entry(node).or_default().visibility = Some(Steps { times, visible });
        }
        Ok(Self(curves))
    }

    pub(crate) fn of(&self, node: usize) -> Option<&NodeCurves> {
        self.0.get(&node)
    }

    /// Transform of a node in its parent at a time.
    pub(crate) fn local(&self, node: usize, rest: &Local, seconds: f32) -> Local {
        match (self.of(node), rest) {
            (Some(curves), &Local::Parts(translation, rotation, scale)) => {
                let vector = |curve: &Option<Curve>, rest: DVec3| {
                    curve.as_ref().map_or(rest, |curve| curve.at(seconds).truncate())
                };
                let rotation = curves.rotation.as_ref().map_or(rotation, |curve| {
                    conventions::rotation(curve.at(seconds).to_array()).unwrap_or(rotation)
                });
                Local::Parts(vector(&curves.translation, translation), rotation, vector(&curves.scale, scale))
            }
            _ => *rest,
        }
    }
}

/// Keys that our writer put between those of a track.
fn inserted(sampler: &Sampler) -> Vec<usize> {
    let extras = sampler.extras.as_ref().map(|extras| serde_json::from_str::<SamplerExtras>(extras.get()));
    extras.and_then(Result::ok).map_or_else(Vec::new, |extras| extras.cif.inserted)
}

impl Curve {
    fn read(source: &Source, object: &str, sampler: &Sampler, path: Path) -> Result<Self, GltfError> {
        let is_rotation = path == Path::Rotation;
        let Checked::Valid(interpolation) = sampler.interpolation else {
            return Err(
                source.invalid(object.to_owned(), "its interpolation is none of LINEAR, STEP, CUBICSPLINE")
            );
        };
        let mut times = key_times(source, object, sampler)?;
        let per_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let count = Some(times.len() * per_key);
        let signed = [(F32, false), (I8, true), (U8, true), (I16, true), (U16, true)];
        let expected = Expected { object, count, types: if is_rotation { &signed } else { &signed[..1] } };
        let values: Vec<DVec4> = if is_rotation {
            let values: Vec<[f32; 4]> = source.numbers(sampler.output.value(), &expected)?;
            values.into_iter().map(|value| DVec4::from_array(value.map(f64::from))).collect()
        } else {
            let values: Vec<[f32; 3]> = source.numbers(sampler.output.value(), &expected)?;
            values.into_iter().map(|value| vector(value).extend(0.0)).collect()
        };
        if let Some(key) = values.iter().position(|value| !value.is_finite()) {
            return Err(
                source.invalid(object.to_owned(), format!("key {} is not finite; delete it", key / per_key))
            );
        }
        let (mut values, tangents): (Vec<DVec4>, _) = if per_key == 3 {
            values.chunks_exact(3).map(|key| (key[1], [key[0], key[2]])).unzip()
        } else {
            (values, Vec::new())
        };
        if is_rotation
            && let Some(key) =
                values.iter().position(|value| conventions::rotation(value.to_array()).is_none())
        {
            return Err(source
                .invalid(object.to_owned(), format!("the rotation of key {key} has no length; delete it")));
        }
        if is_rotation && interpolation == Interpolation::Linear {
            drop_inserted(&mut times, &mut values, &inserted(sampler));
        }
        Ok(Self { times, values, tangents, interpolation, path })
    }

    /// True when it drives a scale, whose steps show and hide.
    pub(crate) fn hides(&self) -> bool {
        self.path == Path::Scale
    }

    /// Value at a time (glTF 2.0, appendix C): held outside the keys.
    pub(crate) fn at(&self, seconds: f32) -> DVec4 {
        let after = self.times.partition_point(|time| *time <= seconds);
        if after == 0 {
            return self.values[0];
        }
        let before = after - 1;
        if after == self.times.len() || self.times[before] == seconds {
            return self.values[before];
        }
        let (start, end) = (f64::from(self.times[before]), f64::from(self.times[after]));
        let length = end - start;
        let t = (f64::from(seconds) - start) / length;
        let (a, b) = (self.values[before], self.values[after]);
        match self.interpolation {
            Interpolation::Step => a,
            Interpolation::Linear if self.path == Path::Rotation => {
                let (a, b) = (DQuat::from_vec4(a).normalize(), DQuat::from_vec4(b).normalize());
                DVec4::from(a.slerp(b, t))
            }
            Interpolation::Linear => a.lerp(b, t),
            Interpolation::CubicSpline => {
                let (t2, t3) = (t * t, t * t * t);
                let [_, out] = self.tangents[before];
                let [into, _] = self.tangents[after];
                a * (2.0 * t3 - 3.0 * t2 + 1.0)
                    + out * (length * (t3 - 2.0 * t2 + t))
                    + b * (3.0 * t2 - 2.0 * t3)
                    + into * (length * (t3 - t2))
            }
        }
    }
}
