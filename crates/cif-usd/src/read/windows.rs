//! Stages whose splats change from window to window of time, as value clips of `/World`.

use cif_scene::{Appearance, DenseMotion, Motion, Node, SceneGraph, SceneWindow};
use glam::DVec3;
use pyo3::prelude::*;

use crate::pxr::Pxr;
use crate::{UsdError, tokens};

/// The clips of a stage.
struct Clips<'py> {
    api: Bound<'py, PyAny>,
    /// First time code of each, and its file.
    clips: Vec<(f64, Bound<'py, PyAny>)>,
    manifest: Bound<'py, PyAny>,
}

impl<'py> Clips<'py> {
    fn of(pxr: &Pxr<'py>, stage: &Bound<'py, PyAny>) -> PyResult<Self> {
        let world = stage.call_method1("GetPrimAtPath", (tokens::WORLD,))?;
        let api = pxr.usd.getattr("ClipsAPI")?.call1((world,))?;
        let resolved =
            |asset: Bound<'py, PyAny>| pxr.sdf.call_method1("AssetPath", (asset.getattr("resolvedPath")?,));
        let files: Vec<Bound<'py, PyAny>> =
            api.call_method0("GetClipAssetPaths")?.try_iter()?.collect::<PyResult<_>>()?;
        let mut clips = Vec::new();
        for pair in api.call_method0("GetClipActive")?.try_iter()? {
            let pair = pair?;
            let (start, index): (f64, f64) = (pair.get_item(0)?.extract()?, pair.get_item(1)?.extract()?);
            if let Some(file) = files.get(index as usize) {
                clips.push((start, resolved(file.clone())?));
            }
        }
        let manifest = resolved(api.call_method0("GetClipManifestAssetPath")?)?;
        // What is changed here is in no file. Clips are played at the rate of the layer that names them.
        let session = stage.call_method0("GetSessionLayer")?;
        session.setattr("timeCodesPerSecond", stage.call_method0("GetTimeCodesPerSecond")?)?;
        stage.call_method1("SetEditTarget", (session,))?;
        Ok(Self { api, clips, manifest })
    }

    /// Shows one of them at all times.
    fn show(&self, pxr: &Pxr<'py>, (start, file): &(f64, Bound<'py, PyAny>)) -> PyResult<()> {
        // In this order clips are valid after every call.
        let begin = pxr.gf.call_method1("Vec2d", (*start, 0.0))?;
        self.api.call_method1("SetClipActive", (pxr.vt.call_method1("Vec2dArray", (vec![begin],))?,))?;
        self.api
            .call_method1("SetClipAssetPaths", (pxr.sdf.call_method1("AssetPathArray", (vec![file],))?,))?;
        self.api.call_method1("SetClipManifestAssetPath", (&self.manifest,))?;
        Ok(())
    }
}

/// Reads a stage of windows of time, each by `read` as if it lasted all the time.
pub(super) fn read<'py>(
    pxr: &Pxr<'py>,
    stage: &Bound<'py, PyAny>,
    failed: impl Fn(PyErr) -> UsdError,
    read: impl Fn() -> Result<SceneGraph, UsdError>,
) -> Result<SceneGraph, UsdError> {
    let clips = Clips::of(pxr, stage).map_err(&failed)?;
    let (mut whole, mut windows) = (None, Vec::with_capacity(clips.clips.len()));
    for clip in &clips.clips {
        clips.show(pxr, clip).map_err(&failed)?;
        let graph = read()?;
        windows.push(SceneWindow { start: clip.0, nodes: graph.nodes.iter().map(of_window).collect() });
        whole.get_or_insert(graph);
    }
    let Some(mut graph) = whole else { return read() };
    for node in &mut graph.nodes {
        node.motion = match node.track() {
            [] => Motion::Static,
            track => Motion::Rigid(track.to_vec()),
        };
        node.appearance = Appearance::default();
    }
    graph.windows = windows;
    Ok(graph)
}

/// The splats of a node during one window, in its frame. Clips hold samples alone, so that one of a kind is a value.
fn of_window(node: &Node) -> Node {
    let mut node = node.clone();
    node.motion = match node.motion {
        Motion::Dense(DenseMotion { mut samples, .. }) if samples.len() > 1 => {
            let resting = &node.splats.scales;
            if samples.iter().all(|sample| sample.scales.as_ref().is_none_or(|scales| scales == resting)) {
                samples.iter_mut().for_each(|sample| sample.scales = None);
            }
            Motion::Dense(DenseMotion { track: Vec::new(), samples })
        }
        _ => Motion::Static,
    };
    let Appearance { opacities, colors } = &mut node.appearance;
    for samples in [opacities, colors] {
        if samples.len() == 1 {
            samples.clear();
        }
    }
    Node { pivot: DVec3::ZERO, ..node }
}
