//! Poses that were trained are those of the stage.

use cif_field::tracks::{Joint, TrackGroup, TrackPose, Tracks};
use cif_field::{Field, Gaussians, Identities, Instance, JointKind, SortMetric, Timeline};
use cif_scene::{Motion, SceneOptions, Tolerance};
use glam::{DMat3, DQuat, DVec3};

use super::session;
use crate::{ExportOptions, export, read_scene};

/// A chest that is turned while its lid opens.
fn chest() -> Field {
    let times: Vec<f64> = (0..9).map(|frame| f64::from(frame) / 8.0).collect();
    let instance =
        Instance { id: 9, label: "chest".into(), category: "chest".into(), taxonomies: Default::default() };
    let pivot = DVec3::new(-1.0, 0.5, 0.2);
    let pose = |time: &f64| TrackPose {
        time: *time,
        translation: pivot + DVec3::new(*time, 0.0, time * time),
        rotation: DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7 + 1.1 * time * time),
    };
    let base =
        TrackGroup { poses: times.iter().map(pose).collect(), ..TrackGroup::of_instance(&instance, pivot) };
    let hinge = Joint { base: 0, kind: JointKind::Revolute, axis: DVec3::Y };
    let opens: Vec<(f64, f64)> = times.iter().map(|time| (*time, 0.3 + time * time)).collect();
    let lid = TrackGroup::jointed("lid", pivot + DVec3::Z * 0.1, hinge, &opens, std::slice::from_ref(&base));
    let mut identities = Identities::empty();
    let places: Vec<[f32; 3]> = (0..60)
        .map(|k: u32| {
            identities.push_certain(Some(0));
            let spread = DVec3::new(f64::from(k % 5), f64::from(k / 5 % 6), f64::from(k / 30));
            (pivot + 0.05 * spread).as_vec3().to_array()
        })
        .collect();
    let mut gaussians = Gaussians::from_points(&places, &vec![[0.4; 3]; places.len()]).unwrap();
    gaussians.opacity_logits.fill(3.0);
    Field {
        gaussians,
        deformation: None,
        tracks: Some(Tracks { group_of: (0..60).map(|row| row / 30).collect(), groups: vec![base, lid] }),
        identities: Some(identities),
        instances: vec![instance],
        timeline: Timeline { times, frames_per_second: 24.0 },
        cameras: Vec::new(),
        sh_degree: 0,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

#[test]
fn trained_poses_are_those_of_the_stage() {
    let _session = session();
    let field = chest();
    let options = SceneOptions { tolerance: Tolerance::Percent(1000.0), ..SceneOptions::default() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("chest.usda");
    export(&cif_scene::build(&field, &options).unwrap(), &path, ExportOptions::default()).unwrap();
    let read = read_scene(&path).unwrap();
    let Motion::Parts(motion) = &read.nodes[0].motion else { panic!("{:?}", read.nodes[0].model()) };
    assert_eq!((motion.parts.len(), motion.parts[1].joint.map(|joint| joint.base)), (2, Some(0)));
    let groups = &field.tracks.as_ref().unwrap().groups;
    for (part, group) in motion.parts.iter().zip(groups) {
        for (frame, time) in field.timeline.times.iter().enumerate() {
            let key = part.track.iter().find(|key| key.time_code == frame as f64);
            let in_node = key.map_or_else(|| part.at_first(), cif_scene::PoseSample::transform);
            let found = read.nodes[0].world_transform(frame as f64).compose(&in_node);
            let (rotation, translation) = group.pose(*time);
            assert!(found.translation.distance(translation) < 1e-6, "{} at {frame}", group.name);
            let turned = (found.rotation - DMat3::from_quat(rotation)).to_cols_array();
            assert!(turned.iter().all(|by| by.abs() < 1e-6), "{} at {frame}: {turned:?}", group.name);
        }
    }
}
