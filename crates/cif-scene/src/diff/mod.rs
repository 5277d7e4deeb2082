//! Differences between two graphs, object by object.
//!
//! Nodes are paired by id, else by name; the background with the background. Splats are paired by their rows in
//! the field where both graphs come from the same one, else by position where their numbers agree. Differences
//! that come from storing numbers in single precision are none.

mod cameras;
mod pair;
pub(crate) mod splats;
pub(crate) mod units;

use serde::Serialize;

pub use cameras::{CameraChange, CameraChangeKind};
pub(crate) use pair::same_rows;
pub use pair::{Pair, pairs};
pub use splats::SplatChanges;

use crate::{Node, NodeKind, SceneGraph};
use units::{delta, key_codes};

/// Kind of an object's difference.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ChangeKind {
    /// Only in the second graph.
    Added,
    /// A copy of an object of the first graph.
    Duplicated,
    /// Only in the first graph.
    Removed,
    /// In both.
    Changed,
}

/// Two values of a property.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FromTo {
    /// In the first graph.
    pub from: String,
    /// In the second.
    pub to: String,
}

impl FromTo {
    fn of(from: &str, to: &str) -> Option<Self> {
        (from != to).then(|| Self { from: from.to_owned(), to: to.to_owned() })
    }
}

/// Displacement of an object from where it was, over all times.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Moved {
    /// Largest distance of the origin of its frame, world units.
    pub translation: f64,
    /// Largest turn, degrees.
    pub rotation_degrees: f64,
    /// True when the move is the same at all times.
    pub constant: bool,
}

/// Differences of one object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObjectChange {
    /// Kind of its difference.
    pub kind: ChangeKind,
    /// Mask value; `None` for the background and where the file has none.
    pub id: Option<u16>,
    /// Its name, in the first graph where it is there.
    pub name: String,
    /// Its label, likewise.
    pub label: String,
    /// Splats, in the second graph where it is there.
    pub splat_count: usize,
    /// Name, if it differs.
    pub renamed: Option<FromTo>,
    /// Label, if it differs.
    pub relabelled: Option<FromTo>,
    /// Category, if it differs.
    pub recategorised: Option<FromTo>,
    /// Names in taxonomies, if they differ: `coco=cup, wikidata_qcode=Q81727`.
    pub taxonomies: Option<FromTo>,
    /// Move, if there is one.
    pub moved: Option<Moved>,
    /// True when it is seen at other times.
    pub visibility: bool,
    /// Splats that differ; `None` where none does.
    pub splats: Option<SplatChanges>,
}

impl ObjectChange {
    /// True when anything differs.
    #[must_use]
    pub fn is_change(&self) -> bool {
        self.kind != ChangeKind::Changed
            || self.renamed.is_some()
            || self.relabelled.is_some()
            || self.recategorised.is_some()
            || self.taxonomies.is_some()
            || self.moved.is_some()
            || self.visibility
            || self.splats.is_some()
    }

    /// The differences in words, one each.
    #[must_use]
    pub fn describe(&self) -> Vec<String> {
        let mut words = Vec::new();
        match self.kind {
            ChangeKind::Added => words.push(format!("added, {} splats", self.splat_count)),
            ChangeKind::Duplicated => words.push(format!("duplicated, {} splats", self.splat_count)),
            ChangeKind::Removed => words.push("removed".to_owned()),
            ChangeKind::Changed => {}
        }
        let changes = [
            ("renamed", &self.renamed),
            ("relabelled", &self.relabelled),
            ("category", &self.recategorised),
            ("taxonomies", &self.taxonomies),
        ];
        for (what, change) in changes {
            if let Some(FromTo { from, to }) = change {
                words.push(format!("{what} {from:?} -> {to:?}"));
            }
        }
        if let Some(moved) = &self.moved {
            let up_to = if moved.constant { "" } else { "up to " };
            words.push(format!(
                "moved {up_to}{:.4}, turned {up_to}{:.2} degrees",
                moved.translation, moved.rotation_degrees
            ));
        }
        if self.visibility {
            words.push("seen at other times".to_owned());
        }
        if let Some(splats) = &self.splats {
            words.extend(splats.describe());
        }
        words
    }
}

