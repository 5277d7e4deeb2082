//! Fits of objects: kept, and saved with the run, until the field takes them over, so that a run that was stopped fits
//! none of them again.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::checkpoint::StateTensor;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::Found;
use super::parts::{Bending, InPlace, Jointed};
use super::start::Fitted;

/// Findings about objects, by label (dense index + 1). Gaussians are saved as tensors, everything else as JSON.
#[derive(Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KnownObjects {
    /// How they move as a whole.
    pub(crate) rigid: BTreeMap<u16, Found>,
    /// Their parts on joints; `None` where they have none.
    pub(crate) parts: BTreeMap<u16, Option<Jointed>>,
    /// Those that deform where they stand.
    #[serde(default)]
    pub(crate) bending: BTreeMap<u16, Bending>,
    /// True once all objects were tried for motion; a state of version 1 does not say.
    #[serde(default)]
    pub(crate) is_searched: bool,
}

/// Error of what stays in place, of that of a motion as a whole, up to which it explains as much, with less freedom.
const AS_MUCH: f64 = 1.02;

/// Start of the names of tensors.
const TENSORS: &str = "objects.";

impl KnownObjects {
    pub(crate) fn is_empty(&self) -> bool {
        self.rigid.is_empty() && self.parts.is_empty() && !self.is_searched
    }

    /// The motion of an object as a whole, where one was found.
    pub(crate) fn moving(&self, label: u16) -> Option<&Fitted> {
        match self.rigid.get(&label) {
            Some(Found::Moves(fitted)) => Some(fitted),
            _ => None,
        }
    }

    /// The part of an object on a joint, where one was found.
    pub(crate) fn jointed(&self, label: u16) -> Option<&Jointed> {
        self.parts.get(&label)?.as_ref()
    }

    /// True where the motion of an object is known: as a whole, of a part, or how it deforms.
    pub(crate) fn is_found(&self, label: u16) -> bool {
        self.moving(label).is_some() || self.is_found_in_place(label)
    }

    /// The same of what stays where it is.
    pub(crate) fn is_found_in_place(&self, label: u16) -> bool {
        self.jointed(label).is_some() || self.bending.contains_key(&label)
    }

    /// Keeps that an object stands still but for a part that turns in place.
    pub(crate) fn insert_turning(&mut self, label: u16, part: Jointed) {
        self.rigid.insert(label, Found::Nothing);
        self.parts.insert(label, Some(part));
    }

    /// Keeps what was looked for of an object that stays in place, instead of a motion as a whole that explains no more.
    pub(crate) fn insert_in_place(&mut self, label: u16, found: Option<InPlace>) {
        let most = self.moving(label).map_or(f64::INFINITY, |whole| AS_MUCH * whole.error);
        match found {
            Some(InPlace::Jointed(part)) if part.errors[0] <= most => self.insert_turning(label, part),
            Some(InPlace::Bends(bending)) if bending.error <= most => {
                self.rigid.insert(label, Found::Nothing);
                self.parts.insert(label, None);
                self.bending.insert(label, bending);
            }
            _ => drop(self.parts.insert(label, None)),
        }
    }

    /// Sets of Gaussians, each under its name.
    fn sets(&mut self) -> Vec<(String, &mut Gaussians)> {
        let mut sets = Vec::new();
        for (label, found) in &mut self.rigid {
            if let Found::Moves(fitted) = found {
                sets.push((format!("{TENSORS}{label}.whole"), &mut fitted.gaussians));
            }
        }
        for (label, found) in &mut self.parts {
            let Some(Jointed { base, part, second, .. }) = found else { continue };
            sets.push((format!("{TENSORS}{label}.base"), base));
            sets.push((format!("{TENSORS}{label}.part"), &mut part.gaussians));
            if let Some(second) = second {
                sets.push((format!("{TENSORS}{label}.second"), &mut second.gaussians));
            }
        }
        for (label, found) in &mut self.bending {
            sets.push((format!("{TENSORS}{label}.bending"), &mut found.gaussians));
        }
        sets
    }

