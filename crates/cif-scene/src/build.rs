//! From a field to a scene graph.

use cif_field::{Field, Gaussians};
use cif_geometry::{RigidTransform, quaternion};
use glam::DVec3;
use rayon::prelude::*;

use crate::assignment::{self, Identity};
use crate::frames::{Frame, Frames};
use crate::graph::{DenseMotion, DenseSample, Motion, Node, NodeKind, Origin, SceneGraph, Splats, TimeCodes};
use crate::motion::{MeanShape, MovingGroup, dot, vector};
use crate::opacities::{self, Opacities};
use crate::procrustes::weighted_quantile;
use crate::report::MotionReport;
use crate::source::FieldMotion;
use crate::{
    MotionModel, MotionSource, SceneError, SceneOptions, camera_tracks, colliders, extent, naming, proxy,
    visibility,
};

/// Share of an instance's weight that may be outliers when a motion model is chosen.
const INSTANCE_TRIM: f64 = 0.05;
/// The same for the background, where unlabelled things may move.
const BACKGROUND_TRIM: f64 = 0.01;
/// Weight left out on each side when the size of a node is taken.
const SIZE_TRIM: f64 = 0.02;
/// Relative change of a scale over time that makes scales sampled.
const SAME_SCALE: f64 = 1e-4;

/// Builds the scene graph of a field; the trained deformation moves it.
///
/// # Errors
/// When the field is inconsistent or has nothing to show, or an option is out of range.
pub fn build(field: &Field, options: &SceneOptions) -> Result<SceneGraph, SceneError> {
    build_from(field, &mut FieldMotion::new(field), options)
}

/// As [`build`], with the motion from elsewhere.
///
/// # Errors
/// As [`build`].
pub fn build_from(
    field: &Field,
    motion: &mut dyn MotionSource,
    options: &SceneOptions,
) -> Result<SceneGraph, SceneError> {
    options.validate()?;
    check_consistency(field)?;
    let frames = sampled_frames(field, options)?;
    let time_codes = TimeCodes {
        samples: frames.iter().map(|&frame| frame as f64).collect(),
        times: frames.iter().map(|&frame| field.timeline.times[frame]).collect(),
        frames_per_second: field.timeline.frames_per_second,
    };
    let reference = motion.gaussians_at(time_codes.times[0]);
    if reference.len() != field.gaussians.len() {
        return Err(SceneError::Inconsistent {
            what: format!("{} Gaussians move, {} are stored", reference.len(), field.gaussians.len()),
        });
    }
    let mut warnings = Vec::new();
    let mut frames_of = Frames::new(motion, &time_codes.times, Frame::of(reference.clone()));
    let opacities = Opacities::of(&mut frames_of);
    let visible = visible_rows(&reference, &opacities.peak, options, &mut warnings)?;
    let identities = assignment::most_probable(field);
    let owners = assignment::assign(field, &identities, &visible, options);
    let mut groups = moving_groups(field, &visible, &owners, &reference, &opacities.peak, options);
    let models = if frames_of.moves() {
        follow(&mut groups, &mut frames_of);
        groups.iter().map(|(_, group)| choose(group, options)).collect()
    } else {
        let frame = frames_of.at(0);
        for (_, group) in &mut groups {
            group.gather_shape(&frame);
            group.finish_shape(&frame);
        }
        vec![MotionModel::Static; groups.len()]
    };
    let mut dense = gather_dense(&groups, &models, &mut frames_of, &time_codes);
    warn_of_unsampled_heads(field, &mut warnings);

    let mut nodes: Vec<Node> = Vec::with_capacity(groups.len());
    for (position, ((owner, group), model)) in groups.iter().zip(&models).enumerate() {
        let samples = std::mem::take(&mut dense[position]);
        let naming = Naming::of(field, *owner, &nodes);
        let input = NodeInput { field, reference: &reference, identities: &identities };
        let mut node = node(&input, naming, *owner, group, *model, samples, &time_codes.samples);
        node.source_frames = (frames[0], frames[frames.len() - 1]);
        node.visibility = visibility::of_rows(field, &node.splats.rows);
        if opacities.change {
            let rows = &node.splats.rows;
            let (shown, mean) =
                opacities::over_time(&mut frames_of, rows, options.min_opacity, &time_codes.samples);
            node.visibility = opacities::both(&node.visibility, &shown);
            node.splats.opacities = mean;
        }
        if options.proxy_points > 0 {
            node.proxy = Some(proxy::point_proxy(&node.splats, options.proxy_points));
        }
        add_colliders(&mut node, options, &mut warnings);
        nodes.push(node);
    }
    let omitted: Vec<String> = (0..field.instances.len())
        .filter(|index| !groups.iter().any(|(owner, _)| *owner == Some(*index)))
        .map(|index| field.instances[index].label.clone())
        .collect();
    if !omitted.is_empty() {
        warnings.push(format!("no visible Gaussian belongs to: {}", omitted.join(", ")));
    }
    let code_of =
        |index: usize| (frames[0]..=frames[frames.len() - 1]).contains(&index).then_some(index as f64);
    Ok(SceneGraph {
        up_axis: options.up_axis,
        meters_per_unit: options.meters_per_unit,
        cameras: camera_tracks::camera_tracks(&field.cameras, code_of),
        time_codes,
        nodes,
        background_color: field.background,
        sort_metric: field.sort_metric,
        omitted,
        warnings,
        origin: Origin { field_fingerprint: Some(field.fingerprint()), options: Some(options.clone()) },
    })
}

