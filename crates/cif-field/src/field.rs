//! A trained scene.

use serde::{Deserialize, Serialize};

use crate::parameters::{LOG_CALIBRATIONS, MLP, PLANES, Tensor, TensorMut};
use crate::{Deformation, Gaussians, Identities, Instance, Record, RecordedCamera, Timeline, Tracks};

/// Order in which a view sorts its Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SortMetric {
    /// Camera-space depth z, as every trainer sorts.
    #[default]
    Z,
    /// Distance to the camera centre, as the interchange formats default to.
    Distance,
}

/// A dynamic Gaussian field with instances.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Canonical Gaussians.
    pub gaussians: Gaussians,
    /// Learned motion; `None` where nothing was learned to move.
    pub deformation: Option<Deformation>,
    /// Recorded motion, put on after the learned one; `None` without.
    pub tracks: Option<Tracks>,
    /// Identity rows, one per Gaussian; `None` before identity estimation or without masks.
    pub identities: Option<Identities>,
    /// Instance table; identity labels index it.
    pub instances: Vec<Instance>,
    /// Captured times.
    pub timeline: Timeline,
    /// Captured cameras, all splits.
    pub cameras: Vec<RecordedCamera>,
    /// Active spherical-harmonics degree, 0 to 3.
    pub sh_degree: u8,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background: [f32; 3],
    /// Order the field was trained with.
    pub sort_metric: SortMetric,
    /// Scene extent: 1.1 x the largest distance of a training camera centre from their mean, metres.
    pub extent: f32,
    /// Origin of the field, and the settings by which a renderer shows it as it was trained.
    pub record: Record,
}

