//! Recorded motion: the fast path against the reference, and images that must not change.

use crate::support::{pixel_discontinuity, render};
use cif_field::tracks::{DenseTrack, NO_GROUP, TrackGroup, TrackPose, Tracks, VisibilityStep};
use cif_field::{Field, Heads};
use cif_geometry::{PixelGrid, RigidTransform};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::reference::{self, Scene};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
#[cfg(feature = "wgpu")]
use cif_render::wgpu::GpuRenderer;
use cif_render::{Channels, Gradients, InstanceSettings, RenderSettings, RenderedImage};
use glam::{DMat3, DQuat, DVec3};

const EVERYTHING: Channels = Channels { depth: true, instances: true };

fn settings() -> RenderSettings {
    RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() }
}

fn config(heads: Option<Heads>) -> SyntheticConfig {
    SyntheticConfig {
        seed: 5,
        gaussians: 120,
        instances: 4,
        width: 61,
        height: 43,
        heads,
        screen_size: (0.02, 0.1),
    }
}

fn turn() -> DQuat {
    DQuat::from_axis_angle(DVec3::new(2.0, -1.0, 2.0) / 3.0, 0.7)
}

/// Groups that turn, hide, follow dense samples and are exempt from the deformation; the rest stands still.
fn with_tracks(field: &Field) -> Field {
    let n = field.len() as u32;
    let group_of: Vec<u32> = (0..n).map(|row| if row % 5 == 4 { NO_GROUP } else { row % 5 }).collect();
    let pivot = DVec3::from_array(field.gaussians.means[0].map(f64::from));
    let pose = |time: f64, angle: f64| TrackPose {
        time,
        translation: pivot + DVec3::new(0.2, 0.1, -0.15) * time,
        rotation: DQuat::from_axis_angle(DVec3::Y, angle),
    };
    let members: Vec<usize> = (0..n as usize).filter(|row| row % 5 == 2).collect();
    let sampled = |shift: f32| {
        members.iter().map(move |&row| {
            let [x, y, z] = field.gaussians.means[row];
            [x + shift, y - 0.5 * shift, z]
        })
    };
    let quaternions = members.iter().map(|&row| field.gaussians.quaternions[row]);
    let dense = DenseTrack {
        times: vec![0.0, 1.0],
        means: sampled(0.0).chain(sampled(0.3)).collect(),
        quaternions: quaternions.clone().chain(quaternions.map(|q| q.map(|c| c * 1.5))).collect(),
        log_scales: None,
    };
    let still = |name| TrackGroup::still(name, pivot);
    let groups = vec![
        TrackGroup { poses: vec![pose(0.0, 0.2), pose(0.5, 1.4)], ..still("turning") },
        TrackGroup { visibility: vec![VisibilityStep { time: 0.0, visible: false }], ..still("hidden") },
        TrackGroup { dense: Some(dense), poses: vec![pose(0.0, -0.3)], ..still("dense") },
        TrackGroup { deformed: false, ..still("exempt") },
    ];
    Field { tracks: Some(Tracks { group_of, groups }), ..field.clone() }
}

fn tracked_scene(heads: Option<Heads>) -> SyntheticScene {
    let mut scene = generate(&config(heads));
    scene.field = with_tracks(&scene.field);
    scene.field.validate().unwrap();
    scene
}