/// Hulls for simulators; told where there is no body to make one of.
fn add_colliders(node: &mut Node, options: &SceneOptions, warnings: &mut Vec<String>) {
    let hulls = match node.kind {
        NodeKind::Instance { .. } => options.hulls_per_instance,
        NodeKind::Background => options.background_hulls,
    };
    node.colliders = colliders::colliders(node, hulls);
    if hulls > 0 && node.colliders.is_empty() {
        warnings.push(format!("{} has no collider: its splats have no extent", node.name));
    }
}

/// What a node is called.
struct Naming {
    kind: NodeKind,
    name: String,
    label: String,
    category: String,
}

impl Naming {
    fn of(field: &Field, owner: Option<usize>, nodes: &[Node]) -> Self {
        match owner {
            Some(index) => {
                let instance = &field.instances[index];
                let name = naming::instance_name(&instance.label, instance.id);
                let name = naming::unique(name, |name| nodes.iter().any(|node| node.name == name));
                Self {
                    kind: NodeKind::Instance { id: instance.id, index },
                    name,
                    label: instance.label.clone(),
                    category: instance.category.clone(),
                }
            }
            None => Self {
                kind: NodeKind::Background,
                name: naming::BACKGROUND.to_owned(),
                label: naming::BACKGROUND.to_owned(),
                category: naming::BACKGROUND.to_owned(),
            },
        }
    }
}

/// What all nodes are made from.
struct NodeInput<'a> {
    field: &'a Field,
    reference: &'a Gaussians,
    identities: &'a [Option<Identity>],
}

fn check_consistency(field: &Field) -> Result<(), SceneError> {
    let n = field.gaussians.len();
    let wrong = |what: String| Err(SceneError::Inconsistent { what });
    let gaussians = &field.gaussians;
    let lengths = [
        gaussians.log_scales.len(),
        gaussians.quaternions.len(),
        gaussians.opacity_logits.len(),
        gaussians.occupancy_logits.len(),
        gaussians.sh_coefficients.len(),
    ];
    if lengths.iter().any(|&length| length != n) {
        return wrong(format!("{n} centres beside arrays of {lengths:?} rows"));
    }
    if let Some(identities) = &field.identities {
        if identities.len() != n {
            return wrong(format!("{} identity rows for {n} Gaussians", identities.len()));
        }
        if let Some(label) = identities.labels.iter().find(|&&l| usize::from(l) >= field.instances.len()) {
            return wrong(format!("identity label {label} of {} instances", field.instances.len()));
        }
    }
    let times = &field.timeline.times;
    if times.is_empty() || !times.windows(2).all(|pair| pair[0] < pair[1]) {
        return wrong("the timeline is empty or not ascending".into());
    }
    if field.sh_degree > 3 {
        return wrong(format!("spherical-harmonics degree {}", field.sh_degree));
    }
    Ok(())
}

