//! Which nodes of two graphs are the same object.

use std::collections::BTreeMap;

use crate::{Node, NodeKind, SceneGraph, Splats};

/// Nodes that belong together, by position in their graphs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pair {
    /// In the first graph; `None` for an added node.
    pub before: Option<usize>,
    /// In the second graph; `None` for a removed node.
    pub after: Option<usize>,
    /// True when the node of the second graph is a copy next to the original.
    pub duplicate: bool,
}

/// Share of its splats that a copy has from its original.
const COPIED: f64 = 0.5;

/// Pairs the nodes: those of the first graph in its order, then what was added.
#[must_use]
pub fn pairs(before: &SceneGraph, after: &SceneGraph) -> Vec<Pair> {
    let mut partner: Vec<Option<usize>> = vec![None; before.nodes.len()];
    let mut taken = vec![false; after.nodes.len()];
    // By id; of several, the one of the same name, else the first, else by name alone.
    let mut match_by = |same: &dyn Fn(&Node, &Node) -> bool| {
        for (index, node) in before.nodes.iter().enumerate() {
            if partner[index].is_some() {
                continue;
            }
            let found =
                (0..after.nodes.len()).find(|&other| !taken[other] && same(node, &after.nodes[other]));
            if let Some(other) = found {
                partner[index] = Some(other);
                taken[other] = true;
            }
        }
    };
    match_by(&|a, b| same_object(a, b) && a.name == b.name);
    match_by(&|a, b| same_object(a, b));
    match_by(&|a, b| has_same_kind(a, b) && a.name == b.name);
    let mut pairs: Vec<Pair> = partner
        .iter()
        .enumerate()
        .map(|(index, other)| Pair { before: Some(index), after: *other, duplicate: false })
        .collect();
    let owners = same_rows(before, after).then(|| owners_of_rows(before));
    for (other, node) in after.nodes.iter().enumerate().filter(|(other, _)| !taken[*other]) {
        let original = owners.as_ref().and_then(|owners| original_of(node, owners));
        pairs.push(Pair { before: original, after: Some(other), duplicate: original.is_some() });
    }
    pairs
}

/// True when both are the background, or instances with one id.
fn same_object(a: &Node, b: &Node) -> bool {
    match (a.kind, b.kind) {
        (NodeKind::Background, NodeKind::Background) => true,
        (NodeKind::Instance { id: a, .. }, NodeKind::Instance { id: b, .. }) => a == b && a != 0,
        _ => false,
    }
}

fn has_same_kind(a: &Node, b: &Node) -> bool {
    (a.kind == NodeKind::Background) == (b.kind == NodeKind::Background)
}

/// Node of every row.
fn owners_of_rows(graph: &SceneGraph) -> BTreeMap<u32, usize> {
    let nodes = graph.nodes.iter().enumerate();
    nodes.flat_map(|(index, node)| node.splats.rows.iter().map(move |row| (*row, index))).collect()
}

/// The node that a copy has most of its rows from.
fn original_of(node: &Node, owners: &BTreeMap<u32, usize>) -> Option<usize> {
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    for owner in
        node.splats.rows.iter().filter(|row| **row != Splats::NO_ROW).filter_map(|row| owners.get(row))
    {
        *counts.entry(*owner).or_default() += 1;
    }
    let (owner, count) =
        counts.into_iter().max_by_key(|(owner, count)| (*count, std::cmp::Reverse(*owner)))?;
    (count as f64 >= COPIED * node.splats.len() as f64).then_some(owner)
}

/// True when rows of two graphs mean the same Gaussians.
pub(crate) fn same_rows(before: &SceneGraph, after: &SceneGraph) -> bool {
    before.origin.field_fingerprint.is_some()
        && before.origin.field_fingerprint == after.origin.field_fingerprint
}
