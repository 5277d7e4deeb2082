//! Nodes from groups of Gaussians and their chosen motion.

use std::collections::BTreeMap;

use cif_field::{Embedding, Field, Gaussians, Identities};
use cif_geometry::RigidTransform;
use cif_geometry::scalar::direct_sigmoid;
use glam::DVec3;

use crate::field_motion::frames::Frames;
use crate::from_field::assignment::Identity;
use crate::graph::{
    Appearance, DenseMotion, IdentityShare, IdentityShares, Motion, MotionReport, Node, NodeKind, Part,
    PartsMotion, ResidualStatistics, SHARES_PER_SPLAT, Splats,
};
use crate::motion::choose::{Chosen, ChosenParts};
use crate::motion::group::{MeanShape, MovingGroup, trimmed_box};
use crate::motion::residuals::{ResidualSum, add_turns_between};
use crate::naming;
use crate::shape::{extent, flat};
use crate::vectors::vector;

/// Kind, names and class of a node.
pub(crate) struct Naming {
    kind: NodeKind,
    name: String,
    label: String,
    category: String,
    taxonomies: BTreeMap<String, String>,
    embedding: Option<Embedding>,
}

impl Naming {
    /// Names the node of an instance, or else `background`.
    pub(crate) fn of(
        field: &Field,
        owner: Option<usize>,
        background: &str,
        names: &mut naming::Names,
    ) -> Self {
        match owner {
            Some(index) => {
                let instance = &field.instances[index];
                let name = names.take(naming::instance_name(&instance.label, instance.id));
                Self {
                    kind: NodeKind::Instance { id: instance.id, index },
                    name,
                    label: instance.label.clone(),
                    category: instance.category.clone(),
                    taxonomies: instance.taxonomies.clone(),
                    embedding: field.record.embeddings.as_ref().and_then(|all| all.embedding(instance.id)),
                }
            }
            None => Self {
                kind: NodeKind::Background,
                name: names.take(background.to_owned()),
                label: match background == naming::MOVING_BACKGROUND {
                    true => naming::MOVING_BACKGROUND_LABEL.to_owned(),
                    false => naming::BACKGROUND.to_owned(),
                },
                category: naming::BACKGROUND.to_owned(),
                taxonomies: BTreeMap::new(),
                embedding: None,
            },
        }
    }
}

/// Inputs from which all nodes are made.
pub(crate) struct NodeInput<'a> {
    pub(crate) field: &'a Field,
    pub(crate) reference: &'a Gaussians,
    pub(crate) identities: &'a [Option<Identity>],
}

/// One node: the splats of the chosen model in the local frame, and the report, whose residual is that of
/// the model before [`measure`].
pub(crate) fn node(input: &NodeInput<'_>, naming: Naming, group: &MovingGroup, chosen: Chosen) -> Node {
    let order: Option<&[u32]> = match &chosen {
        Chosen::Parts(parts) => Some(&parts.order),
        _ => None,
    };
    let rows: Vec<u32> = match order {
        Some(order) => order.iter().map(|&position| group.rows[position as usize]).collect(),
        None => group.rows.clone(),
    };
    let is_instance = matches!(naming.kind, NodeKind::Instance { .. });
    // Recorded poses turn the colours that the field stores.
    let colors = if group.recorded.is_empty() { input.reference } else { &input.field.gaussians };
    let mut splats = appearance(input, colors, is_instance, rows);
    let (motion, residual) = match chosen {
        Chosen::Static => {
            take_shape(&mut splats, &group.static_shape);
            (Motion::Static, group.static_residual.statistics())
        }
        Chosen::Rigid(track) => {
            take_shape(&mut splats, &group.rigid_shape);
            (Motion::Rigid(track), group.rigid_residual.statistics())
        }
        Chosen::Parts(ChosenParts { track, parts, residual, .. }) => {
            let mut out = Vec::with_capacity(parts.len());
            for (number, part) in parts.into_iter().enumerate() {
                take_shape(&mut splats, &part.shape);
                out.push(Part {
                    name: format!("part_{number:02}"),
                    extent: extent::splat_bounds(&RigidTransform::IDENTITY, &splats, part.splats.clone()),
                    splats: part.splats,
                    pivot: part.pivot,
                    track: part.track,
                    joint: part.joint,
                });
            }
            (Motion::Parts(PartsMotion { track, parts: out }), residual)
        }
        Chosen::Dense { track, samples } => {
            // The first sample stands in wherever only the default time is read.
            take_shape(&mut splats, &group.static_shape);
            if let Some(first) = samples.first() {
                splats.means.clone_from(&first.means);
                splats.orientations.clone_from(&first.orientations);
                if let Some(scales) = &first.scales {
                    splats.scales.clone_from(scales);
                }
            }
            (Motion::Dense(DenseMotion { track, samples }), ResidualStatistics::default())
        }
    };
    let report = motion_report(group, &motion, residual, input);
    Node {
        kind: naming.kind,
        name: naming.name,
        label: naming.label,
        category: naming.category,
        taxonomies: naming.taxonomies,
        embedding: naming.embedding,
        pivot: group.pivot,
        extent: extent::node_bounds(&RigidTransform::IDENTITY, &splats, &motion, Part::at_first),
        motion,
        mean_occupancy: splats.mean_occupancy(),
        splats,
        appearance: Appearance::default(),
        proxy: None,
        colliders: Vec::new(),
        visibility: Vec::new(),
        source_frames: (0, 0),
        report,
    }
}

