//! From a scene graph back to a field.
//!
//! Every node becomes Gaussians at their place at the first sampled time, in world coordinates, and its motion
//! a group of [`Tracks`] relative to there, which names the instance. Rigid tracks keep their keys; parts are sampled at the keys of both
//! levels and at all sampled time codes; dense samples stay samples. Instances keep their ids, nodes without
//! one get the next that is free, and every Gaussian belongs to its node ([`cif_field::Owner`]). Identity rows
//! that the file has come back; without them Gaussians of instances are certain of theirs, and those of the
//! background add to no label. Opacities and colours that change become samples of the groups.

mod cameras;
mod check;
mod identities;
mod node;
mod path;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use cif_field::gaussians::{INITIAL_OCCUPANCY, saturated_logit};
use cif_field::tracks::Tracks;
use cif_field::{Declared, Drawing, Field, FrameCodes, Gaussians, Identities, Record, Timeline};

use crate::SceneError;
use crate::graph::{NodeKind, SceneGraph};
use crate::motion::time_map::TimeMap;
use cameras::{cameras, exposures, extent};
pub(crate) use check::check;
pub(crate) use identities::InstanceTable;
use identities::{embeddings, push_identities};
pub(crate) use node::{NodeRows, logit};

/// Builds a field without learned motion that shows what the graph shows. `source` names the file in the
/// field's record.
///
/// Occupancies that the graph does not have are the opacities; splats outside the instances of a file that cif
/// did not write get the occupancy of Gaussians that no mask spoke for.
///
/// # Errors
/// When arrays of the graph do not fit together or hold values that are not finite, and the object is named; or when it
/// has several windows of time (see [`crate::window_alone`]).
pub fn field_from_graph(graph: &SceneGraph, source: &str) -> Result<Field, SceneError> {
    if !graph.windows.is_empty() {
        let what =
            format!("it has {} windows of time, each with its own splats; take one", graph.windows.len());
        return Err(SceneError::Import { object: source.to_owned(), what });
    }
    let times = TimeMap::of_file(&graph.time_codes)?;
    let reference = graph.time_codes.start();
    let has_instances = graph.nodes.iter().any(|node| matches!(node.kind, NodeKind::Instance { .. }));
    let is_foreign = graph.origin.field_fingerprint.is_none();
    let mut instances = InstanceTable::default();
    let mut gaussians = Gaussians::default();
    let mut tracks = Tracks::default();
    let mut identities = Identities::empty();
    let owners = graph
        .nodes
        .iter()
        .map(|node| match node.kind {
            NodeKind::Instance { id, .. } => instances.add(node, id).map(Some),
            NodeKind::Background => Ok(None),
        })
        .collect::<Result<Vec<Option<u16>>, SceneError>>()?;
    // Identity rows name ids as the file has them; the first of several nodes with one id keeps it.
    let mut index_of: BTreeMap<u16, u16> = BTreeMap::new();
    for (node, owner) in graph.nodes.iter().zip(&owners) {
        if let (NodeKind::Instance { id, .. }, Some(index)) = (node.kind, owner) {
            index_of.entry(id).or_insert(*index);
        }
    }
    for (node, &owner) in graph.nodes.iter().zip(&owners) {
        let mut rows = NodeRows::of(node, &times, &graph.time_codes.samples, reference)?;
        if owner.is_none() && is_foreign && has_instances {
            rows.gaussians.occupancy_logits.fill(saturated_logit(INITIAL_OCCUPANCY));
        }
        push_identities(&mut identities, node, owner, &index_of);
        let instance = owner.map(|index| instances.entries[usize::from(index)].id);
        rows.append_to(&mut gaussians, &mut tracks, instance);
    }
    let cameras = cameras(&graph.cameras, &times);
    let degrees = graph.nodes.iter().map(|node| node.splats.sh_degree);
    let imported = serde_json::json!({
        "file": source,
        "first_time_code": reference,
        "exported_from": graph.origin.field_fingerprint,
        "cif": env!("CARGO_PKG_VERSION"),
    });
    let imported = serde_json::Map::from_iter([("imported".to_owned(), imported)]);
    let field = Field {
        extent: extent(&cameras, &gaussians),
        gaussians,
        deformation: None,
        tracks: tracks.compact(),
        identities: has_instances.then_some(identities),
        instances: instances.entries.clone(),
        timeline: Timeline {
            times: times.times().to_vec(),
            frames_per_second: graph.time_codes.frames_per_second,
        },
        cameras,
        sh_degree: degrees.max().unwrap_or(0),
        background: graph.background_color.map(|channel| channel.clamp(0.0, 1.0)),
        sort_metric: graph.sort_metric,
        record: Record {
            drawing: Drawing {
                antialiased: graph.antialiased,
                exposures_in_time: exposures(&graph.cameras, &times),
                ..Drawing::default()
            },
            frame: graph.frame,
            declared: Some(Declared { up_axis: graph.up_axis, meters_per_unit: graph.meters_per_unit }),
            frame_codes: FrameCodes::of(times.codes()),
            embeddings: embeddings(graph, &owners, &instances.entries),
            notes: imported,
            ..Record::default()
        },
    };
    field
        .validate()
        .map_err(|error| SceneError::Import { object: source.to_owned(), what: error.to_string() })?;
    Ok(field)
}

/// Normalised time that a time code of a graph has in the field of [`field_from_graph`].
///
/// # Errors
/// When the time codes of the graph do not ascend.
pub fn time_in_field(graph: &SceneGraph, time_code: f64) -> Result<f64, SceneError> {
    Ok(TimeMap::of_file(&graph.time_codes)?.time(time_code))
}
