//! An origin near the scene, for files that place it far from that of their coordinates: on a map, or on the earth.
//!
//! Splats are kept in single precision, which there is too coarse. The origin is taken off in double precision before
//! anything is rounded, and recorded as the [`CaptureFrame`] of the scene, by which exports put it back.

use cif_geometry::Bounds;
use glam::DVec3;

use super::{Placement, Prim, Track};
use crate::{CameraTrack, CaptureFrame};

/// Distance between neighbouring numbers of single precision from which on coordinates count as coarse, metres: a
/// quarter of a millimetre, so that a few roundings stay inside one. It is reached 2 km from the origin.
const COARSE_METERS: f64 = 2.5e-4;

/// The origin that coordinates inside a box want, whole units, named in a warning; `None` where single precision holds
/// them, or where the box is as large as it is far away.
pub fn origin_of(bounds: &Bounds, meters_per_unit: f64, warnings: &mut Vec<String>) -> Option<DVec3> {
    let corners = [bounds.low, bounds.high];
    if bounds.is_empty() || !corners.iter().all(|corner| corner.is_finite()) {
        return None;
    }
    let farthest = corners.map(|corner| corner.abs().max_element()).into_iter().fold(0.0, f64::max);
    let is_coarse = farthest * f64::from(f32::EPSILON) * meters_per_unit > COARSE_METERS;
    let middle = (bounds.low + bounds.high) / 2.0;
    if !is_coarse || middle.abs().max_element() <= bounds.size().max_element() {
        return None;
    }
    let origin = middle.round();
    let DVec3 { x, y, z } = origin;
    warnings.push(format!(
        "its coordinates are far from their origin: the scene has one of its own at ({x}, {y}, {z}), which exports \
         and queries add again"
    ));
    Some(origin)
}

/// Takes an origin off prims and cameras that are far from that of their file.
pub(super) fn take_off(
    prims: &mut [Prim],
    cameras: &mut [CameraTrack],
    meters_per_unit: f64,
    warnings: &mut Vec<String>,
) -> CaptureFrame {
    let mut bounds = Bounds::EMPTY;
    for prim in prims.iter_mut() {
        let own = own_box(prim);
        if origin_of(&own, meters_per_unit, &mut Vec::new()).is_some() {
            move_frame(prim, own.centre());
        }
        let reach = own.size() / 2.0;
        for pose in poses(&prim.track) {
            bounds = bounds.including(pose - reach).including(pose + reach);
        }
    }
    let Some(origin) = origin_of(&bounds, meters_per_unit, warnings) else { return CaptureFrame::default() };
    for prim in prims {
        shift(&mut prim.track, -origin);
        prim.pivot = prim.pivot.map(|pivot| pivot - origin);
    }
    let frame = CaptureFrame { offset: origin.to_array(), ..CaptureFrame::default() };
    for sample in cameras.iter_mut().flat_map(|track| &mut track.samples) {
        sample.camera = frame.camera(&sample.camera);
    }
    frame
}

fn poses(track: &Track) -> impl Iterator<Item = DVec3> {
    let rest = track.samples.is_empty().then_some(track.rest.translation);
    track.samples.iter().map(|sample| sample.translation).chain(rest)
}

fn shift(track: &mut Track, by: DVec3) {
    track.samples.iter_mut().chain([&mut track.rest]).for_each(|pose| pose.translation += by);
}

/// Box of the centres of an object in its frame, at first.
fn own_box(prim: &Prim) -> Bounds {
    let code = prim.shape_codes.first().copied().unwrap_or(0.0);
    prim.pieces.iter().fold(Bounds::EMPTY, |bounds, piece| {
        let map = piece.placement.at(code);
        let means = piece.splats.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from)));
        bounds.union(Bounds::around(means.map(|mean| map.transform_point3(mean))))
    })
}

/// Moves the frame of an object to a place in it, so that what is in it is near.
fn move_frame(prim: &mut Prim, place: DVec3) {
    for pose in prim.track.samples.iter_mut().chain([&mut prim.track.rest]) {
        pose.translation += pose.rotation * place;
    }
    prim.pivot = None;
    for piece in &mut prim.pieces {
        match &mut piece.placement {
            Placement::Rigid { track, baked } => {
                // What is baked into splats is rounded with them, so that it must not lead far away.
                let far = baked.as_mut().map(|map| std::mem::take(&mut map.translation)).unwrap_or_default();
                for pose in track.samples.iter_mut().chain([&mut track.rest]) {
                    pose.translation += pose.rotation * far;
                }
                shift(track, -place);
            }
            Placement::Sampled(maps) => maps.iter_mut().for_each(|(_, map)| map.translation -= place),
        }
        piece.pivot = piece.pivot.map(|pivot| pivot - place);
    }
    for point in
        prim.colliders.iter_mut().filter(|hull| hull.part.is_none()).flat_map(|hull| &mut hull.points)
    {
        *point = (DVec3::from_array(point.map(f64::from)) - place).as_vec3().to_array();
    }
}