#[test]
fn the_fast_path_follows_tracks_as_the_reference_does() {
    for heads in [None, Some(Heads { sh: false, ..ALL_HEADS }), Some(ALL_HEADS)] {
        let scene = tracked_scene(heads);
        let double = Scene::<f64>::from_field(&scene.field);
        let forward = render(&double, &scene, &settings());
        for simd in [SimdLevel::Auto, SimdLevel::Portable] {
            let mut renderer = Renderer::new(simd);
            let image = renderer.render(&scene.field, &scene.camera, scene.time, &settings(), EVERYTHING);
            let mut compared = 0;
            for (position, (found, expected)) in
                image.color.pixels.iter().zip(&forward.color.pixels).enumerate()
            {
                if pixel_discontinuity(&forward, position, 1e-3).is_some() {
                    continue;
                }
                compared += 1;
                for channel in 0..3 {
                    let error = (f64::from(found[channel]) - expected[channel]).abs();
                    assert!(error < 3e-5, "pixel {position}: {found:?} {expected:?}");
                }
            }
            assert!(compared > 1000, "{compared} pixels are clear of thresholds");
            let reference =
                reference::render::<f64>(&scene.field, &scene.camera, scene.time, &settings(), EVERYTHING);
            let labels = |image: &RenderedImage| image.instances.as_ref().unwrap().label.pixels.clone();
            let same = labels(&image).iter().zip(labels(&reference)).filter(|(a, b)| **a == *b).count();
            assert!(same * 1000 > 995 * image.color.pixels.len(), "{same} labels agree");
        }
        // The comparison can fail: the tracks do show.
        let still = Field { tracks: None, ..scene.field.clone() };
        let plain = reference::render::<f64>(&still, &scene.camera, scene.time, &settings(), EVERYTHING);
        let changed = plain
            .color
            .pixels
            .iter()
            .zip(&forward.color.pixels)
            .filter(|(a, b)| (f64::from(a[0]) - b[0]).abs() > 0.02)
            .count();
        assert!(changed > 300, "{changed} pixels show the tracks");
    }
}

#[test]
fn posed_gaussians_are_the_same_everywhere() {
    for heads in [None, Some(Heads { sh: false, ..ALL_HEADS }), Some(ALL_HEADS)] {
        let scene = tracked_scene(heads);
        for time in [0.0, 0.37, 1.0] {
            let fast = Renderer::new(SimdLevel::Auto).deform(&scene.field, time);
            let plain = scene.field.deformed(time);
            let pairs = [
                (fast.means.as_flattened(), plain.means.as_flattened()),
                (fast.log_scales.as_flattened(), plain.log_scales.as_flattened()),
                (fast.quaternions.as_flattened(), plain.quaternions.as_flattened()),
                (fast.sh_coefficients.as_flattened(), plain.sh_coefficients.as_flattened()),
                (&fast.opacity_logits, &plain.opacity_logits),
                (&fast.occupancy_logits, &plain.occupancy_logits),
            ];
            for (fast, plain) in pairs {
                assert!(fast.iter().zip(plain).all(|(a, b)| (a - b).abs() < 1e-4));
            }
            let unhidden = Renderer::new(SimdLevel::Auto).deform_unhidden(&scene.field, time);
            assert!(plain.opacity(1) == 0.0 && unhidden.opacity(1) > 0.01);
            assert_eq!(unhidden.means, fast.means);
        }
    }
}

#[test]
fn a_scene_and_a_camera_that_move_together_give_the_same_image() {
    // Everything is in one group: places, orientations and view-dependent colours must all turn.
    for heads in [None, Some(ALL_HEADS)] {
        let scene = generate(&config(heads));
        let pivot = DVec3::new(0.4, -0.2, 1.0);
        let (rotation, translation) = (turn(), DVec3::new(-0.6, 0.3, 2.0));
        let group = TrackGroup {
            poses: vec![TrackPose { time: 0.0, translation, rotation }],
            ..TrackGroup::still("world", pivot)
        };
        let tracks = Tracks { group_of: vec![0; scene.field.len()], groups: vec![group] };
        let moved = Field { tracks: Some(tracks), ..scene.field.clone() };
        let rotation = DMat3::from_quat(rotation);
        let moved_from_still = RigidTransform { rotation, translation: translation - rotation * pivot };
        let mut camera = scene.camera;
        camera.camera_from_world = scene.camera.camera_from_world.compose(&moved_from_still.inverse());

        let reference = |field: &Field, camera| {
            reference::render::<f64>(field, camera, scene.time, &settings(), EVERYTHING).color
        };
        let (before, after) = (reference(&scene.field, &scene.camera), reference(&moved, &camera));
        for (a, b) in before.pixels.iter().flatten().zip(after.pixels.iter().flatten()) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
        let fast =
            Renderer::new(SimdLevel::Auto).render(&moved, &camera, scene.time, &settings(), EVERYTHING).color;
        let off = fast.pixels.iter().flatten().zip(before.pixels.iter().flatten());
        let off = off.filter(|(a, b)| (**a - **b).abs() > 1e-4).count();
        assert!(off < 30, "{off} values differ");
        // The comparison can fail: without the turn of the camera it is another image.
        let other = reference(&moved, &scene.camera);
        assert!(other.pixels != before.pixels);
    }
}

