//! Graphs of windows of one long capture as one.
//!
//! Each window was trained alone, on its frames and some of its neighbours ([`cif_geometry::TimeWindow`]), so that each has
//! its own splats of every object. What is the same object is known by the ids of the masks; where it is, over the times
//! that two windows share, carries its frame from one to the next, so that every object keeps one node with one path,
//! whose splats change where the next window begins.

mod alone;
mod carry;
mod reframe;
mod span;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

use cif_field::RotationEvidence;
use glam::DVec3;

use crate::from_field::NO_SPLATS;
use crate::graph::{
    Appearance, CameraSample, CameraTrack, Motion, MotionReport, Node, NodeKind, Origin, SceneGraph,
    SceneWindow, TimeCodes, VisibilitySample,
};
use crate::naming::{self, Names};
use crate::{MotionModel, SceneError};
use span::{Span, spans};

pub use alone::window_alone;

/// A place where two windows meet.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Seam {
    /// First time code of the later window.
    pub time_code: f64,
    /// Objects that both have.
    pub objects: Vec<SeamOfObject>,
}

/// How far two windows differ in where an object is, over the times that both see.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SeamOfObject {
    /// Name of its node.
    pub name: String,
    /// RMS distance of its origin, world units, once the frames are carried over.
    pub distance: f64,
    /// RMS turn, degrees.
    pub degrees: f64,
}

/// Joins graphs of windows of one capture, in any order; and where they meet.
///
/// Objects with parts get a path for every splat: parts and joints differ from window to window.
///
/// # Errors
/// Graphs of fewer than two windows, of other worlds or units, of the same times, or with times missing between them.
pub fn joined(mut graphs: Vec<SceneGraph>) -> Result<(SceneGraph, Vec<Seam>), SceneError> {
    graphs.sort_by(|a, b| a.time_codes.start().total_cmp(&b.time_codes.start()));
    let spans = spans(&graphs)?;
    let mut names = Names::default();
    let mut windows: Vec<SceneWindow> =
        spans.iter().map(|span| SceneWindow { start: span.start, nodes: Vec::new() }).collect();
    let mut seams: Vec<Seam> =
        spans[1..].iter().map(|span| Seam { time_code: span.start, objects: Vec::new() }).collect();
    let mut nodes = Vec::new();
    for (_, key) in keys(&graphs) {
        let found: Vec<Option<&Node>> =
            graphs.iter().map(|graph| graph.nodes.iter().find(|node| key_of(node) == key)).collect();
        let carried = carry::carried(&found, &spans);
        let degree = found.iter().flatten().map(|node| node.splats.sh_degree).max().unwrap_or_default();
        let own: Vec<Option<Node>> = found
            .iter()
            .zip(&carried.object_from_local)
            .zip(&spans)
            .map(|((node, transform), span)| {
                Some(reframe::reframed((*node)?, transform.as_ref()?, span, degree))
            })
            .collect();
        let present: Vec<usize> = (0..own.len()).filter(|window| own[*window].is_some()).collect();
        let Some(first) = present.first().and_then(|first| own[*first].as_ref()) else { continue };
        let name = names.take(first.name.clone());
        for (seam, gap) in seams.iter_mut().zip(&carried.gaps) {
            let instance = matches!(first.kind, NodeKind::Instance { .. });
            if let Some((distance, radians)) = gap.filter(|_| instance) {
                let degrees = radians.to_degrees();
                seam.objects.push(SeamOfObject { name: name.clone(), distance, degrees });
            }
        }
        nodes.push(Node {
            name: name.clone(),
            motion: match carried.track.is_empty() {
                true => Motion::Static,
                false => Motion::Rigid(carried.track),
            },
            visibility: visibility(&found, &spans),
            extent: reframe::extent_over(own.iter().flatten()),
            appearance: Appearance::default(),
            source_frames: source_frames(&found),
            report: report(&found),
            ..first.clone()
        });
        for (index, window) in windows.iter_mut().enumerate() {
            let nearest = present.iter().min_by_key(|present| present.abs_diff(index));
            let Some(node) = nearest.and_then(|nearest| own[*nearest].clone()) else { continue };
            window.nodes.push(Node { name: name.clone(), pivot: DVec3::ZERO, ..node });
        }
    }
    let omitted =
        graphs[0].omitted.iter().filter(|label| graphs.iter().all(|graph| graph.omitted.contains(label)));
    let omitted: Vec<String> = omitted.cloned().collect();
    let mut warnings: Vec<String> = Vec::new();
    for warning in graphs.iter().flat_map(|graph| &graph.warnings) {
        // What one window lacks another may have.
        if !warnings.contains(warning) && !warning.starts_with(NO_SPLATS) {
            warnings.push(warning.clone());
        }
    }
    if !omitted.is_empty() {
        warnings.push(format!("{NO_SPLATS}{}", omitted.join(", ")));
    }
    let (cameras, time_codes) = (cameras(&graphs, &spans), time_codes(&graphs, &spans));
    let origin = Origin { field_fingerprint: None, options: graphs[0].origin.options.clone() };
    let first = graphs.swap_remove(0);
    Ok((SceneGraph { nodes, windows, cameras, time_codes, omitted, warnings, origin, ..first }, seams))
}

