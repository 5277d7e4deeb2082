//! Paths of cameras that no capture has, one view per captured time.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::str::FromStr;

use cif_field::Field;
use cif_geometry::{PinholeCamera, RigidTransform};
use cif_scene::from_field::camera_tracks::camera_tracks;
use cif_scene::{CameraTrack, LabelPattern, SceneGraph, SceneOptions, UpAxis};
use cif_web::describe::up;
use glam::{DMat3, DVec2, DVec3};

use super::shot::Shot;
use crate::camera_file::View;
use crate::error::Error;

/// Seconds of a film of a scene that has one time.
const SECONDS_OF_STILLS: f64 = 5.0;

/// Least arc of an orbit, radians: 30 degrees.
const LEAST_ARC: f64 = PI / 6.0;

/// A path.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Flight {
    /// Around the objects, where recorded cameras have been.
    Orbit,
    /// As the first recorded camera, but along with an object.
    Follow(String),
    /// Through the recorded cameras.
    Cameras,
}

impl FromStr for Flight {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(':') {
            Some(("follow", label)) if !label.is_empty() => Ok(Self::Follow(label.to_owned())),
            None if text == "orbit" => Ok(Self::Orbit),
            None if text == "cameras" => Ok(Self::Cameras),
            _ => Err("orbit, follow:LABEL or cameras is expected".to_owned()),
        }
    }
}

/// Width and height of pictures, as in `1280x720`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size(u32, u32);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parse = |part: &str| part.trim().parse::<u32>().ok();
        let sides = text.split_once(['x', 'X']).and_then(|(w, h)| parse(w).zip(parse(h)));
        let (width, height) = sides.ok_or("WIDTHxHEIGHT is expected, as in 1280x720")?;
        cif_geometry::camera::check_image_size(width, height)?;
        Ok(Self(width, height))
    }
}

/// Views along a path, and how many of them there are per second.
pub(super) struct Film {
    pub(super) shots: Vec<Shot>,
    pub(super) per_second: f64,
}

/// The views of a path over all captured times; a scene of one time is shown for some seconds.
///
/// # Errors
/// When the scene records no cameras, or no object carries the label.
pub(super) fn film(field: &Field, flight: &Flight, size: Option<Size>, place: &str) -> Result<Film, Error> {
    let tracks = camera_tracks(&field.cameras, |index| field.timeline.times.get(index).copied(), |_| 0.0);
    if tracks.is_empty() {
        return Err(Error::failed(
            format!("{place} records no cameras, from which a path could start"),
            "give the views in a file: --camera views.json",
        ));
    }
    let per_second = field.timeline.frames_per_second;
    let stills = ((SECONDS_OF_STILLS * per_second).round() as usize).max(2);
    let times = match field.timeline.times.as_slice() {
        [only] => vec![*only; stills],
        several => several.to_vec(),
    };
    let camera: Box<dyn Fn(f64, f64) -> PinholeCamera> = match flight {
        Flight::Cameras => Box::new(|time, share| between(&tracks, time, share)),
        Flight::Orbit => orbit(field, &tracks),
        Flight::Follow(label) => follow(field, &tracks[0], label, place)?,
    };
    let last = (times.len() - 1) as f64;
    let shots = times.iter().enumerate().map(|(index, time)| {
        let camera = resized(camera(*time, index as f64 / last), size);
        let view = View { name: format!("{index:04}"), time: Some(*time), camera };
        Shot { view, camera: String::new() }
    });
    Ok(Film { shots: shots.collect(), per_second })
}

/// A camera on its track, between the views before and after.
fn at(track: &CameraTrack, time: f64) -> PinholeCamera {
    let after = track.samples.partition_point(|sample| sample.time_code <= time);
    let (a, b) = (&track.samples[after.max(1) - 1], &track.samples[after.min(track.samples.len() - 1)]);
    if b.time_code <= a.time_code {
        return a.camera;
    }
    a.camera.toward(&b.camera, ((time - a.time_code) / (b.time_code - a.time_code)).clamp(0.0, 1.0))
}

