//! Edits come home: what was changed in an exported file is applied to the field it was exported from.
//!
//! The graph that was exported is built again from the field, and compared with the edited one ([`crate::diff`]).
//! Unchanged objects keep everything the field knows of them, their learned motion included:
//!
//! | edit | in the field |
//! |---|---|
//! | object moved, also over time | recorded motion after the learned one |
//! | relabelled, renamed, another category | instance table |
//! | hidden, also over time | visibility of recorded motion |
//! | recoloured, faded or resized splats | their canonical parameters, by the difference |
//! | deleted splats or objects | gone, with what nobody saw of an object |
//! | splats moved within an object | taken from the file, with the motion that the file gives them |
//! | duplicated object | a copy of its Gaussians, as a new instance |
//! | added object | its Gaussians and motion, exempt from the learned one |

mod identities;
mod parts;
mod plan;

use cif_field::tracks::{NO_GROUP, TrackGroup, TrackPose, Tracks, VisibilityStep};
use cif_field::{Field, Instance};
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use glam::DVec3;

use crate::diff::splats::{coefficients, is_faded, is_recoloured, is_resized};
use crate::diff::units::{Unit, delta, key_codes, matching, step};
use crate::diff::{SceneDiff, diff, visibility_differs};
use crate::motion::time_map::TimeMap;
use crate::shape::flat::log_scale;
use crate::to_field::{InstanceTable, NodeRows, logit};
use crate::vectors::rows_of;
use crate::{Node, NodeKind, SceneError, SceneGraph, build, naming};
use identities::{Owner, RowIdentity};
use parts::subset;
use plan::{Plan, Step, instance_of};

/// Applies the edits of a file to the field that the file was exported from, and lists them. `source` names the
/// file, in errors and in the field's record. With `force` another field than the exported one is taken as
/// its base all the same: rows are then compared as they are numbered.
///
/// # Errors
/// When the file was not exported by cif, when it was exported from another field (without `force`), or when an
/// edited object cannot become Gaussians.
pub fn import_edits(
    base: &Field,
    edited: &SceneGraph,
    source: &str,
    force: bool,
) -> Result<(Field, SceneDiff), SceneError> {
    let (Some(fingerprint), Some(options)) = (&edited.origin.field_fingerprint, &edited.origin.options)
    else {
        return Err(SceneError::NotExported { file: source.to_owned() });
    };
    let found = base.fingerprint();
    if *fingerprint != found && !force {
        return Err(SceneError::OtherBase {
            file: source.to_owned(),
            exported: fingerprint.clone(),
            base: found,
        });
    }
    let exported = build(base, options)?;
    if edited.frame != exported.frame {
        return Err(SceneError::Import {
            object: source.to_owned(),
            what: format!(
                "it lies at {:?} of the capture's world, the base at {:?}; export the base again and edit that",
                edited.frame.offset, exported.frame.offset
            ),
        });
    }
    if *fingerprint == found {
        return apply(base, &exported, edited, source);
    }
    let mut edited = edited.clone();
    edited.origin.field_fingerprint = Some(found);
    apply(base, &exported, &edited, source)
}

/// Applies what differs between `exported`, a graph of `base`, and `edited`.
///
/// # Errors
/// When an edited object cannot become Gaussians; it is named.
pub fn apply(
    base: &Field,
    exported: &SceneGraph,
    edited: &SceneGraph,
    source: &str,
) -> Result<(Field, SceneDiff), SceneError> {
    let changes = diff(exported, edited);
    if changes.is_empty() {
        return Ok((base.clone(), changes));
    }
    let plan = Plan::new(base, exported, edited)?;
    let mut work = Work::start(&plan);
    for (index, step) in plan.steps.iter().enumerate() {
        work.adjust(&plan, index, step);
    }
    for step in &plan.steps {
        work.append(&plan, step)?;
    }
    let field = work.finish(&plan, source, &changes)?;
    Ok((field, changes))
}

/// The field under construction.
struct Work {
    field: Field,
    tracks: Tracks,
    rows: Vec<RowIdentity>,
    instances: InstanceTable,
    /// Owner of new splats of every step.
    owners: Vec<Owner>,
}

impl Work {
    /// The base without what is deleted, with copies of what is duplicated.
    fn start(plan: &Plan<'_>) -> Self {
        let mut field = plan.base.gather(&plan.sources);
        let tracks = field
            .tracks
            .take()
            .unwrap_or_else(|| Tracks { group_of: vec![NO_GROUP; field.len()], groups: Vec::new() });
        let rows = (0..plan.sources.len() as u32).map(RowIdentity::Kept).collect();
        let instances = InstanceTable { entries: std::mem::take(&mut field.instances) };
        Self { field, tracks, rows, instances, owners: vec![None; plan.steps.len()] }
    }

