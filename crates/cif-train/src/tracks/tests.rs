use cif_geometry::RigidTransform;
use glam::DMat3;

use super::*;

/// A camera 1 m above the ground and 2 m away that looks at the origin from an angle.
pub(super) fn camera(angle: f64) -> PinholeCamera {
    let centre = DVec3::new(2.0 * angle.sin(), -2.0 * angle.cos(), 1.0);
    let forward = (-centre).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    PinholeCamera {
        width: 256,
        height: 192,
        focal_px: DVec2::splat(300.0),
        principal_px: DVec2::new(128.0, 96.0),
        camera_from_world: RigidTransform { rotation, translation: -(rotation * centre) },
    }
}

const RADIUS: f64 = 0.06;

/// A ball that rolls on the ground, z = 0, past a slowly moving camera.
fn observe(steps: usize, centre: impl Fn(f64) -> DVec3, contacts: bool) -> Vec<Observation> {
    (0..steps)
        .map(|k| {
            let time = k as f64 / (steps - 1) as f64;
            let camera = camera(0.5 * time - 0.2);
            let (pixel, depth) = camera.project(centre(time)).unwrap();
            let below = camera.camera_from_world.apply(centre(time) - DVec3::Z * RADIUS).z;
            Observation {
                time_index: k,
                camera,
                centroid_px: pixel + DVec2::new((k as f64 * 1.7).sin(), (k as f64 * 2.9).cos()) * 0.3,
                area_px: std::f64::consts::PI
                    * (RADIUS * 300.0 / depth).powi(2)
                    * (1.0 + 0.02 * (k as f64).sin()),
                cut: [false; 2],
                contact_depth: contacts.then_some(below * (1.0 + 0.01 * (k as f64 * 0.8).cos())),
            }
        })
        .collect()
}

fn rolling(time: f64) -> DVec3 {
    DVec3::new(0.5 - time, 0.3 * (3.0 * time).sin(), RADIUS)
}

/// Largest difference of the path's shape from the truth, metres: a common offset does not count.
fn error(track: &Track, steps: usize, truth: impl Fn(f64) -> DVec3) -> f64 {
    let times: Vec<f64> = (0..steps).map(|k| k as f64 / (steps - 1) as f64).collect();
    let off: Vec<DVec3> = times.iter().map(|time| track.at(&times, *time) - truth(*time)).collect();
    let mean = off.iter().sum::<DVec3>() / steps as f64;
    off.iter().map(|off| (*off - mean).length()).fold(0.0, f64::max)
}

/// A ball as the border of an image shows it that leaves what is above a row.
fn cut_below(whole: &Observation, row: f64) -> Observation {
    let (side, radius) = (60, whole.radius_px());
    let offset =
        |k: usize| DVec2::new((k % side) as f64, (k / side) as f64) / (0.5 * (side - 1) as f64) - 1.0;
    let disc: Vec<DVec2> = (0..side * side).map(offset).filter(|offset| offset.length() < 1.0).collect();
    let places = disc.iter().map(|offset| whole.centroid_px + radius * *offset);
    let left: Vec<DVec2> = places.filter(|pixel| pixel.y < row).collect();
    let centroid_px = left.iter().sum::<DVec2>() / left.len() as f64;
    let area_px = whole.area_px * left.len() as f64 / disc.len() as f64;
    Observation { centroid_px, area_px, cut: [false, true], ..*whole }
}

#[test]
fn what_the_border_cuts_does_not_travel_because_its_middle_moves() {
    // It stands still while more and more of it comes into the image, and goes again.
    let still = DVec3::new(0.2, 0.1, RADIUS);
    let seen = observe(40, |_| still, true);
    let row = |(k, o): (usize, &Observation)| o.centroid_px.y - 0.8 * o.radius_px() * (k as f64 * 0.3).cos();
    let cut: Vec<Observation> = seen.iter().enumerate().map(|at| cut_below(at.1, row(at))).collect();
    assert!(!travels(&cut));
    let mut whole = cut.clone();
    whole.iter_mut().for_each(|o| o.cut = [false; 2]);
    assert!(travels(&whole), "in masks that the border does not cut, it would");
    let rolls = observe(40, rolling, true);
    let cut: Vec<Observation> = rolls.iter().map(|o| cut_below(o, o.centroid_px.y)).collect();
    assert!(travels(&cut));
}

