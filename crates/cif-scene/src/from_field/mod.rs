//! From a field to a scene graph.

pub mod assignment;
pub mod camera_tracks;
mod group_instances;
mod image;
pub(crate) mod node;

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use cif_field::{Field, Gaussians, RecordedCamera};
use cif_geometry::quaternion;
use cif_geometry::scalar::direct_sigmoid;
use glam::DVec3;

use crate::appearance::blur::Blur;
use crate::appearance::visibility;
use crate::appearance::{self, Opacities, Thinning};
use crate::field_motion::FieldMotion;
use crate::field_motion::frames::{Frame, Frames};
use crate::from_field::assignment::{Assignment, Identity};
use crate::from_field::node::{Naming, NodeInput};
use crate::graph::{CameraTrack, Node, NodeKind, Origin, SceneGraph, TimeCodes};
use crate::motion::choose::{self, Chosen};
use crate::motion::group::{MovingGroup, trimmed_box};
use crate::motion::loose::{self, Change};
use crate::motion::recorded;
use crate::shape::{colliders, flat, proxy};
use crate::{MotionModel, MotionSource, SceneError, SceneOptions, naming, world};

/// Share of an instance's weight that may be outliers when a motion model is chosen.
const INSTANCE_TRIM: f64 = 0.05;
/// The same for the background, where unlabelled things may move.
const BACKGROUND_TRIM: f64 = 0.01;

/// Begin of the warning that names instances without splats.
pub(crate) const NO_SPLATS: &str = "no visible Gaussian belongs to: ";

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
    let codes = field.time_codes();
    let time_codes = TimeCodes {
        samples: frames.iter().map(|&frame| codes[frame]).collect(),
        times: frames.iter().map(|&frame| field.timeline.times[frame]).collect(),
        frames_per_second: field.timeline.frames_per_second,
    };
    let reference = motion.gaussians_at(time_codes.times[0]);
    if reference.len() != field.gaussians.len() {
        return Err(SceneError::Inconsistent {
            what: format!("{} Gaussians move, {} are stored", reference.len(), field.gaussians.len()),
        });
    }
    let mut warnings: Vec<String> = field.record.unknown.iter().cloned().collect();
    let (recolors, follows_tracks) = (motion.recolors(), motion.follows_tracks());
    let mut frames_of = Frames::new(motion, &time_codes.times, Frame::of(reference.clone(), recolors));
    let opacities = Opacities::of(&mut frames_of);
    let visible = visible_rows(&reference, &opacities.peak, options, &mut warnings)?;
    let identities = assignment::most_probable(field);
    let mut assigned = assignment::assign(field, &identities, &visible, options);
    if !follows_tracks {
        assigned.groups.fill(None);
    }
    let sampled =
        SampledField { field, reference: &reference, opacities: &opacities, time_codes: &time_codes };
    let NodeMotions { owners, groups, chosen } =
        moving_nodes(&sampled, &visible, &assigned, &mut frames_of, options);
    let input = NodeInput { field, reference: &reference, identities: &identities };
    let mut nodes = named_nodes(&input, &owners, &groups, chosen);
    node::measure(&mut nodes, &groups, &mut frames_of, &time_codes.samples);
    // Those of the capture, of which the field may be a window.
    let source_frames = (time_codes.start().max(0.0) as usize, time_codes.end().max(0.0) as usize);
    let cameras = cameras(field, frames[0]..=frames[frames.len() - 1]);
    let antialiased = field.record.drawing.antialiased.unwrap_or_default();
    let blur = options.bake_blur.then(|| Blur::of(&cameras, antialiased)).flatten();
    if options.bake_blur && blur.is_none() {
        warnings.push("no camera is recorded, so that the blur of pixels could not be baked".into());
    }
    for (node, group) in nodes.iter_mut().zip(&groups) {
        node.source_frames = source_frames;
        node.visibility = visibility::of_rows(field, &node.splats.rows);
        add_changes(&sampled, node, group, &mut frames_of, options);
        if options.proxy_points > 0 {
            node.proxy = Some(proxy::point_proxy(&node.splats, options.proxy_points));
        }
        add_colliders(node, options, &mut warnings);
        if let Some(blur) = &blur {
            blur.bake(node);
        }
    }
    let omitted = omitted(field, &owners);
    if !omitted.is_empty() {
        warnings.push(without_splats(field, &omitted, &identities, &visible));
    }
    let declared = field.record.declared;
    let unit = options.meters_per_unit.or(declared.map(|of| of.meters_per_unit));
    Ok(SceneGraph {
        up_axis: options.up_axis.or(declared.map(|of| of.up_axis)).unwrap_or_default(),
        meters_per_unit: unit.unwrap_or(1.0),
        frame: world::frame_of(field)?,
        windows: Vec::new(),
        cameras,
        time_codes,
        nodes,
        background_color: field.background,
        sort_metric: field.sort_metric,
        antialiased: field.record.drawing.antialiased,
        near: field.record.drawing.near,
        omitted: omitted.into_iter().map(|index| field.instances[index].label.clone()).collect(),
        warnings,
        origin: Origin { field_fingerprint: Some(field.fingerprint()), options: Some(options.clone()) },
    })
}

