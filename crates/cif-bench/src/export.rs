//! Ladder of tolerances: what accuracy of exported motion costs in samples, bytes and time.

use std::path::Path;
use std::time::Instant;

use cif_field::Field;
use cif_scene::graph::ReportRow;
use cif_scene::{ExportOptions, MotionModel, SceneFormat, SceneGraph, SceneOptions, Tolerance};
use serde::Serialize;

/// One tolerance.
#[derive(Debug, Serialize)]
pub struct Rung {
    /// Tolerance of motion.
    pub tolerance: Tolerance,
    /// Seconds for the scene graph.
    pub graph_seconds: f64,
    /// Samples of all tracks.
    pub samples: usize,
    /// Bytes of their values.
    pub motion_bytes: usize,
    /// Nodes by motion model, cheapest first.
    pub models: Vec<ModelCount>,
    /// Motion of every node.
    pub nodes: Vec<ReportRow>,
    /// Files, by format.
    pub files: Vec<WrittenFile>,
}

/// Nodes of one model.
#[derive(Debug, Serialize)]
pub struct ModelCount {
    /// The model.
    pub model: MotionModel,
    /// Nodes that have it.
    pub nodes: usize,
}

/// Size, time and deviations of a rung's file in one format.
#[derive(Debug, Serialize)]
pub struct WrittenFile {
    /// Name of the format.
    pub format: &'static str,
    /// Size of the file.
    pub bytes: u64,
    /// Seconds for writing.
    pub seconds: f64,
    /// Samples in the file.
    pub samples: usize,
    /// Largest decisive residual of a node, as a share of what the tolerance allows it.
    pub worst_share: f64,
    /// Nodes that miss more than the tolerance allows.
    pub nodes_outside: usize,
    /// The scene as this format holds it, where that is another one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simplified: Option<Simplified>,
}

/// A scene without the motion that a format does not know.
#[derive(Debug, Serialize)]
pub struct Simplified {
    /// Seconds for the scene graph.
    pub graph_seconds: f64,
    /// Motion of every node.
    pub nodes: Vec<ReportRow>,
}

/// Writes a rung; a graph with motion that the format does not know is built again without it.
///
/// # Errors
/// When the graph cannot be built again or the file not be written.
pub fn measure(
    format: &dyn SceneFormat,
    field: &Field,
    graph: &SceneGraph,
    options: &SceneOptions,
    path: &Path,
) -> Result<WrittenFile, String> {
    let start = Instant::now();
    let rebuilt = format.rebuilt(field, graph, options).map_err(|error| error.to_string())?;
    let graph_seconds = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let held = rebuilt.as_ref().unwrap_or(graph);
    let written = format.write(held, path, &ExportOptions::default()).map_err(|error| error.to_string())?;
    let seconds = start.elapsed().as_secs_f64();
    let nodes = held.motion_table();
    let share = |row: &ReportRow| row.motion.residual.decisive / row.motion.tolerance;
    let shares: Vec<f64> = nodes.iter().map(share).filter(|share| share.is_finite()).collect();
    Ok(WrittenFile {
        format: format.about().name,
        bytes: written.bytes,
        seconds,
        samples: nodes.iter().map(|row| row.motion.samples).sum(),
        worst_share: shares.iter().copied().fold(0.0, f64::max),
        nodes_outside: shares.iter().filter(|share| **share > 1.0).count(),
        simplified: rebuilt.is_some().then_some(Simplified { graph_seconds, nodes }),
    })
}

impl Rung {
    /// Of a scene graph, without files.
    #[must_use]
    pub fn of(tolerance: Tolerance, graph_seconds: f64, graph: &SceneGraph) -> Self {
        let nodes = graph.motion_table();
        let count = |model| nodes.iter().filter(|row| row.motion.model == model).count();
        let models = [MotionModel::Static, MotionModel::Rigid, MotionModel::Parts, MotionModel::Dense];
        Self {
            tolerance,
            graph_seconds,
            samples: nodes.iter().map(|row| row.motion.samples).sum(),
            motion_bytes: nodes.iter().map(|row| row.motion.motion_bytes).sum(),
            models: models.map(|model| ModelCount { model, nodes: count(model) }).into(),
            nodes,
            files: Vec::new(),
        }
    }
}
