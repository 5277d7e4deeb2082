//! Poses at times of the capture that no training frame shows: before the first and after the last of them, as where
//! every eighth frame is held out, and before an object comes into the images or after it has left them.

use cif_dataset::Frame;
use cif_field::Tracks;
use cif_field::tracks::TrackPose;
use cif_render::Gradients;
use glam::DQuat;

use super::Trainer;
use crate::poses::PoseMoments;

/// Times that training frames show.
struct Span {
    first: f64,
    last: f64,
    /// The longest time between two of them: so far motion is taken to go on outside.
    reach: f64,
}

impl Span {
    /// `None` without two times of training frames.
    fn of(trained: &[&Frame]) -> Option<Self> {
        let mut times: Vec<f64> = trained.iter().map(|frame| frame.time).collect();
        times.sort_by(f64::total_cmp);
        let reach = times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
        let (first, last) = (*times.first()?, *times.last()?);
        (reach > 0.0).then_some(Self { first, last, reach })
    }

    fn has(&self, time: f64) -> bool {
        (self.first..=self.last).contains(&time)
    }
}

/// The pose at a time before the first of ascending poses, or after the last: motion goes on at the mean speed that it has
/// next to them over as long a time, or over all of them where they last less, and then for no longer. `None` without two
/// poses.
fn continued(poses: &[TrackPose], time: f64, reach: f64) -> Option<TrackPose> {
    let inwards: Vec<&TrackPose> =
        if time < poses.first()?.time { poses.iter().collect() } else { poses.iter().rev().collect() };
    let nearest = inwards[0];
    let away = |pose: &TrackPose| (pose.time - nearest.time).abs();
    let gap = (time - nearest.time).abs().min(reach);
    let other = inwards.iter().skip(1).find(|pose| away(pose) >= gap).or(inwards.last())?;
    if away(other) == 0.0 {
        return None;
    }
    let share = (gap / away(other)).min(1.0);
    let turn = nearest.rotation * other.rotation.conjugate();
    let turn = if turn.w < 0.0 { -turn } else { turn };
    // By half a turn at most, which leaves it in the hemisphere of the nearest.
    let turned = DQuat::from_scaled_axis(turn.to_scaled_axis() * share) * nearest.rotation;
    Some(TrackPose {
        time,
        translation: nearest.translation + share * (nearest.translation - other.translation),
        rotation: turned.normalize(),
    })
}

/// Gives groups that move poses at the times of `times` before and behind those that are trained: outside the span of the
/// training frames, and inside it as long as nothing is in view at the place where they would be then. Those that were
/// there are found anew. True where poses have changed.
fn continue_tracks(
    tracks: &mut Tracks,
    moments: &mut PoseMoments,
    span: &Span,
    times: &[f64],
    is_in_view: impl Fn(&TrackPose) -> bool,
) -> bool {
    let mut place = 0;
    let mut changed = false;
    for group in &mut tracks.groups {
        let places = place..place + group.poses.len();
        let is_trained = |k: &usize| moments.shares[*k] > 0.0;
        let first = places.clone().find(is_trained).unwrap_or(places.start);
        let last = places.clone().rfind(is_trained).map_or(places.end, |last| last + 1);
        let seen = group.poses[first - place..last - place].to_vec();
        // Its part would leave the joint.
        let may_leave = group.joint.is_none();
        let going_on = |unseen: f64, times: &mut dyn Iterator<Item = f64>| -> Vec<TrackPose> {
            let mut poses = Vec::new();
            for time in times {
                let is_outside = !span.has(time);
                let reach = if is_outside { unseen + span.reach } else { f64::INFINITY };
                let Some(pose) = continued(&seen, time, reach) else { break };
                if !is_outside && (!may_leave || is_in_view(&pose)) {
                    break;
                }
                poses.push(pose);
            }
            poses
        };
        let (mut before, mut after) = (Vec::new(), Vec::new());
        if let Some((from, to)) = seen.first().zip(seen.last()) {
            before = going_on(
                from.time - span.first,
                &mut times.iter().rev().copied().filter(|time| *time < from.time),
            );
            before.reverse();
            after = going_on(span.last - to.time, &mut times.iter().copied().filter(|time| *time > to.time));
        }
        moments.replace(places, first..last, [before.len(), after.len()]);
        let poses = [before, seen, after].concat();
        place += poses.len();
        changed |= poses != group.poses;
        group.poses = poses;
    }
    changed
}