#[test]
#[should_panic(expected = "sampled motion has no gradients")]
fn sampled_tracks_are_not_differentiated() {
    let scene = tracked_scene(None);
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let forward = renderer.forward(&scene.field, &scene.camera, 0.0, &settings(), Some(&scene.labels));
    let mut gradients = cif_render::Gradients::zeros(&scene.field);
    renderer.backward(&scene.field, &forward.color, 0.0, &mut gradients);
}

/// A change of a parameter by a step.
type Change<'a> = &'a dyn Fn(&mut Scene<f64>, f64);

/// Two groups that turn and move, and Gaussians without one.
fn posed_scene(heads: Option<Heads>) -> SyntheticScene {
    let mut scene = generate(&SyntheticConfig { gaussians: 40, screen_size: (0.05, 0.2), ..config(heads) });
    let n = scene.field.len() as u32;
    let pivot = DVec3::new(0.1, -0.2, 0.3);
    let group = |name: &str, angle: f64| TrackGroup {
        deformed: false,
        poses: [(0.0, 0.2), (0.5, 0.9), (1.0, 0.4)]
            .map(|(time, share)| TrackPose {
                time,
                translation: pivot + share * DVec3::new(0.1, 0.05, -0.12),
                rotation: DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -2.0) / 3.0, share * angle),
            })
            .to_vec(),
        ..TrackGroup::still(name, pivot)
    };
    let group_of = (0..n).map(|row| [0, 1, NO_GROUP][row as usize % 3]).collect();
    scene.field.tracks = Some(Tracks { group_of, groups: vec![group("one", 0.8), group("two", -1.1)] });
    scene.field.validate().unwrap();
    scene
}

/// Weights of the loss by which poses are differentiated.
fn weights(scene: &SyntheticScene) -> PixelGrid<[f64; 3]> {
    let (width, height) = (scene.camera.width, scene.camera.height);
    let weight = |k: u32| std::array::from_fn(|c| (f64::from(k) * 0.37 + c as f64).sin());
    PixelGrid::from_pixels(width, height, (0..width * height).map(weight).collect())
}

/// Gradients of the fast path.
fn on_processor(scene: &SyntheticScene, settings: &RenderSettings) -> Gradients {
    let mut renderer = Renderer::new(SimdLevel::Auto);
    renderer.forward(&scene.field, &scene.camera, scene.time, settings, None);
    let mut gradients = Gradients::zeros(&scene.field);
    let v_color = weights(scene).map(|weight| weight.map(|w| w as f32));
    renderer.backward(&scene.field, &v_color, 0.0, &mut gradients);
    gradients
}

/// Those of the GPU, where there is one, with the colours that it draws.
#[cfg(feature = "wgpu")]
fn on_gpu(scene: &SyntheticScene, settings: &RenderSettings) -> Option<(Gradients, Vec<[f32; 4]>)> {
    let mut device = crate::on_gpu::device()?;
    let color = weights(scene);
    let cotangents = crate::support::Cotangents { color, depth: None, alpha: None, instance_weight: 0.0 };
    let seen = crate::on_gpu::run(&mut device, scene, settings, &cotangents, |_| {}).unwrap();
    let [planes, mlp] = seen.deformation.map(|values| values.iter().map(|v| *v as f32).collect());
    let (poses, pose_views) = seen.poses.into_iter().unzip();
    let gaussians = cif_render::wgpu::gaussians::gaussians(&seen.geometry, seen.sh);
    let zeros = Gradients::zeros(&scene.field);
    Some((Gradients { gaussians, planes, mlp, poses, pose_views, ..zeros }, seen.colors))
}

