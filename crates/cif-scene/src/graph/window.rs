//! Windows of time.

use super::node::Node;

/// Splats of a scene during one window of time, where a long capture was trained window by window.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneWindow {
    /// Its first time code; it lasts until the next window begins.
    pub start: f64,
    /// The nodes of the graph in the same order, each with its splats of this window, as if the frame of the node were the
    /// world: the graph has its path. One that is not seen now is as in the nearest window that shows it.
    pub nodes: Vec<Node>,
}
