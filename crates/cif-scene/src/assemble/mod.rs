//! Scene graphs from what readers find in files: the one place that makes nodes, unique names, ids, extents, baked
//! maps, mean occupancies and motion models, whatever the format.
//!
//! A reader yields [`Prims`]: named objects with sampled transforms, splats and what the file says about them, in the
//! frame of the scene. Only the `conventions.rs` of a format swaps axes, before anything comes here.

mod bake;
mod colors;
mod identify;
mod node;
mod origin;
mod prims;
#[cfg(test)]
mod tests;
mod track;

pub use bake::{Bake, Decomposed, is_identity, uniform};
pub use colors::{ColorEncoding, color_range};
pub use origin::origin_of;
pub use prims::{
    AssembleError, Copies, FRAMES_PER_SECOND, Identity, Piece, Prim, PrimName, Prims, Shape, Timeline,
};
pub use track::{Placement, Track, one_hemisphere};

use crate::graph::{Motion, Node, NodeKind, PoseSample, SceneGraph, TimeCodes};
use crate::naming;

/// The graph that prims make.
///
/// # Errors
/// More instances than ids.
pub fn assemble(mut found: Prims) -> Result<SceneGraph, AssembleError> {
    let mut warnings = found.warnings;
    let is_foreign = found.origin.field_fingerprint.is_none();
    if is_foreign && found.frame.is_identity() {
        let (unit, cameras) = (found.meters_per_unit, &mut found.cameras);
        found.frame = origin::take_off(&mut found.prims, cameras, unit, &mut warnings);
    }
    let kinds = identify::kinds(&found.prims, &found.reserved, found.copies, &mut warnings)?;
    let mut names = naming::Names::default();
    let mut frames = Vec::with_capacity(found.prims.len());
    let mut nodes: Vec<Node> = Vec::with_capacity(found.prims.len());
    for (prim, (kind, renumbered)) in found.prims.into_iter().zip(kinds) {
        let name = match (&prim.name, kind) {
            (PrimName::Given(name), _) => name.clone(),
            (PrimName::Exported(name), _) if !renumbered => name.clone(),
            (_, NodeKind::Instance { id, .. }) => naming::instance_name(&prim.label, id),
            (_, NodeKind::Background) => naming::BACKGROUND.to_owned(),
        };
        frames.push(prim.source_frames);
        nodes.push(node::node(prim, kind, names.take(name)));
    }
    let time_codes = time_codes(found.timeline, &nodes);
    for (node, frames) in nodes.iter_mut().zip(frames) {
        node.source_frames = frames.unwrap_or((0, time_codes.samples.len() - 1));
    }
    let mut names = naming::Names::default();
    let mut cameras = found.cameras;
    for camera in &mut cameras {
        camera.name = names.take(std::mem::take(&mut camera.name));
        if camera.label.is_empty() {
            camera.label.clone_from(&camera.name);
        }
    }
    Ok(SceneGraph {
        up_axis: found.up_axis,
        meters_per_unit: found.meters_per_unit,
        frame: found.frame,
        time_codes,
        nodes,
        windows: Vec::new(),
        cameras,
        background_color: found.background_color,
        sort_metric: found.sort_metric,
        antialiased: found.antialiased,
        near: None,
        omitted: found.omitted,
        warnings,
        origin: found.origin,
    })
}

/// The timeline of a graph with these nodes; at least one sample.
fn time_codes(timeline: Timeline, nodes: &[Node]) -> TimeCodes {
    let (mut samples, start, frames_per_second) = match timeline {
        Timeline::Recorded(time_codes) => return time_codes,
        Timeline::Sampled { codes, start, frames_per_second } => (codes, start, frames_per_second),
    };
    let of_track = |track: &[PoseSample]| track.iter().map(|pose| pose.time_code).collect::<Vec<_>>();
    for node in nodes {
        samples.extend(of_track(node.track()));
        samples.extend(node.visibility.iter().map(|sample| sample.time_code));
        match &node.motion {
            Motion::Dense(dense) => samples.extend(dense.samples.iter().map(|sample| sample.time_code)),
            Motion::Parts(motion) => {
                samples.extend(motion.parts.iter().flat_map(|part| of_track(&part.track)))
            }
            Motion::Static | Motion::Rigid(_) => {}
        }
    }
    if samples.is_empty() {
        samples.push(start);
    }
    samples.sort_by(f64::total_cmp);
    samples.dedup();
    let (first, last) = (samples[0], samples[samples.len() - 1]);
    let length = if last > first { last - first } else { 1.0 };
    let times = samples.iter().map(|code| (code - first) / length).collect();
    TimeCodes { samples, times, frames_per_second }
}