/// Frame numbers that are sampled: every `frame_step`, and the last.
fn sampled_frames(field: &Field, options: &SceneOptions) -> Result<Vec<usize>, SceneError> {
    let newest = field.timeline.times.len() - 1;
    let (first, last) = match options.frames {
        Some(range) if range.first > newest || range.first > range.last => {
            return Err(SceneError::EmptyFrameRange { first: range.first, last: range.last, newest });
        }
        Some(range) => (range.first, range.last.min(newest)),
        None => (0, newest),
    };
    let mut frames: Vec<usize> = (first..=last).step_by(options.frame_step).collect();
    if frames.last() != Some(&last) {
        frames.push(last);
    }
    Ok(frames)
}

pub(crate) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Rows that can be drawn at any time, ascending.
fn visible_rows(
    gaussians: &Gaussians,
    opacities: &[f32],
    options: &SceneOptions,
    warnings: &mut Vec<String>,
) -> Result<Vec<u32>, SceneError> {
    let (mut invalid, mut invisible) = (0, 0);
    let visible: Vec<u32> = (0..gaussians.len())
        .filter(|&row| {
            let scales = gaussians.log_scales[row].map(f32::exp);
            let usable = scales.iter().all(|scale| scale.is_normal())
                && gaussians.means[row].iter().all(|value| value.is_finite())
                && gaussians.sh_coefficients[row].iter().all(|value| value.is_finite())
                && quaternion::try_normalize(gaussians.quaternions[row]).is_some()
                && !gaussians.opacity_logits[row].is_nan();
            let drawn = opacities[row] >= options.min_opacity
                && sigmoid(gaussians.occupancy_logits[row]) >= options.min_occupancy;
            invalid += usize::from(!usable);
            invisible += usize::from(usable && !drawn);
            usable && drawn
        })
        .map(|row| row as u32)
        .collect();
    if invalid > 0 {
        warnings.push(format!("{invalid} Gaussians with values that are not finite were left out"));
    }
    if visible.is_empty() {
        let (total, min_opacity) = (gaussians.len(), options.min_opacity);
        return Err(SceneError::NoGaussians { total, invisible, invalid, min_opacity });
    }
    Ok(visible)
}

/// Groups of rows: instances in the order of the table, then the background; empty ones left out.
fn moving_groups(
    field: &Field,
    visible: &[u32],
    owners: &[Option<usize>],
    reference: &Gaussians,
    opacities: &[f32],
    options: &SceneOptions,
) -> Vec<(Option<usize>, MovingGroup)> {
    let mut rows: Vec<Vec<u32>> = vec![Vec::new(); field.instances.len() + 1];
    for (&row, owner) in visible.iter().zip(owners) {
        rows[owner.unwrap_or(field.instances.len())].push(row);
    }
    let mut largest_instance: f64 = 0.0;
    let mut groups = Vec::new();
    for (position, rows) in rows.into_iter().enumerate().filter(|(_, rows)| !rows.is_empty()) {
        let owner = (position < field.instances.len()).then_some(position);
        let weights: Vec<f64> = rows
            .iter()
            .map(|&row| {
                let row = row as usize;
                let size = (vector(reference.log_scales[row]).element_sum() / 3.0).exp();
                f64::from(opacities[row]) * size
            })
            .collect();
        let (low, high) = trimmed_box(&rows, &weights, reference);
        let size = (high - low).length();
        // The background is as large as the room; its motion is judged by the scale of the objects in it.
        let yardstick = match owner {
            Some(_) => {
                largest_instance = largest_instance.max(size);
                size
            }
            None if largest_instance > 0.0 => largest_instance.min(size),
            None => size,
        };
        let pivot = if owner.is_some() { (low + high) / 2.0 } else { DVec3::ZERO };
        let trim = if owner.is_some() { INSTANCE_TRIM } else { BACKGROUND_TRIM };
        let tolerance = options.tolerance.in_world_units(yardstick);
        let group =
            MovingGroup::new(rows, weights, pivot, owner.is_some(), trim, tolerance, &reference.means);
        groups.push((owner, group));
    }
    groups
}

