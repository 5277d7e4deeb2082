//! Instances that rest: the network moves their Gaussians only to draw light and shadow, or what shines through them.
//! They are taken out of it as a whole where the held-out pixels hardly miss it, so that they leave as one thing that
//! stands still; likewise what stays behind of an object that has poses.

use cif_field::Field;
use glam::DVec3;

use super::Bench;
use super::bench::{JudgedErrors, gain};
use super::motions::{Motion, put_to_rest};
use crate::config::ObjectMotion;
use crate::error::TrainError;
use crate::state::State;

/// Loss on held-out pixels, dB, up to which instances are taken to rest: each on its own pixels, and together on all.
const OWN_LOSS: f64 = 1.0;
const LOSS: f64 = 0.05;

/// Displacement of the Gaussians of an instance, root mean square, of their spread, up to which it trembles, as where the
/// network draws reflections by shifting them, and the losses, dB, up to which it is put to rest
/// anyway, as its colours are still trained: on its own pixels, and together on all, which shadows on large things are
/// worth more.
const TREMBLES: f64 = 0.06;
const TREMBLING_LOSSES: [f64; 2] = [8.0, 0.3];

/// Share of its image on labelled pixels from which a Gaussian may leave with its instance.
const LABELLED_SHARE: f32 = 0.2;

/// Puts to rest what the network moves of every instance whose pixels allow it; returns the number of Gaussians. It
/// does nothing before identities are estimated.
pub(crate) fn rest_instances(bench: &mut Bench<'_>, motions: &[Motion]) -> Result<usize, TrainError> {
    let instance_of = rows_of_instances(&bench.state.field);
    let mut resting = may_rest(bench.state, &instance_of);
    if !resting.contains(&true) {
        return Ok(0);
    }
    let trembling = trembling(bench.state, motions, &instance_of);
    let settings = bench.state.color_settings();
    let before = bench.errors(None, &settings)?;
    while resting.contains(&true) {
        let mut trial = bench.state.field.clone();
        let at_rest = |row: usize| {
            instance_of[row].is_some_and(|instance| resting[instance]) && !is_mover(bench.state, row)
        };
        let count = put_to_rest(&mut trial, motions, at_rest);
        let after = bench.errors(Some(&trial), &settings)?;
        let missed = missed(&before, &after, &resting, &trembling);
        if missed.is_empty() {
            bench.state.field = trial;
            return Ok(count);
        }
        missed.into_iter().for_each(|instance| resting[instance] = false);
    }
    Ok(0)
}

/// True for instances that the network shifts little compared with their size.
fn trembling(state: &State, motions: &[Motion], instance_of: &[Option<usize>]) -> Vec<bool> {
    let field = &state.field;
    let is_still = |row: usize| field.deformation.as_ref().is_none_or(|network| network.is_still(row));
    let mut shifts = vec![Shift::default(); field.instances.len()];
    for (row, instance) in instance_of.iter().enumerate() {
        if let Some(instance) = instance.filter(|_| !is_mover(state, row)) {
            let displacement = if is_still(row) { 0.0 } else { f64::from(motions[row].displacement) };
            let place = DVec3::from_array(field.gaussians.means[row].map(f64::from));
            shifts[instance].add(f64::from(field.gaussians.opacity(row)), place, displacement);
        }
    }
    shifts.iter().map(Shift::trembles).collect()
}

/// The instance of every row that may leave with it.
fn rows_of_instances(field: &Field) -> Vec<Option<usize>> {
    let Some((identities, of)) = field.identities.as_ref().zip(field.instance_of_gaussians()) else {
        return vec![None; field.len()];
    };
    let shares = identities.labelled_shares();
    of.into_iter()
        .zip(shares)
        .map(|(of, share)| of.filter(|_| share >= LABELLED_SHARE).map(usize::from))
        .collect()
}

/// True for Gaussians that were made for an object that travels or deforms, or that have poses.
fn is_mover(state: &State, row: usize) -> bool {
    let is_posed = state.field.tracks.as_ref().is_some_and(|tracks| tracks.group(row).is_some());
    is_posed || state.guidance.moves(row)
}