/// A field at the sampled times.
struct SampledField<'a> {
    field: &'a Field,
    /// The Gaussians at the first of the times, `[N]`.
    reference: &'a Gaussians,
    /// Opacities at all of them.
    opacities: &'a Opacities,
    time_codes: &'a TimeCodes,
}

/// Motion of every node to be, `[nodes]`.
struct NodeMotions {
    /// Index of the instance; `None` for the background.
    owners: Vec<Option<usize>>,
    /// The Gaussians.
    groups: Vec<MovingGroup>,
    /// The motion model that was chosen.
    chosen: Vec<Chosen>,
}

/// Groups visible rows into nodes and chooses their motion.
fn moving_nodes(
    sampled: &SampledField<'_>,
    visible: &[u32],
    assigned: &Assignment,
    frames: &mut Frames<'_>,
    options: &SceneOptions,
) -> NodeMotions {
    let SampledField { field, reference, opacities, time_codes } = *sampled;
    // Instances at rest, which something passes over: known once all have been looked at.
    let mut at_rest = BTreeSet::new();
    loop {
        let grouped = rows_of_nodes(field, visible, assigned, &at_rest, frames, options);
        let (owners, mut groups) = moving_groups(grouped, reference, &opacities.peak, options);
        let chosen = motions(field, &mut groups, frames, reference, time_codes, options);
        let rest =
            owners.iter().zip(&groups).zip(&chosen).filter(|(_, chosen)| matches!(chosen, Chosen::Static));
        let passed: Vec<usize> = rest
            .filter_map(|((owner, group), _)| owner.filter(|_| group.is_passed))
            .filter(|owner| !at_rest.contains(owner))
            .collect();
        if passed.is_empty() || options.most_expensive_motion < MotionModel::Parts {
            return NodeMotions { owners, groups, chosen };
        }
        at_rest.extend(passed);
    }
}

/// Motion of every group: recorded, or else chosen by what fits.
fn motions(
    field: &Field,
    groups: &mut [MovingGroup],
    frames: &mut Frames<'_>,
    reference: &Gaussians,
    time_codes: &TimeCodes,
    options: &SceneOptions,
) -> Vec<Chosen> {
    let recorded: Vec<Option<Chosen>> = groups
        .iter_mut()
        .map(|group| recorded::motion(field, group, reference, time_codes, options))
        .collect();
    let open = groups.iter_mut().zip(&recorded).filter(|(_, recorded)| recorded.is_none());
    let mut open: Vec<&mut MovingGroup> = open.map(|(group, _)| group).collect();
    let mut fitted = choose::choose(&mut open, frames, &time_codes.samples, options).into_iter();
    recorded.into_iter().filter_map(|recorded| recorded.or_else(|| fitted.next())).collect()
}

/// Nodes with their names: the first of the background is what stands still.
fn named_nodes(
    input: &NodeInput<'_>,
    owners: &[Option<usize>],
    groups: &[MovingGroup],
    chosen: Vec<Chosen>,
) -> Vec<Node> {
    let mut nodes: Vec<Node> = Vec::with_capacity(groups.len());
    let mut names = naming::Names::default();
    for ((owner, group), chosen) in owners.iter().zip(groups).zip(chosen) {
        let stands = nodes.last().is_none_or(|node| node.kind != NodeKind::Background);
        let background = if stands { naming::BACKGROUND } else { naming::MOVING_BACKGROUND };
        let naming = Naming::of(input.field, *owner, background, &mut names);
        nodes.push(node::node(input, naming, group, chosen));
    }
    nodes
}