/// Box of the centres without the outermost weight on each side.
fn trimmed_box(rows: &[u32], weights: &[f64], gaussians: &Gaussians) -> (DVec3, DVec3) {
    let mut low = DVec3::ZERO;
    let mut high = DVec3::ZERO;
    for axis in 0..3 {
        let values: Vec<f64> =
            rows.iter().map(|&row| f64::from(gaussians.means[row as usize][axis])).collect();
        low[axis] = weighted_quantile(&values, weights, SIZE_TRIM);
        high[axis] = weighted_quantile(&values, weights, 1.0 - SIZE_TRIM).max(low[axis]);
    }
    (low, high)
}

/// Both passes of [`crate::motion`].
fn follow(groups: &mut [(Option<usize>, MovingGroup)], frames: &mut Frames<'_>) {
    for step in 0..frames.len() {
        let gaussians = frames.at(step);
        groups.par_iter_mut().for_each(|(_, group)| group.gather_shape(&gaussians));
    }
    let reference = frames.at(0);
    groups.par_iter_mut().for_each(|(_, group)| group.finish_shape(&reference));
    for step in 0..frames.len() {
        let gaussians = frames.at(step);
        groups.par_iter_mut().for_each(|(_, group)| group.gather_residuals(&gaussians));
    }
}

/// The cheapest model inside the tolerance, no more expensive than allowed.
fn choose(group: &MovingGroup, options: &SceneOptions) -> MotionModel {
    let limit = options.most_expensive_motion;
    let inside = |decisive: f64| decisive <= group.tolerance;
    if inside(group.static_residual.statistics().decisive) || limit == MotionModel::Static {
        MotionModel::Static
    } else if group.is_body
        && (inside(group.rigid_residual.statistics().decisive) || limit == MotionModel::Rigid)
    {
        MotionModel::Rigid
    } else if limit == MotionModel::Rigid {
        MotionModel::Static
    } else {
        MotionModel::Dense
    }
}

/// Third pass: the splats of dense nodes at every time; empty for the others.
fn gather_dense(
    groups: &[(Option<usize>, MovingGroup)],
    models: &[MotionModel],
    frames: &mut Frames<'_>,
    time_codes: &TimeCodes,
) -> Vec<Vec<DenseSample>> {
    let mut samples: Vec<Vec<DenseSample>> = vec![Vec::new(); groups.len()];
    if !models.contains(&MotionModel::Dense) {
        return samples;
    }
    for (step, &time_code) in time_codes.samples.iter().enumerate() {
        let gaussians = frames.at(step);
        samples.par_iter_mut().zip(groups).zip(models).for_each(|((samples, (_, group)), model)| {
            if *model == MotionModel::Dense {
                let pose = group.poses.get(step).copied().unwrap_or_else(|| group.rest_pose());
                let sample = dense_sample(group, &gaussians, &pose, time_code, samples.last());
                samples.push(sample);
            }
        });
    }
    for samples in &mut samples {
        drop_constant_scales(samples);
    }
    samples
}

