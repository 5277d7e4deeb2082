//! Motion that the deformation network gives Gaussians: measured, held against limits, and taken out of it.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::deformation::evaluate::Deltas;
use cif_field::deformation::{Deformation, HeadKind};
use cif_field::{Field, Gaussians};
use glam::DVec3;

/// Times at which the network is probed.
const PROBES: usize = 8;

/// Gaussians probed together, which bounds the memory.
const CHUNK: usize = 4_096;

/// Side of the cells in which Gaussians have neighbours, relative to the extent.
const AROUND: f32 = 0.02;

/// Cells from the origin up to which neighbouring cells are distinguished: whole numbers beyond are not all exact in
/// double precision. What lies farther away is put into the last cell.
const FARTHEST_CELL: f64 = 9.0e15;

/// Share of its neighbours that must move for a Gaussian to be kept awake, and fewest of them.
const RESTLESS: f64 = 0.2;
const FEWEST_MOVING: u32 = 3;

/// Mean and spread of the deltas that the network gives a Gaussian over the probe times.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Motion {
    /// Mean of the deltas.
    pub mean: Deltas<f32>,
    /// Largest distance of the displacement from its mean, metres.
    pub displacement: f32,
    /// Largest difference of the other deltas from their mean; quaternions are measured as if of unit length.
    pub shape: f32,
}

/// Evenly spread captured times.
pub(crate) fn probe_times(times: &[f64]) -> Vec<f64> {
    let mut probes: Vec<f64> =
        (0..PROBES).map(|k| times[k * times.len().saturating_sub(1) / (PROBES - 1)]).collect();
    probes.dedup();
    probes
}

/// Limits of motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Limits {
    /// Metres.
    pub displacement: f32,
    pub shape: f32,
}

impl Limits {
    pub(crate) fn scaled(self, factor: f32) -> Self {
        Self { displacement: factor * self.displacement, shape: factor * self.shape }
    }

    pub(crate) fn hold(self, motion: &Motion) -> bool {
        motion.displacement <= self.displacement && motion.shape <= self.shape
    }
}

/// Share by which the room around an object that moves as a whole is larger than the object: as far as its shadow
/// reaches.
const SHADOW: f64 = 2.0;

/// Most Gaussians of an object that show where it passes.
const PASSING: usize = 64;

/// Gaussians among others that move: of those that go through the network around them, a share moves more than the
/// limits, or an object with poses of its own passes. Things move as wholes, what moves little learns it late, and
/// objects cast shadows.
pub(crate) fn restless(field: &Field, motions: &[Motion], limits: Limits) -> Vec<bool> {
    let Some(deformation) = &field.deformation else { return vec![false; motions.len()] };
    let cell_at = |place: [f64; 3]| -> [i64; 3] {
        place.map(|place| {
            let cell = (place / f64::from(AROUND * field.extent)).floor();
            cell.clamp(-FARTHEST_CELL, FARTHEST_CELL) as i64
        })
    };
    let cell_of = |row: usize, motion: &Motion| -> [i64; 3] {
        let moved = if deformation.is_still(row) { [0.0; 3] } else { motion.mean.position };
        cell_at(std::array::from_fn(|axis| f64::from(field.gaussians.means[row][axis] + moved[axis])))
    };
    let passed: BTreeSet<[i64; 3]> = passed(field, limits).map(|place| cell_at(place.to_array())).collect();
    // Rows that go through the network, and of these those that move, by cell.
    let mut cells: BTreeMap<[i64; 3], [u32; 2]> = BTreeMap::new();
    for (row, motion) in motions.iter().enumerate().filter(|(row, _)| !deformation.is_still(*row)) {
        let counts = cells.entry(cell_of(row, motion)).or_default();
        counts[0] += 1;
        counts[1] += u32::from(!limits.hold(motion));
    }
    let mut known: BTreeMap<[i64; 3], bool> = BTreeMap::new();
    let around = |[x, y, z]: [i64; 3]| {
        let (mut all, mut moving) = (0, 0);
        for (near_x, near_y) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (x + dx, y + dy))) {
            if passed.range([near_x, near_y, z - 1]..=[near_x, near_y, z + 1]).next().is_some() {
                return true;
            }
            for (_, counts) in cells.range([near_x, near_y, z - 1]..=[near_x, near_y, z + 1]) {
                (all, moving) = (all + counts[0], moving + counts[1]);
            }
        }
        moving >= FEWEST_MOVING && f64::from(moving) >= RESTLESS * f64::from(all)
    };
    let of_row = |(row, motion)| {
        let cell = cell_of(row, motion);
        *known.entry(cell).or_insert_with(|| around(cell))
    };
    motions.iter().enumerate().map(of_row).collect()
}