#[test]
fn a_rolling_ball_is_followed_by_one_moving_camera() {
    let seen = observe(40, rolling, true);
    assert!(travels(&seen));
    let track = fit(&seen).unwrap();
    let error = error(&track, 40, rolling);
    assert!(error < 0.03, "{error}");
    assert!((track.radius - RADIUS).abs() < 0.005, "{}", track.radius);
}

#[test]
fn what_stands_still_does_not_travel() {
    let still = DVec3::new(0.2, 0.1, RADIUS);
    let seen = observe(40, |_| still, true);
    assert!(!travels(&seen));
    assert!(error(&fit(&seen).unwrap(), 40, |_| still) < 0.01);
    assert!(!travels(&seen[..3]) && fit(&seen[..3]).is_none(), "too little is seen");
}

#[test]
fn wrong_masks_do_not_pull_the_path_away() {
    let mut seen = observe(40, rolling, true);
    for k in [8, 9, 23] {
        // Another object's mask.
        seen[k].centroid_px = DVec2::new(40.0, 150.0);
        seen[k].area_px *= 6.0;
        seen[k].contact_depth = Some(1.2);
    }
    for k in 15..20 {
        // Half hidden.
        (seen[k].area_px, seen[k].contact_depth) = (seen[k].area_px * 0.5, None);
    }
    let error = error(&fit(&seen).unwrap(), 40, rolling);
    assert!(error < 0.03, "{error}");
}

#[test]
fn without_contacts_many_directions_at_a_time_suffice() {
    let fly = |time: f64| DVec3::new(0.3 - 0.6 * time, 0.0, 0.2 + 0.5 * time);
    let mut seen = Vec::new();
    for time_index in 0..20 {
        for view in 0..3 {
            let camera = camera(f64::from(view) - 1.0);
            let (centroid_px, depth) = camera.project(fly(time_index as f64 / 19.0)).unwrap();
            let area_px = std::f64::consts::PI * (RADIUS * 300.0 / depth).powi(2);
            seen.push(Observation {
                time_index,
                camera,
                centroid_px,
                area_px,
                cut: [false; 2],
                contact_depth: None,
            });
        }
    }
    assert!(travels(&seen));
    let error = error(&fit(&seen).unwrap(), 20, fly);
    assert!(error < 0.01, "{error}");
}

#[test]
fn paths_rest_before_and_after_and_are_straight_between() {
    let track = Track {
        time_indices: vec![1, 3],
        centres: vec![DVec3::ZERO, DVec3::new(2.0, 4.0, 0.0)],
        radius: 1.0,
    };
    let times = [0.0, 0.25, 0.5, 0.75, 1.0];
    assert_eq!(track.at(&times, 0.1), DVec3::ZERO);
    assert_eq!(track.at(&times, 0.5), DVec3::new(1.0, 2.0, 0.0));
    assert_eq!(track.at(&times, 1.0), DVec3::new(2.0, 4.0, 0.0));
}

#[test]
fn band_systems_are_solved() {
    let expected: Vec<f64> = (0..15).map(|k| (f64::from(k) * 1.3).sin()).collect();
    let at = |j: usize| DVec3::from_slice(&expected[3 * j..]);
    let mut system = Banded::zeros(15);
    for j in 0..5 {
        for axis in DVec3::AXES {
            system.add(&[(j, axis)], axis.dot(at(j)), 1.0 + j as f64);
        }
    }
    for j in 0..3 {
        let rows = [DVec3::new(1.0, -2.0, 0.5), DVec3::new(0.3, 1.0, 2.0), DVec3::new(-1.0, 0.2, 0.7)];
        let value = (0..3).map(|k| rows[k].dot(at(j + k))).sum();
        system.add(&[(j, rows[0]), (j + 1, rows[1]), (j + 2, rows[2])], value, 3.0);
    }
    for (found, expected) in system.solve().unwrap().iter().zip(&expected) {
        assert!((found - expected).abs() < 1e-12);
    }
    assert!(Banded::zeros(3).solve().is_none());
}