/// Recorded cameras at the captured frames of a range.
fn cameras(field: &Field, frames: RangeInclusive<usize>) -> Vec<CameraTrack> {
    let codes = field.time_codes();
    let code_of = |index: usize| frames.contains(&index).then(|| codes[index]);
    let exposure_of = |recorded: &RecordedCamera| {
        let time = field.timeline.times[recorded.time_index];
        field.record.drawing.exposure(&recorded.name, time).map_or(0.0, |exposure| exposure.stops())
    };
    camera_tracks::camera_tracks(&field.cameras, code_of, exposure_of)
}

/// Opacities and colours over time, where they change.
fn add_changes(
    sampled: &SampledField<'_>,
    node: &mut Node,
    group: &MovingGroup,
    frames: &mut Frames<'_>,
    options: &SceneOptions,
) {
    let thinning = Thinning {
        time_codes: &sampled.time_codes.samples,
        weights: &node::weights(node, group),
        tolerance: options.appearance_tolerance,
        reduce: options.reduce_keys,
    };
    if sampled.opacities.change {
        appearance::fade(node, frames, options.min_opacity, &thinning);
    }
    if frames.recolor() {
        appearance::recolor(node, frames, &thinning);
    }
}

/// Instances without node, by index.
fn omitted(field: &Field, owners: &[Option<usize>]) -> Vec<usize> {
    (0..field.instances.len()).filter(|index| !owners.contains(&Some(*index))).collect()
}

/// The warning that names instances without splats.
fn without_splats(
    field: &Field,
    omitted: &[usize],
    identities: &[Option<Identity>],
    visible: &[u32],
) -> String {
    let hidden = hidden_rows(field, identities, visible);
    let names: Vec<String> = omitted
        .iter()
        .map(|index| match hidden[*index] {
            0 => field.instances[*index].label.clone(),
            count => format!("{} ({count} are too faint to be drawn)", field.instances[*index].label),
        })
        .collect();
    format!("{NO_SPLATS}{}", names.join(", "))
}

/// Per instance, how many Gaussians are most probably its own and cannot be drawn.
fn hidden_rows(field: &Field, identities: &[Option<Identity>], visible: &[u32]) -> Vec<usize> {
    let mut hidden = vec![0; field.instances.len()];
    for (row, identity) in identities.iter().enumerate() {
        if let Some(identity) = identity.filter(|_| visible.binary_search(&(row as u32)).is_err()) {
            hidden[identity.index] += 1;
        }
    }
    hidden
}

/// Hulls for simulators; reported where there is no body to make one of.
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
            // The logarithm of no thickness is a number below all others.
            let usable = gaussians.log_scales[row].iter().all(|log| log.exp().is_finite())
                && gaussians.means[row].iter().all(|value| value.is_finite())
                && gaussians.sh_coefficients[row].iter().all(|value| value.is_finite())
                && quaternion::try_normalize(gaussians.quaternions[row]).is_some()
                && !gaussians.opacity_logits[row].is_nan();
            let drawn = opacities[row] >= options.min_opacity
                && direct_sigmoid(gaussians.occupancy_logits[row]) >= options.min_occupancy;
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

/// Rows of a node to be.
struct NodeRows {
    owner: Option<usize>,
    rows: Vec<u32>,
    /// For each row, true where it moves as far as a picture shows.
    moves: Vec<bool>,
    /// True of an instance some of whose splats go farther than they are large, by the network.
    is_passed: bool,
    /// True of splats each of which may have a path of its own, whatever motion is allowed.
    is_loose: bool,
    /// See [`MovingGroup::recorded`].
    recorded: Vec<u32>,
}

impl NodeRows {
    fn of(owner: Option<usize>, rows: Vec<(u32, Change)>) -> Self {
        let (rows, changes): (_, Vec<Change>) = rows.into_iter().unzip();
        let moves = changes.iter().map(Change::shows).collect();
        Self { owner, rows, moves, is_passed: false, is_loose: false, recorded: Vec::new() }
    }
}

