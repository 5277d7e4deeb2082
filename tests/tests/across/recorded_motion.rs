//! Poses that were trained leave as they are: in glTF here, in USD, which needs Python, in `cif-usd/src/tests/recorded.rs`.

use cif_field::tracks::{Joint, NO_GROUP, TrackGroup, TrackPose, Tracks};
use cif_field::{Field, Gaussians, Identities, Instance, JointKind, Owner, SortMetric, Timeline};
use cif_geometry::RigidTransform;
use cif_scene::{Motion, Node, NodeKind, PoseSample, ReadOptions, SceneGraph};
use cif_test::command::run_line;
use glam::{DMat3, DQuat, DVec3};

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

const FRAMES: usize = 9;
/// Gaussians of every body.
const MEMBERS: usize = 30;
const MUG: u16 = 4;
const CHEST: u16 = 9;

/// A number in [-1, 1) for every place of a table.
fn noise(a: usize, b: usize) -> f64 {
    ((a * 7919 + b * 104_729 + 17) as f64 * 0.618_033_988_75).fract() * 2.0 - 1.0
}

/// A mug that is carried by a trembling hand, and a chest that is turned while its lid opens; a ground with a shadow
/// that the masks give to the mug. The poses begin turned, as those of objects that were fitted at another time.
fn carried() -> Field {
    let times: Vec<f64> = (0..FRAMES).map(|frame| frame as f64 / (FRAMES - 1) as f64).collect();
    let instances = [(MUG, "mug"), (CHEST, "chest")].map(|(id, label)| Instance {
        id,
        label: label.to_owned(),
        category: label.to_owned(),
        taxonomies: Default::default(),
    });
    let moving = |instance: &Instance, pivot: DVec3, tremble: f64| {
        let pose = |(k, time): (usize, &f64)| TrackPose {
            time: *time,
            translation: pivot
                + DVec3::X * *time
                + tremble * DVec3::new(noise(k, 0), noise(k, 1), noise(k, 2)),
            rotation: DQuat::from_axis_angle(
                DVec3::new(0.6, 0.0, 0.8),
                0.7 + 1.1 * time + tremble * noise(k, 3),
            ),
        };
        let poses = times.iter().enumerate().map(pose).collect();
        TrackGroup { poses, ..TrackGroup::of_instance(instance, pivot) }
    };
    let mut groups = vec![
        moving(&instances[0], DVec3::new(0.2, 0.1, 0.4), 0.004),
        moving(&instances[1], DVec3::new(-1.0, 0.5, 0.2), 0.0),
    ];
    let hinge = Joint { base: 1, kind: JointKind::Revolute, axis: DVec3::Y };
    let opens: Vec<(f64, f64)> = times.iter().map(|time| (*time, 0.3 + time * time)).collect();
    groups.push(TrackGroup::jointed("lid", DVec3::new(-0.9, 0.5, 0.3), hinge, &opens, &groups));
    let (mut places, mut identities, mut group_of) = (Vec::new(), Identities::empty(), Vec::new());
    for body in 0..4 {
        let centre = groups.get(body).map_or(DVec3::new(0.0, 0.0, -0.5), |group| group.pivot);
        for k in 0..MEMBERS {
            let place =
                centre + 0.1 * DVec3::new(noise(body, 3 * k), noise(body, 3 * k + 1), noise(body, 3 * k + 2));
            places.push(place.as_vec3().to_array());
            group_of.push(if body == 3 { NO_GROUP } else { body as u32 });
            // Masks are wrong about every fifth Gaussian of an object, and take some of the ground for the mug.
            let (own, other) = [(0, 1), (1, 0), (1, 0), (0, 1)][body];
            let (share, label) = match k % 5 {
                0 if body < 3 => (0.9, other),
                0 => (0.8, own),
                _ if body < 3 => (0.9, own),
                _ => (0.02, own),
            };
            identities.push(Owner::Estimated, &[(label, share)]);
        }
    }
    let mut gaussians =
        Gaussians::from_points(&places, &vec![[0.4; 3]; places.len()]).expect("as many colours");
    gaussians.log_scales.fill([-4.0, -4.5, -4.2]);
    gaussians.opacity_logits.fill(3.0);
    gaussians.occupancy_logits.fill(3.0);
    Field {
        gaussians,
        deformation: None,
        tracks: Some(Tracks { group_of, groups }),
        identities: Some(identities),
        instances: instances.to_vec(),
        timeline: Timeline { times, frames_per_second: 24.0 },
        cameras: Vec::new(),
        sh_degree: 0,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

/// Exports a field with a tolerance that would hold everything in place, and reads the file.
fn exported(field: &Field) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    field.save(folder.path().join("scene.cif")).unwrap();
    run_line(CIF, folder.path(), "export scene.cif scene.glb --tolerance 1000%").succeeds();
    cif::formats::read(&folder.path().join("scene.glb"), ReadOptions::default(), None).unwrap()
}

/// Holds poses `world_from_local` against those of a group.
#[track_caller]
fn assert_trained(field: &Field, group: usize, pose: impl Fn(f64) -> RigidTransform) {
    let group = &field.tracks.as_ref().unwrap().groups[group];
    for (frame, time) in field.timeline.times.iter().enumerate() {
        let (rotation, translation) = group.pose(*time);
        let found = pose(frame as f64);
        let moved = found.translation.distance(translation);
        assert!(moved < 1e-6, "{} at {frame}: off by {moved}", group.name);
        let turned = (found.rotation - DMat3::from_quat(rotation)).to_cols_array();
        let turned = turned.into_iter().fold(0.0, |most: f64, by| most.max(by.abs()));
        assert!(turned < 1e-6, "{} at {frame}: turned by {turned}", group.name);
    }
}

fn node(graph: &SceneGraph, id: u16) -> &Node {
    let is_own = |node: &&Node| matches!(node.kind, NodeKind::Instance { id: own, .. } if own == id);
    graph.nodes.iter().find(is_own).expect("a node of the instance")
}

#[track_caller]
fn assert_leaves_as_trained(field: &Field, graph: &SceneGraph) {
    let mug = node(graph, MUG);
    assert!(matches!(mug.motion, Motion::Rigid(_)), "{:?}", mug.model());
    assert_eq!(mug.splats.len(), MEMBERS, "all of its group, and no shadow");
    assert_trained(field, 0, |code| mug.world_transform(code));
    let chest = node(graph, CHEST);
    let Motion::Parts(parts) = &chest.motion else { panic!("{:?}", chest.model()) };
    let [base, lid] = &parts.parts[..] else { panic!("{} parts", parts.parts.len()) };
    assert_eq!([base.splats.len(), lid.splats.len()], [MEMBERS; 2]);
    for (part, group) in [(base, 1), (lid, 2)] {
        let in_node = |code: f64| {
            let key = part.track.iter().find(|key| key.time_code == code);
            key.map_or_else(|| part.at_first(), PoseSample::transform)
        };
        assert_trained(field, group, |code| chest.world_transform(code).compose(&in_node(code)));
    }
    let joint = lid.joint.expect("the lid is on a joint");
    assert_eq!((joint.base, joint.kind), (0, JointKind::Revolute));
    assert!(joint.axis.distance(DVec3::Y) < 1e-6, "{}", joint.axis);
}

#[test]
fn trained_poses_are_those_of_the_files() {
    let field = carried();
    assert_leaves_as_trained(&field, &exported(&field));
}

#[test]
fn groups_of_older_files_are_of_the_instances_that_they_show() {
    let named = carried();
    let mut field = named.clone();
    let groups = &mut field.tracks.as_mut().unwrap().groups;
    groups.iter_mut().for_each(|group| group.instance = None);
    let folder = tempfile::tempdir().unwrap();
    let format = |field: &Field| {
        let path = folder.path().join("scene.cif");
        field.save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(Field::load(&path).unwrap(), *field);
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header = String::from_utf8(bytes[8..8 + length].to_vec()).unwrap();
        let found = header.split("\"cif.format\":\"").nth(1).expect("a format");
        found.split('"').next().unwrap().parse::<u32>().unwrap()
    };
    assert_eq!((format(&field), format(&named)), (6, 9));
    assert_leaves_as_trained(&named, &exported(&field));
}
