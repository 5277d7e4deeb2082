//! What nodes carry beside their motion: colliders, levels of detail, velocities, visibility.

use super::*;
use crate::convex_hull::HullMesh;

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
        points: hull.points.iter().map(|point| motion::vector(*point)).collect(),
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
    let hulls = colliders::colliders(&node, 1);
    assert_eq!(hulls.len(), 1);
    let mesh = mesh(&hulls[0]);
    assert!(mesh.points.len() <= convex_hull::MAX_CORNERS);
    let body: Vec<DVec3> =
        (0..500).filter(|k| k % 7 != 0).map(|k| motion::vector(node.splats.means[k])).collect();
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
            let centre = motion::vector(node.splats.means[*k]);
            hulls.iter().any(|hull| hull.outside(centre) < 1e-6)
        });
        inside.map(|k| weights[k]).sum::<f64>() / weights.iter().sum::<f64>()
    })
}

#[test]
fn large_nodes_are_enclosed_by_what_a_sample_of_them_says() {
    let node = node(&cloud(90_000, DVec3::new(0.4, 0.2, 0.1)));
    let hulls = colliders::colliders(&node, 1);
    let shares = shares_held(&hulls, &node);
    assert!(shares.iter().all(|share| *share >= colliders::ENCLOSED - 5e-3), "{shares:?}");
    assert!(mesh(&hulls[0]).volume() < 1.5 * 0.4 * 0.2 * 0.1);
}

#[test]
fn colliders_enclose_their_splats_by_opacity_and_by_sight() {
    let enclosed = |node: &Node, hulls: usize| {
        let hulls = colliders::colliders(node, hulls);
        let shares = shares_held(&hulls, node);
        assert!(shares.iter().all(|share| *share >= colliders::ENCLOSED - 1e-9), "{shares:?}");
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
    let (one, several) = (colliders::colliders(&node, 1), colliders::colliders(&node, 4));
    assert!(several.len() > 1 && several.len() <= 4);
    assert!(volume(&several) < 0.5 * volume(&one), "{} {}", volume(&several), volume(&one));
    assert!(share_inside(&several, &points) >= 0.99);
    // A convex body stays in one piece.
    assert_eq!(colliders::colliders(&super::nodes::node(&cloud(600, DVec3::ONE)), 4).len(), 1);
}

#[test]
fn flat_small_and_glassy_nodes_have_colliders() {
    let flat: Vec<DVec3> = cloud(100, DVec3::new(1.0, 1.0, 0.0));
    let mut sheet = node(&flat);
    sheet.splats.scales.fill([0.02, 0.02, 1e-9]);
    assert!(share_inside(&colliders::colliders(&sheet, 1), &flat) >= 0.99);
    assert_eq!(colliders::colliders(&node(&[DVec3::ONE]), 1).len(), 1, "one ellipsoid has an extent");
    let glass_points = cloud(50, DVec3::ONE);
    let mut glass = node(&glass_points);
    glass.splats.opacities.fill(0.05);
    assert!(share_inside(&colliders::colliders(&glass, 1), &glass_points) >= 0.99);
    assert!(colliders::colliders(&glass, 0).is_empty());
    assert!(colliders::colliders(&node(&[]), 1).is_empty());
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
    };
    node.motion = Motion::Parts(PartsMotion { track: Vec::new(), parts: vec![part(0..90), part(90..100)] });
    let kept = level_of_detail(&node, 0.25);
    assert_eq!((kept.len(), kept.iter().filter(|index| **index >= 90).count()), (25, 1));
    assert_eq!(level_of_detail(&node, 0.0).len(), 2);
    assert_eq!(level_of_detail(&node, f64::NAN).len(), 2);
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
    let graph = build_from(&field, &mut source, &options).unwrap();
    let seconds = (FRAMES - 1) as f64 / graph.time_codes.frames_per_second;
    for time_code in [0.0, 3.5, 8.0, 100.0] {
        let velocity = graph.nodes[0].initial_velocity(time_code, graph.time_codes.frames_per_second);
        let angular = DVec3::new(0.6, 0.0, 0.8) * 2.0 / seconds;
        assert!((velocity.angular - angular).length() < 1e-3 * angular.length(), "{velocity:?}");
        // The origin of the frame turns about the world's origin besides.
        let pose = graph.nodes[0].world_transform(time_code.clamp(0.0, 8.0));
        let at = motion(time_code.clamp(0.0, 8.0) / 8.0).translation;
        let expected = DVec3::X * 3.0 / seconds + angular.cross(pose.translation - at);
        let error = (velocity.linear - expected).length();
        assert!(error < 0.1 * expected.length(), "{time_code}: {velocity:?} {expected}");
    }
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
}
