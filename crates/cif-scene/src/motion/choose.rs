//! The cheapest motion model inside the tolerance, and the fewest samples that keep it there.

use std::ops::Range;
use std::time::Instant;

use cif_geometry::RigidTransform;
use glam::DVec3;
use rayon::prelude::*;

use crate::field_motion::frames::{Frame, Frames};
use crate::graph::{
    DENSE_BYTES, DenseSample, MotionModel, POSE_BYTES, PartJoint, PoseSample, ResidualStatistics,
    SceneOptions, pose_at,
};
use crate::motion::dense;
use crate::motion::group::{MeanShape, MovingGroup, trimmed_box};
use crate::motion::keys::{self, Moments};
use crate::motion::parts::{self, Partition};
use crate::motion::residuals::ResidualSum;

/// Partitions that are fitted to all Gaussians and times before a group is given up to dense motion.
const TRIED_PARTITIONS: usize = 3;
/// A partition is fitted when its sampled residual is within this factor of the tolerance.
const PROMISING: f64 = 1.2;
/// Residual of parts over that of one rigid body above which parts are not worth having.
const WORTH: f64 = 0.98;
/// Where the best parts miss the tolerance, those that move by less than this share of it are at rest: compared with
/// what the model misses, such motion would be made up.
const UNSHOWN: f64 = 0.5;
/// Tolerances within which what stands still in a picture is at rest.
const RESTING: f64 = 5.0;
/// Share of the tolerance within which rounding alone moves a part.
const ROUNDING: f64 = 1e-6;
/// Chosen motion of a group.
pub(crate) enum Chosen {
    Static,
    Rigid(Vec<PoseSample>),
    Parts(ChosenParts),
    Dense { track: Vec<PoseSample>, samples: Vec<DenseSample> },
}

/// Rigid parts of a group.
pub(crate) struct ChosenParts {
    /// Path of the node.
    pub(crate) track: Vec<PoseSample>,
    /// Positions of the group, part by part.
    pub(crate) order: Vec<u32>,
    pub(crate) parts: Vec<RigidPart>,
    /// Residual of all parts together.
    pub(crate) residual: ResidualStatistics,
}

/// A rigid part of a group.
#[derive(Default)]
pub(crate) struct RigidPart {
    /// Range of [`ChosenParts::order`].
    pub(crate) splats: Range<usize>,
    /// Its splats, in its frame.
    pub(crate) shape: MeanShape,
    /// Origin of its frame in that of the node, at the reference time.
    pub(crate) pivot: DVec3,
    /// Poses `node_from_part`; empty where it stays at its pivot.
    pub(crate) track: Vec<PoseSample>,
    pub(crate) joint: Option<PartJoint>,
}

/// Rigid parts, fitted to all Gaussians and times of a group.
struct FittedParts {
    /// Positions of the group, part by part.
    order: Vec<u32>,
    /// Range of `order` of every part, and its shape and poses in the world.
    parts: Vec<(Range<usize>, MovingGroup)>,
    /// Residual of all parts together.
    residual: ResidualSum,
}

/// Fits every model that is needed to decide, and decides.
pub(crate) fn choose(
    groups: &mut [&mut MovingGroup],
    frames: &mut Frames<'_>,
    time_codes: &[f64],
    options: &SceneOptions,
) -> Vec<Chosen> {
    if !groups.iter().any(|group| frames.move_rows(&group.rows)) {
        let frame = frames.at(0);
        for group in groups.iter_mut() {
            group.gather_shape(&frame);
            group.finish_shape(&frame);
        }
        return groups.iter().map(|_| Chosen::Static).collect();
    }
    follow(groups, frames);
    let mut fitted = fit_parts_where_needed(groups, frames, options);
    let models: Vec<MotionModel> =
        groups.iter().zip(&mut fitted).map(|(group, parts)| decide(group, parts, options)).collect();
    let mut chosen: Vec<Chosen> = groups
        .par_iter_mut()
        .zip(fitted)
        .zip(&models)
        .map(|((group, parts), model)| {
            let start = Instant::now();
            let chosen = with_tracks(group, parts, *model, time_codes, options);
            group.seconds += start.elapsed().as_secs_f64();
            chosen
        })
        .collect();
    gather_dense(groups, &mut chosen, frames, time_codes, options);
    chosen
}