/// Views at keys and between, with and without other Gaussians that deform.
fn posed_views() -> Vec<SyntheticScene> {
    let views = [(None, 0.5), (None, 0.8), (Some(ALL_HEADS), 0.0), (Some(ALL_HEADS), 0.3)];
    views.map(|(heads, time)| SyntheticScene { time, ..posed_scene(heads) }).into()
}

fn colored() -> RenderSettings {
    RenderSettings { sh_degree: 3, ..RenderSettings::default() }
}

#[test]
fn poses_and_their_gaussians_have_the_gradients_of_the_reference() {
    for scene in posed_views() {
        check_gradients(&scene, &on_processor(&scene, &colored()));
    }
}

#[cfg(feature = "wgpu")]
#[test]
fn poses_and_their_gaussians_have_the_gradients_of_the_reference_on_a_gpu() {
    for scene in posed_views() {
        let Some((gradients, colors)) = on_gpu(&scene, &colored()) else { return };
        let forward = render(&Scene::<f64>::from_field(&scene.field), &scene, &colored());
        let mut compared = 0;
        for (position, (found, expected)) in colors.iter().zip(&forward.color.pixels).enumerate() {
            if pixel_discontinuity(&forward, position, 1e-3).is_none() {
                compared += 1;
                let error = (0..3).map(|c| (f64::from(found[c]) - expected[c]).abs()).fold(0.0, f64::max);
                assert!(error < 3e-5, "pixel {position}: {found:?} {expected:?}");
            }
        }
        assert!(compared > 1000, "{compared} pixels are clear of thresholds");
        check_gradients(&scene, &gradients);
        let expected = on_processor(&scene, &colored());
        assert_eq!(gradients.pose_views, expected.pose_views);
        for name in ["turn", "translation"] {
            let part = |pose: &cif_render::PoseGradient| match name {
                "turn" => pose.turn,
                _ => pose.translation,
            };
            let largest = expected.poses.iter().map(|pose| part(pose).length()).fold(0.0, f64::max);
            let differences = gradients.poses.iter().zip(&expected.poses);
            let worst = differences.map(|(a, b)| (part(a) - part(b)).length() / largest).fold(0.0, f64::max);
            eprintln!("{name} at {}: worst error {worst:.1e} of the largest, {largest:.2e}", scene.time);
            assert!(worst < 1e-4, "{name} at {}: {worst:.1e} of the largest", scene.time);
        }
        let again = on_gpu(&scene, &colored()).map(|(gradients, _)| gradients);
        assert!(again.as_ref() == Some(&gradients), "the same on every run");
    }
}

#[cfg(feature = "wgpu")]
#[test]
fn hidden_groups_and_groups_without_poses_are_drawn_on_a_gpu_as_on_the_processor() {
    for (time, views) in [(0.2, 2), (0.7, 0)] {
        let mut scene = SyntheticScene { time, ..posed_scene(None) };
        let tracks = scene.field.tracks.as_mut().unwrap();
        tracks.groups[0].visibility =
            [(0.0, true), (0.5, false)].map(|(time, visible)| VisibilityStep { time, visible }).into();
        tracks.groups[1].poses.clear();
        // One that has no Gaussians.
        tracks.groups.insert(1, TrackGroup { deformed: false, ..TrackGroup::still("none", DVec3::X) });
        tracks.group_of.iter_mut().filter(|group| **group == 1).for_each(|group| *group = 2);
        scene.field.validate().unwrap();
        let Some((gradients, colors)) = on_gpu(&scene, &colored()) else { return };
        let expected = on_processor(&scene, &colored());
        let mut renderer = Renderer::new(SimdLevel::Auto);
        let image = renderer.render(&scene.field, &scene.camera, time, &colored(), Channels::default());
        for (found, expected) in colors.iter().zip(&image.color.pixels) {
            assert!((0..3).all(|c| (found[c] - expected[c]).abs() < 1e-4), "{found:?} {expected:?}");
        }
        assert_eq!(gradients.pose_views, expected.pose_views);
        assert_eq!(gradients.pose_views.iter().sum::<u32>(), views);
    }
}