/// Adds the splats of a shape.
fn take_shape(splats: &mut Splats, shape: &MeanShape) {
    splats.means.extend(shape.means.iter().map(|mean| mean.to_array().map(|v| v as f32)));
    splats.orientations.extend(shape.orientations.iter().map(|q| q.map(|v| v as f32)));
    splats.scales.extend(shape.log_scales.iter().map(|log| log.to_array().map(flat::scale)));
}

/// Highest degree of spherical harmonics, up to `highest`, that any of the rows has: bands of zeros are not written.
fn used_degree(gaussians: &Gaussians, rows: &[u32], highest: u8) -> u8 {
    let first = |degree| 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    let is_used = |degree: u8| {
        let band = first(degree - 1)..first(degree);
        rows.iter()
            .any(|row| gaussians.sh_coefficients[*row as usize][band.clone()].iter().any(|v| *v != 0.0))
    };
    (1..=highest.min(3)).rev().find(|degree| is_used(*degree)).unwrap_or(0)
}

/// Everything about the splats that no motion model changes.
fn appearance(input: &NodeInput<'_>, colors: &Gaussians, is_instance: bool, rows: Vec<u32>) -> Splats {
    let gaussians = input.reference;
    let degree = used_degree(colors, &rows, input.field.sh_degree);
    let floats = 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    let mut splats = Splats { sh_degree: degree, ..Splats::default() };
    for &row in &rows {
        let row = row as usize;
        splats.opacities.push(direct_sigmoid(gaussians.opacity_logits[row]));
        splats.sh_coefficients.extend_from_slice(&colors.sh_coefficients[row][..floats]);
        splats.occupancies.push(direct_sigmoid(gaussians.occupancy_logits[row]));
        let probability = input.identities[row].map_or(0.0, |identity| identity.probability);
        splats.identity_probabilities.push(if is_instance { probability } else { 0.0 });
    }
    if let Some(identities) = &input.field.identities {
        let ids: Vec<u16> = input.field.instances.iter().map(|instance| instance.id).collect();
        splats.identities = rows.iter().map(|row| identity_shares(identities, *row as usize, &ids)).collect();
    }
    splats.rows = rows;
    splats
}

/// Probability below which an instance is left out of what is kept of an identity row.
const LEAST_PROBABILITY: f32 = 1e-3;

