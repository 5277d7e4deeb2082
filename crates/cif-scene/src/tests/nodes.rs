//! Properties of nodes other than their motion: colliders, levels of detail, velocities, visibility.

use super::*;
use cif_field::tracks::{NO_GROUP, Samples, TrackGroup, TrackPose};
use cif_field::{Owner, RotationEvidence, Tracks};

use crate::shape::convex_hull::HullMesh;

/// A node of round splats at these places.
pub(super) fn node(means: &[DVec3]) -> Node {
    let count = means.len();
    let splats = Splats {
        means: means.iter().map(|mean| mean.to_array().map(|v| v as f32)).collect(),
        orientations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        scales: vec![[0.01; 3]; count],
        opacities: vec![0.9; count],
        sh_coefficients: vec![0.0; 3 * count],
        rows: (0..count as u32).collect(),
        ..Splats::default()
    };
    let field = field(1);
    let graph = build_from(&field, &mut |_| field.gaussians.clone(), &SceneOptions::default()).unwrap();
    Node { splats, pivot: DVec3::ZERO, ..graph.nodes[0].clone() }
}

fn cloud(count: usize, size: DVec3) -> Vec<DVec3> {
    let steps = DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5);
    (1..=count).map(|k| ((steps * k as f64).fract() - 0.5) * size).collect()
}

fn mesh(hull: &ConvexHull) -> HullMesh {
    HullMesh {
        points: hull.points.iter().map(|point| vectors::vector(*point)).collect(),
        triangles: hull.triangles.clone(),
    }
}

fn share_inside(hulls: &[ConvexHull], points: &[DVec3]) -> f64 {
    let hulls: Vec<HullMesh> = hulls.iter().map(mesh).collect();
    let inside = points.iter().filter(|point| hulls.iter().any(|hull| hull.outside(**point) < 1e-6)).count();
    inside as f64 / points.len() as f64
}

#[test]
fn a_collider_holds_its_splats_and_no_stragglers() {
    let mut points = cloud(500, DVec3::new(0.4, 0.2, 0.1));
    points.extend([DVec3::new(3.0, 0.0, 0.0), DVec3::new(0.0, -2.0, 1.0)]);
    let mut node = node(&points);
    // A faint cloud around the body, and a needle that sticks out of it.
    for k in (0..500).step_by(7) {
        node.splats.opacities[k] = 0.1;
        node.splats.means[k] = (points[k] * 4.0).to_array().map(|v| v as f32);
    }
    node.splats.scales[5] = [2.0, 0.001, 0.001];
    let hulls = crate::shape::colliders::colliders(&node, 1);
    assert_eq!(hulls.len(), 1);
    let mesh = mesh(&hulls[0]);
    assert!(mesh.points.len() <= crate::shape::convex_hull::MAX_CORNERS);
    let body: Vec<DVec3> =
        (0..500).filter(|k| k % 7 != 0).map(|k| vectors::vector(node.splats.means[k])).collect();
    assert!(share_inside(&hulls, &body) >= 0.99, "{}", share_inside(&hulls, &body));
    assert!(mesh.points.iter().all(|point| point.abs().cmplt(DVec3::new(0.25, 0.15, 0.1)).all()), "{mesh:?}");
    assert!((0.4 * 0.2 * 0.1..0.5 * 0.3 * 0.2).contains(&mesh.volume()), "{}", mesh.volume());
}

/// Shares of the opacity, and of what is seen, whose centres lie in the hulls.
fn shares_held(hulls: &[ConvexHull], node: &Node) -> [f64; 2] {
    let hulls: Vec<HullMesh> = hulls.iter().map(mesh).collect();
    let opacities: Vec<f64> = node.splats.opacities.iter().map(|opacity| f64::from(*opacity)).collect();
    [opacities, node.splats.importance()].map(|weights| {
        let inside = (0..node.splats.len()).filter(|k| {
            let centre = vectors::vector(node.splats.means[*k]);
            hulls.iter().any(|hull| hull.outside(centre) < 1e-6)
        });
        inside.map(|k| weights[k]).sum::<f64>() / weights.iter().sum::<f64>()
    })
}

