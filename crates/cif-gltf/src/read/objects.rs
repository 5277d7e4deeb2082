//! Nodes with splats to objects of the scene: ours by what `extras.cif` says, others by their names.

use std::collections::BTreeSet;

use cif_geometry::{Bounds, RigidTransform};
use cif_scene::graph::pose_at;
use cif_scene::{
    Motion, MotionModel, MotionReport, Node, NodeKind, Part, PartsMotion, PoseSample, Splats, extent, naming,
};
use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::bake;
use super::hierarchy::Placed;
use super::motion::{Movement, Stage};
use super::splats::append;
use crate::GltfError;
use crate::extras::{Cif, Object};

/// Frames of objects that do not say over which they exist; put right when the timeline is known.
pub(crate) const ALL_FRAMES: (usize, usize) = (usize::MAX, usize::MAX);

/// A node that becomes an object, with the parts below it.
pub(crate) struct Found<'a> {
    placed: &'a Placed,
    parts: Vec<&'a Placed>,
}

impl Found<'_> {
    /// The node and its parts.
    pub(crate) fn all(&self) -> impl Iterator<Item = &Placed> {
        std::iter::once(self.placed).chain(self.parts.iter().copied())
    }
}

/// Objects of a file, in its order.
pub(crate) fn find<'a>(stage: &Stage<'_>, placed: &'a [Placed]) -> Vec<Found<'a>> {
    let mut found: Vec<Found<'a>> = Vec::new();
    let has_splats = |placed: &Placed| {
        let mesh = stage.source.root.nodes[placed.index].mesh;
        mesh.is_some_and(|mesh| stage.source.splat_count(mesh.value()).is_some())
    };
    for candidate in placed {
        match &candidate.cif {
            Some(Cif::Instance(_) | Cif::Background(_)) => {
                found.push(Found { placed: candidate, parts: Vec::new() });
            }
            Some(Cif::Part(_)) if has_splats(candidate) => {
                let owner = found.iter_mut().rev().find(|found| {
                    found.placed.index != candidate.index
                        && found.placed.cif.is_some()
                        && candidate.chain.contains(&found.placed.index)
                });
                match owner {
                    Some(owner) => owner.parts.push(candidate),
                    None => found.push(Found { placed: candidate, parts: Vec::new() }),
                }
            }
            _ if has_splats(candidate) => found.push(Found { placed: candidate, parts: Vec::new() }),
            _ => {}
        }
    }
    found
}

/// Makes nodes of a scene.
pub(crate) struct Builder<'a> {
    pub(crate) stage: &'a Stage<'a>,
    /// Node of our root, and what brings glTF's world into ours where that node was moved.
    pub(crate) world: Option<(usize, Option<DAffine3>)>,
    pub(crate) warnings: &'a mut Vec<String>,
    pub(crate) nodes: Vec<Node>,
    /// Names of the nodes.
    pub(crate) names: naming::Names,
    /// Ids of instances that are made already.
    pub(crate) used_ids: BTreeSet<u16>,
    /// Ids that our nodes carry.
    pub(crate) reserved_ids: BTreeSet<u16>,
    pub(crate) next_index: usize,
    /// Rows of files that know none.
    pub(crate) next_row: Option<u32>,
}