    /// Everything about a pair but its new splats.
    fn adjust(&mut self, plan: &Plan<'_>, index: usize, step: &Step) {
        let (Some(first), Some(second)) = plan.nodes(step) else { return };
        let kept = plan.kept_rows(step, first);
        self.appearance(plan, first, second, &kept);
        self.motion(plan, step, first, second, &kept);
        if step.pair.duplicate {
            return;
        }
        self.owners[index] = instance_of(first).map(|index| index as u16);
        if let NodeKind::Instance { id, index } = first.kind {
            rename(&mut self.instances.entries[index], id, first, second);
        }
    }

    /// Colours, opacities and sizes, by their differences.
    fn appearance(&mut self, plan: &Plan<'_>, first: &Node, second: &Node, kept: &[(u32, usize, usize)]) {
        let (a, b) = (&first.splats, &second.splats);
        let time = plan.times.time(plan.reference);
        for unit in crate::diff::units::units(first) {
            let rest = unit.pose(plan.reference).rotation;
            for &(row, i, j) in kept.iter().filter(|(_, i, _)| unit.splats.contains(i)) {
                let row = row as usize;
                let gaussians = &mut self.field.gaussians;
                if is_recoloured(a, i, b, j) {
                    let (x, y) = (coefficients(a, i), coefficients(b, j));
                    let mut change = [0.0; cif_field::gaussians::SH_FLOATS];
                    for (k, change) in change.iter_mut().enumerate() {
                        *change = y.get(k).unwrap_or(&0.0) - x.get(k).unwrap_or(&0.0);
                    }
                    // The file shows colours in the object's frame; the field keeps them before its tracks.
                    let posed = self.tracks.group(row).map(|group| self.tracks.groups[group].pose(time).0);
                    let back = posed.unwrap_or_default().conjugate() * rest;
                    if back.xyz().length() > 1e-9 {
                        HarmonicsRotation::new(rows_of(back)).rotate(&mut change);
                    }
                    let sh = &mut gaussians.sh_coefficients[row];
                    sh.iter_mut().zip(change).for_each(|(value, change)| *value += change);
                }
                if is_faded(a, i, b, j) {
                    gaussians.opacity_logits[row] += logit(b.opacities[j]) - logit(a.opacities[i]);
                    if let Some((x, y)) = a.occupancies.get(i).zip(b.occupancies.get(j)) {
                        gaussians.occupancy_logits[row] += logit(*y) - logit(*x);
                    }
                }
                if is_resized(a, i, b, j) {
                    for axis in 0..3 {
                        gaussians.log_scales[row][axis] +=
                            log_scale(b.scales[j][axis]) - log_scale(a.scales[i][axis]);
                    }
                }
            }
        }
    }

    /// Moves and visibility, as recorded motion after what moves the rows already.
    fn motion(
        &mut self,
        plan: &Plan<'_>,
        step: &Step,
        first: &Node,
        second: &Node,
        kept: &[(u32, usize, usize)],
    ) {
        let codes = key_codes(&[plan.exported, plan.edited], &[first, second]);
        let hides = visibility_differs(first, second, &codes);
        let Some(pairs) = matching(first, second) else { return };
        let is_whole = pairs.len() == 1;
        for (before, after) in &pairs {
            let moved = delta(before, after, &codes);
            if moved.is_none() && !hides {
                continue;
            }
            let mut rows: Vec<u32> =
                kept.iter().filter(|(_, i, _)| before.splats.contains(i)).map(|(row, ..)| *row).collect();
            if is_whole {
                rows.extend(step.unseen.iter().filter_map(|row| plan.new_of_base[*row as usize]));
            }
            if rows.is_empty() {
                continue;
            }
            let pivot = before.pose(plan.reference).translation;
            self.tracks.regroup(&rows, &second.name, pivot, |mut group| {
                if let Some(moved) = &moved {
                    carry(&mut group, before, after, moved.constant, &codes, &plan.times);
                }
                if hides {
                    group.visibility = visibility(second, &plan.times);
                }
                group
            });
        }
    }

