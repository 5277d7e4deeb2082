//! Solids whose motion is known, as cameras see them, for tests.

use std::collections::BTreeMap;
use std::sync::Arc;

use cif_field::tracks::{TrackGroup, TrackPose, Tracks};
use cif_field::{Field, Gaussians};
use cif_geometry::{PinholeCamera, PixelGrid, RigidTransform};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings, synthetic};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rand::RngExt;

use super::object::{Object, Surroundings};
use super::order::Order;
use super::outline::Outline;
use super::outlines;
use super::plane::Plane;
use super::view::{ObjectView, set_visible};
use crate::frames::TrainFrame;
use crate::mask_table::MaskTable;
use crate::phases::Phases;
use crate::random::{Purpose, stream};

pub(super) const TIMES: usize = 30;
pub(super) const FLOOR: Plane = Plane { normal: DVec3::Z, offset: 0.0 };

/// Cameras by time.
pub(super) type Cameras = fn(usize) -> Vec<PinholeCamera>;

/// One camera, on an arc above the floor.
pub(super) fn moving(time: usize) -> Vec<PinholeCamera> {
    vec![camera(0.5 + 0.9 * time as f64 / TIMES as f64)]
}

/// Five cameras that stay in place.
pub(super) fn rig(_: usize) -> Vec<PinholeCamera> {
    [0.0, 1.2, 2.5, 3.7, 5.0].map(camera).to_vec()
}

/// One camera that looks from another side at every time.
pub(super) fn jumping(time: usize) -> Vec<PinholeCamera> {
    vec![camera(2.4 * time as f64)]
}

/// A camera above the floor, which looks at its origin.
pub(super) fn camera(angle: f64) -> PinholeCamera {
    let centre = DVec3::new(1.1 * angle.sin(), -1.1 * angle.cos(), 0.8);
    let forward = (DVec3::new(0.0, 0.0, 0.05) - centre).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    PinholeCamera {
        width: 160,
        height: 120,
        focal_px: DVec2::splat(330.0),
        principal_px: DVec2::new(80.0, 60.0),
        camera_from_world: RigidTransform { rotation, translation: -(rotation * centre) },
    }
}

/// Opaque Gaussians at places around the origin, in colours of these places.
pub(super) fn solid(places: &[DVec3], color: impl Fn(DVec3) -> [f32; 3], size: f32) -> Gaussians {
    let means: Vec<[f32; 3]> = places.iter().map(|p| p.to_array().map(|v| v as f32)).collect();
    let colors: Vec<[f32; 3]> = places.iter().map(|p| color(*p)).collect();
    let mut gaussians = Gaussians::from_points(&means, &colors).unwrap();
    gaussians.log_scales.fill([size.ln(); 3]);
    gaussians.opacity_logits.fill(4.0);
    gaussians
}

/// Views of a solid on its way.
pub(super) fn views(gaussians: Gaussians, poses: &[(DQuat, DVec3)], cameras: Cameras) -> Vec<ObjectView> {
    let group_of = vec![0; gaussians.len()];
    views_of_groups(gaussians, group_of, &[poses.to_vec()], cameras)
}

/// Views of Gaussians in groups, each on its way.
pub(super) fn views_of_groups(
    gaussians: Gaussians,
    group_of: Vec<u32>,
    poses: &[Vec<(DQuat, DVec3)>],
    cameras: Cameras,
) -> Vec<ObjectView> {
    views_in_masks(gaussians, group_of, poses, cameras, |labels| labels)
}