fn dense_sample(
    group: &MovingGroup,
    gaussians: &Frame,
    pose: &RigidTransform,
    time_code: f64,
    previous: Option<&DenseSample>,
) -> DenseSample {
    let local = pose.inverse();
    let turn = crate::motion::quaternion_of(&local.rotation);
    let mut means = Vec::with_capacity(group.rows.len());
    let mut orientations = Vec::with_capacity(group.rows.len());
    let mut scales = Vec::with_capacity(group.rows.len());
    for (k, &row) in group.rows.iter().enumerate() {
        let row = row as usize;
        let before = previous.map(|sample| (sample.means[k], sample.orientations[k]));
        let mean = local.apply(vector(gaussians.means[row])).to_array().map(|value| value as f32);
        // A Gaussian that the network throws out of the world at one time stays where it was.
        means.push(if mean.iter().all(|value| value.is_finite()) {
            mean
        } else {
            before.map_or([0.0; 3], |(mean, _)| mean)
        });
        let before = before.map(|(_, orientation)| orientation);
        let unit = quaternion::try_normalize(gaussians.quaternions[row].map(f64::from));
        let orientation = match unit {
            Some(unit) => {
                let turned = quaternion::multiply(turn, unit);
                let reference = before.map_or([1.0, 0.0, 0.0, 0.0], |before| before.map(f64::from));
                let sign = if dot(turned, reference) < 0.0 { -1.0 } else { 1.0 };
                turned.map(|component| (sign * component) as f32)
            }
            None => before.unwrap_or([1.0, 0.0, 0.0, 0.0]),
        };
        orientations.push(orientation);
        scales.push(positive_scales(gaussians.log_scales[row].map(f64::from)));
    }
    let extent = extent::ellipsoid_bounds(&RigidTransform::IDENTITY, &means, &orientations, &scales);
    DenseSample { time_code, means, orientations, scales: Some(scales), extent }
}

/// exp of log-scales, kept inside the positive range of f32.
fn positive_scales(log_scales: [f64; 3]) -> [f32; 3] {
    log_scales.map(|log| (log.exp() as f32).clamp(f32::MIN_POSITIVE, f32::MAX))
}

/// Scales that never change need no samples.
fn drop_constant_scales(samples: &mut [DenseSample]) {
    let Some((first, rest)) = samples.split_first() else { return };
    let Some(first) = &first.scales else { return };
    let same = |a: &[f32; 3], b: &[f32; 3]| {
        a.iter().zip(b).all(|(a, b)| f64::from((a - b).abs()) <= SAME_SCALE * f64::from(*a))
    };
    let constant = rest
        .iter()
        .filter_map(|sample| sample.scales.as_ref())
        .all(|scales| scales.iter().zip(first).all(|(scale, first)| same(first, scale)));
    if constant {
        for sample in samples {
            sample.scales = None;
        }
    }
}

fn warn_of_unsampled_heads(field: &Field, warnings: &mut Vec<String>) {
    if let Some(deformation) = &field.deformation {
        let heads = deformation.config.heads;
        for (on, what, when) in
            [(heads.opacity, "opacities", "as their mean"), (heads.sh, "colours", "as at the first frame")]
        {
            if on {
                warnings.push(format!("{what} change over time in this field, but leave {when}"));
            }
        }
    }
}