/// A camera between those of all tracks at a share of the film; along the only one over time.
fn between(tracks: &[CameraTrack], time: f64, share: f64) -> PinholeCamera {
    let along = share * (tracks.len() - 1) as f64;
    let first = (along.floor() as usize).min(tracks.len() - 1);
    let Some(second) = tracks.get(first + 1) else { return at(&tracks[first], time) };
    at(&tracks[first], time).toward(&at(second, time), along - first as f64)
}

/// The upward direction of a scene.
fn up_of(field: &Field) -> DVec3 {
    let axis = field.record.declared.map_or(UpAxis::Z, |declared| declared.up_axis);
    DVec3::from_array(up(axis, field.cameras.iter().map(|recorded| &recorded.camera)))
}

/// The middle of the objects at rest, or of everything where there are none: medians, so that strays do not count.
fn middle(field: &Field) -> DVec3 {
    let shares = field.identities.as_ref().map(cif_field::Identities::labelled_shares).unwrap_or_default();
    let is_object = |index: usize| shares.get(index).is_some_and(|share| *share > 0.5);
    let means = &field.gaussians.means;
    let mut chosen: Vec<[f32; 3]> =
        means.iter().enumerate().filter(|(index, _)| is_object(*index)).map(|(_, mean)| *mean).collect();
    if chosen.is_empty() {
        chosen.clone_from(means);
    }
    let median = |axis: usize| {
        let mut values: Vec<f32> = chosen.iter().map(|mean| mean[axis]).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().map_or(0.0, f64::from)
    };
    DVec3::new(median(0), median(1), median(2))
}

/// Around the middle of the objects: a full turn where recorded cameras stand all around them, else to and fro over the
/// arc on which they stand, as nothing is known of what lies behind.
fn orbit(field: &Field, tracks: &[CameraTrack]) -> Box<dyn Fn(f64, f64) -> PinholeCamera> {
    let (up, centre) = (up_of(field), middle(field));
    let first = tracks[0].samples[0].camera;
    let ahead = up.any_orthonormal_vector();
    let aside = up.cross(ahead);
    let places: Vec<DVec3> = field.cameras.iter().map(|recorded| recorded.camera.centre() - centre).collect();
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let height = median(places.iter().map(|place| place.dot(up)).collect());
    let radius = median(places.iter().map(|place| place.reject_from(up).length()).collect());
    let mut angles: Vec<f64> =
        places.iter().map(|place| place.dot(aside).atan2(place.dot(ahead)).rem_euclid(TAU)).collect();
    angles.sort_by(f64::total_cmp);
    let (gap, start) = widest_gap(&angles);
    let arc = (TAU - gap).max(LEAST_ARC);
    let start = start - (arc - (TAU - gap)) / 2.0;
    Box::new(move |_, share| {
        let angle = match gap < FRAC_PI_2 {
            true => start + TAU * share,
            false => start + arc * (1.0 - (TAU * share).cos()) / 2.0,
        };
        let place = centre + radius * (angle.cos() * ahead + angle.sin() * aside) + height * up;
        looking(&first, place, centre, up)
    })
}

/// The widest gap between ascending angles on a circle, and the angle that ends it.
fn widest_gap(angles: &[f64]) -> (f64, f64) {
    let wrapped = angles.first().map(|first| first + TAU);
    let pairs = angles.iter().zip(angles.iter().skip(1).copied().chain(wrapped));
    let gaps = pairs.map(|(a, b)| (b - a, b));
    gaps.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((TAU, 0.0))
}

