//! What becomes of the splats of every object.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::Field;

use crate::diff::splats::{SplatPairs, pair};
use crate::diff::{Pair, pairs, same_rows};
use crate::from_field::assignment;
use crate::motion::time_map::TimeMap;
use crate::{Node, NodeKind, SceneError, SceneGraph};

/// One pair of nodes and what becomes of their splats.
pub(super) struct Step {
    pub(super) pair: Pair,
    pub(super) splats: SplatPairs,
    /// First row of a duplicate in the edited field.
    pub(super) first_copy: u32,
    /// Base rows that nobody sees, but that belong to the object.
    pub(super) unseen: Vec<u32>,
}

/// Splats of all objects, and the rows of the edited field.
pub(super) struct Plan<'a> {
    pub(super) base: &'a Field,
    pub(super) exported: &'a SceneGraph,
    pub(super) edited: &'a SceneGraph,
    pub(super) times: TimeMap,
    pub(super) reference: f64,
    pub(super) steps: Vec<Step>,
    /// Base row of every row that is kept or copied.
    pub(super) sources: Vec<u32>,
    /// Row in the edited field of every base row that is kept.
    pub(super) new_of_base: Vec<Option<u32>>,
    /// Base instances that go.
    pub(super) removed: BTreeSet<usize>,
}

impl<'a> Plan<'a> {
    pub(super) fn new(
        base: &'a Field,
        exported: &'a SceneGraph,
        edited: &'a SceneGraph,
    ) -> Result<Self, SceneError> {
        let rows_match = same_rows(exported, edited);
        let mut unseen = unseen_members(base, exported);
        let mut deleted = vec![false; base.len()];
        let mut removed = BTreeSet::new();
        let mut steps = Vec::new();
        for pair_of_nodes in pairs(exported, edited) {
            let first = pair_of_nodes.before.map(|index| &exported.nodes[index]);
            let second = pair_of_nodes.after.map(|index| &edited.nodes[index]);
            if let Some(second) = second {
                crate::to_field::check(second)?;
            }
            let mut step = Step {
                pair: pair_of_nodes,
                splats: SplatPairs::default(),
                first_copy: 0,
                unseen: Vec::new(),
            };
            let mut delete = |row: u32| deleted[row as usize] = true;
            match (first, second) {
                (Some(first), Some(second)) => {
                    step.splats = pair(first, second, rows_match);
                    if !pair_of_nodes.duplicate {
                        let reshaped = step.splats.reshaped.iter().map(|(i, _)| i);
                        step.splats
                            .removed
                            .iter()
                            .chain(reshaped)
                            .for_each(|i| delete(first.splats.rows[*i]));
                        step.unseen = instance_of(first).and_then(|k| unseen.remove(&k)).unwrap_or_default();
                    }
                }
                (Some(first), None) => {
                    first.splats.rows.iter().copied().for_each(&mut delete);
                    if let Some(index) = instance_of(first) {
                        unseen.remove(&index).unwrap_or_default().into_iter().for_each(&mut delete);
                        removed.insert(index);
                    }
                }
                (None, Some(second)) => step.splats.added = (0..second.splats.len()).collect(),
                (None, None) => {}
            }
            steps.push(step);
        }
        let mut sources: Vec<u32> = (0..base.len() as u32).filter(|row| !deleted[*row as usize]).collect();
        let mut new_of_base = vec![None; base.len()];
        for (new, old) in sources.iter().enumerate() {
            new_of_base[*old as usize] = Some(new as u32);
        }
        for step in steps.iter_mut().filter(|step| step.pair.duplicate) {
            step.first_copy = sources.len() as u32;
            if let Some(first) = step.pair.before.map(|index| &exported.nodes[index]) {
                sources.extend(step.splats.kept.iter().map(|(i, _)| first.splats.rows[*i]));
            }
        }
        Ok(Self {
            times: TimeMap::of_field(base),
            reference: exported.time_codes.start(),
            base,
            exported,
            edited,
            steps,
            sources,
            new_of_base,
            removed,
        })
    }

    pub(super) fn nodes(&self, step: &Step) -> (Option<&'a Node>, Option<&'a Node>) {
        let before = step.pair.before.map(|index| &self.exported.nodes[index]);
        (before, step.pair.after.map(|index| &self.edited.nodes[index]))
    }

    /// Rows in the edited field of the kept splats of a step, with their positions in both nodes.
    pub(super) fn kept_rows(&self, step: &Step, first: &Node) -> Vec<(u32, usize, usize)> {
        let pairs = step.splats.kept.iter().enumerate();
        pairs
            .filter_map(|(place, (i, j))| {
                let row = if step.pair.duplicate {
                    Some(step.first_copy + place as u32)
                } else {
                    self.new_of_base[first.splats.rows[*i] as usize]
                };
                row.map(|row| (row, *i, *j))
            })
            .collect()
    }
}

pub(super) fn instance_of(node: &Node) -> Option<usize> {
    match node.kind {
        NodeKind::Instance { index, .. } => Some(index),
        NodeKind::Background => None,
    }
}

/// Rows of each instance that are in no node of the graph: too faint to be seen, they still belong to it.
fn unseen_members(base: &Field, exported: &SceneGraph) -> BTreeMap<usize, Vec<u32>> {
    let mut members: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
    if base.identities.is_none() {
        return members;
    }
    let mut is_seen = vec![false; base.len()];
    for row in exported.nodes.iter().flat_map(|node| &node.splats.rows) {
        is_seen[*row as usize] = true;
    }
    // As if they could be seen.
    let all: Vec<u32> = (0..base.len() as u32).collect();
    let options = exported.origin.options.clone().unwrap_or_default();
    let owners = assignment::assign(base, &assignment::most_probable(base), &all, &options).owners;
    for (row, owner) in owners.into_iter().enumerate().filter(|(row, _)| !is_seen[*row]) {
        if let Some(owner) = owner {
            members.entry(owner).or_default().push(row as u32);
        }
    }
    members
}