/// One node: the splats of the chosen model in the local frame, and the report.
fn node(
    input: &NodeInput<'_>,
    naming: Naming,
    owner: Option<usize>,
    group: &MovingGroup,
    model: MotionModel,
    samples: Vec<DenseSample>,
    time_codes: &[f64],
) -> Node {
    let mut splats = appearance(input, owner, group);
    let shape = |splats: &mut Splats, shape: &MeanShape| {
        splats.means = shape.means.iter().map(|mean| mean.to_array().map(|v| v as f32)).collect();
        splats.orientations = shape.orientations.iter().map(|q| q.map(|v| v as f32)).collect();
        splats.scales = shape.log_scales.iter().map(|log| positive_scales(log.to_array())).collect();
    };
    let motion = match model {
        MotionModel::Static => {
            shape(&mut splats, &group.static_shape);
            Motion::Static
        }
        MotionModel::Rigid => {
            shape(&mut splats, &group.rigid_shape);
            Motion::Rigid(group.track(time_codes))
        }
        MotionModel::Parts | MotionModel::Dense => {
            // The first sample stands in wherever only the default time is read.
            shape(&mut splats, &group.static_shape);
            if let Some(first) = samples.first() {
                splats.means.clone_from(&first.means);
                splats.orientations.clone_from(&first.orientations);
                if let Some(scales) = &first.scales {
                    splats.scales.clone_from(scales);
                }
            }
            Motion::Dense(DenseMotion { track: group.track(time_codes), samples })
        }
    };
    let identity = RigidTransform::IDENTITY;
    let extent = extent::ellipsoid_bounds(&identity, &splats.means, &splats.orientations, &splats.scales);
    let mean_occupancy = {
        let (sum, total) = splats
            .occupancies
            .iter()
            .zip(&splats.opacities)
            .fold((0.0, 0.0), |(sum, total), (pi, o)| (sum + f64::from(pi * o), total + f64::from(*o)));
        if total > 0.0 { (sum / total) as f32 } else { 0.0 }
    };
    let report = motion_report(group, &motion, model, input);
    Node {
        kind: naming.kind,
        name: naming.name,
        label: naming.label,
        category: naming.category,
        pivot: group.pivot,
        motion,
        splats,
        proxy: None,
        colliders: Vec::new(),
        visibility: Vec::new(),
        extent,
        source_frames: (0, 0),
        mean_occupancy,
        report,
    }
}

/// Everything about the splats that no motion model changes.
fn appearance(input: &NodeInput<'_>, owner: Option<usize>, group: &MovingGroup) -> Splats {
    let gaussians = input.reference;
    let degree = input.field.sh_degree;
    let floats = 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    let mut splats = Splats { sh_degree: degree, rows: group.rows.clone(), ..Splats::default() };
    for &row in &group.rows {
        let row = row as usize;
        splats.opacities.push(sigmoid(gaussians.opacity_logits[row]));
        splats.sh_coefficients.extend_from_slice(&gaussians.sh_coefficients[row][..floats]);
        splats.occupancies.push(sigmoid(gaussians.occupancy_logits[row]));
        let probability = input.identities[row].map_or(0.0, |identity| identity.probability);
        splats.identity_probabilities.push(if owner.is_some() { probability } else { 0.0 });
    }
    splats
}

fn motion_report(
    group: &MovingGroup,
    motion: &Motion,
    model: MotionModel,
    input: &NodeInput<'_>,
) -> MotionReport {
    let static_residual = group.static_residual.statistics();
    let rigid_residual = group.is_body.then(|| group.rigid_residual.statistics());
    let (low, high) = trimmed_box(&group.rows, &group.weights, input.reference);
    let pose_bytes = 3 * 8 + 4 * 4;
    let (residual, samples, motion_bytes) = match motion {
        Motion::Static => (static_residual, 0, 0),
        Motion::Rigid(track) => (rigid_residual.unwrap_or_default(), track.len(), track.len() * pose_bytes),
        Motion::Parts(motion) => {
            let samples =
                motion.track.len() + motion.parts.iter().map(|part| part.track.len()).sum::<usize>();
            (rigid_residual.unwrap_or_default(), samples, samples * pose_bytes)
        }
        Motion::Dense(dense) => {
            let per_splat = |sample: &DenseSample| 28 + if sample.scales.is_some() { 12 } else { 0 };
            let bytes: usize =
                dense.samples.iter().map(|sample| sample.means.len() * per_splat(sample)).sum();
            (Default::default(), dense.samples.len(), bytes + dense.track.len() * pose_bytes)
        }
    };
    MotionReport {
        model,
        gaussians: group.rows.len(),
        size: (high - low).length(),
        tolerance: group.tolerance,
        residual,
        static_residual,
        rigid_residual,
        parts_residual: None,
        parts: 0,
        samples,
        motion_bytes,
        seconds: 0.0,
    }
}