#[test]
fn large_nodes_are_enclosed_by_what_a_sample_of_them_says() {
    let node = node(&cloud(90_000, DVec3::new(0.4, 0.2, 0.1)));
    let hulls = crate::shape::colliders::colliders(&node, 1);
    let shares = shares_held(&hulls, &node);
    assert!(shares.iter().all(|share| *share >= crate::shape::colliders::ENCLOSED - 5e-3), "{shares:?}");
    assert!(mesh(&hulls[0]).volume() < 1.5 * 0.4 * 0.2 * 0.1);
}

#[test]
fn colliders_enclose_their_splats_by_opacity_and_by_sight() {
    let enclosed = |node: &Node, hulls: usize| {
        let hulls = crate::shape::colliders::colliders(node, hulls);
        let shares = shares_held(&hulls, node);
        assert!(shares.iter().all(|share| *share >= crate::shape::colliders::ENCLOSED - 1e-9), "{shares:?}");
        hulls.iter().map(|hull| mesh(hull).volume()).sum::<f64>()
    };
    let ball = |count: usize, radius: f64| {
        let points = cloud(count, DVec3::ONE).into_iter().filter_map(DVec3::try_normalize);
        points.map(move |point| radius * point)
    };
    // A bright core in a faint shell that holds a quarter of the opacity.
    let mut shell = node(&ball(300, 0.1).chain(ball(300, 0.12)).collect::<Vec<_>>());
    shell.splats.opacities[300..].fill(0.3);
    assert!(enclosed(&shell, 1) < 1.3 * 4.19 * 0.12_f64.powi(3));
    // Broad splats, and many small opaque ones beside them: 12 % of the opacity, next to nothing of what is seen.
    let mut specks: Vec<DVec3> = ball(300, 0.1).collect();
    specks.extend(ball(42, 0.02).map(|point| point + 0.2 * DVec3::X));
    let mut specks = node(&specks);
    specks.splats.scales[300..].fill([1e-3; 3]);
    enclosed(&specks, 1);
    enclosed(&specks, 4);
    // The other way round: one broad faint splat out of 200 is most of what is seen.
    let mut broad: Vec<DVec3> = ball(199, 0.1).collect();
    broad.push(DVec3::new(0.0, 0.15, 0.0));
    let mut broad = node(&broad);
    broad.splats.scales[199] = [0.2; 3];
    broad.splats.opacities[199] = 0.2;
    enclosed(&broad, 1);
    // Parts enclose theirs.
    let mut jointed = node(&ball(200, 0.1).chain(ball(100, 0.05)).collect::<Vec<_>>());
    jointed.splats.opacities[200..].fill(0.2);
    let part = |splats: std::ops::Range<usize>| Part {
        name: format!("part_{}", splats.start),
        splats,
        pivot: DVec3::ZERO,
        track: Vec::new(),
        extent: cif_geometry::Bounds::EMPTY,
        joint: None,
    };
    jointed.motion =
        Motion::Parts(PartsMotion { track: Vec::new(), parts: vec![part(0..200), part(200..300)] });
    enclosed(&jointed, 2);
}

#[test]
fn concave_nodes_fall_into_hulls() {
    // An L of two bars.
    let mut points = cloud(300, DVec3::new(1.0, 0.1, 0.1));
    points.extend(cloud(300, DVec3::new(0.1, 1.0, 0.1)).iter().map(|p| *p + DVec3::new(-0.45, 0.55, 0.0)));
    let node = node(&points);
    let volume = |hulls: &[ConvexHull]| hulls.iter().map(|hull| mesh(hull).volume()).sum::<f64>();
    let (one, several) =
        (crate::shape::colliders::colliders(&node, 1), crate::shape::colliders::colliders(&node, 4));
    assert!(several.len() > 1 && several.len() <= 4);
    assert!(volume(&several) < 0.5 * volume(&one), "{} {}", volume(&several), volume(&one));
    assert!(share_inside(&several, &points) >= 0.99);
    // A convex body stays in one piece.
    assert_eq!(crate::shape::colliders::colliders(&super::nodes::node(&cloud(600, DVec3::ONE)), 4).len(), 1);
}