    /// New splats of a pair, as the file has them.
    fn append(&mut self, plan: &Plan<'_>, step: &Step) -> Result<(), SceneError> {
        let (first, second) = plan.nodes(step);
        let Some(second) = second else { return Ok(()) };
        let is_new = step.pair.duplicate || first.is_none();
        let owner = match (is_new, second.kind, first.and_then(instance_of)) {
            (true, NodeKind::Instance { id, .. }, _) => {
                // A copy has the id of its original; everything else keeps its own where it is free.
                Some(self.instances.add(second, if step.pair.duplicate { 0 } else { id })?)
            }
            (true, NodeKind::Background, _) => None,
            (false, _, index) => index.map(|index| index as u16),
        };
        let id = owner.map(|index| self.instances.entries[usize::from(index)].id);
        if step.pair.duplicate {
            let copies = step.first_copy..step.first_copy + step.splats.kept.len() as u32;
            self.rows[copies.start as usize..copies.end as usize].fill(RowIdentity::Given(owner));
            // Not in the groups of the original.
            let is_named = |group: usize| self.tracks.groups[group].instance.is_some();
            let named: Vec<u32> =
                copies.filter(|row| self.tracks.group(*row as usize).is_some_and(is_named)).collect();
            let own = |group| TrackGroup { instance: id, ..group };
            self.tracks.regroup(&named, &second.name, second.pivot, own);
        }
        let reshaped = step.splats.reshaped.iter().map(|(_, j)| *j);
        let mut positions: Vec<usize> = step.splats.added.iter().copied().chain(reshaped).collect();
        if positions.is_empty() {
            return Ok(());
        }
        positions.sort_unstable();
        let node = subset(second, &positions);
        let samples = &plan.edited.time_codes.samples;
        let mut rows = NodeRows::of(&node, &plan.times, samples, plan.reference)?;
        if plan.base.deformation.is_some() {
            rows.exempt(&node.name);
        }
        let degree = node.splats.sh_degree;
        if degree > self.field.sh_degree {
            let active = 3 * cif_geometry::spherical_harmonics::coefficient_count(self.field.sh_degree);
            for sh in &mut self.field.gaussians.sh_coefficients {
                sh[active..].fill(0.0);
            }
            self.field.sh_degree = degree;
        }
        self.rows.extend(std::iter::repeat_n(RowIdentity::Given(owner), rows.gaussians.len()));
        // Groups of an instance that the network moves are not all of it.
        let is_named = is_new || self.tracks.groups.iter().any(|group| group.instance == id);
        rows.append_to(&mut self.field.gaussians, &mut self.tracks, id.filter(|_| is_named));
        Ok(())
    }

    fn finish(self, plan: &Plan<'_>, source: &str, changes: &SceneDiff) -> Result<Field, SceneError> {
        let Self { mut field, tracks, rows, instances, .. } = self;
        field.tracks = tracks.compact();
        (field.instances, field.identities) =
            identities::rebuild(plan, instances.entries, field.identities.as_ref(), &rows);
        identities::follow_groups(&mut field);
        field.record.edits.push(serde_json::json!({ "file": source, "objects": changes.objects }));
        field
            .validate()
            .map_err(|error| SceneError::Import { object: source.to_owned(), what: error.to_string() })?;
        Ok(field)
    }
}

/// Label and category of the edited node; a new name becomes the label where the label was left alone.
fn rename(instance: &mut Instance, id: u16, first: &Node, second: &Node) {
    if second.label != first.label {
        instance.label.clone_from(&second.label);
    } else if second.name != first.name {
        instance.label = naming::label_of_name(&second.name, id);
    }
    if second.category != first.category {
        instance.category.clone_from(&second.category);
    }
    if second.taxonomies != first.taxonomies {
        instance.taxonomies.clone_from(&second.taxonomies);
    }
}

fn visibility(node: &Node, times: &TimeMap) -> Vec<VisibilityStep> {
    let steps = node.visibility.iter();
    let steps: Vec<VisibilityStep> = steps
        .map(|step| VisibilityStep { time: times.time(step.time_code), visible: step.visible })
        .collect();
    if steps.iter().all(|step| step.visible) { Vec::new() } else { steps }
}

/// Puts the move from one unit to another after the poses of a group.
fn carry(
    group: &mut TrackGroup,
    before: &Unit<'_>,
    after: &Unit<'_>,
    constant: bool,
    codes: &[f64],
    times: &TimeMap,
) {
    if constant {
        let (turn, shift) = step(before, after, codes[0]);
        if group.poses.is_empty() {
            let rest = TrackPose { time: 0.0, translation: group.pivot, rotation: glam::DQuat::IDENTITY };
            group.poses.push(rest);
        }
        for pose in &mut group.poses {
            pose.translation = turn * pose.translation + shift;
            pose.rotation = (turn * pose.rotation).normalize();
        }
        return;
    }
    let mut codes: Vec<f64> =
        codes.iter().copied().chain(group.poses.iter().map(|pose| times.code(pose.time))).collect();
    codes.sort_by(f64::total_cmp);
    codes.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
    let mut poses: Vec<TrackPose> = Vec::with_capacity(codes.len());
    for code in codes {
        let time = times.time(code);
        let (rotation, translation): (_, DVec3) = group.pose(time);
        let (turn, shift) = step(before, after, code);
        let mut rotation = (turn * rotation).normalize();
        if poses.last().is_some_and(|last| last.rotation.dot(rotation) < 0.0) {
            rotation = -rotation;
        }
        poses.push(TrackPose { time, translation: turn * translation + shift, rotation });
    }
    group.poses = poses;
}

#[cfg(test)]
mod tests;
