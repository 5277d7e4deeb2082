//! Nodes by label.

pub mod label_pattern;
pub mod search;
pub mod trajectory;

use cif_dataset::meant::known_names;
use cif_geometry::Bounds;
use serde::Serialize;

use crate::{LabelPattern, SceneGraph, world};

/// Query for objects by label, at a time code.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelQuery {
    /// Label, class or instance name; see [`LabelPattern`].
    pub pattern: String,
    /// Time code at which transforms, boxes and labels are taken; `None` takes the default time.
    pub time_code: Option<f64>,
}

/// An object that carries the label.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LabelMatch {
    /// Path of the prim.
    pub path: String,
    /// Class, e.g. `mug`.
    pub class: String,
    /// Unique instance name, e.g. `red_mug_001`.
    pub instance: String,
    /// Human name, e.g. `red mug`.
    pub label: String,
    /// `world_from_local`, `[row][column]`, acting on column vectors.
    pub transform: [[f64; 4]; 4],
    /// Smallest corner of the world box; `None` for an object without extent.
    pub low: Option<[f64; 3]>,
    /// Largest corner of the world box.
    pub high: Option<[f64; 3]>,
}

/// Why a query found nothing to say.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum QueryError {
    /// No object carries the label.
    #[error("no object is labelled '{pattern}' in {place}; {}", known_names(.pattern, "known labels", .known))]
    Unknown {
        /// Given pattern.
        pattern: String,
        /// File or scene.
        place: String,
        /// Labels that exist.
        known: Vec<String>,
    },
}

impl LabelQuery {
    /// The pattern, ready to match.
    #[must_use]
    pub fn matcher(&self) -> LabelPattern {
        LabelPattern::new(&self.pattern)
    }

    /// The error for a pattern that matches none of `known`; sorts them and drops doubles.
    #[must_use]
    pub fn unknown(&self, place: &str, mut known: Vec<String>) -> QueryError {
        known.sort();
        known.dedup();
        QueryError::Unknown { pattern: self.pattern.clone(), place: place.to_owned(), known }
    }
}

/// Corners of a box for [`LabelMatch`].
#[must_use]
pub fn corners(bounds: &Bounds) -> (Option<[f64; 3]>, Option<[f64; 3]>) {
    if bounds.is_empty() { (None, None) } else { (Some(bounds.low.to_array()), Some(bounds.high.to_array())) }
}

/// Nodes whose label, class or name matches, in the order of the graph. `place` names the scene in errors.
/// Without a time code the first sample counts.
///
/// # Errors
/// When nothing matches.
pub fn query(graph: &SceneGraph, query: &LabelQuery, place: &str) -> Result<Vec<LabelMatch>, QueryError> {
    let matcher = query.matcher();
    let time_code = query.time_code.unwrap_or_else(|| graph.time_codes.start());
    let mut known = Vec::new();
    let mut found = Vec::new();
    for node in &graph.nodes {
        let names = || [&node.label, &node.category, &node.name].into_iter().chain(node.taxonomies.values());
        if names().any(|name| matcher.matches(name)) {
            let rows = world::world_matrix(&graph.frame, &node.world_transform(time_code));
            let (low, high) = corners(&world::world_bounds(&graph.frame, node.boxes().world(time_code)));
            found.push(LabelMatch {
                path: format!("/World/{}", node.name),
                class: node.category.clone(),
                instance: node.name.clone(),
                label: node.label.clone(),
                transform: rows,
                low,
                high,
            });
        }
        known.extend(names().cloned());
    }
    if found.is_empty() { Err(query.unknown(place, known)) } else { Ok(found) }
}