    /// JSON and tensors to save; nothing where nothing is known.
    pub(crate) fn saved(&self) -> (Option<Value>, Vec<(String, StateTensor)>) {
        if self.is_empty() {
            return (None, Vec::new());
        }
        let mut tensors = Vec::new();
        for (name, gaussians) in self.clone().sets() {
            for (parameter, values) in gaussians.tensors() {
                tensors.push((format!("{name}.{}", parameter.name), StateTensor::F32(values.to_vec())));
            }
        }
        (serde_json::to_value(self).ok(), tensors)
    }

    /// What [`Self::saved`] gave; `None` when it is damaged, or not of a capture with so many instances and times.
    pub(crate) fn restored(
        json: Value,
        tensors: &mut BTreeMap<String, StateTensor>,
        instances: usize,
        times: usize,
    ) -> Option<Self> {
        let mut known: Self = serde_json::from_value(json).ok()?;
        let labels = known.rigid.keys().chain(known.parts.keys()).chain(known.bending.keys());
        let are_labels = labels.copied().all(|label| (1..=instances).contains(&usize::from(label)));
        let of_rigid = known.rigid.values().filter_map(|found| match found {
            Found::Moves(fitted) => Some(
                fitted.poses.len() == fitted.shares.len() && {
                    let last = fitted.poses.last_key_value();
                    last.is_some_and(|(time, _)| *time < times)
                },
            ),
            _ => None,
        });
        let of_parts = known.parts.values().flatten().flat_map(|found| {
            found.parts().map(|part| part.values.last_key_value().is_some_and(|(time, _)| *time < times))
        });
        let of_bending = known.bending.values().map(|found| found.shifts.are_sound(times));
        if !are_labels || !of_rigid.chain(of_parts).chain(of_bending).all(|fits| fits) {
            return None;
        }
        for (name, gaussians) in known.sets() {
            let StateTensor::F32(means) = tensors.get(&format!("{name}.means"))? else { return None };
            *gaussians = Gaussians::zeros(means.len() / 3);
            for (parameter, values) in gaussians.tensors_mut() {
                let Some(StateTensor::F32(saved)) = tensors.remove(&format!("{name}.{}", parameter.name))
                else {
                    return None;
                };
                if saved.len() != values.len() || !saved.iter().all(|value| value.is_finite()) {
                    return None;
                }
                values.copy_from_slice(&saved);
            }
        }
        Some(known)
    }
}

#[cfg(test)]
mod tests {
    use cif_field::tracks::{JointKind, RotationEvidence};
    use glam::{DQuat, DVec3};

    use super::super::parts::{Hinge, JointedPart};
    use super::*;

    fn part(error: f64) -> Jointed {
        let hinge = Hinge { kind: JointKind::Revolute, axis: DVec3::X, point: DVec3::ZERO };
        let gaussians = || Gaussians::zeros(1);
        let values = BTreeMap::from([(0, 0.0), (1, 0.5)]);
        let on_joint = || JointedPart { gaussians: gaussians(), hinge, values: values.clone() };
        Jointed {
            base: gaussians(),
            part: on_joint(),
            second: Some(Box::new(on_joint())),
            errors: [error, 0.4],
        }
    }

    fn whole(error: f64) -> Found {
        Found::Moves(Box::new(Fitted {
            poses: BTreeMap::new(),
            shares: BTreeMap::new(),
            gaussians: Gaussians::zeros(1),
            reference: (DQuat::IDENTITY, DVec3::ZERO),
            rotation: RotationEvidence::Assumed,
            is_turned: false,
            error,
            unturned: None,
            bent: None,
            is_ball: false,
            is_surrounded: false,
            way: "slides".into(),
        }))
    }