#[test]
fn flat_small_and_glassy_nodes_have_colliders() {
    let flat: Vec<DVec3> = cloud(100, DVec3::new(1.0, 1.0, 0.0));
    let mut sheet = node(&flat);
    sheet.splats.scales.fill([0.02, 0.02, 1e-9]);
    assert!(share_inside(&crate::shape::colliders::colliders(&sheet, 1), &flat) >= 0.99);
    assert_eq!(
        crate::shape::colliders::colliders(&node(&[DVec3::ONE]), 1).len(),
        1,
        "one ellipsoid has an extent"
    );
    let glass_points = cloud(50, DVec3::ONE);
    let mut glass = node(&glass_points);
    glass.splats.opacities.fill(0.05);
    assert!(share_inside(&crate::shape::colliders::colliders(&glass, 1), &glass_points) >= 0.99);
    assert!(crate::shape::colliders::colliders(&glass, 0).is_empty());
    assert!(crate::shape::colliders::colliders(&node(&[]), 1).is_empty());
}

#[test]
fn colliders_come_as_asked_for() {
    let field = field(2);
    let build =
        |options: &SceneOptions| build_from(&field, &mut |_| field.gaussians.clone(), options).unwrap();
    let counts = |graph: &SceneGraph| graph.nodes.iter().map(|node| node.colliders.len()).collect::<Vec<_>>();
    assert_eq!(counts(&build(&SceneOptions::default())), [1, 1, 0]);
    let none = SceneOptions { hulls_per_instance: 0, background_hulls: 3, ..SceneOptions::default() };
    let graph = build(&none);
    assert_eq!(counts(&graph)[..2], [0, 0]);
    assert!((1..=3).contains(&counts(&graph)[2]));
}

