//! Objects with parts on joints: found where an object is at rest but for these, given Gaussians in groups, of which those of
//! the parts move on the joints.

use cif_field::Instance;
use cif_field::tracks::{Joint, TrackGroup};
use rayon::prelude::*;

use super::Trainer;
use super::objects::in_time;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::objects::{self, BENDS_NO_BETTER, Fitted, InPlace, Jointed, Order, Plane};
use crate::phase::Phase;

impl Trainer {
    /// Looks for parts of objects (labels: dense index + 1) that do not travel, and of which nothing is declared: among all
    /// that moves, a joint far away does what travelling does. Of what was found to move as a whole in place, where bending
    /// explains more, a part is kept that explains as much, as it has less freedom.
    pub(super) fn find_parts(&mut self, labels: &[u16], plane: Option<&Plane>) -> Result<(), TrainError> {
        let motion = &self.state.config.motion;
        if !motion.rigid || !motion.parts {
            return Ok(());
        }
        let known = &self.state.objects;
        let may_bend = |fitted: &Fitted| fitted.bent.is_some_and(|bent| bent < BENDS_NO_BETTER);
        let is_open =
            |label: &u16| known.moving(*label).is_none_or(may_bend) && self.state.told(*label).is_none();
        let candidates: Vec<u16> = labels.iter().copied().filter(is_open).collect();
        let is_known = |label: &&u16| known.parts.contains_key(*label);
        let unknown: Vec<u16> = candidates.iter().filter(|label| !is_known(label)).copied().collect();
        if !unknown.is_empty() {
            self.find_unknown_parts(&unknown, plane)?;
        }
        for label in candidates {
            if self.state.objects.is_found_in_place(label) {
                self.state.guidance.travelling[usize::from(label)] = true;
            }
        }
        Ok(())
    }

    /// Looks for parts of objects of which that is not known yet, and keeps what is found, also where the run is stopped
    /// meanwhile.
    fn find_unknown_parts(&mut self, labels: &[u16], plane: Option<&Plane>) -> Result<(), TrainError> {
        let state = &self.state;
        let entered = state.phases.enter(Phase::Joints, labels.len());
        let order = Order::of(&state.dataset, &state.frames, &state.phases)?;
        entered.until(self.deadline(Phase::Joints));
        let surroundings = self.surroundings(plane, &order);
        let find = |label: &u16| {
            let found = in_time(objects::find_part(*label, &state.dataset, &state.frames, surroundings))?;
            state.phases.advance();
            Ok(found)
        };
        let found: Vec<Result<Option<Option<InPlace>>, TrainError>> = labels.par_iter().map(find).collect();
        drop(entered);
        let (mut left_out, mut failed) = (Vec::new(), None);
        for (label, found) in labels.iter().zip(found) {
            match found {
                Ok(Some(found)) => self.state.objects.insert_in_place(*label, found),
                Ok(None) => left_out.push(*label),
                Err(error) => failed = failed.or(Some(error)),
            }
        }
        self.note_left_out(&left_out, "taken to have no parts on joints");
        failed.map_or(Ok(()), Err)
    }

    /// Gives an object with parts groups for its base and each of them.
    pub(super) fn add_parts(&mut self, instance: &Instance, found: &Jointed) {
        let [with, without] = found.errors;
        let name = &instance.label;
        self.messages.push(TrainEvent::note(format!(
            "{name} rests, but {} (error {with:.3} on pixels left out, {without:.3} without)",
            found.told()
        )));
        let base = TrackGroup::of_instance(instance, found.part.hinge.point);
        let base = self.add_group(found.base.clone(), base, &[]);
        for part in found.parts() {
            let times = &self.state.dataset.times;
            let values: Vec<(f64, f64)> =
                part.values.iter().map(|(time, value)| (times[*time], *value)).collect();
            let joint = Joint { base, kind: part.hinge.kind, axis: part.hinge.axis };
            let groups = self.state.field.tracks.as_ref().map_or(&[][..], |tracks| &tracks.groups);
            let group = TrackGroup::jointed(name, part.hinge.point, joint, &values, groups);
            let shares = vec![1.0; group.poses.len()];
            self.add_group(part.gaussians.clone(), group, &shares);
        }
    }
}