/// As the first view of a camera, but moving along with an object and turned to it.
fn follow(
    field: &Field,
    track: &CameraTrack,
    label: &str,
    place: &str,
) -> Result<Box<dyn Fn(f64, f64) -> PinholeCamera>, Error> {
    let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
    let graph: SceneGraph = cif_scene::build(field, &options).map_err(Error::plain)?;
    let pattern = LabelPattern::new(label);
    let node = graph.nodes.iter().find(|node| pattern.matches(&node.label) || pattern.matches(&node.name));
    let Some(node) = node else {
        let known = graph.nodes.iter().map(|node| node.label.clone()).collect();
        let query = cif_scene::LabelQuery { pattern: label.to_owned(), time_code: None };
        return Err(Error::plain(query.unknown(place, known)));
    };
    let boxes = node.boxes();
    let path: Vec<(f64, DVec3)> = graph
        .time_codes
        .times
        .iter()
        .zip(&graph.time_codes.samples)
        .map(|(time, code)| (*time, boxes.world(*code).centre()))
        .collect();
    let first = track.samples[0].camera;
    let (up, offset) = (up_of(field), first.centre() - path[0].1);
    Ok(Box::new(move |time, _| {
        let after = path.partition_point(|(known, _)| *known <= time);
        let object = path[after.max(1) - 1].1;
        looking(&first, object + offset, object, up)
    }))
}

/// A camera with the lens of another, at a place, turned to a point.
fn looking(lens: &PinholeCamera, place: DVec3, point: DVec3, up: DVec3) -> PinholeCamera {
    let forward = (point - place).try_normalize().unwrap_or(DVec3::Z);
    let right = forward.cross(up).try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
    let world_from_camera = RigidTransform {
        rotation: DMat3::from_cols(right, forward.cross(right), forward),
        translation: place,
    };
    PinholeCamera { camera_from_world: world_from_camera.inverse(), ..*lens }
}

/// A camera with pictures of another size and the vertical field of view that it has.
fn resized(camera: PinholeCamera, size: Option<Size>) -> PinholeCamera {
    let Some(Size(width, height)) = size else { return camera };
    let scale = f64::from(height) / f64::from(camera.height);
    let middle = DVec2::new(f64::from(camera.width), f64::from(camera.height)) / 2.0;
    PinholeCamera {
        width,
        height,
        focal_px: camera.focal_px * scale,
        principal_px: (camera.principal_px - middle) * scale
            + DVec2::new(f64::from(width), f64::from(height)) / 2.0,
        ..camera
    }
}

#[cfg(test)]
mod tests {
    use cif_field::RecordedCamera;
    use cif_render::synthetic::{SyntheticConfig, generate};

    use super::*;

    /// A field seen by cameras that stand around its objects at these angles, degrees, 2 units away and 1 above.
    fn seen_from(angles: &[f64]) -> Field {
        let config = SyntheticConfig { gaussians: 60, instances: 2, ..SyntheticConfig::default() };
        let mut field = generate(&config).field;
        let (centre, lens) = (middle(&field), generate(&config).camera);
        let camera = |(index, angle): (usize, &f64)| {
            let (sine, cosine) = angle.to_radians().sin_cos();
            let place = centre + DVec3::new(2.0 * cosine, 2.0 * sine, 1.0);
            let camera = looking(&lens, place, centre, DVec3::Z);
            RecordedCamera { name: format!("cam{index}"), time_index: 0, trained: true, camera }
        };
        field.cameras = angles.iter().enumerate().map(camera).collect();
        field
    }

    fn flight(field: &Field, path: &str) -> Vec<PinholeCamera> {
        let film = film(field, &path.parse().unwrap(), None, "scene.cif");
        film.unwrap_or_else(|error| panic!("{error}")).shots.iter().map(|shot| shot.view.camera).collect()
    }

    /// Angles about the objects, degrees.
    fn angles(field: &Field, cameras: &[PinholeCamera]) -> Vec<f64> {
        let centre = middle(field);
        let angle = |camera: &PinholeCamera| {
            let place = camera.centre() - centre;
            place.y.atan2(place.x).to_degrees()
        };
        cameras.iter().map(angle).collect()
    }