/// Places around objects with poses of their own, wherever they go beyond the limits.
fn passed(field: &Field, limits: Limits) -> impl Iterator<Item = DVec3> {
    let groups =
        field.tracks.iter().flat_map(|tracks| tracks.groups.iter().enumerate().map(move |g| (tracks, g)));
    groups.flat_map(move |(tracks, (index, group))| {
        let limit = f64::from(limits.displacement);
        let goes = group.poses.iter().any(|pose| (pose.translation - group.pivot).length() > limit);
        let rows = (0..field.len()).filter(|row| goes && tracks.group_of[*row] as usize == index);
        let rows: Vec<usize> = rows.collect();
        let some = rows.iter().step_by(rows.len() / PASSING + 1).map(|row| {
            SHADOW * (DVec3::from_array(field.gaussians.means[*row].map(f64::from)) - group.pivot)
        });
        let offsets: Vec<DVec3> = some.collect();
        group.poses.iter().flat_map(move |pose| {
            offsets.clone().into_iter().map(|offset| pose.rotation * offset + pose.translation)
        })
    })
}

/// Takes rows out of the network, at the mean of what it did to them; returns their number. A field without a
/// deformation stays as it is.
pub(crate) fn put_to_rest(field: &mut Field, motions: &[Motion], selected: impl Fn(usize) -> bool) -> usize {
    set_still(field, motions, true, selected)
}

/// Hands rows back to the network, near where they were; returns their number.
pub(crate) fn wake(field: &mut Field, motions: &[Motion], selected: impl Fn(usize) -> bool) -> usize {
    set_still(field, motions, false, selected)
}

fn set_still(field: &mut Field, motions: &[Motion], to: bool, selected: impl Fn(usize) -> bool) -> usize {
    let Some(deformation) = &mut field.deformation else { return 0 };
    deformation.still.resize(motions.len(), false);
    let mut changed = 0;
    for (row, motion) in motions.iter().enumerate() {
        let is_grouped = field.tracks.as_ref().is_some_and(|tracks| tracks.group(row).is_some());
        if deformation.still[row] != to && selected(row) && !is_grouped {
            motion.mean.add_to(&mut field.gaussians, row, if to { 1.0 } else { -1.0 });
            deformation.still[row] = to;
            changed += 1;
        }
    }
    if !deformation.still.contains(&true) {
        deformation.still.clear();
    }
    changed
}

/// Motions that the network gives rows over some times, also rows that are marked as still.
pub(crate) fn probe(
    deformation: &Deformation,
    gaussians: &Gaussians,
    rows: &[u32],
    times: &[f64],
) -> Vec<Motion> {
    let mut motions = Vec::with_capacity(rows.len());
    for rows in rows.chunks(CHUNK) {
        let positions: Vec<[f32; 3]> = rows.iter().map(|row| gaussians.means[*row as usize]).collect();
        let deltas: Vec<Vec<Deltas<f32>>> =
            times.iter().map(|time| deformation.deltas_at(&positions, *time)).collect();
        for (k, row) in rows.iter().enumerate() {
            let norm = length(&gaussians.quaternions[*row as usize]).max(1e-6);
            let of_row: Vec<&Deltas<f32>> = deltas.iter().map(|at| &at[k]).collect();
            motions.push(motion(&of_row, norm));
        }
    }
    motions
}

fn motion(deltas: &[&Deltas<f32>], quaternion_norm: f32) -> Motion {
    let share = 1.0 / deltas.len() as f32;
    let mut mean = Deltas::zero();
    for (head, delta) in
        HeadKind::ALL.into_iter().flat_map(|head| deltas.iter().map(move |delta| (head, delta)))
    {
        accumulate(mean.output_mut(head), delta.output(head), share);
    }
    let (mut displacement, mut shape) = (0.0_f32, 0.0_f32);
    for delta in deltas {
        displacement = displacement.max(distance(&delta.position, &mean.position));
        shape = shape
            .max(distance(&delta.scale, &mean.scale))
            .max(distance(&delta.rotation, &mean.rotation) / quaternion_norm)
            .max((delta.opacity - mean.opacity).abs())
            .max(distance(&delta.sh, &mean.sh));
    }
    Motion { mean, displacement, shape }
}

/// Adds values, weighted, to totals.
pub(crate) fn accumulate(totals: &mut [f32], values: &[f32], weight: f32) {
    for (total, value) in totals.iter_mut().zip(values) {
        *total += weight * value;
    }
}

fn distance<const LENGTH: usize>(a: &[f32; LENGTH], b: &[f32; LENGTH]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
}

fn length(values: &[f32; 4]) -> f32 {
    distance(values, &[0.0; 4])
}

#[cfg(test)]
mod tests {
    use cif_field::tracks::{NO_GROUP, TrackGroup, TrackPose, Tracks};
    use cif_render::synthetic;
    use glam::DQuat;