    #[test]
    fn a_part_is_kept_instead_of_a_motion_as_a_whole_that_explains_no_more() {
        for (of_part, of_whole, is_kept) in [(0.10, 0.11, true), (0.112, 0.11, true), (0.114, 0.11, false)] {
            let mut known = KnownObjects::default();
            known.rigid.insert(1, whole(of_whole));
            known.insert_in_place(1, Some(InPlace::Jointed(part(of_part))));
            assert_eq!(known.jointed(1).is_some(), is_kept, "{of_part}, {of_whole}");
            assert_eq!(known.moving(1).is_none(), is_kept, "{of_part}, {of_whole}");
            // It was looked for, whatever is kept.
            assert!(known.parts.contains_key(&1));
        }
        let mut known = KnownObjects::default();
        known.insert_in_place(1, Some(InPlace::Jointed(part(0.2))));
        assert!(known.jointed(1).is_some());
    }

    #[test]
    fn parts_come_back_as_they_were_saved_also_of_runs_that_knew_no_second_one() {
        let mut known = KnownObjects::default();
        known.insert_turning(1, part(0.1));
        let (json, tensors) = known.saved();
        let (json, tensors): (_, BTreeMap<_, _>) = (json.unwrap(), tensors.into_iter().collect());
        let restored = |json: Value| KnownObjects::restored(json, &mut tensors.clone(), 1, 2);
        let values = |known: &KnownObjects| -> Vec<BTreeMap<usize, f64>> {
            known.parts[&1].iter().flat_map(Jointed::parts).map(|part| part.values.clone()).collect()
        };
        assert_eq!(values(&restored(json.clone()).unwrap()), values(&known));
        assert_eq!(values(&known).len(), 2);
        let mut older = json.clone();
        older["parts"]["1"].as_object_mut().unwrap().remove("second").unwrap();
        assert_eq!(values(&restored(older).unwrap()), values(&known)[..1]);
        let mut late = json;
        late["parts"]["1"]["second"]["values"]["2"] = Value::from(0.1);
        assert!(restored(late).is_none(), "a value at a time that the capture does not have");
    }

    #[test]
    fn what_rounds_to_zero_is_shown_without_a_sign() {
        let mut jointed = part(0.1);
        jointed.second = None;
        jointed.part.values = BTreeMap::from([(0, -0.004), (1, 0.5)]);
        assert_eq!(jointed.told(), "a part turns on a hinge, 0 to 29 deg");
        jointed.part.hinge.kind = JointKind::Prismatic;
        jointed.part.values = BTreeMap::from([(0, -0.0004), (1, 0.0623)]);
        assert_eq!(jointed.told(), "a part slides, 0.000 to 0.062");
    }

    fn bending(knot: usize) -> Bending {
        let knots = vec![[[0.25; 3]; 10]; 2];
        let shifts = serde_json::json!({ "first": 1, "knot": knot, "size": 0.5, "knots": knots });
        let gaussians = Gaussians::from_points(&[[0.5, 0.0, 0.25]], &[[0.5; 3]]).unwrap();
        let shifts = serde_json::from_value(shifts).unwrap();
        Bending { gaussians, shifts, place: DVec3::X, error: 0.1 }
    }

    #[test]
    fn what_deforms_comes_back_as_it_was_saved_and_damage_shows() {
        let restored = |knot: usize, times: usize| {
            let mut known = KnownObjects::default();
            known.insert_in_place(1, Some(InPlace::Bends(bending(knot))));
            let (json, tensors) = known.saved();
            KnownObjects::restored(json.unwrap(), &mut tensors.into_iter().collect(), 1, times)
        };
        let known = restored(2, 3).unwrap();
        assert!(known.is_found(1) && known.jointed(1).is_none());
        let (found, saved) = (&known.bending[&1], bending(2));
        assert_eq!((&found.gaussians, found.place), (&saved.gaussians, saved.place));
        let shifted = |bending: &Bending| bending.shifts.shifted(2, &[DVec3::splat(0.5)]);
        assert_eq!(shifted(found), shifted(&saved));
        assert!(restored(0, 3).is_none() && restored(2, 1).is_none());
    }
}