impl Builder<'_> {
    /// Adds an object.
    pub(crate) fn add(&mut self, found: &Found<'_>) -> Result<(), GltfError> {
        let source = self.stage.source;
        let placed = found.placed;
        let ours = placed.cif.is_some();
        let (prefix, nodes) = self.below_world(&placed.chain);
        let Some(movement) = self.stage.movement(&self.stage.chain(prefix, nodes, ours)) else {
            self.warnings.push(format!(
                "{}: its scale is 0, so that nothing of it can be seen; left out",
                source.node_name(placed.index)
            ));
            return Ok(());
        };
        self.warn_of_stretch(placed.index, &movement);
        let mut splats = self.own_splats(placed.index)?;
        let mut parts = Vec::new();
        if found.parts.is_empty() {
            apply(&mut splats, &movement.stretch);
        } else {
            parts = self.parts(found, &mut splats, &movement)?;
        }
        if splats.is_empty() {
            self.warnings
                .push(format!("{}: it has no splats left; taken as deleted", source.node_name(placed.index)));
            return Ok(());
        }
        self.fill_rows(&mut splats);
        let node = match &placed.cif {
            Some(Cif::Instance(instance)) => {
                let id = (instance.id > 0 && !self.used_ids.contains(&instance.id)).then_some(instance.id);
                self.ours(placed.index, &instance.object, id.map(|id| (id, instance.index)))?
            }
            Some(Cif::Background(object)) if !self.has_background() => self.background(object),
            Some(Cif::Background(object)) => self.ours(placed.index, object, None)?,
            _ => self.foreign(placed)?,
        };
        let node = self.finished(node, splats, parts, movement, ours);
        self.nodes.push(node);
        Ok(())
    }

    fn has_background(&self) -> bool {
        self.nodes.iter().any(|node| node.kind == NodeKind::Background)
    }

    /// A chain as it counts for the scene: below our root, or whole.
    pub(crate) fn below_world<'c>(&self, chain: &'c [usize]) -> (Option<DAffine3>, &'c [usize]) {
        match self.world {
            Some((world, None)) => match chain.iter().position(|&node| node == world) {
                Some(at) => (None, &chain[at + 1..]),
                // Beside our root: seen from it.
                None => (self.world_from_gltf(), chain),
            },
            Some((_, Some(inverse))) => (Some(inverse), chain),
            None => (None, chain),
        }
    }

    fn world_from_gltf(&self) -> Option<DAffine3> {
        let (world, _) = self.world?;
        Some(self.stage.locals[world].affine().inverse())
    }

    fn warn_of_stretch(&mut self, node: usize, movement: &Movement) {
        if movement.stretch_changes {
            self.warnings.push(format!(
                "{}: its size changes over time, which a scene cannot hold; it stays as at first",
                self.stage.source.node_name(node)
            ));
        }
    }

    fn own_splats(&mut self, node: usize) -> Result<Splats, GltfError> {
        let source = self.stage.source;
        match source.root.nodes[node].mesh {
            Some(mesh) if source.splat_count(mesh.value()).is_some() => {
                source.mesh_splats(mesh.value(), self.warnings)
            }
            _ => Ok(Splats::default()),
        }
    }

    /// Parts in their order; their splats are added to those of the object.
    fn parts(
        &mut self,
        found: &Found<'_>,
        splats: &mut Splats,
        object: &Movement,
    ) -> Result<Vec<Part>, GltfError> {
        let source = self.stage.source;
        let factor = bake::uniform(&object.stretch).unwrap_or_else(|| {
            self.warnings.push(format!(
                "{}: its scale differs between axes, which parts cannot follow; their mean is taken",
                source.node_name(found.placed.index)
            ));
            object.stretch.determinant().cbrt()
        });
        let stretch = DMat3::from_diagonal(DVec3::splat(factor));
        let mut parts: Vec<Part> = Vec::new();
        let mut names = naming::Names::default();
        if !splats.is_empty() {
            apply(splats, &stretch);
            let splats = 0..splats.len();
            parts.push(part(names.take("whole".to_owned()), splats, DVec3::ZERO, Vec::new()));
        }
        let position = |placed: &&Placed| match &placed.cif {
            Some(Cif::Part(part)) => part.part,
            _ => usize::MAX,
        };
        let mut ordered = found.parts.clone();
        ordered.sort_by_key(position);
        for placed in ordered {
            let at = placed.chain.iter().position(|&node| node == found.placed.index).map_or(0, |at| at + 1);
            let chain = self.stage.chain(None, &placed.chain[at..], true);
            let Some(movement) = self.stage.movement(&chain) else { continue };
            self.warn_of_stretch(placed.index, &movement);
            let mut more = self.own_splats(placed.index)?;
            apply(&mut more, &(stretch * movement.stretch));
            let range = splats.len()..splats.len() + more.len();
            append(splats, more);
            let (name, written) = match &placed.cif {
                Some(Cif::Part(part)) => (part.name.clone(), DVec3::from_array(part.pivot)),
                _ => (format!("part_{:02}", parts.len()), movement.rest.translation),
            };
            let name = names.take(name);
            let (pivot, mut track) = placement(&movement, written, false);
            for pose in &mut track {
                pose.translation *= factor;
            }
            parts.push(part(name, range, pivot * factor, track));
        }
        for part in &mut parts {
            let range = part.splats.clone();
            part.extent = extent::ellipsoid_bounds(
                &RigidTransform::IDENTITY,
                &splats.means[range.clone()],
                &splats.orientations[range.clone()],
                &splats.scales[range],
            );
        }
        Ok(parts)
    }

    fn fill_rows(&mut self, splats: &mut Splats) {
        if let Some(next) = &mut self.next_row {
            for row in &mut splats.rows {
                *row = *next;
                *next = next.saturating_add(1).min(Splats::NO_ROW - 1);
            }
        }
    }

    /// Identity of one of our objects; without id and index, a new instance like it.
    fn ours(
        &mut self,
        index: usize,
        object: &Object,
        known: Option<(u16, usize)>,
    ) -> Result<Named, GltfError> {
        let source = self.stage.source;
        let (id, position) = match known {
            Some(known) => {
                self.used_ids.insert(known.0);
                known
            }
            None => {
                let new = self.new_instance(index)?;
                let (node, name) = (source.node_name(index), &object.name);
                self.warnings.push(format!("{node} repeats {name}: it becomes the instance {}", new.0));
                new
            }
        };
        let node_name = source.root.nodes[index].name.as_deref().unwrap_or(&object.name);
        let name = if is_renamed(node_name, &object.name) {
            naming::identifier(node_name, &object.name)
        } else if known.is_some() {
            object.name.clone()
        } else {
            naming::instance_name(&object.label, id)
        };
        let name = self.names.take(name);
        Ok(Named {
            kind: NodeKind::Instance { id, index: position },
            name,
            label: object.label.clone(),
            category: object.category.clone(),
            pivot: Some(DVec3::from_array(object.pivot)),
            report: Some(object.motion.clone()),
            source_frames: Some(object.source_frames),
            mean_occupancy: Some(object.mean_occupancy),
        })
    }

    fn background(&mut self, object: &Object) -> Named {
        Named {
            kind: NodeKind::Background,
            name: self.names.take(object.name.clone()),
            label: object.label.clone(),
            category: object.category.clone(),
            pivot: Some(DVec3::from_array(object.pivot)),
            report: Some(object.motion.clone()),
            source_frames: Some(object.source_frames),
            mean_occupancy: Some(object.mean_occupancy),
        }
    }

    /// Identity of a node that others wrote: its own name, that of the nearest named node above, of its mesh, or
    /// of the file.
    fn foreign(&mut self, placed: &Placed) -> Result<Named, GltfError> {
        let root = &self.stage.source.root;
        let (id, index) = self.new_instance(placed.index)?;
        let above = placed.chain.iter().rev().filter_map(|&node| root.nodes[node].name.clone());
        let mesh = root.nodes[placed.index].mesh.and_then(|mesh| root.meshes[mesh.value()].name.clone());
        let stem = self.stage.source.path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let label = above.chain(mesh).chain(stem).find(|name| !name.trim().is_empty());
        let label = label.unwrap_or_else(|| "object".to_owned());
        Ok(Named {
            kind: NodeKind::Instance { id, index },
            name: self.names.take(naming::instance_name(&label, id)),
            category: label.clone(),
            label,
            pivot: None,
            report: None,
            source_frames: None,
            mean_occupancy: None,
        })
    }

    fn new_instance(&mut self, node: usize) -> Result<(u16, usize), GltfError> {
        let id = (1..=u16::MAX)
            .find(|id| !self.used_ids.contains(id) && !self.reserved_ids.contains(id))
            .ok_or_else(|| {
                let source = self.stage.source;
                source.invalid(source.node_name(node), "a scene holds 65535 objects; merge some of them")
            })?;
        self.used_ids.insert(id);
        let index = self.next_index;
        self.next_index += 1;
        Ok((id, index))
    }

    fn finished(
        &self,
        named: Named,
        splats: Splats,
        parts: Vec<Part>,
        movement: Movement,
        ours: bool,
    ) -> Node {
        let written_model = named.report.as_ref().map(|report| report.model);
        let (mut pivot, mut track) = match named.pivot {
            Some(pivot) => placement(&movement, pivot, written_model == Some(MotionModel::Rigid)),
            None => placement(&movement, movement.rest.translation, false),
        };
        // Where a body moves, the pivot only says where it was at the reference time.
        if let (Some(written), false) = (named.pivot, track.is_empty()) {
            pivot = written;
        }
        let motion = if !parts.is_empty() {
            Motion::Parts(PartsMotion { track: std::mem::take(&mut track), parts })
        } else if track.is_empty() {
            Motion::Static
        } else {
            Motion::Rigid(track)
        };
        let (samples, model) = match &motion {
            Motion::Static => (0, MotionModel::Static),
            Motion::Parts(motion) => (
                motion.track.len() + motion.parts.iter().map(|part| part.track.len()).sum::<usize>(),
                MotionModel::Parts,
            ),
            Motion::Rigid(track) => (track.len(), MotionModel::Rigid),
            Motion::Dense(dense) => (dense.samples.len(), MotionModel::Dense),
        };
        let mut report = named.report.unwrap_or_else(|| MotionReport::unfitted(&splats, samples));
        report.model = model;
        Node {
            kind: named.kind,
            name: named.name,
            label: named.label,
            category: named.category,
            pivot,
            extent: local_extent(&splats, &motion, self.stage.start),
            motion,
            proxy: None,
            colliders: Vec::new(),
            visibility: movement.visibility,
            source_frames: named.source_frames.unwrap_or(ALL_FRAMES),
            mean_occupancy: named.mean_occupancy.unwrap_or_else(|| mean_occupancy(&splats)),
            report: if ours { report } else { MotionReport { gaussians: splats.len(), ..report } },
            splats,
            appearance: Default::default(),
        }
    }
}