#[test]
fn levels_of_detail_nest_and_keep_the_important() {
    let mut node = node(&cloud(100, DVec3::ONE));
    for k in 0..100 {
        node.splats.opacities[k] = 0.1 + 0.008 * ((k * 37) % 100) as f32;
    }
    let mut previous: Vec<u32> = Vec::new();
    for share in [0.0, 0.01, 0.25, 0.5, 0.505, 1.0] {
        let kept = level_of_detail(&node, share);
        assert_eq!(kept.len(), ((share * 100.0).ceil() as usize).max(1));
        assert!(kept.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(previous.iter().all(|index| kept.contains(index)), "{share}");
        let faintest = kept.iter().map(|&k| node.splats.opacities[k as usize]).fold(f32::INFINITY, f32::min);
        let lost = (0..100).filter(|k| !kept.contains(k));
        assert!(lost.clone().all(|k| node.splats.opacities[k as usize] <= faintest));
        previous = kept;
    }
    // Every part keeps one, however faint.
    node.splats.opacities[90..].fill(1e-6);
    let part = |splats: std::ops::Range<usize>| Part {
        name: format!("part_{}", splats.start),
        splats,
        pivot: DVec3::ZERO,
        track: Vec::new(),
        extent: cif_geometry::Bounds::EMPTY,
        joint: None,
    };
    node.motion = Motion::Parts(PartsMotion { track: Vec::new(), parts: vec![part(0..90), part(90..100)] });
    let kept = level_of_detail(&node, 0.25);
    assert_eq!((kept.len(), kept.iter().filter(|index| **index >= 90).count()), (25, 1));
    assert_eq!(level_of_detail(&node, 0.0).len(), 2);
    assert_eq!(level_of_detail(&node, f64::NAN).len(), 2);
}

#[test]
fn members_are_those_of_the_nodes() {
    let mut field = field(3);
    field.gaussians.opacity_logits[7] = -9.0;
    let options = SceneOptions::default();
    let members = crate::from_field::assignment::members(&field, &options);
    let graph = build(&field, &options).unwrap();
    assert_eq!((members.len(), members[0].len()), (3, 59), "one is too faint to be drawn");
    for (node, members) in graph.nodes.iter().zip(&members) {
        let mut rows = node.splats.rows.clone();
        rows.sort_unstable();
        assert_eq!(&rows, members, "{}", node.name);
    }
    field.identities = None;
    let none = crate::from_field::assignment::members(&field, &options);
    assert!(none.len() == 3 && none.iter().all(Vec::is_empty));
}

#[test]
fn velocities_are_those_of_the_track() {
    let field = field(1);
    let motion = |time: f64| RigidTransform {
        rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.0 * time),
        translation: DVec3::new(3.0 * time, 0.0, -1.0),
    };
    let mut source = |time: f64| moved(&field, 0..60, &motion(time));
    let options = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
    let mut graph = build_from(&field, &mut source, &options).unwrap();
    // A tetrahedron beside the origin, whose centre of mass is the mean of its corners, cut into two hulls.
    let corners = [[0.5, 0.0, 0.0], [0.9, 0.0, 0.0], [0.5, 0.4, 0.0], [0.5, 0.0, 0.4], [0.7, 0.2, 0.0]];
    let half = |a: u32, b: u32, c: u32| ConvexHull {
        points: corners.to_vec(),
        triangles: vec![[a, c, b], [a, b, 3], [b, c, 3], [c, a, 3]],
        part: None,
    };
    graph.nodes[0].colliders = vec![half(0, 1, 4), half(0, 4, 2)];
    let centre = DVec3::new(0.6, 0.1, 0.1);
    let seconds = (FRAMES - 1) as f64 / graph.time_codes.frames_per_second;
    for time_code in [0.0, 3.5, 8.0, 100.0] {
        let velocity = graph.nodes[0].initial_velocity(time_code, graph.time_codes.frames_per_second);
        let angular = DVec3::new(0.6, 0.0, 0.8) * 2.0 / seconds;
        assert!((velocity.angular - angular).length() < 1e-3 * angular.length(), "{velocity:?}");
        // The centre of mass turns about the world's origin besides.
        let pose = graph.nodes[0].world_transform(time_code.clamp(0.0, 8.0));
        let at = motion(time_code.clamp(0.0, 8.0) / 8.0).translation;
        let arm = pose.rotation * centre + pose.translation - at;
        let expected = DVec3::X * 3.0 / seconds + angular.cross(arm);
        let error = (velocity.linear - expected).length();
        assert!(error < 0.1 * expected.length(), "{time_code}: {velocity:?} {expected}");
        let of_origin = DVec3::X * 3.0 / seconds + angular.cross(pose.translation - at);
        assert!((velocity.linear - of_origin).length() > 0.15 * expected.length(), "{time_code}");
    }
    // Without colliders it is the origin of the local frame.
    graph.nodes[0].colliders.clear();
    let codes = graph.time_codes.frames_per_second;
    let [before, after] = [0.0, 1.0].map(|code| graph.nodes[0].world_transform(code).translation);
    let velocity = graph.nodes[0].initial_velocity(0.0, codes);
    assert!((velocity.linear - (after - before) * codes).length() < 1e-9, "{velocity:?}");
    assert_eq!(graph.nodes[1].initial_velocity(0.0, 24.0), Velocity::default());
    assert_eq!(graph.nodes[0].initial_velocity(0.0, 0.0), Velocity::default());
}

