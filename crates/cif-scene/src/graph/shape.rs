//! Meshes and points that stand for the splats of a node.

/// A closed convex mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConvexHull {
    /// Corners, at most 64; in the node's local frame, or in the part's where there is one.
    pub points: Vec<[f32; 3]>,
    /// Triangles, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Part that the hull moves with.
    pub part: Option<usize>,
}

/// A light point cloud standing in for the splats.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointProxy {
    /// Splats that the points sit on, ascending.
    pub indices: Vec<u32>,
    /// Diameters, world units.
    pub widths: Vec<f32>,
    /// Colours, display-referred.
    pub colors: Vec<[f32; 3]>,
}