/// Who an object is.
struct Named {
    kind: NodeKind,
    name: String,
    label: String,
    category: String,
    pivot: Option<DVec3>,
    report: Option<MotionReport>,
    source_frames: Option<(usize, usize)>,
    mean_occupancy: Option<f32>,
}

/// Editors number copies: `mug.001`, `mug_2`.
fn is_renamed(now: &str, written: &str) -> bool {
    match now.strip_prefix(written) {
        Some(rest) => {
            let numbered = rest.strip_prefix(['.', '_']).is_some_and(|digits| {
                !digits.is_empty() && digits.chars().all(|character| character.is_ascii_digit())
            });
            !(rest.is_empty() || numbered)
        }
        None => !now.trim().is_empty(),
    }
}

fn part(name: String, splats: std::ops::Range<usize>, pivot: DVec3, track: Vec<PoseSample>) -> Part {
    Part { name, splats, pivot, track, extent: Bounds::EMPTY }
}

/// Stretches splats unless that changes nothing.
fn apply(splats: &mut Splats, stretch: &DMat3) {
    let change = *stretch - DMat3::IDENTITY;
    if change.to_cols_array().iter().any(|value| value.abs() > 1e-7) {
        bake::stretch(splats, stretch);
    }
}

/// Pivot and track of a movement; the written pivot is kept where the file holds it rounded.
fn placement(movement: &Movement, written: DVec3, keep_track: bool) -> (DVec3, Vec<PoseSample>) {
    if !movement.keys.is_empty() {
        return (written, movement.keys.clone());
    }
    let rest = movement.rest;
    if rest.rotation != DQuat::IDENTITY || keep_track {
        return (written, vec![rest]);
    }
    let same = written.as_vec3() == rest.translation.as_vec3();
    (if same { written } else { rest.translation }, Vec::new())
}

/// Box of the splats in the node's frame; parts as they stand at the first time.
fn local_extent(splats: &Splats, motion: &Motion, start: f64) -> Bounds {
    let of = |transform: &RigidTransform, range: std::ops::Range<usize>| {
        let (means, orientations) = (&splats.means[range.clone()], &splats.orientations[range.clone()]);
        extent::ellipsoid_bounds(transform, means, orientations, &splats.scales[range])
    };
    match motion {
        Motion::Parts(motion) => motion.parts.iter().fold(Bounds::EMPTY, |bounds, part| {
            let pose = pose_at(&part.track, part.pivot, start).transform();
            bounds.union(of(&pose, part.splats.clone()))
        }),
        _ => of(&RigidTransform::IDENTITY, 0..splats.len()),
    }
}

fn mean_occupancy(splats: &Splats) -> f32 {
    let pairs = splats.occupancies.iter().zip(&splats.opacities);
    let (sum, total) = pairs.fold((0.0, 0.0), |(sum, total), (occupancy, opacity)| {
        (sum + f64::from(occupancy * opacity), total + f64::from(*opacity))
    });
    if total > 0.0 { (sum / total) as f32 } else { 0.0 }
}