impl Field {
    /// Number of Gaussians N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.gaussians.len()
    }

    /// True when there are no Gaussians.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.gaussians.is_empty()
    }

    /// The Gaussians at a normalised time in [0, 1], in raw form: the deformation's deltas added, then moved by their
    /// tracks. Gaussians that are hidden at this time have an opacity and an occupancy of 0.
    #[must_use]
    pub fn deformed(&self, time: f64) -> Gaussians {
        let mut posed = match &self.deformation {
            Some(deformation) => deformation.apply(&self.gaussians, time),
            None => self.gaussians.clone(),
        };
        if let Some(tracks) = &self.tracks {
            tracks.at(time).apply(&self.gaussians, posed.rows_mut());
        }
        posed
    }

    /// Every learnable tensor, in the order of the table; those that the field has not are empty.
    #[must_use]
    pub fn tensors(&self) -> Vec<Tensor<'_>> {
        let mut tensors = self.gaussians.tensors().to_vec();
        let (planes, mlp) = self.deformation.as_ref().map_or((&[][..], &[][..]), |d| (&d.planes, &d.mlp));
        let calibrations = self.identities.as_ref().map_or(&[][..], |rows| &rows.log_calibrations);
        tensors.extend([(PLANES, planes), (MLP, mlp), (LOG_CALIBRATIONS, calibrations)]);
        tensors
    }

    /// As [`Self::tensors`], to be changed.
    pub fn tensors_mut(&mut self) -> Vec<TensorMut<'_>> {
        let mut tensors = Vec::from(self.gaussians.tensors_mut());
        let (planes, mlp) = match &mut self.deformation {
            Some(deformation) => (&mut deformation.planes[..], &mut deformation.mlp[..]),
            None => (&mut [][..], &mut [][..]),
        };
        let calibrations =
            self.identities.as_mut().map_or(&mut [][..], |rows| &mut rows.log_calibrations[..]);
        tensors.extend([(PLANES, planes), (MLP, mlp), (LOG_CALIBRATIONS, calibrations)]);
        tensors
    }

    /// Gaussians that the deformation network leaves alone, `[N]`: those that stand still, and those of groups that are
    /// exempt from it; empty when it moves all.
    #[must_use]
    pub fn left_alone(&self) -> Vec<bool> {
        let Some(deformation) = &self.deformation else { return Vec::new() };
        let Some(tracks) = &self.tracks else { return deformation.still.clone() };
        let is_exempt = |row: usize| tracks.group(row).is_some_and(|group| !tracks.groups[group].deformed);
        (0..self.len()).map(|row| deformation.is_still(row) || is_exempt(row)).collect()
    }

    /// Time code of every captured frame, `[T]`, ascending: its number, or that of the file that the field was imported
    /// from.
    #[must_use]
    pub fn time_codes(&self) -> Vec<f64> {
        let frames = self.timeline.times.len();
        let recorded = self.record.frame_codes.as_ref().and_then(|codes| codes.codes(frames));
        recorded.unwrap_or_else(|| (0..frames).map(|frame| frame as f64).collect())
    }

    /// True when Gaussians move or deform over time, by learning or by record.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.deformation.is_some() || self.tracks.as_ref().is_some_and(Tracks::moves)
    }

    /// The field with the Gaussians `sources[0], sources[1], ...` instead of its own; they may repeat.
    ///
    /// # Panics
    /// When a source is out of range.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        Self {
            gaussians: self.gaussians.gather(sources),
            deformation: self.deformation.as_ref().map(|deformation| deformation.gather(sources)),
            tracks: self.tracks.as_ref().and_then(|tracks| tracks.gather(sources).compact()),
            identities: self.identities.as_ref().map(|identities| identities.gather(sources)),
            instances: self.instances.clone(),
            timeline: self.timeline.clone(),
            cameras: self.cameras.clone(),
            record: self.record.clone(),
            ..*self
        }
    }

    /// Most probable instance of every Gaussian, `[N]`, as index into [`Field::instances`], `None` for one of no
    /// instance; `None` without identities.
    #[must_use]
    pub fn instance_of_gaussians(&self) -> Option<Vec<Option<u16>>> {
        self.identities.as_ref().map(Identities::argmax)
    }

    /// Gaussians whose most probable instance is `instance` (an index into [`Field::instances`]), ascending;
    /// none without identities.
    #[must_use]
    pub fn members(&self, instance: usize) -> Vec<u32> {
        let of_gaussians = self.instance_of_gaussians().unwrap_or_default();
        let rows = of_gaussians.iter().enumerate();
        rows.filter(|(_, of)| of.is_some_and(|of| usize::from(of) == instance))
            .map(|(row, _)| row as u32)
            .collect()
    }

    /// Instances (indices into [`Field::instances`], ascending) whose label is `label`: those that match
    /// exactly, or, when none does, those that match but for case.
    #[must_use]
    pub fn instances_by_label(&self, label: &str) -> Vec<usize> {
        let matching = |same: &dyn Fn(&str) -> bool| -> Vec<usize> {
            let all = self.instances.iter().enumerate();
            all.filter(|(_, instance)| same(&instance.label)).map(|(index, _)| index).collect()
        };
        let exact = matching(&|other| other == label);
        if exact.is_empty() {
            let folded = label.to_lowercase();
            matching(&|other| other.to_lowercase() == folded)
        } else {
            exact
        }
    }

    /// Gives the field another table of instances, which no Gaussian and no track group is known to be of.
    pub fn replace_instances(&mut self, instances: Vec<Instance>) {
        self.instances = instances;
        self.identities = None;
        self.tracks.iter_mut().for_each(Tracks::forget_instances);
    }

    /// Position in [`Field::instances`] of the instance with a mask value.
    #[must_use]
    pub fn instance_by_id(&self, id: u16) -> Option<usize> {
        self.instances.iter().position(|instance| instance.id == id)
    }
}

#[cfg(test)]
mod tests {
    use crate::testing;

    #[test]
    fn labels_match_exactly_before_they_match_but_for_case() {
        let mut field = testing::field(6, 1);
        let template = field.instances[0].clone();
        field.instances = ["mug", "Mug", "red mug", "MUG", "ÄPFEL"]
            .iter()
            .enumerate()
            .map(|(index, label)| crate::Instance {
                id: index as u16 + 1,
                label: (*label).to_owned(),
                ..template.clone()
            })
            .collect();
        assert_eq!(field.instances_by_label("Mug"), [1]);
        assert_eq!(field.instances_by_label("mUG"), [0, 1, 3]);
        assert_eq!(field.instances_by_label("äpfel"), [4]);
        assert!(field.instances_by_label("m*").is_empty());
        assert_eq!(field.instance_by_id(3), Some(2));
        assert_eq!(field.instance_by_id(9), None);
    }

    #[test]
    fn members_partition_the_gaussians() {
        let field = testing::field(200, 2);
        let mut all: Vec<u32> = (0..field.instances.len()).flat_map(|k| field.members(k)).collect();
        all.sort_unstable();
        assert!(all.into_iter().eq(0..200));
        let unlabelled = crate::Field { identities: None, ..field };
        assert!(unlabelled.members(0).is_empty());
    }

    #[test]
    fn a_static_field_does_not_move() {
        let mut field = testing::field(20, 3);
        assert_ne!(field.deformed(0.5).means, field.gaussians.means);
        field.deformation = None;
        assert_eq!(field.deformed(0.5), field.gaussians);
    }
}
