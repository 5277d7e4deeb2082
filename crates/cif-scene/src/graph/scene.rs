//! A scene: its nodes, cameras and timeline.

use cif_dataset::CaptureFrame;
use cif_geometry::UpAxis;

use super::camera::CameraTrack;
use super::node::Node;
use super::options::SceneOptions;
use super::time::TimeCodes;
use super::window::SceneWindow;

/// A scene, ready to be written in any format.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneGraph {
    /// Declared up axis of the world.
    pub up_axis: UpAxis,
    /// Metres per world unit.
    pub meters_per_unit: f64,
    /// Where the coordinates of the graph lie in the world: that of the capture. *World* in a graph means its own
    /// frame; writers place it in the world, and readers take it from there. The identity for ordinary captures; see
    /// [`crate::world`].
    pub frame: CaptureFrame,
    /// When the samples are.
    pub time_codes: TimeCodes,
    /// One node per instance in the order of the field's instance table, then the background where there is one.
    pub nodes: Vec<Node>,
    /// Splats of the nodes window by window, where the scene was trained so (see [`crate::windows`]): at least two windows,
    /// the first of which the nodes hold as well. Empty for all others.
    pub windows: Vec<SceneWindow>,
    /// Recorded cameras.
    pub cameras: Vec<CameraTrack>,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background_color: [f32; 3],
    /// Order in which the splats were blended in training.
    pub sort_metric: cif_field::SortMetric,
    /// True when the splats are drawn antialiased: footprints widened, and their opacity lowered in turn; `None` where
    /// that is not known, which means not.
    pub antialiased: Option<bool>,
    /// Distance of the near plane that the scene was trained with, world units; `None` where that is not known. Files of
    /// exchange do not hold it.
    pub near: Option<f32>,
    /// Labels of instances that no visible Gaussian belongs to, so that they have no node.
    pub omitted: Vec<String>,
    /// Warnings for the user, one sentence each.
    pub warnings: Vec<String>,
    /// Where the graph came from: what an edited file is compared with when it comes home.
    pub origin: Origin,
}

/// Where a graph came from.
///
/// A file that cif wrote keeps both, so that [`Splats::rows`] read from it can be traced to the field and the
/// graph that was exported can be built again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// Fingerprint of the field whose rows [`Splats::rows`] are; `None` for files that others wrote.
    pub field_fingerprint: Option<String>,
    /// Options that the graph was built with; `None` for files that others wrote.
    pub options: Option<SceneOptions>,
}