#[test]
fn fading_nodes_hide_and_come_back() {
    let field = field(2);
    // The second object is there from the middle on, the first always; all of it from frame 4 on.
    let mut source = |time: f64| {
        let mut gaussians = field.gaussians.clone();
        if time < 0.5 {
            gaussians.opacity_logits[60..120].fill(-20.0);
            gaussians.opacity_logits[0..30].fill(logit(0.4));
        }
        gaussians
    };
    let graph = build_from(&field, &mut source, &SceneOptions::default()).unwrap();
    let [first, second, background] = &graph.nodes[..] else { panic!("{:?}", graph.omitted) };
    assert!(first.visibility.is_empty() && background.visibility.is_empty());
    let changes: Vec<(f64, bool)> =
        second.visibility.iter().map(|sample| (sample.time_code, sample.visible)).collect();
    assert_eq!(changes, [(0.0, false), (4.0, true)]);
    assert!(!second.is_visible(3.9) && second.is_visible(4.0) && second.is_visible(99.0));
    assert!(second.splats.opacities.iter().all(|opacity| (opacity - 0.8).abs() < 1e-6), "while visible");
    let mean = (4.0 * 0.4 + 5.0 * 0.8) / 9.0;
    assert!(
        (first.splats.opacities[0] - mean).abs() < 1e-6 && (first.splats.opacities[40] - 0.8).abs() < 1e-6
    );
    // Samples are kept in addition to the means, as few as a step needs.
    let codes = |node: &Node| -> Vec<f64> {
        node.appearance.opacities.iter().map(|sample| sample.time_code).collect()
    };
    assert_eq!((codes(first), codes(second)), (vec![0.0, 3.0, 4.0, 8.0], vec![0.0, 3.0, 4.0, 8.0]));
    assert!(background.appearance.opacities.is_empty() && first.appearance.colors.is_empty());
    for (code, expected) in [(0.0, 0.4), (3.0, 0.4), (3.5, 0.6), (4.0, 0.8), (9.0, 0.8)] {
        let found = first.appearance.opacities_at(code).unwrap();
        assert!((found[0] - expected).abs() < 1e-6 && (found[40] - 0.8).abs() < 1e-6, "{code}: {}", found[0]);
    }
    let loose = SceneOptions { appearance_tolerance: 0.3, ..SceneOptions::default() };
    let graph = build_from(&field, &mut source, &loose).unwrap();
    assert!(graph.nodes[0].appearance.opacities.is_empty(), "0.2 off in half of the splats");
    let whole = SceneOptions { reduce_keys: false, ..SceneOptions::default() };
    let graph = build_from(&field, &mut source, &whole).unwrap();
    assert_eq!(graph.nodes[0].appearance.opacities.len(), FRAMES);
    // The loss that formats without samples report.
    let lost = crate::appearance::lost_without_samples(&graph.nodes[0]);
    assert_eq!(lost.len(), 1);
    assert!(
        lost[0].starts_with("red_mug_001: opacities change over time and leave as their mean"),
        "{lost:?}"
    );
    assert!(crate::appearance::lost_without_samples(background).is_empty());
}

#[test]
fn what_changes_over_time_comes_back_from_the_graph() {
    let mut field = field(2);
    let n = field.gaussians.len();
    let times = field.timeline.times.clone();
    let mut opacities = vec![0.8; 60 * FRAMES];
    let mut colors = vec![[0.25; 48]; 60 * FRAMES];
    for step in 0..FRAMES {
        for k in 0..60 {
            opacities[60 * step + k] = if step < 4 { 0.2 } else { 0.9 };
            colors[60 * step + k][1] = step as f32 / 8.0;
            // Degree 2 is the highest of the field.
            colors[60 * step + k][27..].fill(0.0);
        }
    }
    let mut tracks = Tracks { group_of: vec![NO_GROUP; n], groups: Vec::new() };
    tracks.group_of[..60].fill(0);
    let turn = |time: f64| DQuat::from_rotation_z(1.5 * time);
    tracks.groups.push(TrackGroup {
        poses: times
            .iter()
            .map(|time| TrackPose { time: *time, translation: DVec3::X * *time, rotation: turn(*time) })
            .collect(),
        instance: Some(field.instances[0].id),
        rotation: Some(RotationEvidence::Assumed),
        opacities: Some(Samples { times: times.clone(), values: opacities }),
        colors: Some(Samples { times: times.clone(), values: colors }),
        ..TrackGroup::still("changing", DVec3::ZERO)
    });
    field.tracks = Some(tracks);
    field.validate().unwrap();
    let options = SceneOptions { reduce_keys: false, appearance_tolerance: 0.0, ..SceneOptions::default() };
    let graph = build(&field, &options).unwrap();
    let node = &graph.nodes[0];
    assert_eq!((node.model(), node.appearance.colors.len()), (MotionModel::Rigid, FRAMES));
    let evidence: Vec<_> = graph.nodes.iter().map(|node| node.report.rotation).collect();
    assert_eq!(evidence, [Some(RotationEvidence::Assumed), None, None], "of what follows the track alone");
    let back = field_from_graph(&graph, "graph").unwrap();
    assert_eq!(back.tracks.as_ref().unwrap().groups[0].rotation, Some(RotationEvidence::Assumed));
    for time in &times {
        let (a, b) = (field.deformed(*time), back.deformed(*time));
        for row in 0..n {
            assert!((a.opacity(row) - b.opacity(row)).abs() < 1e-5, "row {row} at {time}");
            for (x, y) in a.sh_coefficients[row].iter().zip(&b.sh_coefficients[row]).take(27) {
                assert!((x - y).abs() < 1e-4, "row {row} at {time}: {x} {y}");
            }
        }
    }
}