impl Trainer {
    /// Continues the motion of objects to the times of the capture at which no training frame shows them.
    pub(super) fn continue_poses(&mut self) {
        let state = &mut self.state;
        // Without those that were left out for their masks, which say nothing of where objects are.
        let trained: Vec<&Frame> =
            (0..state.frames.len()).map(|k| &state.dataset.frames[state.frames.index(k)]).collect();
        let Some(span) = Span::of(&trained) else { return };
        let Some(tracks) = &mut state.field.tracks else { return };
        let is_in_view = |pose: &TrackPose| {
            let mut then = trained.iter().filter(|frame| frame.time == pose.time);
            then.any(|frame| frame.camera.pixel_of(pose.translation).is_some())
        };
        if continue_tracks(tracks, &mut state.pose_moments, &span, &state.dataset.times, is_in_view) {
            state.gradients = Gradients::zeros(&state.field);
        }
    }
}

#[cfg(test)]
mod tests {
    use cif_dataset::Split;
    use cif_field::Gaussians;
    use cif_field::tracks::TrackGroup;
    use glam::DVec3;

    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::*;
    use crate::events::{Control, Outcome};
    use crate::stage::Stage;

    const SPAN: Span = Span { first: 0.2, last: 0.8, reach: 0.2 };
    const TIMES: [f64; 6] = [0.0, 0.1, 0.2, 0.5, 0.8, 0.9];

    /// A group that moves at a speed and turns around z, with keys at some times.
    fn moving(times: &[f64]) -> TrackGroup {
        let pose = |time: &f64| TrackPose {
            time: *time,
            translation: DVec3::new(2.0 * time, 0.0, 1.0),
            rotation: DQuat::from_rotation_z(3.0 * time),
        };
        TrackGroup { poses: times.iter().map(pose).collect(), ..TrackGroup::still("a", DVec3::ZERO) }
    }