/// Instances of which something goes through the network that is no mover, and that are not declared free.
fn may_rest(state: &State, instance_of: &[Option<usize>]) -> Vec<bool> {
    let field = &state.field;
    let mut may_rest = vec![false; field.instances.len()];
    let Some(deformation) = &field.deformation else { return may_rest };
    for (row, instance) in instance_of.iter().enumerate() {
        if let Some(instance) = *instance
            && state.told(instance as u16 + 1) != Some(ObjectMotion::Free)
        {
            may_rest[instance] |= !deformation.is_still(row) && !is_mover(state, row);
        }
    }
    may_rest
}

/// Sums over the Gaussians of an instance, by their opacities.
#[derive(Clone, Debug, Default)]
struct Shift {
    weight: f64,
    places: DVec3,
    squared_places: f64,
    squared_displacements: f64,
}

impl Shift {
    fn add(&mut self, weight: f64, place: DVec3, displacement: f64) {
        self.weight += weight;
        self.places += weight * place;
        self.squared_places += weight * place.length_squared();
        self.squared_displacements += weight * displacement * displacement;
    }

    /// True of displacements that are small compared with the spread of the places.
    fn trembles(&self) -> bool {
        let spread = self.squared_places / self.weight - (self.places / self.weight).length_squared();
        self.squared_displacements / self.weight <= TREMBLES * TREMBLES * spread
    }
}