/// Differences of two graphs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SceneDiff {
    /// Objects that differ: those of the first graph in its order, then added ones.
    pub objects: Vec<ObjectChange>,
    /// Objects that do not.
    pub unchanged: usize,
    /// Cameras that differ. They are only reported: cameras of a scene are those of its capture.
    pub cameras: Vec<CameraChange>,
}

impl SceneDiff {
    /// True when no object differs.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }
}

/// Compares two graphs.
#[must_use]
pub fn diff(before: &SceneGraph, after: &SceneGraph) -> SceneDiff {
    let mut result = SceneDiff { cameras: cameras::changes(before, after), ..SceneDiff::default() };
    for pair in pairs(before, after) {
        let change = compare(before, after, &pair);
        if change.is_change() {
            result.objects.push(change);
        } else {
            result.unchanged += 1;
        }
    }
    result
}

/// Compares a pair.
pub(crate) fn compare(before: &SceneGraph, after: &SceneGraph, pair: &Pair) -> ObjectChange {
    let first = pair.before.map(|index| &before.nodes[index]);
    let second = pair.after.map(|index| &after.nodes[index]);
    let named = first.or(second);
    let counted = second.or(first);
    let kind = match (first, second, pair.duplicate) {
        (Some(_), Some(_), true) => ChangeKind::Duplicated,
        (Some(_), Some(_), false) => ChangeKind::Changed,
        (Some(_), None, _) => ChangeKind::Removed,
        _ => ChangeKind::Added,
    };
    let mut change = ObjectChange {
        kind,
        id: named.and_then(|node| match node.kind {
            NodeKind::Instance { id, .. } => Some(id).filter(|id| *id != 0),
            NodeKind::Background => None,
        }),
        name: named.map_or_else(String::new, |node| node.name.clone()),
        label: named.map_or_else(String::new, |node| node.label.clone()),
        splat_count: counted.map_or(0, |node| node.splats.len()),
        renamed: None,
        relabelled: None,
        recategorised: None,
        taxonomies: None,
        moved: None,
        visibility: false,
        splats: None,
    };
    let (Some(first), Some(second)) = (first, second) else { return change };
    change.renamed = FromTo::of(&first.name, &second.name);
    change.relabelled = FromTo::of(&first.label, &second.label);
    change.recategorised = FromTo::of(&first.category, &second.category);
    let taxonomies = |node: &Node| {
        node.taxonomies.iter().map(|(name, label)| format!("{name}={label}")).collect::<Vec<_>>().join(", ")
    };
    change.taxonomies = FromTo::of(&taxonomies(first), &taxonomies(second));
    let codes = key_codes(&[before, after], &[first, second]);
    change.moved = moved(first, second, &codes);
    change.visibility = visibility_differs(first, second, &codes);
    let changes = splats::compare(first, second, same_rows(before, after));
    change.splats = (!changes.is_empty()).then_some(changes);
    change
}

/// Largest move of any unit of a node; `None` within the tolerances, and where the units do not correspond.
fn moved(first: &Node, second: &Node, codes: &[f64]) -> Option<Moved> {
    let pairs = units::matching(first, second)?;
    let mut largest = Moved { translation: 0.0, rotation_degrees: 0.0, constant: true };
    let mut any = false;
    for (a, b) in &pairs {
        let delta = delta(a, b, codes);
        let Some(delta) = delta else { continue };
        any = true;
        largest.translation = largest.translation.max(delta.translation);
        largest.rotation_degrees = largest.rotation_degrees.max(delta.rotation.to_degrees());
        largest.constant &= delta.constant;
    }
    any.then_some(largest)
}

/// True when two nodes are seen at different times.
pub(crate) fn visibility_differs(first: &Node, second: &Node, codes: &[f64]) -> bool {
    let steps = first.visibility.iter().chain(&second.visibility).map(|step| step.time_code);
    codes.iter().copied().chain(steps).any(|code| first.is_visible(code) != second.is_visible(code))
}

#[cfg(test)]
mod tests;