#[test]
fn identity_rows_come_back_from_the_graph() {
    let mut field = field(3);
    let mut rows = Identities::empty();
    for row in 0..field.len() {
        let own = (row / 60).min(2) as u16;
        let other = (own + 1) % 3;
        let mut shares = if row < 180 { vec![(own, 0.6), (other, 0.2)] } else { vec![(own, 0.05)] };
        shares.sort_by_key(|(label, _)| *label);
        rows.push(Owner::Estimated, &shares);
    }
    field.identities = Some(rows);
    let graph = build(&field, &SceneOptions::default()).unwrap();
    assert_eq!(graph.nodes.len(), 4);
    let back = field_from_graph(&graph, "graph").unwrap();
    let (before, after) = (field.identities.unwrap(), back.identities.clone().unwrap());
    let shares = |rows: &Identities, row| {
        rows.entries(row).map(|(label, log, _)| (label, log.exp())).collect::<Vec<_>>()
    };
    for row in 0..180 {
        for (a, b) in shares(&before, row).iter().zip(&shares(&after, row)) {
            assert!(a.0 == b.0 && (a.1 - b.1).abs() < 1e-6, "{row}: {a:?} {b:?}");
        }
        assert_eq!(after.owner(row), Owner::Instance((row / 60) as u16));
    }
    assert!((180..220).all(|row| after.owner(row) == Owner::Background));
    assert!((after.labelled_shares()[200] - 0.05).abs() < 1e-6);
    // And again, with the same owners.
    let again = build(&back, &SceneOptions::default()).unwrap();
    let counts = |graph: &SceneGraph| graph.nodes.iter().map(|node| node.splats.len()).collect::<Vec<_>>();
    assert_eq!(counts(&again), counts(&graph));
    // A copy under another id takes the entries of its own id with it, and leaves the others.
    let mut copied = graph.clone();
    let mut copy = copied.nodes[0].clone();
    copy.name = "copy".into();
    copied.nodes.push(copy);
    let back = field_from_graph(&copied, "graph").unwrap();
    let index = back.instances.len() as u16 - 1;
    let rows = back.identities.unwrap();
    assert_eq!(shares(&rows, 220).iter().map(|(label, _)| *label).collect::<Vec<_>>(), [1, index]);
    // Files without rows are certain of instances, and of nothing in the background.
    let mut bare = graph.clone();
    bare.nodes.iter_mut().for_each(|node| node.splats.identities.clear());
    let rows = field_from_graph(&bare, "graph").unwrap().identities.unwrap();
    assert_eq!((rows.entries(0).count(), rows.entries(200).count()), (1, 0), "no label but in objects");
}

#[test]
fn thin_objects_own_the_soft_splats_that_draw_them() {
    let mut field = field(2);
    let mut rows = Identities::empty();
    for row in 0..field.len() {
        // A wire: its splats are wider than its mask. Those of the compact object lie in it, but for some at its edge.
        let share = match row {
            0..40 => 0.34,
            40..60 => 0.1,
            60..100 => 0.95,
            100..120 => 0.34,
            _ => 0.02,
        };
        rows.push(Owner::Estimated, &[((row / 60).min(1) as u16, share)]);
    }
    field.identities = Some(rows);
    let graph = build(&field, &SceneOptions::default()).unwrap();
    let counts: Vec<usize> = graph.nodes.iter().map(|node| node.splats.len()).collect();
    assert_eq!(counts, [40, 40, 80], "the wire has its splats, and the compact object not those beside it");
}