/// Instances that must not rest: those whose own pixels miss the network or, where all pixels together do, the one that
/// costs most. Pixels of instances that tremble may lose more; where those of the others lose too much, it is one of the
/// others, if one costs anything.
fn missed(before: &JudgedErrors, after: &JudgedErrors, resting: &[bool], trembling: &[bool]) -> Vec<usize> {
    let own = |errors: &JudgedErrors, instance: usize| errors.of_labels[instance + 1].sum();
    let tried = || (0..resting.len()).filter(|instance| resting[*instance]);
    let limit = |instance: usize| if trembling[instance] { TREMBLING_LOSSES[0] } else { OWN_LOSS };
    let misses = |instance: &usize| gain(own(after, *instance), own(before, *instance)) > limit(*instance);
    let missed: Vec<usize> = tried().filter(misses).collect();
    let others = |errors: &JudgedErrors| {
        let excused = tried().filter(|instance| trembling[*instance]).map(|instance| own(errors, instance));
        errors.all.sum() - excused.sum::<f64>()
    };
    let others_fit = gain(others(after), others(before)) <= LOSS;
    let all_fit = gain(after.all.sum(), before.all.sum()) <= TREMBLING_LOSSES[1];
    if !missed.is_empty() || (others_fit && all_fit) {
        return missed;
    }
    let cost = |instance: usize| own(after, instance) - own(before, instance);
    let dearest = |among: &dyn Fn(usize) -> bool| {
        tried().filter(|instance| among(*instance)).max_by(|a, b| cost(*a).total_cmp(&cost(*b)))
    };
    let of_others = dearest(&|instance| !others_fit && !trembling[instance] && cost(instance) > 0.0);
    of_others.or_else(|| dearest(&|_| true)).into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::super::bench::SquaredError;
    use super::super::motions::{probe, probe_times};
    use super::*;
    use crate::stage::Stage;
    use crate::trainer::guard_tests::support::{Scene, capture, small_config, stopped_after};

    #[test]
    fn instances_rest_where_their_pixels_allow_it() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene::default());
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 200, 10);
        (config.motion.rigid, config.effects.still_every) = (false, 0);
        let mut trainer = stopped_after(&dataset, &config, 261);
        // Whether pixels miss what a short run has learnt differs from seed to seed: here they miss nothing.
        trainer.state.field.deformation.as_mut().unwrap().mlp.fill(0.0);
        let rows: Vec<u32> = (0..trainer.state.field.len() as u32).collect();
        let motions = probe(
            trainer.state.field.deformation.as_ref().unwrap(),
            &trainer.state.field.gaussians,
            &rows,
            &probe_times(&trainer.state.dataset.times),
        );
        let instance_of = rows_of_instances(&trainer.state.field);
        assert!(may_rest(&trainer.state, &instance_of)[0]);
        let mut events = Vec::new();
        let mut bench = trainer.at_judgement(Stage::Instance, 1, &mut events);
        let before = bench.error(None).unwrap();
        assert!(rest_instances(&mut bench, &motions).unwrap() > 10);
        let after = bench.error(None).unwrap();
        for (row, instance) in instance_of.iter().enumerate() {
            let is_still = trainer.state.field.deformation.as_ref().unwrap().is_still(row);
            let at_rest = *instance == Some(0) && !is_mover(&trainer.state, row);
            assert!(is_still || !at_rest, "{row} of a ball that rests");
            assert!(!is_still || !is_mover(&trainer.state, row), "{row} of the ball that moves");
        }
        assert!(!may_rest(&trainer.state, &instance_of)[0]);
        assert_eq!(gain(after, before), 0.0);
        trainer.state.config.motion.of =
            ["ball 4", "ball 7", "ball 9"].map(|name| (name.to_owned(), ObjectMotion::Free)).into();
        assert_eq!(may_rest(&trainer.state, &instance_of), [false; 3]);
    }

    #[test]
    fn what_misses_the_network_does_not_rest() {
        let errors = |of: [f64; 4]| {
            let mut errors = JudgedErrors { all: SquaredError::default(), of_labels: Vec::new() };
            for difference in of {
                let mut of_label = SquaredError::default();
                of_label.add(difference);
                errors.all.add(difference);
                errors.of_labels.push(of_label);
            }
            errors
        };
        let before = errors([0.1; 4]);
        let missed =
            |after: [f64; 4], resting: [bool; 3]| missed(&before, &errors(after), &resting, &[false; 3]);
        assert!(missed([0.1, 0.1005, 0.1, 0.1], [true; 3]).is_empty());
        assert_eq!(missed([0.1, 0.1, 0.2, 0.1], [true; 3]), [1]);
        assert_eq!(missed([0.1, 0.11, 0.105, 0.1], [true; 3]), [0], "all pixels together miss it");
        assert_eq!(missed([0.2, 0.1, 0.1, 0.1], [true; 3]).len(), 1, "so they do for what has no label");
        assert!(missed([0.1, 0.1, 0.2, 0.1], [true, false, true]) != [1], "it was not tried");
        // What trembles may lose more of its own pixels, but not of those around it, nor much of all.
        let few = errors([0.3, 0.3, 0.05, 0.3]);
        let of = |after: [f64; 4]| super::missed(&few, &errors(after), &[true; 3], &[false, true, false]);
        assert!(of([0.3, 0.3, 0.08, 0.3]).is_empty());
        assert_eq!(of([0.3, 0.3, 0.13, 0.3]), [1]);
        assert_eq!(of([0.31, 0.3, 0.06, 0.3]), [1]);
        // What costs the others is not what trembles.
        assert_eq!(of([0.3, 0.3, 0.08, 0.31]), [2]);
        let large = errors([0.1, 0.1, 0.3, 0.1]);
        let of = |after: [f64; 4]| super::missed(&large, &errors(after), &[true; 3], &[false, true, false]);
        assert!(of([0.1, 0.1, 0.305, 0.1]).is_empty());
        assert_eq!(of([0.1, 0.1, 0.33, 0.1]), [1]);
    }

    #[test]
    fn what_shifts_little_beside_its_size_trembles() {
        let shift = |displacement: f64, moving: i32| {
            let mut shift = Shift::default();
            for k in 0..20 {
                let place = DVec3::new(0.01 * f64::from(k), 2.0, 0.0);
                shift.add(0.8, place, if k < moving { displacement } else { 0.0 });
            }
            shift
        };
        assert!(shift(0.003, 10).trembles() && shift(0.0, 0).trembles());
        assert!(!shift(0.008, 10).trembles());
        // A few that go far are no trembling.
        assert!(!shift(0.03, 1).trembles());
    }
}