/// Both passes of [`crate::motion`].
fn follow(groups: &mut [&mut MovingGroup], frames: &mut Frames<'_>) {
    for step in 0..frames.len() {
        let frame = frames.at(step);
        groups.par_iter_mut().for_each(|group| group.timed(|group| group.gather_shape(&frame)));
    }
    let reference = frames.at(0);
    groups.par_iter_mut().for_each(|group| group.timed(|group| group.finish_shape(&reference)));
    for step in 0..frames.len() {
        let frame = frames.at(step);
        groups.par_iter_mut().for_each(|group| {
            group.timed(|group| {
                group.gather_residuals(&frame);
            });
        });
    }
}

fn inside(group: &MovingGroup, residual: &ResidualSum) -> bool {
    residual.statistics().decisive <= group.tolerance
}

/// Parts of the groups that neither stand still nor are rigid inside the tolerance.
fn fit_parts_where_needed(
    groups: &mut [&mut MovingGroup],
    frames: &mut Frames<'_>,
    options: &SceneOptions,
) -> Vec<Option<FittedParts>> {
    let allowed = options.most_expensive_motion >= MotionModel::Parts;
    let needed: Vec<bool> = groups
        .iter()
        .map(|group| {
            allowed
                && group.is_body
                && !inside(group, &group.static_residual)
                && !inside(group, &group.rigid_residual)
        })
        .collect();
    let mut own: Vec<Vec<Frame>> = vec![Vec::new(); groups.len()];
    if needed.contains(&true) {
        for step in 0..frames.len() {
            let frame = frames.at(step);
            own.par_iter_mut().zip(groups.par_iter()).zip(&needed).for_each(|((own, group), needed)| {
                if *needed {
                    own.push(frame.rows(&group.rows));
                }
            });
        }
    }
    groups
        .par_iter_mut()
        .zip(own)
        .map(|(group, own)| {
            let start = Instant::now();
            let fitted = (!own.is_empty()).then(|| fit_parts(group, &own, options)).flatten();
            group.seconds += start.elapsed().as_secs_f64();
            fitted
        })
        .collect()
}

/// The fewest parts inside the tolerance, or else the best there are.
fn fit_parts(group: &MovingGroup, own: &[Frame], options: &SceneOptions) -> Option<FittedParts> {
    let partitions = parts::partitions(own, &group.weights, group.tolerance, group.trim, options.max_parts);
    let promising = partitions.iter().filter(|partition| partition.decisive <= PROMISING * group.tolerance);
    let mut best: Option<FittedParts> = None;
    let mut keep_better = |fitted: FittedParts| {
        let residual = fitted.residual.statistics().decisive;
        if best.as_ref().is_none_or(|best| residual < best.residual.statistics().decisive) {
            best = Some(fitted);
        }
        residual <= group.tolerance
    };
    if !promising.take(TRIED_PARTITIONS).any(|partition| keep_better(fit_partition(group, own, partition))) {
        let least = partitions.iter().min_by(|a, b| a.decisive.total_cmp(&b.decisive));
        if let Some(least) = least {
            keep_better(fit_partition(group, own, least));
        }
    }
    best
}

/// Mean shapes and poses of the parts of a partition, over all Gaussians and times of the group.
fn fit_partition(group: &MovingGroup, own: &[Frame], partition: &Partition) -> FittedParts {
    let mut order = Vec::with_capacity(partition.labels.len());
    let mut parts = Vec::with_capacity(partition.count);
    for part in 0..partition.count {
        let start = order.len();
        order.extend((0..partition.labels.len() as u32).filter(|&k| partition.labels[k as usize] == part));
        let rows = order[start..].to_vec();
        let weights: Vec<f64> = rows.iter().map(|&k| group.weights[k as usize]).collect();
        let (low, high) = trimmed_box(&rows, &weights, &own[0].means);
        let pivot = (low + high) / 2.0;
        let part = MovingGroup::new(rows, weights, pivot, true, 0.0, group.tolerance, &own[0].means);
        parts.push((start..order.len(), part));
    }
    for frame in own {
        parts.iter_mut().for_each(|(_, part)| part.gather_shape(frame));
    }
    parts.iter_mut().for_each(|(_, part)| part.finish_shape(&own[0]));
    let weights: Vec<f64> = order.iter().map(|&k| group.weights[k as usize]).collect();
    let mut residual = ResidualSum::default();
    for frame in own {
        let distances: Vec<f64> =
            parts.iter_mut().flat_map(|(_, part)| part.gather_residuals(frame)).collect();
        residual.add(&distances, &weights, group.trim, group.tolerance);
    }
    FittedParts { order, parts, residual }
}

