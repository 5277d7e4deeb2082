//! Paths of nodes over all captured times.

use glam::DQuat;
use serde::Serialize;

use super::search::{ObjectQuery, labelled};
use crate::graph::pose_at;
use crate::{Node, QueryError, SceneGraph, world};

/// Path of an object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trajectory {
    /// Class, e.g. `mug`.
    pub class: String,
    /// Unique instance name, e.g. `red_mug_001`.
    pub instance: String,
    /// Human name, e.g. `red mug`.
    pub label: String,
    /// A pose per sampled time code of the graph, ascending.
    pub samples: Vec<TrajectorySample>,
}

/// Pose of an object at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrajectorySample {
    /// Time code: the captured frame number.
    pub time_code: f64,
    /// Normalised time, 0 at the first captured frame and 1 at the last.
    pub time: f64,
    /// Time code over time codes per second.
    pub seconds: f64,
    /// Origin of the object's frame in the world of the capture: at the first time the middle of the object.
    pub translation: [f64; 3],
    /// Unit quaternion (w, x, y, z) that turns the axes of the object's frame into the world, and is the identity while
    /// it is turned as at the first time; successive ones lie in one hemisphere.
    pub rotation: [f64; 4],
    /// False while the object is hidden.
    pub visible: bool,
}

/// Paths of the nodes that carry the label of a query, in the order of the graph; other conditions do not count. An
/// object of several parts has the path of its largest one, a bending object that of its best rigid fit. `place` names
/// the scene in errors.
///
/// # Errors
/// When no node carries the label.
pub fn trajectories(
    graph: &SceneGraph,
    query: &ObjectQuery,
    place: &str,
) -> Result<Vec<Trajectory>, QueryError> {
    let nodes = labelled(graph, query, place)?;
    Ok(nodes.into_iter().map(|node| of_node(graph, node)).collect())
}

fn of_node(graph: &SceneGraph, node: &Node) -> Trajectory {
    let codes = &graph.time_codes;
    let world_from_graph = world::world_from_graph(&graph.frame);
    let mut before = DQuat::IDENTITY;
    let samples = codes.samples.iter().zip(&codes.times).map(|(&time_code, &time)| {
        let pose = pose_at(node.track(), node.pivot, time_code);
        let turn = if before.dot(pose.rotation) < 0.0 { -pose.rotation } else { pose.rotation };
        before = turn;
        TrajectorySample {
            time_code,
            time,
            seconds: time_code / codes.frames_per_second,
            translation: world_from_graph.transform_point3(pose.translation).to_array(),
            rotation: [turn.w, turn.x, turn.y, turn.z],
            visible: node.is_visible(time_code),
        }
    });
    Trajectory {
        class: node.category.clone(),
        instance: node.name.clone(),
        label: node.label.clone(),
        samples: samples.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::{Motion, PoseSample, TimeCodes, VisibilitySample};
    use crate::{SceneOptions, testing};
    use cif_dataset::CaptureFrame;
    use glam::DVec3;

    #[test]
    fn a_path_has_a_pose_per_frame_in_the_world() {
        let field = testing::recorded_field(1, 3);
        let mut graph = crate::build(&field, &SceneOptions::default()).unwrap();
        graph.frame = CaptureFrame { offset: [100.0, 0.0, -5.0], scale: 0.5 };
        graph.time_codes =
            TimeCodes { samples: vec![0.0, 1.0, 4.0], times: vec![0.0, 0.5, 1.0], frames_per_second: 8.0 };
        // Three quarter turns, of which the last two are written as their opposites.
        let pose = |time_code: f64, x: f64, quarters: f64, sign: f64| {
            let turn = DQuat::from_rotation_z(quarters * std::f64::consts::FRAC_PI_2);
            PoseSample {
                time_code,
                translation: DVec3::new(x, 2.0, 3.0),
                rotation: DQuat::from_vec4(sign * glam::DVec4::from(turn)),
            }
        };
        let node = &mut graph.nodes[0];
        node.motion = Motion::Rigid(vec![
            pose(0.0, 1.0, 0.0, 1.0),
            pose(1.0, 2.0, 1.0, -1.0),
            pose(4.0, 5.0, 2.0, -1.0),
        ]);
        node.visibility = vec![
            VisibilitySample { time_code: 0.0, visible: true },
            VisibilitySample { time_code: 3.5, visible: false },
        ];
        let label = node.label.clone();
        let query = ObjectQuery { label: Some(label), ..ObjectQuery::default() };
        let found = trajectories(&graph, &query, "here").unwrap();
        assert_eq!(found.len(), 1);
        let samples = &found[0].samples;
        let of = |take: &dyn Fn(&TrajectorySample) -> f64| samples.iter().map(take).collect::<Vec<_>>();
        assert_eq!(of(&|sample| sample.time_code), [0.0, 1.0, 4.0]);
        assert_eq!(of(&|sample| sample.time), [0.0, 0.5, 1.0]);
        assert_eq!(of(&|sample| sample.seconds), [0.0, 0.125, 0.5]);
        assert_eq!(of(&|sample| sample.translation[0]), [102.0, 104.0, 110.0]);
        assert_eq!(samples[2].translation[1..], [4.0, 1.0]);
        assert_eq!(samples.iter().map(|sample| sample.visible).collect::<Vec<_>>(), [true, true, false]);
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for (sample, (w, z)) in samples.iter().zip([(1.0, 0.0), (half, half), (0.0, 1.0)]) {
            let [qw, qx, qy, qz] = sample.rotation;
            assert!((qw - w).abs() < 1e-12 && (qz - z).abs() < 1e-12 && qx == 0.0 && qy == 0.0, "{sample:?}");
        }
    }

    #[test]
    fn what_stands_still_has_a_path_too_and_an_unknown_label_lists_the_known() {
        let field = testing::learned_field(2, 5);
        let graph = crate::build(&field, &SceneOptions::default()).unwrap();
        let all = trajectories(&graph, &ObjectQuery::default(), "here").unwrap();
        assert_eq!(all.len(), graph.nodes.len());
        assert!(all.iter().all(|one| one.samples.len() == graph.time_codes.samples.len()));
        let query = ObjectQuery { label: Some("teapot".to_owned()), ..ObjectQuery::default() };
        let error = trajectories(&graph, &query, "here").unwrap_err().to_string();
        assert!(error.contains("teapot") && error.contains(&graph.nodes[0].label), "{error}");
    }
}