/// The same in masks that are not exact.
pub(super) fn views_in_masks(
    gaussians: Gaussians,
    group_of: Vec<u32>,
    poses: &[Vec<(DQuat, DVec3)>],
    cameras: Cameras,
    mut masks: impl FnMut(PixelGrid<u16>) -> PixelGrid<u16>,
) -> Vec<ObjectView> {
    let time = |k: usize| k as f64 / (TIMES - 1) as f64;
    let group = |poses: &Vec<(DQuat, DVec3)>| {
        let poses = poses.iter().enumerate().map(|(k, (rotation, translation))| TrackPose {
            time: time(k),
            translation: *translation,
            rotation: *rotation,
        });
        TrackGroup { deformed: false, poses: poses.collect(), ..TrackGroup::still("solid", DVec3::ZERO) }
    };
    let groups = poses.iter().map(group).collect();
    let scene = synthetic::generate(&synthetic::SyntheticConfig::default()).field;
    let field = Field {
        gaussians,
        identities: None,
        deformation: None,
        tracks: Some(Tracks { group_of, groups }),
        ..scene
    };
    let settings = RenderSettings { sh_degree: 0, background: [0.6, 0.6, 0.55], ..RenderSettings::default() };
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let object = Order::among(&[], 2).of_label(1);
    let mut views = Vec::new();
    for (k, camera) in (0..TIMES).flat_map(|k| cameras(k).into_iter().map(move |camera| (k, camera))) {
        let channels = Channels { depth: false, instances: false };
        let image = renderer.render(&field, &camera, time(k), &settings, channels);
        let labels = masks(image.alpha.map(|alpha| u16::from(*alpha > 0.5)));
        let bytes = image.color.map(|c| c.map(|c| (255.0 * c.clamp(0.0, 1.0)).round() as u8));
        let table = MaskTable::of(&labels);
        let frame = Arc::new(TrainFrame { image: bytes, labels: Some(labels), labelled: 0, features: None });
        views.extend(ObjectView::new(&object, k, &camera, &frame, 1, &table));
    }
    set_visible(&mut views);
    views
}

/// The object of some views, by the outlines that it may have, with facts about its surroundings.
pub(super) fn with_objects<T>(
    plane: Option<&Plane>,
    views: &[ObjectView],
    act: impl FnOnce(&[Object<'_>]) -> T,
) -> T {
    let outlines = outlines::outlines(views, plane, TIMES);
    let phases = Phases::default();
    let order = Order::among(&[], 2);
    let surroundings = Surroundings {
        plane,
        up: DVec3::Z,
        order: &order,
        times: TIMES,
        near: 0.05,
        seed: 0,
        gaussians: 150,
        phases: &phases,
    };
    act(&Object::by_outlines(1, views, &outlines, false, surroundings))
}

/// The outline of an object of this height and radius, and roundness, which stays on its support along a path.
pub(super) fn shaped(height: f64, radius: f64, roundness: f64, path: BTreeMap<usize, DVec3>) -> Outline {
    Outline {
        height,
        radius,
        roundness,
        path,
        air: Vec::new(),
        stiffness: 1.0,
        is_surrounded: false,
        held: Vec::new(),
        guessed: Vec::new(),
        is_resort: false,
    }
}

/// Patches of colour.
pub(super) fn patches(p: DVec3) -> [f32; 3] {
    let cell = (p * 40.0).floor();
    std::array::from_fn(|k| {
        let wave = (cell.x * (2.1 + k as f64) + cell.y * 3.7 + cell.z * (5.3 - k as f64)).sin();
        (0.5 + 0.45 * wave) as f32
    })
}

/// Places on the sides of a box around the origin, by half its extents.
pub(super) fn sides(half: DVec3, seed: u64) -> Vec<DVec3> {
    let mut rng = stream(0, Purpose::Objects, seed);
    (0..1500)
        .map(|k| {
            let mut p = DVec3::from(std::array::from_fn(|_| 2.0 * rng.random::<f64>() - 1.0));
            p[k % 3] = if (k / 3) % 2 == 0 { 1.0 } else { -1.0 };
            half * p
        })
        .collect()
}

pub(super) fn sphere_places(radius: f64) -> Vec<DVec3> {
    let mut rng = stream(0, Purpose::Objects, 10);
    (0..1200)
        .map(|_| {
            let z = 2.0 * rng.random::<f64>() - 1.0;
            let angle = std::f64::consts::TAU * rng.random::<f64>();
            let flat = (1.0 - z * z).sqrt();
            radius * DVec3::new(flat * angle.cos(), flat * angle.sin(), z)
        })
        .collect()
}