/// The cheapest model inside the tolerance, no more expensive than allowed; trembling that no picture shows may be
/// some tolerances large. Parts that are not chosen stay for
/// the report.
fn decide(group: &MovingGroup, parts: &Option<FittedParts>, options: &SceneOptions) -> MotionModel {
    let limit = options.most_expensive_motion;
    if !group.is_body {
        // Each of these splats moves as far as a picture shows: a mean, and even more one without outliers, would hold
        // thousands in place for the sake of some that hardly move.
        let moves = group.is_loose && group.static_residual.statistics().max > group.tolerance;
        return if moves { MotionModel::Dense } else { MotionModel::Static };
    }
    let is_at_rest =
        group.stands_still && group.static_residual.statistics().decisive <= RESTING * group.tolerance;
    if is_at_rest || inside(group, &group.static_residual) || limit == MotionModel::Static {
        return MotionModel::Static;
    }
    if inside(group, &group.rigid_residual) || limit == MotionModel::Rigid {
        return MotionModel::Rigid;
    }
    let cheaper_than_dense =
        |parts: &FittedParts| (parts.parts.len() + 1) * POSE_BYTES < group.rows.len() * DENSE_BYTES;
    match (parts, limit) {
        (Some(parts), MotionModel::Dense) if inside(group, &parts.residual) && cheaper_than_dense(parts) => {
            MotionModel::Parts
        }
        (_, MotionModel::Dense) => MotionModel::Dense,
        (Some(parts), _)
            if parts.residual.statistics().decisive < WORTH * group.rigid_residual.statistics().decisive =>
        {
            MotionModel::Parts
        }
        _ => MotionModel::Rigid,
    }
}

/// The tracks of a chosen model, reduced.
fn with_tracks(
    group: &mut MovingGroup,
    parts: Option<FittedParts>,
    model: MotionModel,
    time_codes: &[f64],
    options: &SceneOptions,
) -> Chosen {
    group.parts_residual = parts.as_ref().map(|parts| parts.residual.statistics());
    let full = group.track(time_codes);
    let moments = Moments::of(&group.rigid_shape.means, &group.weights);
    let deviation = |sample: usize, pose: &RigidTransform| moments.deviation(&full[sample].transform(), pose);
    match (model, parts) {
        (MotionModel::Static, _) => Chosen::Static,
        (MotionModel::Rigid, _) => {
            let allowed = keys::allowances(&group.rigid_residual.times, group.tolerance);
            Chosen::Rigid(if options.reduce_keys { keys::reduce(&full, &allowed, deviation) } else { full })
        }
        (MotionModel::Parts, Some(parts)) => {
            let track = leading_track(group, &parts, time_codes, options);
            let residual = parts.residual.statistics();
            let part = |(splats, part): (Range<usize>, MovingGroup)| RigidPart {
                splats,
                pivot: part.pivot - group.pivot,
                track: part_track(group, &track, &part, &parts.residual, time_codes, options),
                shape: part.rigid_shape,
                joint: None,
            };
            let of_parts = parts.parts.into_iter().map(part).collect();
            Chosen::Parts(ChosenParts { track, order: parts.order, parts: of_parts, residual })
        }
        _ => {
            let track = if group.is_body { bulk_track(group, full.clone(), options) } else { Vec::new() };
            Chosen::Dense { track, samples: Vec::new() }
        }
    }
}

/// The track of a node with parts: that of its largest part, which then needs none of its own. The other parts
/// are taken relative to it as it is interpolated.
fn leading_track(
    group: &MovingGroup,
    parts: &FittedParts,
    time_codes: &[f64],
    options: &SceneOptions,
) -> Vec<PoseSample> {
    let Some((_, leader)) = parts.parts.first() else { return Vec::new() };
    let offset = group.pivot - leader.pivot;
    let part_from_node = RigidTransform { translation: offset, ..RigidTransform::IDENTITY };
    let mut full: Vec<PoseSample> = leader
        .track(time_codes)
        .iter()
        .map(|sample| PoseSample::new(sample.time_code, &sample.transform().compose(&part_from_node)))
        .collect();
    keys::one_hemisphere(&mut full);
    if !options.reduce_keys {
        return full;
    }
    let shape: Vec<DVec3> = leader.rigid_shape.means.iter().map(|mean| *mean - offset).collect();
    let moments = Moments::of(&shape, &leader.weights);
    let allowed = keys::allowances(&parts.residual.times, group.tolerance);
    reduced_or_resting(&full, &allowed, &moments, &group.rest_pose(), unshown(group, &parts.residual))
}