/// Rows of every node: instances in the order of the table, without what passes over those `at_rest`, then of the
/// background what stands still and what moves, if the motion may be of parts; empty ones left out.
fn rows_of_nodes(
    field: &Field,
    visible: &[u32],
    assigned: &Assignment,
    at_rest: &BTreeSet<usize>,
    frames: &mut Frames<'_>,
    options: &SceneOptions,
) -> Vec<NodeRows> {
    let mut rows: Vec<Vec<u32>> = vec![Vec::new(); field.instances.len() + 1];
    for (&row, owner) in visible.iter().zip(&assigned.owners) {
        rows[owner.unwrap_or(field.instances.len())].push(row);
    }
    let mut background = rows.pop().unwrap_or_default();
    let passes = |row: u32, change: &Change| {
        let by_network = field.tracks.as_ref().is_none_or(|tracks| tracks.group(row as usize).is_none());
        by_network && change.travels()
    };
    let mut nodes: Vec<NodeRows> = Vec::with_capacity(rows.len() + 2);
    for (index, rows) in rows.into_iter().enumerate() {
        let recorded = recorded::groups_of(field, &assigned.groups, index, &rows, options);
        let changes = match recorded.is_empty() {
            true => loose::changes(frames, &rows),
            false => vec![Change::default(); rows.len()],
        };
        let mut own: Vec<(u32, Change)> = rows.into_iter().zip(changes).collect();
        let is_passed = own.iter().any(|(row, change)| passes(*row, change));
        if at_rest.contains(&index) {
            let (passing, rest): (Vec<_>, Vec<_>) =
                own.into_iter().partition(|(row, change)| passes(*row, change));
            background.extend(passing.into_iter().map(|(row, _)| row));
            own = rest;
        }
        nodes.push(NodeRows { is_passed, recorded, ..NodeRows::of(Some(index), own) });
    }
    background.sort_unstable();
    let changes = loose::changes(frames, &background);
    let background: Vec<(u32, Change)> = background.into_iter().zip(changes).collect();
    if options.most_expensive_motion >= MotionModel::Parts {
        let (mut moving, mut still): (Vec<_>, Vec<_>) =
            background.into_iter().partition(|(_, change)| change.shows());
        if options.most_expensive_motion == MotionModel::Parts {
            still.extend(loose::leave_farthest(&mut moving));
            still.sort_unstable_by_key(|(row, _)| *row);
        }
        nodes.push(NodeRows::of(None, still));
        nodes.push(NodeRows { is_loose: true, ..NodeRows::of(None, moving) });
    } else {
        nodes.push(NodeRows::of(None, background));
    }
    nodes.retain(|node| !node.rows.is_empty());
    nodes
}

/// Groups of rows that move together, and whose they are.
fn moving_groups(
    nodes: Vec<NodeRows>,
    reference: &Gaussians,
    opacities: &[f32],
    options: &SceneOptions,
) -> (Vec<Option<usize>>, Vec<MovingGroup>) {
    let mut largest_instance: f64 = 0.0;
    let (mut group_owners, mut groups) = (Vec::new(), Vec::new());
    for NodeRows { owner, rows, moves, is_passed, is_loose, recorded } in nodes {
        let is_body = owner.is_some();
        let weights: Vec<f64> = rows
            .iter()
            .map(|&row| {
                let row = row as usize;
                f64::from(opacities[row]) * flat::size(reference.log_scales[row].map(f64::from))
            })
            .collect();
        let (low, high) = trimmed_box(&rows, &weights, &reference.means);
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
        let pivot = if is_body { (low + high) / 2.0 } else { DVec3::ZERO };
        let trim = if is_body { INSTANCE_TRIM } else { BACKGROUND_TRIM };
        let tolerance = options.tolerance.in_world_units(yardstick);
        let mut group = MovingGroup::new(rows, weights, pivot, is_body, trim, tolerance, &reference.means);
        let moving: f64 =
            group.weights.iter().zip(moves).filter(|(_, moves)| *moves).map(|(weight, _)| weight).sum();
        group.is_passed = is_passed;
        group.is_loose = is_loose;
        group.recorded = recorded;
        group.stands_still = moving <= trim * group.weights.iter().sum::<f64>();
        group_owners.push(owner);
        groups.push(group);
    }
    (group_owners, groups)
}