/// The most probable instances of an identity row; what is left out goes to the others in proportion.
fn identity_shares(identities: &Identities, row: usize, ids: &[u16]) -> IdentityShares {
    let range = identities.range(row);
    let mut probabilities = vec![0.0; range.len()];
    identities.row_probabilities(row, &mut probabilities);
    let mut entries: Vec<(usize, f32)> = range.clone().zip(probabilities).collect();
    // Stable, so that ties go to the lower index.
    entries.sort_by(|a, b| b.1.total_cmp(&a.1));
    entries.truncate(SHARES_PER_SPLAT);
    entries.retain(|(_, probability)| *probability >= LEAST_PROBABILITY);
    let kept: f32 = entries.iter().map(|(_, probability)| probability).sum();
    let labelled = identities.log_estimates[range].iter().map(|log| log.exp()).sum::<f32>().min(1.0);
    let mut shares = IdentityShares::default();
    for (place, (entry, probability)) in shares.iter_mut().zip(entries) {
        let id = ids[usize::from(identities.labels[entry])];
        *place = IdentityShare { id, share: probability / kept * labelled };
    }
    shares
}

/// Takes the residuals of nodes with a fitted motion against the trained Gaussians at all sampled times, as the nodes are
/// now: with the samples that were left out interpolated.
pub(crate) fn measure(
    nodes: &mut [Node],
    groups: &[MovingGroup],
    frames: &mut Frames<'_>,
    time_codes: &[f64],
) {
    use rayon::prelude::*;

    let mut sums = vec![ResidualSum::default(); nodes.len()];
    let weights: Vec<Vec<f64>> =
        nodes.iter().zip(groups).map(|(node, group)| self::weights(node, group)).collect();
    let is_fitted = |node: &Node, group: &MovingGroup| {
        !matches!(node.motion, Motion::Static) && group.recorded.is_empty()
    };
    if !nodes.iter().zip(groups).any(|(node, group)| is_fitted(node, group)) {
        return;
    }
    for (step, &time_code) in time_codes.iter().enumerate() {
        let frame = frames.at(step);
        sums.par_iter_mut().zip(nodes.par_iter()).zip(groups).zip(&weights).for_each(
            |(((sum, node), group), weights)| {
                if is_fitted(node, group) {
                    let placed = node.splats_at(time_code);
                    let distances: Vec<f64> = placed
                        .means
                        .iter()
                        .zip(&node.splats.rows)
                        .map(|(mean, &row)| mean.distance(vector(frame.means[row as usize])))
                        .collect();
                    sum.add(&distances, weights, group.trim, group.tolerance);
                    add_turns_between(sum, &placed.orientations, &node.splats.rows, weights, &frame);
                }
            },
        );
    }
    for ((node, group), sum) in nodes.iter_mut().zip(groups).zip(&sums) {
        if is_fitted(node, group) {
            node.report.residual = sum.statistics();
        }
    }
}

/// Weights of a group, in the order of the node made from it.
pub(crate) fn weights(node: &Node, group: &MovingGroup) -> Vec<f64> {
    let position = |row: &u32| group.rows.binary_search(row).ok();
    let rows = node.splats.rows.iter();
    rows.map(|row| position(row).map_or(0.0, |position| group.weights[position])).collect()
}

fn motion_report(
    group: &MovingGroup,
    motion: &Motion,
    residual: ResidualStatistics,
    input: &NodeInput<'_>,
) -> MotionReport {
    let (low, high) = trimmed_box(&group.rows, &group.weights, &input.reference.means);
    let recorded = group.recorded.first().map(|group| *group as usize);
    let evidence = || input.field.tracks.as_ref()?.groups.get(recorded?)?.rotation;
    MotionReport {
        model: motion.model(),
        rotation: match motion {
            Motion::Rigid(_) => evidence(),
            Motion::Static | Motion::Parts(_) | Motion::Dense(_) => None,
        },
        gaussians: group.rows.len(),
        size: DVec3::length(high - low),
        tolerance: group.tolerance,
        residual,
        static_residual: group.static_residual.statistics(),
        rigid_residual: (group.is_body && recorded.is_none()).then(|| group.rigid_residual.statistics()),
        parts_residual: group.parts_residual,
        parts: motion.part_count(),
        samples: motion.sample_count(),
        motion_bytes: motion.bytes(),
        seconds: group.seconds,
    }
}
