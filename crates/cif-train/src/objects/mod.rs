//! Poses of rigid objects, from masks and colours, before the scene's motion is trained. Source: methods reference of
//! motion, 4.
//!
//! | file | answers |
//! |---|---|
//! | `view` | what a frame shows of an object |
//! | `plane` | which plane objects stand on |
//! | `outline`, `path` | how large an object is, and where it goes |
//! | `shape` | its Gaussians alone, against crops |
//! | `fit` | its poses and Gaussians, moved together |
//! | `ways` | which ways of moving are tried |
//! | `follow` | how it moves from time to time |
//! | `trials` | which way is kept |
//! | `start` | everything in order |
//! | `parts` | which part of it turns on a hinge or slides |

mod fit;
mod follow;
mod outline;
mod parts;
mod path;
mod plane;
mod shape;
mod start;
#[cfg(test)]
mod tests;
mod trials;
mod view;
mod ways;

use cif_dataset::{Dataset, Split};
use glam::DVec3;

pub(crate) use self::parts::Jointed;
pub(crate) use self::plane::Plane;
use self::start::Object;
pub(crate) use self::start::{Fitted, Surroundings};
use self::view::ObjectView;
use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::random::{Purpose, stream};
use crate::stop::Stop;

/// Distance from a plane within which a point is on it, of the extent of the cameras.
const ON_PLANE: f64 = 0.005;

/// The plane that objects of a capture stand on, among points of what rests; `None` where no plane has enough of them.
pub(crate) fn support(dataset: &Dataset, points: &[[f32; 3]], seed: u64) -> Option<Plane> {
    let points: Vec<DVec3> = points.iter().map(|p| DVec3::from_array(p.map(f64::from))).collect();
    let training = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
    let cameras: Vec<DVec3> = training.map(|frame| frame.camera.centre()).collect();
    let rng = stream(seed, Purpose::Objects, 0);
    plane::support(&points, &cameras, ON_PLANE * dataset.extent(), rng)
}

/// Fits one object (a label: dense index + 1); `None` where it rests, unless it is told to be rigid, or where its masks,
/// or the scene, do not tell enough.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
pub(crate) fn fit(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
    is_told: bool,
) -> Result<Option<Fitted>, TrainError> {
    let views = views_of(label, dataset, frames, surroundings.stop)?;
    let Some(outline) = outline::outline(&views, surroundings.plane) else { return Ok(None) };
    start::fit_object(Object { label, views: &views, outline: &outline, is_told, surroundings })
}

/// Finds the part of an object that rests (a label: dense index + 1) which turns on a hinge or slides; `None` where it
/// has none, or the masks do not tell enough.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
pub(crate) fn find_part(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
) -> Result<Option<Jointed>, TrainError> {
    let views = views_of(label, dataset, frames, surroundings.stop)?;
    let Some(outline) = outline::outline(&views, surroundings.plane) else { return Ok(None) };
    let object = Object { label, views: &views, outline: &outline, is_told: false, surroundings };
    parts::find(object)
}

/// The object in all training frames that show it, in the order of times.
fn views_of(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    stop: &Stop,
) -> Result<Vec<ObjectView>, TrainError> {
    let mut views = Vec::new();
    for k in 0..frames.len() {
        stop.check()?;
        let frame = &dataset.frames[frames.index(k)];
        let data = frames.get(dataset, k)?;
        views.extend(ObjectView::new(label, frame.time_index, &frame.camera, &data));
    }
    views.sort_by_key(|view| view.time_index);
    view::set_visible(&mut views);
    Ok(views)
}
