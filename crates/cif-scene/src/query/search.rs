//! Objects by label, time and place.

use cif_field::Embedding;
use cif_geometry::Bounds;
use glam::DVec3;
use serde::Serialize;

pub use crate::shape::convex_hull::hull_volume;
use crate::{LabelMatch, LabelQuery, Node, QueryError, SceneGraph, query, world};

/// When something is looked for, in time codes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum When {
    /// At the default time: the first sample of a graph, default values of a file.
    #[default]
    Default,
    /// At a time code.
    At(f64),
    /// At any time from the first to the last.
    Over(f64, f64),
}

/// Which labels count: a taxonomy of semantic labels.
pub const TAXONOMY_CLASS: &str = "class";
/// The taxonomy of unique names.
pub const TAXONOMY_INSTANCE: &str = "instance";

/// Conditions of a search; an object has to meet every one given.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ObjectQuery {
    /// Label, class or unique name; see [`crate::LabelPattern`].
    pub label: Option<String>,
    /// Only labels of this taxonomy count; [`TAXONOMY_CLASS`] holds classes and human labels,
    /// [`TAXONOMY_INSTANCE`] unique names, others the names in vocabularies of others.
    pub taxonomy: Option<String>,
    /// When.
    pub when: When,
    /// Place that the object's box holds, world.
    pub point: Option<DVec3>,
    /// Box that the object's box touches, world.
    pub region: Option<Bounds>,
}

/// Geometry that a volume is measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum VolumeOf {
    /// The convex hulls of the collider.
    Hull,
    /// The world box.
    Box,
}

/// An object that meets the conditions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObjectMatch {
    /// Names, transform and box. Over an interval the transform is that of its start, and the box holds the object at
    /// every sample of the interval.
    #[serde(flatten)]
    pub found: LabelMatch,
    /// Volume in cubic world units; `None` for an object without extent.
    pub volume: Option<f64>,
    /// Geometry that the volume was measured on.
    pub volume_of: Option<VolumeOf>,
    /// World units per second that the origin of the object's frame moves: around a time code, or on average over an
    /// interval.
    pub speed: f64,
    /// Every name that it is found by: labels of all taxonomies, and what people call it.
    #[serde(skip)]
    pub names: Vec<String>,
    /// Its appearance.
    #[serde(skip)]
    pub embedding: Option<Embedding>,
}

impl ObjectQuery {
    /// The part about labels.
    #[must_use]
    pub fn label_query(&self) -> Option<LabelQuery> {
        let time_code = match self.when {
            When::Default => None,
            When::At(code) | When::Over(code, _) => Some(code),
        };
        self.label.as_ref().map(|pattern| LabelQuery { pattern: pattern.clone(), time_code })
    }

    /// True when labels of a taxonomy count.
    #[must_use]
    pub fn counts(&self, taxonomy: &str) -> bool {
        self.taxonomy.as_deref().is_none_or(|requested| requested == taxonomy)
    }

    /// True when a world box is where the query looks.
    #[must_use]
    pub fn is_at(&self, bounds: &Bounds) -> bool {
        let contains = |low: DVec3, high: DVec3| {
            !bounds.is_empty() && low.cmple(bounds.high).all() && high.cmpge(bounds.low).all()
        };
        self.point.is_none_or(|point| contains(point, point))
            && self.region.as_ref().is_none_or(|region| contains(region.low, region.high))
    }
}

/// Most time codes that are sampled in an interval.
const MAX_CODES: f64 = 10_000.0;

/// Time codes at which speed and box are sampled: around a time code half a code to either side, over an interval its
/// ends and the whole codes between them.
#[must_use]
pub fn sampled_codes(when: When, start: f64, end: f64) -> Vec<f64> {
    match when {
        When::Default => sampled_codes(When::At(start), start, end),
        When::At(code) => {
            let code = code.clamp(start, end.max(start));
            vec![(code - 0.5).max(start), (code + 0.5).min(end.max(start))]
        }
        When::Over(first, last) => {
            let mut codes = vec![first];
            // An interval far outside the samples is not walked code by code.
            let (from, to) = (first.max(start).floor(), last.min(end).ceil());
            // Nor is one of a timeline without measure.
            let step = ((to - from) / MAX_CODES).ceil().max(1.0);
            let walked = (1..).map(|k| from + step * f64::from(k)).take_while(|code| *code < to);
            codes.extend(walked.filter(|code| *code > first && *code < last));
            codes.push(last);
            codes
        }
    }
}

/// World units per second along a path of one position per code.
#[must_use]
pub fn speed(codes: &[f64], path: &[DVec3], codes_per_second: f64) -> f64 {
    let length: f64 = path.windows(2).map(|ends| ends[0].distance(ends[1])).sum();
    match (codes.first(), codes.last()) {
        (Some(first), Some(last)) if last > first => length * codes_per_second / (last - first),
        _ => 0.0,
    }
}

/// Volume of an object: of its hulls where it has any, else of its box.
#[must_use]
pub fn volume(hulls: f64, bounds: &Bounds) -> (Option<f64>, Option<VolumeOf>) {
    if hulls > 0.0 {
        (Some(hulls), Some(VolumeOf::Hull))
    } else if bounds.is_empty() {
        (None, None)
    } else {
        ((bounds.high - bounds.low).to_array().iter().product::<f64>().into(), Some(VolumeOf::Box))
    }
}

