//! One window of a scene of several.

use crate::graph::{
    CameraTrack, DenseMotion, Motion, Node, PoseSample, SceneGraph, TimeCodes, VisibilitySample, pose_at,
};

/// The scene of one window alone, by its index; the graph as it is where it has no windows. `None` where there is no such
/// window.
#[must_use]
pub fn window_alone(graph: &SceneGraph, index: usize) -> Option<SceneGraph> {
    if graph.windows.is_empty() {
        return (index == 0).then(|| graph.clone());
    }
    let window = graph.windows.get(index)?;
    let next = graph.windows.get(index + 1).map_or(f64::INFINITY, |next| next.start);
    let lasts_at = |code: f64| (window.start..next).contains(&code);
    let of_all = &graph.time_codes;
    let samples: Vec<f64> = of_all.samples.iter().copied().filter(|code| lasts_at(*code)).collect();
    let (first, last) = (*samples.first()?, *samples.last()?);
    let times = samples.iter().map(|code| (code - first) / (last - first).max(f64::MIN_POSITIVE)).collect();
    let node = |(whole, own): (&Node, &Node)| {
        let track = during(whole.track(), whole, (first, last));
        let motion = match &own.motion {
            Motion::Dense(dense) => Motion::Dense(DenseMotion { track, samples: dense.samples.clone() }),
            _ if track.is_empty() => Motion::Static,
            _ => Motion::Rigid(track),
        };
        Node {
            motion,
            pivot: whole.pivot,
            visibility: visibility(whole, (first, last)),
            source_frames: (first.max(0.0) as usize, last.max(0.0) as usize),
            ..own.clone()
        }
    };
    let camera = |track: &CameraTrack| CameraTrack {
        samples: track.samples.iter().filter(|sample| lasts_at(sample.time_code)).copied().collect(),
        ..track.clone()
    };
    Some(SceneGraph {
        nodes: graph.nodes.iter().zip(&window.nodes).map(node).collect(),
        windows: Vec::new(),
        cameras: graph.cameras.iter().map(camera).filter(|track| !track.samples.is_empty()).collect(),
        time_codes: TimeCodes { samples, times, ..of_all.clone() },
        ..graph.clone()
    })
}

/// Poses between two time codes, and at these.
fn during(track: &[PoseSample], node: &Node, (first, last): (f64, f64)) -> Vec<PoseSample> {
    if track.is_empty() {
        return Vec::new();
    }
    let inside = track.iter().copied().filter(|sample| first < sample.time_code && sample.time_code < last);
    let at = |code: f64| pose_at(track, node.pivot, code);
    let mut poses = vec![at(first)];
    poses.extend(inside);
    if last > first {
        poses.push(at(last));
    }
    poses
}

fn visibility(node: &Node, (first, last): (f64, f64)) -> Vec<VisibilitySample> {
    let mut changes = vec![VisibilitySample { time_code: first, visible: node.is_visible(first) }];
    changes.extend(
        node.visibility.iter().copied().filter(|change| first < change.time_code && change.time_code <= last),
    );
    if changes.iter().all(|change| change.visible) { Vec::new() } else { changes }
}
