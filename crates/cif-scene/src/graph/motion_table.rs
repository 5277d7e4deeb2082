//! The motion of all nodes as a table.

use serde::{Deserialize, Serialize};

use super::node::Node;
use super::report::MotionReport;
use super::scene::SceneGraph;

/// One line of the table that a command prints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReportRow {
    /// Node name.
    pub name: String,
    /// Human name.
    pub label: String,
    /// Motion.
    #[serde(flatten)]
    pub motion: MotionReport,
    /// Seconds spent fitting and choosing.
    pub seconds: f64,
}

impl SceneGraph {
    /// The motion table, one row per node.
    #[must_use]
    pub fn motion_table(&self) -> Vec<ReportRow> {
        let row = |node: &Node| ReportRow {
            name: node.name.clone(),
            label: node.label.clone(),
            motion: node.report.clone(),
            seconds: node.report.seconds,
        };
        self.nodes.iter().map(row).collect()
    }
}