/// Identity of a node over all windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Key {
    /// An instance, by its mask value.
    Instance(u16),
    /// The part of the scene that belongs to no instance, or the moving part of that.
    Background { moves: bool },
}

fn key_of(node: &Node) -> Key {
    match node.kind {
        NodeKind::Instance { id, .. } => Key::Instance(id),
        NodeKind::Background => Key::Background { moves: node.name == naming::MOVING_BACKGROUND },
    }
}

/// Keys of all nodes, in the order of the table of instances, then the backgrounds.
fn keys(graphs: &[SceneGraph]) -> BTreeSet<(usize, Key)> {
    let place = |node: &Node| match node.kind {
        NodeKind::Instance { index, .. } => index,
        NodeKind::Background => usize::MAX,
    };
    let mut known = BTreeSet::new();
    let nodes = graphs.iter().flat_map(|graph| &graph.nodes);
    nodes.filter(|node| known.insert(key_of(node))).map(|node| (place(node), key_of(node))).collect()
}

/// Changes of visibility while each window lasts; hidden in those without the node.
fn visibility(nodes: &[Option<&Node>], spans: &[Span]) -> Vec<VisibilitySample> {
    let mut changes: Vec<VisibilitySample> = Vec::new();
    let mut change = |time_code: f64, visible: bool| {
        if changes.last().is_none_or(|last| last.visible != visible) {
            changes.push(VisibilitySample { time_code, visible });
        }
    };
    for (node, span) in nodes.iter().zip(spans) {
        change(span.start, node.is_some_and(|node| node.is_visible(span.start)));
        for sample in node.iter().flat_map(|node| &node.visibility) {
            if span.lasts_at(sample.time_code) {
                change(sample.time_code, sample.visible);
            }
        }
    }
    if changes.iter().all(|change| change.visible) { Vec::new() } else { changes }
}

fn source_frames(nodes: &[Option<&Node>]) -> (usize, usize) {
    let frames = nodes.iter().flatten().map(|node| node.source_frames);
    frames.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))).unwrap_or_default()
}

/// The report of the window that misses most, with the richest model, and the weakest evidence, of all.
fn report(nodes: &[Option<&Node>]) -> MotionReport {
    let reports = || nodes.iter().flatten().map(|node| &node.report);
    let worst = reports().max_by(|a, b| a.residual.decisive.total_cmp(&b.residual.decisive));
    let mut report = worst.expect("some window has the node").clone();
    report.model = reports().map(|report| report.model).max().unwrap_or(MotionModel::Static);
    // Parts leave as paths of splats.
    if report.model == MotionModel::Parts {
        report.model = MotionModel::Dense;
    }
    report.parts = 0;
    let evidence = |kind| reports().any(|report| report.rotation == Some(kind));
    report.rotation = match (evidence(RotationEvidence::Assumed), evidence(RotationEvidence::Observed)) {
        (true, _) => Some(RotationEvidence::Assumed),
        (false, true) => Some(RotationEvidence::Observed),
        (false, false) => None,
    };
    report.samples = reports().map(|report| report.samples).sum();
    report.motion_bytes = reports().map(|report| report.motion_bytes).sum();
    report.seconds = reports().map(|report| report.seconds).sum();
    report
}

/// Views of each camera while each window lasts.
fn cameras(graphs: &[SceneGraph], spans: &[Span]) -> Vec<CameraTrack> {
    let mut tracks: BTreeMap<&str, CameraTrack> = BTreeMap::new();
    for (graph, span) in graphs.iter().zip(spans) {
        for camera in &graph.cameras {
            let samples: Vec<CameraSample> =
                camera.samples.iter().filter(|sample| span.lasts_at(sample.time_code)).copied().collect();
            let empty = || CameraTrack { samples: Vec::new(), ..camera.clone() };
            tracks.entry(&camera.name).or_insert_with(empty).samples.extend(samples);
        }
    }
    tracks.into_values().filter(|track| !track.samples.is_empty()).collect()
}

fn time_codes(graphs: &[SceneGraph], spans: &[Span]) -> TimeCodes {
    let of_span = |(graph, span): (&SceneGraph, &Span)| {
        graph.time_codes.samples.iter().copied().filter(|code| span.lasts_at(*code)).collect::<Vec<_>>()
    };
    let samples: Vec<f64> = graphs.iter().zip(spans).flat_map(of_span).collect();
    let (first, last) = (samples[0], samples[samples.len() - 1]);
    let times = samples.iter().map(|code| (code - first) / (last - first)).collect();
    TimeCodes { samples, times, frames_per_second: graphs[0].time_codes.frames_per_second }
}