    #[test]
    fn orbits_stay_where_cameras_have_been() {
        let field = seen_from(&[10.0, 40.0, 80.0]);
        let cameras = flight(&field, "orbit");
        let angles = angles(&field, &cameras);
        let range = angles.iter().fold((f64::MAX, f64::MIN), |(low, high), a| (low.min(*a), high.max(*a)));
        assert!((range.0 - 10.0).abs() < 0.5 && (range.1 - 80.0).abs() < 0.5, "{range:?}");
        assert!(
            (angles[0] - angles[angles.len() - 1]).abs() < 1e-6,
            "a film that is played again does not jump"
        );
        for camera in &cameras {
            let seen = camera.camera_from_world.apply(middle(&field));
            assert!(seen.x.abs() < 1e-9 && seen.y.abs() < 1e-9 && seen.z > 0.0, "{seen}");
            let distance = (camera.centre() - middle(&field)).length();
            assert!((distance - 5.0_f64.sqrt()).abs() < 1e-9, "{distance}");
        }
    }

    #[test]
    fn orbits_go_around_where_cameras_stand_all_around() {
        let field = seen_from(&[0.0, 80.0, 160.0, 240.0, 320.0]);
        let angles = angles(&field, &flight(&field, "orbit"));
        let turned: f64 = angles.windows(2).map(|pair| (pair[1] - pair[0]).rem_euclid(360.0)).sum();
        assert!((turned - 360.0).abs() < 1e-6, "{turned}");
    }

    #[test]
    fn flights_pass_through_the_recorded_cameras() {
        let field = seen_from(&[0.0, 20.0, 50.0]);
        let cameras = flight(&field, "cameras");
        for recorded in &field.cameras {
            let place = recorded.camera.centre();
            let nearest = cameras.iter().map(|camera| camera.centre().distance(place));
            assert!(nearest.fold(f64::MAX, f64::min) < 0.05, "{}", recorded.name);
        }
    }

    #[test]
    fn an_object_that_is_followed_stays_in_the_middle() {
        let field = seen_from(&[0.0]);
        let label = field.instances[1].label.clone();
        let cameras = flight(&field, &format!("follow:{label}"));
        let graph = cif_scene::build(&field, &SceneOptions::default()).unwrap();
        let node = graph.nodes.iter().find(|node| node.label == label).unwrap();
        let codes = &graph.time_codes.samples;
        assert!(codes.len() < 2 || cameras.len() == codes.len());
        let place = node.boxes().world(codes[0]).centre();
        let seen = cameras[0].camera_from_world.apply(place);
        assert!(seen.x.abs() < 1e-9 && seen.y.abs() < 1e-9 && seen.z > 0.0, "{seen}");
        let error = film(&field, &Flight::Follow("teapot".into()), None, "scene.cif").err().unwrap();
        assert!(error.to_string().contains("no object is labelled 'teapot'"), "{error}");
        let unseen = Field { cameras: Vec::new(), ..field };
        let error = film(&unseen, &Flight::Orbit, None, "scene.cif").err().unwrap();
        assert!(error.to_string().contains("records no cameras"), "{error}");
    }

    #[test]
    fn sizes_keep_the_vertical_view() {
        let field = seen_from(&[0.0]);
        let size = "200x100".parse().unwrap();
        let film = film(&field, &Flight::Cameras, Some(size), "scene.cif").map_err(|error| error.to_string());
        let camera = film.unwrap().shots[0].view.camera;
        let recorded = field.cameras[0].camera;
        assert_eq!((camera.width, camera.height), (200, 100));
        let of = |camera: &PinholeCamera| camera.focal_px.y / f64::from(camera.height);
        assert!((of(&camera) - of(&recorded)).abs() < 1e-12);
        for wrong in ["200", "0x5", "x", "99999x99999"] {
            assert!(wrong.parse::<Size>().is_err(), "{wrong}");
        }
        for wrong in ["spiral", "follow:", "orbit:1"] {
            assert!(wrong.parse::<Flight>().is_err(), "{wrong}");
        }
    }
}
