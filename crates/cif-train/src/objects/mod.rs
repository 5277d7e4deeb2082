//! Poses of rigid objects, from masks and colours, before the scene's motion is trained. Source: methods reference of
//! motion, 4.
//!
//! | file | answers |
//! |---|---|
//! | `order` | what cannot hide an object |
//! | `view` | what a frame shows of an object |
//! | `plane`, `below` | which plane objects stand on, and which points may lie on it |
//! | `object` | what is known of an object before it is fitted |
//! | `outline`, `outlines`, `path` | how large an object is, and where it goes |
//! | `shape` | its Gaussians alone, against crops |
//! | `hull` | where its Gaussians start |
//! | `fit` | its poses and Gaussians, moved together |
//! | `split` | which views are fitted to, and which judge |
//! | `priors` | how it moves where pictures say little |
//! | `texture`, `ball`, `sphere` | how it turns, where its outline does not show it |
//! | `ways` | which ways of moving are tried |
//! | `sequence` | which values over time cost least |
//! | `rests` | how it is turned between places at which it rests |
//! | `likeliest` | which of the motions that several starts lead to is kept |
//! | `follow` | how it moves from time to time |
//! | `grow` | where it is when little of it is seen |
//! | `mend` | which of its poses jump, and where they belong |
//! | `trials` | which way is kept |
//! | `bend` | whether it rather deforms, and how |
//! | `start` | everything in order |
//! | `rotation` | whether the pictures show how it turns |
//! | `discs` | whether it is a ball on a stand |
//! | `parts` | which part of it turns on a hinge or slides, where it stays in place |
//! | `known` | what was found of all objects, saved with the run |

mod ball;
mod below;
mod bend;
mod discs;
mod fit;
mod follow;
mod grow;
mod hull;
mod known;
mod likeliest;
mod mend;
mod object;
mod order;
mod outline;
mod outlines;
mod parts;
mod path;
mod plane;
mod priors;
mod rests;
mod rotation;
mod sequence;
mod shape;
mod sphere;
mod split;
mod start;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod texture;
mod trials;
mod view;
mod ways;

use cif_dataset::{Dataset, Split};
use glam::DVec3;
use serde::{Deserialize, Serialize};

pub(crate) use self::known::KnownObjects;
use self::object::Object;
pub(crate) use self::object::Surroundings;
pub(crate) use self::order::Order;
pub(crate) use self::parts::{Bending, InPlace, Jointed};
pub(crate) use self::plane::Plane;
pub(crate) use self::start::Fitted;
pub(crate) use self::trials::BENDS_NO_BETTER;
use self::view::ObjectView;
use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::phases::Phases;
use crate::random::{Purpose, stream};

/// Distance from a plane within which a point is on it, of the extent of the cameras.
const ON_PLANE: f64 = 0.005;

/// The plane that objects of a capture stand on, among points of what is at rest; `None` where no plane has enough of them.
pub(crate) fn support(dataset: &Dataset, points: &[[f32; 3]], seed: u64) -> Option<Plane> {
    let rng = stream(seed, Purpose::Objects, 0);
    plane::support(&doubles(points), &cameras(dataset), ON_PLANE * dataset.extent(), rng)
}

/// The same among the points that lie just below objects in the images, which scatter where they come from structure
/// from motion.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
pub(crate) fn support_below(
    dataset: &Dataset,
    frames: &FrameStore,
    seed: u64,
    phases: &Phases,
) -> Result<Option<Plane>, TrainError> {
    let below = below::below(&doubles(&dataset.points.positions), dataset, frames, phases)?;
    let rng = stream(seed, Purpose::Objects, 0);
    Ok(plane::rough_support(&below, &cameras(dataset), up(dataset), rng))
}

fn doubles(points: &[[f32; 3]]) -> Vec<DVec3> {
    points.iter().map(|point| DVec3::from_array(point.map(f64::from))).collect()
}

/// Places of the training cameras.
fn cameras(dataset: &Dataset) -> Vec<DVec3> {
    let training = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
    training.map(|frame| frame.camera.centre()).collect()
}

/// Mean direction upwards in the training images of a capture.
pub(crate) fn up(dataset: &Dataset) -> DVec3 {
    let training = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
    let ups = training.map(|frame| -frame.camera.camera_from_world.rotation.row(1));
    ups.sum::<DVec3>().try_normalize().unwrap_or(DVec3::Z)
}

/// Finding about one object.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) enum Found {
    /// Its motion as a whole.
    Moves(Box<Fitted>),
    /// It stands still, but for a part that turns in place.
    Turns(Box<Jointed>),
    /// It is at rest, or its masks do not show enough.
    Nothing,
    /// Nothing shows how far away it is: one camera sees it, from one side, and no support is known.
    Nowhere,
}

/// Fits one object (a label: dense index + 1); one at rest is fitted only where it is declared rigid, or where it is
/// a ball on a stand that turns.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop, or is out of time for this.
pub(crate) fn fit(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
    is_declared: bool,
) -> Result<Found, TrainError> {
    let views = views_of(label, dataset, frames, surroundings)?;
    let outlines = outlines::outlines(&views, surroundings.plane, surroundings.times);
    if outlines.is_empty() {
        return Ok(if views.is_empty() { Found::Nothing } else { Found::Nowhere });
    }
    let objects = Object::by_outlines(label, &views, &outlines, is_declared, surroundings);
    if !is_declared && let Some(found) = parts::turning_ball(objects[0])? {
        return Ok(Found::Turns(Box::new(found)));
    }
    let fitted = start::fit_object(&objects)?;
    surroundings.phases.check()?;
    Ok(fitted.map_or(Found::Nothing, |fitted| Found::Moves(Box::new(fitted))))
}

/// Finds the part of an object at rest (a label: dense index + 1) which turns on a hinge or slides, or how it deforms; `None`
/// where it does neither, or the masks do not show enough.
///
/// # Errors
/// As of [`fit`].
pub(crate) fn find_part(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
) -> Result<Option<InPlace>, TrainError> {
    let views = views_of(label, dataset, frames, surroundings)?;
    let outlines = outlines::outlines(&views, surroundings.plane, surroundings.times);
    // It is at rest: as standing, which is the first of its outlines.
    let object = Object::by_outlines(label, &views, &outlines, false, surroundings).into_iter().next();
    let found = object.map_or(Ok(None), parts::find)?;
    surroundings.phases.check()?;
    Ok(found)
}

/// The object in all training frames that show it, in the order of times.
fn views_of(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
) -> Result<Vec<ObjectView>, TrainError> {
    let object = surroundings.order.of_label(label);
    let masks = frames.masks(dataset, surroundings.phases)?;
    let areas = masks.iter().flatten().filter_map(|table| Some(f64::from(table.rows.get(&label)?.pixels)));
    let joined = view::joined(areas.collect());
    let mut views = Vec::new();
    for (k, table) in masks.iter().enumerate() {
        surroundings.phases.check()?;
        let Some(table) = table.as_ref().filter(|table| table.rows.contains_key(&label)) else { continue };
        let frame = &dataset.frames[frames.index(k)];
        let data = frames.get(dataset, k)?;
        views.extend(ObjectView::new(&object, frame.time_index, &frame.camera, &data, joined, table));
    }
    views.sort_by_key(|view| view.time_index);
    view::set_visible(&mut views);
    Ok(views)
}
