//! Instances, identity rows and embeddings of nodes.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::{Embeddings, Identities, Instance, Owner};

use crate::SceneError;
use crate::graph::{Node, NodeKind, SceneGraph};

/// Adds the identity rows of a node.
pub(super) fn push_identities(
    identities: &mut Identities,
    node: &Node,
    owner: Option<u16>,
    index_of: &BTreeMap<u16, u16>,
) {
    let own_id = match node.kind {
        NodeKind::Instance { id, .. } => id,
        NodeKind::Background => 0,
    };
    for splat in 0..node.splats.len() {
        let shares = node.splats.identities.get(splat).copied().unwrap_or_default();
        let mut entries: Vec<(u16, f32)> = shares
            .iter()
            .filter(|entry| entry.id != 0 && entry.share > 0.0)
            .filter_map(|entry| {
                let own = owner.filter(|_| entry.id == own_id);
                own.or_else(|| index_of.get(&entry.id).copied()).map(|index| (index, entry.share))
            })
            .collect();
        entries.sort_by_key(|(index, _)| *index);
        entries.dedup_by_key(|(index, _)| *index);
        match owner {
            _ if entries.is_empty() => identities.push_certain(owner),
            Some(index) => identities.push(Owner::Instance(index), &entries),
            None => identities.push(Owner::Background, &entries),
        }
    }
}

/// Instances while they are collected.
#[derive(Default)]
pub(crate) struct InstanceTable {
    pub(crate) entries: Vec<Instance>,
}

impl InstanceTable {
    /// Adds an instance for a node and returns its index; an id of 0 or one that is taken is replaced by the
    /// lowest free one.
    pub(crate) fn add(&mut self, node: &Node, id: u16) -> Result<u16, SceneError> {
        let taken: BTreeSet<u16> = self.entries.iter().map(|instance| instance.id).collect();
        let id = if id != 0 && !taken.contains(&id) {
            id
        } else {
            (1..=u16::MAX).find(|id| !taken.contains(id)).ok_or_else(|| SceneError::Import {
                object: node.name.clone(),
                what: "a field holds at most 65535 instances, and all ids are taken".to_owned(),
            })?
        };
        let index = self.entries.len() as u16;
        let label = if node.label.is_empty() { node.name.clone() } else { node.label.clone() };
        let category = if node.category.is_empty() { label.clone() } else { node.category.clone() };
        let taxonomies = node.taxonomies.clone();
        self.entries.push(Instance { id, label, category, taxonomies });
        Ok(index)
    }
}

/// Appearance of the instances, by the model of the first that has any; one field has one model.
pub(super) fn embeddings(
    graph: &SceneGraph,
    owners: &[Option<u16>],
    instances: &[Instance],
) -> Option<Embeddings> {
    let known = || {
        let nodes = graph.nodes.iter().zip(owners);
        nodes.filter_map(|(node, owner)| {
            Some((instances[usize::from((*owner)?)].id, node.embedding.as_ref()?))
        })
    };
    let model = known().next()?.1.model.clone();
    let of = known().filter(|(_, embedding)| embedding.model == model && embedding.is_valid());
    let of = of.map(|(id, embedding)| (id, embedding.direction.clone())).collect();
    Some(Embeddings { model, of })
}