    use super::*;

    fn field() -> Field {
        let mut field = synthetic::generate(&synthetic::SyntheticConfig {
            gaussians: 60,
            heads: Some(synthetic::ALL_HEADS),
            ..Default::default()
        })
        .field;
        field.extent = 1.0;
        field
    }

    #[test]
    fn probe_times_are_captured_times_from_first_to_last() {
        let times: Vec<f64> = (0..50).map(|k| f64::from(k) / 49.0).collect();
        let probes = probe_times(&times);
        assert_eq!((probes.len(), probes[0], probes[7]), (8, 0.0, 1.0));
        assert!(probes.iter().all(|probe| times.contains(probe)));
        assert_eq!(probe_times(&[0.0, 1.0]), [0.0, 1.0]);
        assert_eq!(probe_times(&[0.3]), [0.3]);
    }

    #[test]
    fn what_settles_stays_at_its_mean_and_what_moves_is_left_alone() {
        let mut field = field();
        let times = probe_times(&[0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0]);
        let before = field.clone();
        let rows: Vec<u32> = (0..field.len() as u32).collect();
        let motions = probe(before.deformation.as_ref().unwrap(), &before.gaussians, &rows, &times);
        let mut sizes: Vec<f32> = motions.iter().map(|motion| motion.displacement).collect();
        sizes.sort_by(f32::total_cmp);
        let limit = sizes[30];
        let limits = Limits { displacement: limit, shape: f32::INFINITY };
        assert_eq!(put_to_rest(&mut field, &motions, |row| limits.hold(&motions[row])), 31);
        for (row, motion) in motions.iter().enumerate() {
            let is_still = motion.displacement <= limit;
            assert_eq!(field.deformation.as_ref().unwrap().is_still(row), is_still);
            if !is_still {
                assert_eq!(field.gaussians.means[row], before.gaussians.means[row]);
            }
            // At no probe is anything farther from where it was than the limit.
            for time in &times {
                let (now, then) = (field.deformed(*time), before.deformed(*time));
                let moved = distance(&now.means[row], &then.means[row]);
                assert!(moved <= if is_still { limit * 1.001 } else { 0.0 }, "{row}: {moved}");
            }
        }
    }