    #[test]
    fn frames_that_were_left_out_show_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 4, views: 2, ..Scene::default() });
        let ends = |trained: &[&Frame]| Span::of(trained).map(|span| (span.first, span.last));
        let all: Vec<&Frame> = dataset.frames.iter().collect();
        assert_eq!(ends(&all), Some((dataset.times[0], dataset.times[3])));
        let later: Vec<&Frame> = all.iter().copied().filter(|frame| frame.time_index > 0).collect();
        assert_eq!(ends(&later), Some((dataset.times[1], dataset.times[3])));
        assert_eq!(ends(&all[..1]), None);
    }

    #[test]
    fn steady_motion_goes_on() {
        let group = moving(&[0.2, 0.3, 0.5, 0.8]);
        for time in [0.0, 0.1, 0.9] {
            let pose = continued(&group.poses, time, SPAN.reach).unwrap();
            assert!(pose.translation.distance(DVec3::new(2.0 * time, 0.0, 1.0)) < 1e-12, "{time}: {pose:?}");
            assert!(
                pose.rotation.angle_between(DQuat::from_rotation_z(3.0 * time)) < 1e-6,
                "{time}: {pose:?}"
            );
        }
        // Beyond the reach it stays; one pose says nothing of motion.
        let far = continued(&group.poses, -1.0, 0.2).unwrap();
        assert!((far.translation.x - 0.0).abs() < 1e-12, "{far:?}");
        assert_eq!(continued(&group.poses[..1], 0.0, 0.2), None);
        // No longer than the motion is known.
        let short = continued(&group.poses[..2], 0.0, 0.2).unwrap();
        assert!((short.translation.x - 0.2).abs() < 1e-12, "{short:?}");
    }

    #[test]
    fn what_is_at_rest_stays_to_the_bit() {
        let mut group = moving(&[0.2, 0.3, 0.4]);
        for pose in &mut group.poses {
            (pose.translation, pose.rotation) = (DVec3::splat(0.7), DQuat::IDENTITY);
        }
        let pose = continued(&group.poses, 0.1, 0.2).unwrap();
        assert_eq!((pose.translation, pose.rotation), (DVec3::splat(0.7), DQuat::IDENTITY));
    }

    fn go_on(tracks: &mut Tracks, moments: &mut PoseMoments) -> bool {
        continue_tracks(tracks, moments, &SPAN, &TIMES, |_| true)
    }

    #[test]
    fn what_is_out_of_sight_is_on_its_way() {
        let groups = vec![moving(&[0.4, 0.5, 0.6, 0.7]), moving(&[0.3, 0.4, 0.5, 0.6])];
        let mut tracks = Tracks { groups, ..Tracks::default() };
        let mut moments = PoseMoments::zeros(Some(&tracks));
        let times = [0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
        // At 0.2 they would be in view, but nothing is seen of them.
        let is_in_view = |pose: &TrackPose| pose.translation.x < 0.5;
        for _ in 0..2 {
            continue_tracks(&mut tracks, &mut moments, &SPAN, &times, is_in_view);
            for group in &tracks.groups {
                assert_eq!(group.poses.iter().map(|pose| pose.time).collect::<Vec<_>>(), times[1..]);
                assert!(group.poses.iter().all(|pose| (pose.translation.x - 2.0 * pose.time).abs() < 1e-9));
            }
        }
        let trained = [[0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]];
        assert_eq!(moments.shares, trained.concat());
    }

    #[test]
    fn moments_follow_their_poses_and_a_second_time_changes_nothing() {
        // Of the second, the first training frame shows nothing, though it would: it is not known to have been there.
        let groups = vec![moving(&[0.2, 0.5, 0.8]), moving(&[0.5, 0.8]), TrackGroup::still("b", DVec3::ZERO)];
        let mut tracks = Tracks { groups, ..Tracks::default() };
        let mut moments = PoseMoments::zeros(Some(&tracks));
        for (k, steps) in moments.steps.iter_mut().enumerate() {
            *steps = 10 + k as u32;
        }
        assert!(go_on(&mut tracks, &mut moments));
        let times =
            |group: usize| tracks.groups[group].poses.iter().map(|pose| pose.time).collect::<Vec<_>>();
        assert_eq!(times(0), [0.0, 0.1, 0.2, 0.5, 0.8, 0.9]);
        assert_eq!(times(1), [0.5, 0.8, 0.9]);
        assert!(times(2).is_empty());
        assert_eq!(moments.steps, [0, 0, 10, 11, 12, 0, 13, 14, 0]);
        assert_eq!(moments.shares, [0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0]);
        let (before, kept) = (tracks.clone(), moments.clone());
        assert!(!go_on(&mut tracks, &mut moments));
        assert!(tracks == before && moments == kept);
        // Poses that were trained on take those outside with them.
        tracks.groups[0].poses[2].translation.y = 1.0;
        assert!(go_on(&mut tracks, &mut moments));
        assert!(tracks.groups[0].poses[1].translation.y > 1.0 && moments == kept);
    }

    /// The time of the first frames is held out, as every eighth frame of a video is: a body in steady motion is in its
    /// place there once a run has ended, and in one that is read back.
    #[test]
    fn finished_runs_know_where_bodies_are_before_their_first_training_frame() {
        let folder = tempfile::tempdir().unwrap();
        let mut dataset = capture(folder.path(), Scene { times: 4, views: 2, ..Scene::default() });
        for frame in dataset.frames.iter_mut().filter(|frame| frame.time == 0.0) {
            frame.split = Split::Val;
        }
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (2, 4, 2);
        let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
        while trainer.stage() != Stage::Fine {
            let next = trainer.stages.after(&trainer.state.config, trainer.stage());
            trainer.enter(next).unwrap();
        }
        let times = trainer.state.dataset.times.clone();
        let rows = Gaussians::from_points(&[[0.0; 3], [0.1; 3]], &[[0.5; 3]; 2]).unwrap();
        trainer.add_group(rows, moving(&times[1..]), &[1.0; 3]);
        trainer.state.field.tracks.as_mut().unwrap().groups[0].deformed = false;
        trainer.state.gradients = Gradients::zeros(&trainer.state.field);
        trainer.state.optimiser = crate::optimiser::Optimiser::new(&trainer.state.field);
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);

        let poses = |trainer: &Trainer| trainer.field().tracks.as_ref().unwrap().groups[0].poses.clone();
        let found = poses(&trainer);
        assert_eq!(found.iter().map(|pose| pose.time).collect::<Vec<_>>(), times);
        let (step, last) =
            (found[1].translation - found[0].translation, found[2].translation - found[1].translation);
        assert!(step.distance(last) < 1e-9 && step.length() > 0.5, "{found:?}");

        let resumed = Trainer::resume(dataset, trainer.checkpoint(true)).unwrap();
        assert_eq!(poses(&resumed), found);
    }
}
