//! Nodes with splats to objects of the scene: ours by what `extras.cif` says, others by their names.

use cif_scene::assemble::{Identity, Piece, Placement, Prim, PrimName, Shape, Track, uniform};
use cif_scene::{MotionModel, Splats, naming};
use glam::{DAffine3, DMat3, DVec3};

use super::hierarchy::Placed;
use super::motion::{Chain, Movement, Stage};
use crate::GltfError;
use crate::extras::{Cif, Object};

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

/// Makes the prims of a scene.
pub(crate) struct Reader<'a> {
    pub(crate) stage: &'a Stage<'a>,
    /// Node of our root, and what brings glTF's world into ours where that node was moved.
    pub(crate) world: Option<(usize, Option<DAffine3>)>,
    pub(crate) warnings: &'a mut Vec<String>,
    /// Rows of files that know none.
    pub(crate) next_row: Option<u32>,
}

impl Reader<'_> {
    /// The prim of an object; `None` where nothing of it can be seen.
    pub(crate) fn prim(&mut self, found: &Found<'_>) -> Result<Option<Prim>, GltfError> {
        let source = self.stage.source;
        let placed = found.placed;
        let place = source.node_name(placed.index);
        let (prefix, nodes) = self.below_world(&placed.chain);
        let Some(movement) = self.stage.movement(&self.stage.chain(prefix, nodes, placed.cif.is_some()))
        else {
            self.warnings
                .push(format!("{place}: its scale is 0, so that nothing of it can be seen; left out"));
            return Ok(None);
        };
        self.warn_of_stretch(placed.index, &movement);
        let splats = self.own_splats(placed.index)?;
        let is_loose = splats.is_empty() && placed.cif.as_ref().is_some_and(Cif::moves_by_splat);
        let codes = if is_loose { self.shape_codes(found) } else { Vec::new() };
        let mut pieces = match (found.parts.is_empty(), codes.is_empty()) {
            (true, _) => vec![piece(String::new(), splats, Track::still(), movement.stretch, None)],
            (false, true) => self.parts(found, splats, &movement)?,
            (false, false) => self.loose(found, &movement, &codes)?,
        };
        if pieces.iter().all(|piece| piece.splats.is_empty()) {
            self.warnings.push(format!("{place}: it has no splats left; taken as deleted"));
            return Ok(None);
        }
        for piece in &mut pieces {
            self.fill_rows(&mut piece.splats);
        }
        let foreign = Prim {
            in_parts: !found.parts.is_empty() && codes.is_empty(),
            shape_codes: codes,
            scales_change: is_loose,
            track: movement.track,
            pieces,
            visibility: movement.visibility,
            ..Prim::still(place, self.label(placed), Splats::default())
        };
        Ok(Some(match &placed.cif {
            Some(Cif::Instance(instance)) => {
                let index = Some(instance.index);
                let identity = match instance.id {
                    0 => Identity::New,
                    id => Identity::Recorded { id, index, original: false },
                };
                let name = self.name(placed.index, &instance.object);
                ours(Prim { identity, name, ..foreign }, &instance.object)
            }
            Some(Cif::Background(object)) => {
                let name = PrimName::Exported(object.name.clone());
                ours(Prim { identity: Identity::Background, name, ..foreign }, object)
            }
            _ => foreign,
        }))
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

    /// Parts in their order, after the splats of the object itself.
    fn parts(
        &mut self,
        found: &Found<'_>,
        whole: Splats,
        object: &Movement,
    ) -> Result<Vec<Piece>, GltfError> {
        let source = self.stage.source;
        let factor = uniform(&object.stretch).unwrap_or_else(|| {
            self.warnings.push(format!(
                "{}: its scale differs between axes, which parts cannot follow; their mean is taken",
                source.node_name(found.placed.index)
            ));
            object.stretch.determinant().cbrt()
        });
        let stretch = DMat3::from_diagonal(DVec3::splat(factor));
        let mut pieces: Vec<Piece> = Vec::new();
        if !whole.is_empty() {
            pieces.push(piece("whole".to_owned(), whole, Track::still(), stretch, None));
        }
        let position = |placed: &&Placed| match &placed.cif {
            Some(Cif::Part(part)) => part.part,
            _ => usize::MAX,
        };
        let mut ordered = found.parts.clone();
        ordered.sort_by_key(position);
        for placed in ordered {
            let chain = self.part_chain(found, placed);
            let Some(movement) = self.stage.movement(&chain) else { continue };
            self.warn_of_stretch(placed.index, &movement);
            let splats = self.own_splats(placed.index)?;
            let (name, pivot) = match &placed.cif {
                Some(Cif::Part(part)) => (part.name.clone(), Some(factor * DVec3::from_array(part.pivot))),
                _ => (format!("part_{:02}", pieces.len()), None),
            };
            let mut track = movement.track;
            for pose in track.samples.iter_mut().chain([&mut track.rest]) {
                pose.translation *= factor;
            }
            let joint = match &placed.cif {
                Some(Cif::Part(part)) => part.joint,
                _ => None,
            };
            pieces.push(Piece { joint, ..piece(name, splats, track, stretch * movement.stretch, pivot) });
        }
        if pieces.len() != found.parts.len()
            || found.parts.iter().any(|placed| position(placed) >= pieces.len())
        {
            // Joints count parts that are not where they were.
            pieces.iter_mut().for_each(|piece| piece.joint = None);
        }
        Ok(pieces)
    }

    /// Chain of a part below its object.
    fn part_chain(&self, found: &Found<'_>, part: &Placed) -> Chain {
        let at = part.chain.iter().position(|&node| node == found.placed.index).map_or(0, |at| at + 1);
        self.stage.chain(None, &part.chain[at..], true)
    }

    /// Time codes at which any part has a key.
    fn shape_codes(&self, found: &Found<'_>) -> Vec<f64> {
        let keys = |part: &&Placed| self.stage.movement(&self.part_chain(found, part));
        let poses = found.parts.iter().filter_map(keys).flat_map(|movement| movement.track.samples);
        let mut codes: Vec<f64> = poses.map(|pose| pose.time_code).collect();
        codes.sort_by(f64::total_cmp);
        codes.dedup();
        codes
    }

    /// The parts as splats that deform: where each is and how it is stretched at every time code.
    fn loose(
        &mut self,
        found: &Found<'_>,
        object: &Movement,
        codes: &[f64],
    ) -> Result<Vec<Piece>, GltfError> {
        let stretch = DAffine3::from_mat3(object.stretch);
        let mut pieces = Vec::with_capacity(found.parts.len());
        for &part in &found.parts {
            let splats = self.own_splats(part.index)?;
            let chain = self.part_chain(found, part);
            let map = |code: f64| {
                let decomposed = self.stage.at(&chain, self.stage.clock.seconds(code))?;
                let turned = DMat3::from_quat(decomposed.rotation) * decomposed.stretch;
                Some((code, stretch * DAffine3::from_mat3_translation(turned, decomposed.translation)))
            };
            let Some(maps) = codes.iter().map(|&code| map(code)).collect::<Option<Vec<_>>>() else {
                self.warnings.push(format!(
                    "{}: its scale is 0, so that nothing of it can be seen; left out",
                    self.stage.source.node_name(part.index)
                ));
                continue;
            };
            let shape = Shape {
                means: splats.means.clone(),
                orientations: splats.orientations.clone(),
                scales: splats.scales.clone(),
            };
            pieces.push(Piece {
                placement: Placement::Sampled(maps),
                shapes: vec![shape; codes.len()],
                ..piece(String::new(), splats, Track::still(), DMat3::IDENTITY, None)
            });
        }
        Ok(pieces)
    }

    fn fill_rows(&mut self, splats: &mut Splats) {
        if let Some(next) = &mut self.next_row {
            for row in &mut splats.rows {
                *row = *next;
                *next = next.saturating_add(1).min(Splats::NO_ROW - 1);
            }
        }
    }

    /// Name of one of our instances: that of its node, where somebody gave it another.
    fn name(&self, index: usize, object: &Object) -> PrimName {
        let now = self.stage.source.root.nodes[index].name.as_deref().unwrap_or(&object.name);
        match is_renamed(now, &object.name) {
            true => PrimName::Given(naming::identifier(now, &object.name)),
            false => PrimName::Exported(object.name.clone()),
        }
    }

    /// Label of a node that others wrote: its own name, that of the nearest named node above, of its mesh, or of the
    /// file.
    fn label(&self, placed: &Placed) -> String {
        let root = &self.stage.source.root;
        let above = placed.chain.iter().rev().filter_map(|&node| root.nodes[node].name.clone());
        let mesh = root.nodes[placed.index].mesh.and_then(|mesh| root.meshes[mesh.value()].name.clone());
        let stem = self.stage.source.path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let label = above.chain(mesh).chain(stem).find(|name| !name.trim().is_empty());
        label.unwrap_or_else(|| "object".to_owned())
    }
}

/// A prim with what our exporter said about it.
fn ours(prim: Prim, object: &Object) -> Prim {
    Prim {
        label: object.label.clone(),
        category: object.category.clone(),
        taxonomies: object.taxonomies.clone(),
        embedding: object.embedding.clone().filter(cif_field::Embedding::is_valid),
        pivot: Some(DVec3::from_array(object.pivot)),
        keeps_pose: object.motion.model == MotionModel::Rigid,
        report: Some(object.motion.clone()),
        source_frames: Some(object.source_frames),
        mean_occupancy: Some(object.mean_occupancy),
        ..prim
    }
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

/// Splats below a stretch, unless that changes nothing.
fn piece(name: String, splats: Splats, track: Track, stretch: DMat3, pivot: Option<DVec3>) -> Piece {
    let change = stretch - DMat3::IDENTITY;
    let changes = change.to_cols_array().iter().any(|value| value.abs() > 1e-7);
    let placement = Placement::Rigid { track, baked: changes.then(|| DAffine3::from_mat3(stretch)) };
    let joint = None;
    Piece {
        name,
        splats,
        placement,
        pivot,
        joint,
        shapes: Vec::new(),
        opacities: Vec::new(),
        colors: Vec::new(),
    }
}