    #[test]
    fn what_the_network_moves_again_is_released_near_where_it_was() {
        let mut field = field();
        let times = [0.0, 0.25, 0.5, 0.75, 1.0];
        let motions = |field: &Field| {
            let rows: Vec<u32> = (0..60).collect();
            probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &times)
        };
        let first = motions(&field);
        assert_eq!(put_to_rest(&mut field, &first, |_| true), 60);
        let still = field.deformed(0.4);
        assert_eq!(still, field.gaussians, "nothing goes through the network");
        let second = motions(&field);
        assert_eq!(wake(&mut field, &second, |_| true), 60);
        assert!(field.deformation.as_ref().unwrap().still.is_empty());
        let mut farthest = 0.0_f32;
        let largest = motions(&field).iter().map(|motion| motion.displacement).fold(0.0, f32::max);
        for time in times {
            let moved = field.deformed(time);
            for row in 0..60 {
                farthest = farthest.max(distance(&moved.means[row], &still.means[row]));
            }
        }
        assert!(farthest < 3.0 * largest, "{farthest} against a motion of {largest}");
    }

    #[test]
    fn those_kept_awake_go_through_the_network_from_where_they_stood() {
        let mut field = field();
        let times = [0.0, 0.5, 1.0];
        let rows: Vec<u32> = (0..60).collect();
        let motions =
            |field: &Field| probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &times);
        let awake: Vec<bool> = (0..60).map(|row| row % 4 == 0).collect();
        let first = motions(&field);
        assert_eq!(put_to_rest(&mut field, &first, |row| !awake[row]), 45);
        let others: Vec<bool> = awake.iter().map(|awake| !awake).collect();
        assert_eq!(field.deformation.as_ref().unwrap().still, others);
        let (before, second) = (field.clone(), motions(&field));
        // Those that stood still wake, the others settle.
        assert_eq!(put_to_rest(&mut field, &second, |row| awake[row]), 15);
        assert_eq!(wake(&mut field, &second, |row| others[row]), 45);
        assert_eq!(field.deformation.as_ref().unwrap().still, awake);
        let farthest = second.iter().map(|motion| motion.displacement).fold(0.0, f32::max);
        for time in times {
            let (now, then) = (field.deformed(time), before.deformed(time));
            for row in 0..60 {
                let moved = distance(&now.means[row], &then.means[row]);
                assert!(moved <= 3.0 * farthest, "{row}: {moved} against a motion of {farthest}");
            }
        }
    }

    #[test]
    fn what_is_among_others_that_move_stays_awake() {
        let mut field = field();
        // One crowd at the origin, one far away; a third of the first moves.
        for (row, place) in field.gaussians.means.iter_mut().enumerate() {
            let side = if row < 30 { 0.0 } else { 0.5 };
            *place = [side + 0.001 * (row % 5) as f32, 0.0, 0.0];
        }
        let still =
            Deltas { position: [0.0; 3], scale: [0.0; 3], rotation: [0.0; 4], opacity: 0.0, sh: [0.0; 48] };
        let mut motions: Vec<Motion> = (0..60)
            .map(|row| Motion {
                mean: still.clone(),
                displacement: if row < 30 && row % 3 == 0 { 0.1 } else { 0.0 },
                shape: 0.0,
            })
            .collect();
        let limits = Limits { displacement: 0.01, shape: 1.0 };
        let first_crowd: Vec<bool> = (0..60).map(|row| row < 30).collect();
        assert_eq!(restless(&field, &motions, limits), first_crowd);
        // Only those that are looked at count: where few of many are awake, these represent all.
        field.deformation.as_mut().unwrap().still = (0..60).map(|row| row % 3 != 0).collect();
        assert_eq!(restless(&field, &motions, limits), first_crowd);
        field.deformation.as_mut().unwrap().still = (0..60).map(|row| row % 3 == 0).collect();
        assert_eq!(restless(&field, &motions, limits), [false; 60]);
        // Two are too few to judge.
        field.deformation.as_mut().unwrap().still.clear();
        motions.iter_mut().skip(4).for_each(|motion| motion.displacement = 0.0);
        assert_eq!(restless(&field, &motions, limits), [false; 60]);
    }

    #[test]
    fn what_an_object_with_poses_passes_stays_awake() {
        let mut field = field();
        // The first ten are an object; twenty lie on its way, the others far from it.
        for (row, place) in field.gaussians.means.iter_mut().enumerate() {
            let side = [0.0, 0.3, 0.6, 0.6, 0.6, 0.6][row / 10];
            *place = [side, if row < 20 { 0.0 } else { 0.5 }, 0.001 * (row % 5) as f32];
        }
        let pose = |time, x| TrackPose { time, translation: DVec3::X * x, rotation: DQuat::IDENTITY };
        let group = |reach| TrackGroup {
            deformed: false,
            poses: vec![pose(0.0, 0.0), pose(0.5, reach), pose(1.0, 0.0)],
            ..TrackGroup::still("ball", DVec3::ZERO)
        };
        let group_of: Vec<u32> = (0..60).map(|row| if row < 10 { 0 } else { NO_GROUP }).collect();
        field.deformation.as_mut().unwrap().still = (0..60).map(|row| row < 10).collect();
        let still =
            Deltas { position: [0.0; 3], scale: [0.0; 3], rotation: [0.0; 4], opacity: 0.0, sh: [0.0; 48] };
        let motions = vec![Motion { mean: still, displacement: 0.0, shape: 0.0 }; 60];
        let limits = Limits { displacement: 0.01, shape: 1.0 };
        for (reach, passes) in [(0.3, true), (0.005, false)] {
            let groups = vec![group(reach)];
            field.tracks = Some(Tracks { group_of: group_of.clone(), groups });
            let found = restless(&field, &motions, limits);
            assert!(found[10..20].iter().all(|awake| *awake == passes), "{reach}");
            assert!(found[20..].iter().all(|awake| !awake), "{reach}");
        }
    }

    #[test]
    fn what_is_farther_away_than_cells_are_counted_stays_among_its_own() {
        let mut field = field();
        let far = [1e17, -1e17, 1e30, -3e38, f32::MAX];
        for (row, place) in field.gaussians.means.iter_mut().enumerate() {
            *place = [0.0; 3];
            place[row % 3] = far[row % far.len()];
        }
        let still =
            Deltas { position: [0.0; 3], scale: [0.0; 3], rotation: [0.0; 4], opacity: 0.0, sh: [0.0; 48] };
        let motions = vec![Motion { mean: still, displacement: 0.1, shape: 0.0 }; 60];
        let limits = Limits { displacement: 0.01, shape: 1.0 };
        for extent in [1.0, 1e-30, 1e30] {
            field.extent = extent;
            assert_eq!(restless(&field, &motions, limits), [true; 60], "{extent}");
        }
    }

    #[test]
    fn shape_counts_like_displacement() {
        let mut field = field();
        let rows: Vec<u32> = (0..60).collect();
        let motions = probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &[0.0, 0.5, 1.0]);
        let only = Limits { displacement: f32::INFINITY, shape: 0.0 };
        assert!(!motions.iter().any(|motion| only.hold(motion)));
        field.deformation = None;
        assert_eq!(put_to_rest(&mut field, &motions, |_| true), 0);
    }
}