/// RMS deviation by which a part may always rest.
fn unshown(group: &MovingGroup, residual: &ResidualSum) -> f64 {
    group.tolerance * if inside(group, residual) { ROUNDING } else { UNSHOWN }
}

/// A reduced track, or none where resting is inside the allowances, or inside `unshown`, too.
fn reduced_or_resting(
    full: &[PoseSample],
    allowed: &[f64],
    moments: &Moments,
    rest: &RigidTransform,
    unshown: f64,
) -> Vec<PoseSample> {
    let deviation = |sample: usize, pose: &RigidTransform| moments.deviation(&full[sample].transform(), pose);
    if (0..full.len()).all(|sample| deviation(sample, rest) <= allowed[sample].max(unshown)) {
        return Vec::new();
    }
    keys::reduce(full, allowed, deviation)
}

/// The track that carries the bulk of the motion of dense samples. Those are taken relative to it as it is
/// interpolated, so that leaving out its samples costs nothing but larger relative motion.
fn bulk_track(group: &MovingGroup, full: Vec<PoseSample>, options: &SceneOptions) -> Vec<PoseSample> {
    if !options.reduce_keys {
        return full;
    }
    let moments = Moments::of(&group.rigid_shape.means, &group.weights);
    reduced_or_resting(&full, &vec![group.tolerance; full.len()], &moments, &group.rest_pose(), 0.0)
}

/// Poses `node_from_part`, reduced; empty where the part stays at its pivot inside the bound.
fn part_track(
    group: &MovingGroup,
    bulk: &[PoseSample],
    part: &MovingGroup,
    residual: &ResidualSum,
    time_codes: &[f64],
    options: &SceneOptions,
) -> Vec<PoseSample> {
    let mut full: Vec<PoseSample> = part
        .track(time_codes)
        .into_iter()
        .map(|sample| {
            let node_from_world = pose_at(bulk, group.pivot, sample.time_code).transform().inverse();
            PoseSample::new(sample.time_code, &node_from_world.compose(&sample.transform()))
        })
        .collect();
    keys::one_hemisphere(&mut full);
    if !options.reduce_keys {
        return full;
    }
    let moments = Moments::of(&part.rigid_shape.means, &part.weights);
    let allowed = keys::allowances(&residual.times, group.tolerance);
    let rest = RigidTransform { translation: part.pivot - group.pivot, ..RigidTransform::IDENTITY };
    reduced_or_resting(&full, &allowed, &moments, &rest, unshown(group, residual))
}

/// The splats of dense groups at every time, relative to their tracks.
fn gather_dense(
    groups: &mut [&mut MovingGroup],
    chosen: &mut [Chosen],
    frames: &mut Frames<'_>,
    time_codes: &[f64],
    options: &SceneOptions,
) {
    if !chosen.iter().any(|chosen| matches!(chosen, Chosen::Dense { .. })) {
        return;
    }
    for (step, &time_code) in time_codes.iter().enumerate() {
        let frame = frames.at(step);
        groups.par_iter_mut().zip(chosen.par_iter_mut()).for_each(|(group, chosen)| {
            if let Chosen::Dense { track, samples } = chosen {
                let start = Instant::now();
                let pose = pose_at(track, group.pivot, time_code).transform();
                let sample = dense::sample(group, &frame, &pose, time_code, samples.last());
                samples.push(sample);
                group.seconds += start.elapsed().as_secs_f64();
            }
        });
    }
    groups.par_iter_mut().zip(chosen.par_iter_mut()).for_each(|(group, chosen)| {
        if let Chosen::Dense { samples, .. } = chosen {
            let start = Instant::now();
            if options.reduce_keys {
                let full = std::mem::take(samples);
                *samples = dense::reduce(full, &group.weights, group.trim, group.tolerance);
            }
            dense::drop_constant_scales(samples);
            group.seconds += start.elapsed().as_secs_f64();
        }
    });
}