/// Nodes that meet every condition, in the order of the graph; `place` names the scene in errors. Nodes that are
/// hidden at the time, or over the whole interval, do not count. `path` makes the path of a node from its name.
///
/// # Errors
/// When no node carries the label at all.
pub fn search(
    graph: &SceneGraph,
    query: &ObjectQuery,
    place: &str,
    path: impl Fn(&str) -> String,
) -> Result<Vec<ObjectMatch>, QueryError> {
    let nodes = labelled(graph, query, place)?;
    let codes = &graph.time_codes;
    let sampled = sampled_codes(query.when, codes.start(), codes.end());
    let at = match query.when {
        When::Default => codes.start(),
        When::At(code) | When::Over(code, _) => code,
    };
    Ok(nodes.into_iter().filter_map(|node| describe(graph, node, query, at, &sampled, &path)).collect())
}

/// Nodes that carry the label of a query, in the order of the graph; `place` names the scene in errors.
///
/// # Errors
/// When no node carries the label.
pub(super) fn labelled<'a>(
    graph: &'a SceneGraph,
    query: &ObjectQuery,
    place: &str,
) -> Result<Vec<&'a Node>, QueryError> {
    let label_query = query.label_query();
    let matcher = label_query.as_ref().map(LabelQuery::matcher);
    let (mut known, mut found) = (Vec::new(), Vec::new());
    for node in &graph.nodes {
        let names: Vec<&String> =
            all_names(node).filter_map(|(taxonomy, name)| query.counts(taxonomy).then_some(name)).collect();
        if names.iter().any(|name| matcher.as_ref().is_none_or(|pattern| pattern.matches(name))) {
            found.push(node);
        }
        known.extend(names.into_iter().cloned());
    }
    match label_query {
        Some(label_query) if found.is_empty() => Err(label_query.unknown(place, known)),
        _ => Ok(found),
    }
}

/// Names of a node with their taxonomies.
fn all_names(node: &Node) -> impl Iterator<Item = (&str, &String)> {
    let own =
        [(TAXONOMY_CLASS, &node.label), (TAXONOMY_CLASS, &node.category), (TAXONOMY_INSTANCE, &node.name)];
    own.into_iter().chain(node.taxonomies.iter().map(|(taxonomy, name)| (taxonomy.as_str(), name)))
}

fn describe(
    graph: &SceneGraph,
    node: &Node,
    query: &ObjectQuery,
    at: f64,
    sampled: &[f64],
    path: impl Fn(&str) -> String,
) -> Option<ObjectMatch> {
    let over = matches!(query.when, When::Over(..));
    let visible: Vec<f64> = if over { sampled.to_vec() } else { vec![at] }
        .into_iter()
        .filter(|code| node.is_visible(*code))
        .collect();
    let boxes = node.boxes();
    let bounds = visible.iter().fold(Bounds::EMPTY, |all, code| all.union(boxes.world(*code)));
    let bounds = world::world_bounds(&graph.frame, bounds);
    if visible.is_empty() || !query.is_at(&bounds) {
        return None;
    }
    let world_per_unit = 1.0 / graph.frame.scale;
    let positions: Vec<DVec3> = sampled.iter().map(|code| node.world_transform(*code).translation).collect();
    let (volume, volume_of) = volume(hull_volume(&node.colliders) * world_per_unit.powi(3), &bounds);
    let (low, high) = query::corners(&bounds);
    Some(ObjectMatch {
        found: LabelMatch {
            path: path(&node.name),
            class: node.category.clone(),
            instance: node.name.clone(),
            label: node.label.clone(),
            transform: world::world_matrix(&graph.frame, &node.world_transform(at)),
            low,
            high,
        },
        volume,
        volume_of,
        speed: speed(sampled, &positions, graph.time_codes.frames_per_second) * world_per_unit,
        names: all_names(node).map(|(_, name)| name.clone()).collect(),
        embedding: node.embedding.clone(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ConvexHull;

    #[test]
    fn codes_lie_around_a_time_and_fill_an_interval() {
        assert_eq!(sampled_codes(When::At(3.0), 0.0, 10.0), [2.5, 3.5]);
        assert_eq!(sampled_codes(When::Default, 2.0, 10.0), [2.0, 2.5]);
        assert_eq!(sampled_codes(When::At(12.0), 0.0, 10.0), [9.5, 10.0]);
        assert_eq!(sampled_codes(When::Over(1.5, 4.0), 0.0, 10.0), [1.5, 2.0, 3.0, 4.0]);
        assert_eq!(sampled_codes(When::Over(-1e300, 1e300), 0.0, 2.0), [-1e300, 1.0, 1e300]);
        // One more than these numbers is these numbers again.
        assert!(sampled_codes(When::Over(0.0, 1e30), 1e17, 1e18).len() < 10_003);
        assert!(sampled_codes(When::Over(-1e30, 1e30), -1e30, 1e30).len() < 10_003);
    }

    #[test]
    fn speeds_are_path_over_time() {
        let path = [DVec3::ZERO, DVec3::X, DVec3::ZERO];
        assert_eq!(speed(&[0.0, 1.0, 2.0], &path, 24.0), 24.0);
        assert_eq!(speed(&[1.0, 1.0], &path[..2], 24.0), 0.0, "one sample has no speed");
    }

    #[test]
    fn hulls_have_the_volume_of_their_inside() {
        let tetrahedron = ConvexHull {
            points: vec![[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [1.0, 3.0, 1.0], [1.0, 1.0, 4.0]],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            part: None,
        };
        assert!((hull_volume(&[tetrahedron.clone(), tetrahedron]) - 2.0).abs() < 1e-12);
        let bounds = Bounds { low: DVec3::ZERO, high: DVec3::new(1.0, 2.0, 3.0) };
        assert_eq!(volume(0.0, &bounds), (Some(6.0), Some(VolumeOf::Box)));
        assert_eq!(volume(0.5, &bounds), (Some(0.5), Some(VolumeOf::Hull)));
        assert_eq!(volume(0.0, &Bounds::EMPTY), (None, None));
    }
}