#[cfg(feature = "wgpu")]
#[test]
fn pictures_of_groups_on_a_gpu_are_those_of_the_processor() {
    let Some(device) = crate::on_gpu::device() else { return };
    let sampled = tracked_scene(Some(ALL_HEADS));
    for scene in posed_views().iter().chain([&sampled]) {
        for settings in [settings(), RenderSettings { deform: false, ..settings() }] {
            let mut renderer = GpuRenderer::compact(&device.0, &scene.field).unwrap();
            let mut expected = Renderer::new(SimdLevel::Auto);
            for time in [scene.time, 0.35] {
                let (field, camera) = (&scene.field, &scene.camera);
                let found = renderer.render(field, camera, time, &settings, EVERYTHING).unwrap();
                let expected = expected.render(field, camera, time, &settings, EVERYTHING);
                let values = found.color.pixels.iter().flatten().zip(expected.color.pixels.iter().flatten());
                let off = values.filter(|(a, b)| (**a - **b).abs() > 1e-4).count();
                assert!(off < 10, "{off} values differ at {time}");
            }
        }
    }
}

/// Gradients by poses, and by the Gaussians of groups, against differences of the reference.
fn check_gradients(scene: &SyntheticScene, gradients: &Gradients) {
    let weights = weights(scene);
    let loss = |double: &Scene<f64>| -> f64 {
        let forward = reference::render::forward(double, &scene.camera, scene.time, &colored(), None);
        let pixels = forward.color.pixels.iter().flatten();
        pixels.zip(weights.pixels.iter().flatten()).map(|(color, weight)| color * weight).sum()
    };
    // By every key that decides the time.
    let difference = |change: &dyn Fn(&mut Scene<f64>, f64)| {
        let at = |step: f64| {
            let mut double = Scene::<f64>::from_field(&scene.field);
            change(&mut double, step);
            loss(&double)
        };
        (at(1e-5) - at(-1e-5)) / 2e-5
    };
    let mut compared = 0;
    for group in 0..2 {
        let keys = scene.field.tracks.as_ref().unwrap().groups[group].keys(scene.time).unwrap();
        for (key, share) in keys.into_iter().filter(|(_, share)| *share > 0.0) {
            let found = gradients.poses[3 * group + key];
            assert_eq!(gradients.pose_views[3 * group + key], 1);
            for axis in 0..3 {
                let mut unit = DVec3::ZERO;
                unit[axis] = 1.0;
                let moved = |double: &mut Scene<f64>, step: f64| {
                    let pose = &mut double.tracks.as_mut().unwrap().groups[group].poses[key];
                    pose.translation += step * unit;
                };
                let expected = difference(&moved);
                let actual = found.translation[axis];
                assert!((actual - expected).abs() < 2e-3 * (1.0 + expected.abs()), "{actual} {expected}");
                // Spherical interpolation is not linear in its ends.
                if share == 1.0 {
                    let turned = |double: &mut Scene<f64>, step: f64| {
                        let pose = &mut double.tracks.as_mut().unwrap().groups[group].poses[key];
                        pose.rotation *= DQuat::from_scaled_axis(step * unit);
                    };
                    let expected = difference(&turned);
                    let actual = found.turn[axis];
                    assert!((actual - expected).abs() < 2e-3 * (1.0 + expected.abs()), "{actual} {expected}");
                }
                compared += 1;
            }
        }
    }
    assert!(compared >= 6);
    let g = &gradients.gaussians;
    for row in (0..scene.field.len()).filter(|row| row % 3 < 2) {
        for k in 0..4 {
            let cases: [(f32, Change<'_>); 3] = [
                (g.means[row][k % 3], &|double, step| {
                    double.parameters.gaussians[row].mean[k % 3] += step;
                }),
                (g.quaternions[row][k], &|double, step| {
                    double.parameters.gaussians[row].quaternion[k] += step;
                }),
                (g.sh_coefficients[row][3 + 7 * k], &|double, step| {
                    double.parameters.gaussians[row].sh[3 + 7 * k] += step;
                }),
            ];
            for (actual, change) in cases {
                let expected = difference(change);
                let error = (f64::from(actual) - expected).abs();
                assert!(error < 2e-3 * (1.0 + expected.abs()), "row {row}, {k}: {actual} {expected}");
            }
        }
    }
}
