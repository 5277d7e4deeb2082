//! The outlines that an object may have: height, size and path, from its masks and the plane it stands on.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use glam::{DMat2, DVec2, DVec3};

use super::object;
use super::outline::{Outline, RAISED, ROOM};
use super::path;
use super::plane::Plane;
use super::sequence::between;
use super::view::{ObjectView, WITHIN, are_discs, is_at_rest, is_one_camera, median, meeting_point};

/// Largest apparent size of a mask, relative to that on the plane, at which its object is taken to touch the plane.
const AIR: f64 = 1.1;

/// Share of the times in contact from which an object is taken to rest on the plane at all times.
const GROUNDED: f64 = 0.9;

/// Difference of the apparent size of an object that leaves the plane from that in contact, up to which it touches
/// the plane, and the fewest times in a row that do.
const SAME_SIZE: f64 = 0.03;
const SHORTEST_RUN: usize = 3;

/// Roundness of rough masks from which they are those of a ball, if they are discs too.
const BALL: f64 = 0.93;

/// Times before and after one among which its size is the middle one, and the median change by it, of the size, from which
/// masks are rough.
const STEADY: usize = 2;
const ROUGH: f64 = 0.005;

/// Height of an object in its typical tallest pose, of that in its lowest, from which it may topple.
const TOPPLES: f64 = 1.5;

/// Visible share from which a mask shows how high it is.
const MOSTLY_SEEN: f64 = 0.6;

/// Visible share from which what touches a mask is behind it.
const FULLY_SEEN: f64 = 0.9;

/// Length of a mask in its widths from which it is that of a bar, and the sine of the angle between its long axis and
/// the way down from which the bar lies.
const BAR: (f64, f64) = (2.2, 0.15);

/// Of so many times the lowest is one at which an object stands, and limits of its height there, of that which its
/// outlines imply.
const LOWEST: usize = 8;
const STANDS: (f64, f64) = (0.4, 1.5);

/// Reading of one mask.
struct Reading {
    height: f64,
    radius: f64,
    roundness: f64,
    /// True of a bar that lies.
    is_bar: bool,
}

/// How an object is taken to stand on its plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stance {
    /// At all times, as high as it is at most times.
    Stays,
    /// Not where it looks larger than there.
    MayLeave,
    /// At all times, as high as its mask is then.
    Topples,
}

/// Outlines that the views of an object may have; none where nothing shows where it is. Several cameras at a time give
/// one. One camera leaves open whether what is no ball and looks larger comes nearer or shows a broader side, and whether
/// what looks lower fell over: pictures decide. Where it sees the object from other sides soon after, rays that cross give
/// the path of what leaves the plane. `times` are those of the sequence.
pub(super) fn outlines(views: &[ObjectView], plane: Option<&Plane>, times: usize) -> Vec<Outline> {
    let met = meetings(views);
    if !met.is_empty() {
        return vec![met_outline(views, plane, met)];
    }
    let on_plane = |stance: Stance| plane.and_then(|plane| on_plane(views, plane, stance));
    // It has no broader side, and does not fall over, however rough its masks are.
    let is_ball = are_discs(views.iter());
    let leaves = on_plane(Stance::MayLeave).filter(|outline| !outline.air.is_empty());
    let crossing = path::crossing(views, times);
    let must_leave = is_ball && leaves.is_some() && crossing.is_empty();
    let stays = Some(Stance::Stays).filter(|_| !must_leave).and_then(on_plane);
    let mut found: Vec<Outline> = stays.into_iter().collect();
    if crossing.is_empty() {
        found.extend(leaves);
    } else {
        let is_resort = !found.is_empty() && leaves.is_none();
        let mut outline = around(views, crossing, path::CROSSING);
        outline.air = plane.map_or_else(Vec::new, |plane| raised(&outline, plane));
        found.push(Outline { is_resort, ..outline });
    }
    found.extend(Some(Stance::Topples).filter(|_| !is_ball).and_then(on_plane));
    found
}

/// Outline of an object whose centres are known by time, with the stiffness of their path.
fn around(views: &[ObjectView], path: BTreeMap<usize, DVec3>, stiffness: f64) -> Outline {
    let radius_of = |view: &ObjectView| {
        let depth = view.camera.project(*path.get(&view.time_index)?)?.1;
        Some(view.reach(WITHIN) * depth / view.camera.focal_px.x)
    };
    let mut radii: Vec<f64> = views.iter().filter(|view| view.is_whole()).filter_map(radius_of).collect();
    if radii.is_empty() {
        radii = views.iter().filter_map(radius_of).collect();
    }
    let radius = median(&mut radii);
    Outline {
        height: radius,
        radius,
        roundness: if are_discs(views.iter()) { 1.0 } else { 0.0 },
        path,
        air: Vec::new(),
        stiffness,
        is_surrounded: true,
        held: Vec::new(),
        guessed: Vec::new(),
        is_resort: false,
    }
}

/// Outline of an object that several cameras see, by where their rays meet and by what a plane implies.
fn met_outline(views: &[ObjectView], plane: Option<&Plane>, met: BTreeMap<usize, DVec3>) -> Outline {
    let on_plane = plane.and_then(|plane| on_plane(views, plane, Stance::MayLeave));
    let mut outline = match on_plane {
        Some(known) => Outline { air: Vec::new(), stiffness: path::MEETING, is_surrounded: true, ..known },
        None => around(views, met.clone(), path::MEETING),
    };
    if let Some(plane) = plane
        && let Some(height) = standing_height(&met, plane, outline.height)
    {
        outline.height = height;
        stand(&mut outline, views, plane, &met);
    }
    guess(&mut outline, views, &met);
    outline.path.extend(met);
    outline
}

/// Puts an object that few of several cameras see where it stands: at times next to which it does where their rays meet, and
/// at those at which it is at rest.
fn stand(outline: &mut Outline, views: &[ObjectView], plane: &Plane, met: &BTreeMap<usize, DVec3>) {
    let stands =
        |(_, centre): (&usize, &DVec3)| (plane.height(*centre) / outline.height - 1.0).abs() < RAISED;
    let neighbours_stand = |time: usize| {
        met.range(..time).next_back().is_none_or(stands) && met.range(time..).next().is_none_or(stands)
    };
    let held = outline.path.keys().copied().filter(|time| !met.contains_key(time));
    let held: Vec<usize> = held.filter(|time| neighbours_stand(*time) || is_at_rest(views, *time)).collect();
    for time in &held {
        let largest = views
            .iter()
            .filter(|view| view.time_index == *time)
            .max_by(|a, b| (!a.cut, a.area()).partial_cmp(&(!b.cut, b.area())).unwrap_or(Ordering::Equal));
        let place = largest.and_then(|view| {
            let (origin, ray) = (view.camera.centre(), view.camera.ray(view.centroid));
            Some(origin + plane.meet(origin, ray, outline.height)? * ray)
        });
        outline.path.extend(place.map(|place| (*time, place)));
    }
    outline.held = held;
}

/// Puts an object about where the rays of masks meet that the border cuts, at times at which nothing else shows it.
fn guess(outline: &mut Outline, views: &[ObjectView], met: &BTreeMap<usize, DVec3>) {
    let is_known = |time: &usize| met.contains_key(time) || outline.held.contains(time);
    let weight = |view: &ObjectView| view.visible.powi(2) * if view.cut { path::CUT } else { 1.0 } + 1e-4;
    outline.guessed = outline.path.keys().copied().filter(|time| !is_known(time)).collect();
    for time in &outline.guessed {
        let at: Vec<&ObjectView> = views.iter().filter(|view| view.time_index == *time).collect();
        if at.len() > 1
            && let Some(place) = meeting_point(at.into_iter().map(|view| (view, weight(view))))
        {
            outline.path.insert(*time, place);
        }
    }
}

/// Times at which an object on a known path is not as low as it stands; all, where it may never stand: as the height of
/// its outline is its reach, its middle is no higher then.
fn raised(outline: &Outline, plane: &Plane) -> Vec<usize> {
    let reaches = |stands: &f64| *stands < ROOM * outline.height;
    let stands = standing_height(&outline.path, plane, outline.height).filter(reaches);
    let is_raised =
        |centre: DVec3| stands.is_none_or(|stands| plane.height(centre) > stands + RAISED * outline.height);
    outline.path.iter().filter(|(_, centre)| is_raised(**centre)).map(|(time, _)| *time).collect()
}

/// Height above the plane at which an object stands whose centres are known: the middle one of times that are about as low
/// as its lowest ones. `None` where these are few and differ, or far from what its outlines imply, so that it may
/// never stand.
fn standing_height(met: &BTreeMap<usize, DVec3>, plane: &Plane, implied: f64) -> Option<f64> {
    let mut heights: Vec<f64> = met.values().map(|centre| plane.height(*centre)).collect();
    heights.sort_by(f64::total_cmp);
    let [lowest, highest] = [*heights.first()?, *heights.last()?];
    // Few suffice where all are as high.
    let are_alike = heights.len() >= SHORTEST_RUN && highest < ROOM * lowest;
    let low = *heights.get(heights.len() / LOWEST).filter(|_| heights.len() >= LOWEST || are_alike)?;
    heights.retain(|height| *height < ROOM * low);
    let height = median(&mut heights);
    (STANDS.0 * implied..STANDS.1 * implied).contains(&height).then_some(height)
}

/// Centres at times that several cameras see, where their rays meet.
fn meetings(views: &[ObjectView]) -> BTreeMap<usize, DVec3> {
    let mut times: BTreeMap<usize, Vec<(&ObjectView, f64)>> = BTreeMap::new();
    for view in views.iter().filter(|view| !view.cut) {
        let weight = view.visible.powi(2) * (1.0 - 0.9 * view.touched);
        times.entry(view.time_index).or_default().push((view, weight));
    }
    let several = times.into_iter().filter(|(_, views)| views.len() > 1);
    several.filter_map(|(time, views)| Some((time, meeting_point(views.into_iter())?))).collect()
}

/// Outline of the views of an object on a plane; `None` where no mask is seen from above, or nothing shows that it moves
/// like this.
fn on_plane(views: &[ObjectView], plane: &Plane, stance: Stance) -> Option<Outline> {
    let is_whole = |view: &&ObjectView| view.is_whole() || (!view.cut && view.visible >= FULLY_SEEN);
    let whole: Vec<&ObjectView> = match views.iter().filter(is_whole).collect::<Vec<_>>() {
        whole if !whole.is_empty() => whole,
        _ => match views.iter().filter(|view| !view.cut).collect::<Vec<_>>() {
            uncut if !uncut.is_empty() => uncut,
            _ => views.iter().collect(),
        },
    };
    let is_ball = are_discs(views.iter()) && median_reading(&whole, plane, false)?.roundness > BALL;
    let mut grounded = whole.clone();
    let mut medians = median_reading(&grounded, plane, is_ball)?;
    for _ in 0..3 {
        let mut sizes: Vec<f64> =
            whole.iter().filter_map(|view| implied_size(view, plane, medians.height)).collect();
        sizes.sort_by(f64::total_cmp);
        let low = *sizes.get((sizes.len() as f64 * 0.3) as usize)?;
        let is_grounded = |view: &&&ObjectView| {
            implied_size(view, plane, medians.height).is_some_and(|size| size <= AIR * low)
        };
        let found: Vec<&ObjectView> = whole.iter().filter(is_grounded).copied().collect();
        let Some(reading) = median_reading(&found, plane, is_ball) else { break };
        (grounded, medians) = (found, reading);
    }
    let mut sizes: Vec<f64> =
        grounded.iter().filter_map(|view| implied_size(view, plane, medians.height)).collect();
    let in_contact = median(&mut sizes);
    let larger = steady_sizes(views, plane, medians.height);
    let larger = larger.iter().filter(|size| size.is_some_and(|size| size > AIR * in_contact)).count();
    let uncut = views.iter().filter(|view| !view.cut).count();
    let leaves = stance == Stance::MayLeave && larger as f64 > (1.0 - GROUNDED) * uncut as f64;
    if !leaves {
        medians = median_reading(&whole, plane, is_ball)?;
    }
    let mut heights = vec![medians.height; views.len()];
    if stance == Stance::Topples {
        heights = steady_heights(views, plane, medians.height)?;
        medians.height = heights.iter().copied().fold(0.0, f64::max);
    }
    let rests =
        if leaves && !is_ball { sizes_at_rest(views, plane, &medians, in_contact) } else { BTreeMap::new() };
    let mut sums: BTreeMap<usize, (DVec3, f64, bool)> = BTreeMap::new();
    for ((view, size), height) in views.iter().zip(steady_sizes(views, plane, medians.height)).zip(heights) {
        let ray = view.camera.ray(view.centroid);
        let Some(mut depth) = plane.meet(view.camera.centre(), ray, height) else { continue };
        let in_contact = if rests.is_empty() { in_contact } else { between(&rests, view.time_index) };
        if leaves
            && let Some(size) = size
            && size > in_contact
        {
            depth *= in_contact / size;
        }
        let (sum, weight, touches) = sums.entry(view.time_index).or_insert((DVec3::ZERO, 0.0, false));
        *sum += view.area() * (view.camera.centre() + depth * ray);
        *weight += view.area();
        *touches |= !leaves || size.is_some_and(|size| (size / in_contact - 1.0).abs() < SAME_SIZE);
    }
    let touching: Vec<(usize, bool)> = sums.iter().map(|(time, (_, _, touches))| (*time, *touches)).collect();
    let runs = touching.chunk_by(|a, b| a.1 == b.1);
    let off = runs.filter(|run| !run[0].1 || (leaves && run.len() < SHORTEST_RUN));
    let air: Vec<usize> = off.flatten().map(|(time, _)| *time).collect();
    Some(Outline {
        height: medians.height,
        radius: medians.radius,
        roundness: medians.roundness,
        air,
        path: sums.into_iter().map(|(time, (sum, weight, _))| (time, sum / weight)).collect(),
        stiffness: path::CUT_BY_PLANE,
        is_surrounded: false,
        held: Vec::new(),
        guessed: Vec::new(),
        is_resort: false,
    })
}

/// Sizes, by time, that the masks of an object before one camera imply where it rests on the plane: its masks stay in one
/// place on it, or move less than half as far as they would if it were as far off as its size tells, of that in contact,
/// while the camera travels.
fn sizes_at_rest(
    views: &[ObjectView],
    plane: &Plane,
    reading: &Reading,
    in_contact: f64,
) -> BTreeMap<usize, f64> {
    let mut found = BTreeMap::new();
    if !is_one_camera(views) {
        return found;
    }
    let placed = |(view, size): (&ObjectView, Option<f64>)| {
        let (centre, ray) = (view.camera.centre(), view.camera.ray(view.centroid));
        let place = centre + plane.meet(centre, ray, reading.height)? * ray;
        Some(Placed { time: view.time_index, size: size?, centre, place })
    };
    let sizes = steady_sizes(views, plane, reading.height);
    let placed: Vec<Placed> = views.iter().zip(sizes).filter_map(placed).collect();
    let step = object::STANDS * reading.height.max(reading.radius);
    let stands = |a: &Placed, b: &Placed| (b.place - a.place).length() < step * (b.time - a.time) as f64;
    for row in placed.chunk_by(stands).filter(|row| row.len() >= SHORTEST_RUN) {
        let (first, last) = (&row[0], &row[row.len() - 1]);
        let size = median(&mut row.iter().map(|at| at.size).collect::<Vec<_>>());
        let travelled = last.centre - first.centre;
        let along = (travelled - plane.normal * plane.normal.dot(travelled)).length();
        // By similar triangles: nearer by this share, it is above where it stands by as much of the height of the camera.
        let shifts = along * (size / in_contact - 1.0);
        if size < AIR * in_contact || (last.place - first.place).length() < 0.5 * shifts {
            found.extend(row.iter().map(|at| (at.time, at.size)));
        }
    }
    found
}

/// A mask as if its object stood on the plane.
struct Placed {
    time: usize,
    /// Size that it implies.
    size: f64,
    /// Of the camera.
    centre: DVec3,
    /// Of the object.
    place: DVec3,
}

/// Size that a mask implies if its object stands on the plane: the root of its area at that distance.
fn implied_size(view: &ObjectView, plane: &Plane, height: f64) -> Option<f64> {
    let depth = plane.meet(view.camera.centre(), view.camera.ray(view.centroid), height)?;
    Some(view.area().sqrt() * depth / view.camera.focal_px.x)
}

/// Sizes that masks imply in the order of their times, `None` for those that the border cuts. Those of rough masks are
/// the middle ones of a few times, so that their objects do not seem to come nearer and go.
fn steady_sizes(views: &[ObjectView], plane: &Plane, height: f64) -> Vec<Option<f64>> {
    let of = |view: &ObjectView| implied_size(view, plane, height).filter(|_| !view.cut);
    let sizes: Vec<Option<f64>> = views.iter().map(of).collect();
    let middle = |k: usize| {
        let near = k.saturating_sub(STEADY)..(k + STEADY + 1).min(sizes.len());
        sizes[k].map(|_| median(&mut sizes[near].iter().flatten().copied().collect::<Vec<_>>()))
    };
    let steady: Vec<Option<f64>> = (0..sizes.len()).map(middle).collect();
    let both = sizes.iter().flatten().zip(steady.iter().flatten());
    let mut changes: Vec<f64> = both.map(|(size, steady)| (size / steady - 1.0).abs()).collect();
    if is_one_camera(views) && median(&mut changes) > ROUGH { steady } else { sizes }
}

/// Heights of the centre by view, as the masks of a few times imply them; `None` where they hardly change.
fn steady_heights(views: &[ObjectView], plane: &Plane, typical: f64) -> Option<Vec<f64>> {
    let of = |view: &ObjectView| {
        let is_seen = !view.cut && view.visible >= MOSTLY_SEEN;
        let reading = is_seen.then(|| read(view, plane, false)).flatten();
        reading.map(|reading| reading.height)
    };
    let heights: Vec<Option<f64>> = views.iter().map(of).collect();
    let middle = |k: usize| {
        let near = k.saturating_sub(STEADY)..(k + STEADY + 1).min(heights.len());
        let mut near: Vec<f64> = heights[near].iter().flatten().copied().collect();
        if near.is_empty() { typical } else { median(&mut near) }
    };
    let steady: Vec<f64> = (0..heights.len()).map(middle).collect();
    let mut sorted = steady.clone();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
    (is_one_camera(views) && at(0.9) > TOPPLES * at(0.1)).then_some(steady)
}

fn median_reading(views: &[&ObjectView], plane: &Plane, is_ball: bool) -> Option<Reading> {
    let readings: Vec<Reading> = views.iter().filter_map(|view| read(view, plane, is_ball)).collect();
    let of = |value: fn(&Reading) -> f64| median(&mut readings.iter().map(value).collect::<Vec<_>>());
    // A bar looks shorter from its ends.
    let mut bars: Vec<f64> = readings.iter().filter(|r| r.is_bar).map(|r| r.radius).collect();
    bars.sort_by(f64::total_cmp);
    let longest = bars.get(bars.len() * 9 / 10).filter(|_| 2 * bars.len() > readings.len());
    (!readings.is_empty()).then(|| Reading {
        height: of(|reading| reading.height),
        radius: longest.copied().unwrap_or_else(|| of(|reading| reading.radius)),
        roundness: of(|reading| reading.roundness),
        is_bar: longest.is_some(),
    })
}

/// Half height and radius of the upright cylinder, or the ellipsoid, on the plane that fills the extent of a mask
/// along and across the image of the normal. That of a ball is an ellipsoid, however rough its masks are.
fn read(view: &ObjectView, plane: &Plane, is_ball: bool) -> Option<Reading> {
    let camera = &view.camera;
    let ray = camera.ray(view.centroid);
    let slope = plane.normal.dot(ray);
    if slope > -1e-6 {
        return None;
    }
    // Image of the way down at the centroid.
    let rotation = camera.camera_from_world.rotation;
    let (normal, ahead) = (rotation * plane.normal, rotation * ray);
    let down = -(camera.focal_px * DVec2::new(normal.x - ahead.x * normal.z, normal.y - ahead.y * normal.z));
    let down = down.try_normalize()?;
    let across = DVec2::new(-down.y, down.x);
    let turned = |x: f64, y: f64| {
        let d = DVec2::new(x, y) - view.centroid;
        DVec2::new(d.dot(down), d.dot(across))
    };
    let places: Vec<DVec2> =
        view.pixels.iter().map(|[x, y]| turned(f64::from(*x) + 0.5, f64::from(*y) + 0.5)).collect();
    let n = places.len() as f64;
    let mean = places.iter().sum::<DVec2>() / n;
    let mut moments = DMat2::ZERO;
    for place in &places {
        let d = *place - mean;
        moments += DMat2::from_cols(d * d.x, d * d.y);
    }
    let moments = moments * (1.0 / (n - 1.0)) + DMat2::IDENTITY * (1.0 / 12.0);
    let inverse = moments.inverse();
    let (mut inside, mut joined) = (0.0, n);
    for y in 0..view.size[1] {
        for x in 0..view.size[0] {
            let d = turned(f64::from(x) + 0.5, f64::from(y) + 0.5) - mean;
            if d.dot(inverse * d) <= 4.0 {
                // Pixels of both are counted once.
                joined += 1.0;
            }
        }
    }
    for place in &places {
        let d = *place - mean;
        if d.dot(inverse * d) <= 4.0 {
            inside += 1.0;
        }
    }
    let roundness: f64 = if is_ball { 1.0 } else { inside / (joined - inside) };
    let share = 0.5 + 0.5 * ((roundness - 0.93) / 0.04).clamp(0.0, 1.0);
    let range = |axis: usize| {
        let mut values: Vec<f64> = places.iter().map(|place| place[axis]).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        at(0.99) - at(0.01)
    };
    let extent = |axis: usize, more: f64| {
        share * 4.0 * moments.col(axis)[axis].sqrt() + (1.0 - share) * (range(axis) + more)
    };
    let (along, wide) = (extent(0, 0.5), extent(1, 0.0));
    let bar = bar(&places, mean, moments);
    let sine = -slope / ray.length();
    let cosine = (1.0 - sine * sine).max(1e-6).sqrt();
    let focal = camera.focal_px.x;
    let mut depth = plane.meet(camera.centre(), ray, 0.0)?;
    let (mut height, mut radius) = (0.0, 0.0);
    for _ in 0..20 {
        radius = 0.5 * bar.map_or(wide, |[length, _]| length) * depth / focal;
        let extent = along * depth / focal;
        let cylinder = ((extent - 2.0 * radius * sine) / cosine).max(0.3 * radius);
        let ellipsoid =
            ((0.5 * extent).powi(2) - (radius * sine).powi(2)).max((0.15 * radius).powi(2)).sqrt() / cosine;
        // A bar that lies is as high as it is thick.
        let upright = 0.5 * bar.map_or(cylinder, |[_, thickness]| thickness * depth / focal);
        height = share * ellipsoid + (1.0 - share) * upright;
        depth = plane.meet(camera.centre(), ray, height)?;
    }
    Some(Reading { height, radius, roundness, is_bar: bar.is_some() })
}

/// Length and thickness, pixels, of a mask that is long across the way down, as of a bar that lies; places are along and
/// across the way down.
fn bar(places: &[DVec2], mean: DVec2, moments: DMat2) -> Option<[f64; 2]> {
    let half = 0.5 * (moments.x_axis.x - moments.y_axis.y);
    let spread = half.hypot(moments.x_axis.y);
    let middle = 0.5 * (moments.x_axis.x + moments.y_axis.y);
    // Angle of the long axis from the way down.
    let angle = 0.5 * moments.x_axis.y.atan2(half);
    let is_long = middle + spread > BAR.0 * BAR.0 * (middle - spread);
    if !is_long || angle.sin().abs() < BAR.1 {
        return None;
    }
    let along = DVec2::new(angle.cos(), angle.sin());
    Some([along, along.perp()].map(|axis| {
        let mut values: Vec<f64> = places.iter().map(|place| (*place - mean).dot(axis)).collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        at(0.99) - at(0.01) + 0.5
    }))
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use rand::RngExt;

    use super::super::testing::{FLOOR, TIMES, jumping, moving, rig, sides, solid, sphere_places, views};
    use super::*;
    use crate::random::{Purpose, stream};

    const RADIUS: f64 = 0.05;

    /// A plain ball at rest on the floor, at one time or at all.
    fn ball(times: usize, cameras: super::super::testing::Cameras) -> Vec<ObjectView> {
        let at_rest = (DQuat::IDENTITY, DVec3::new(0.0, 0.0, RADIUS));
        let mut all =
            views(solid(&sphere_places(RADIUS), |_| [0.8, 0.5, 0.2], 0.006), &[at_rest; TIMES], cameras);
        all.retain(|view| view.time_index < times);
        all
    }

    #[test]
    fn what_looks_larger_where_it_rests_is_not_off_its_support() {
        // A block that stands with its broad side to the camera, is lifted, and put down with its narrow side to it.
        let size = DVec3::new(0.045, 0.025, 0.05);
        let places = sides(size, 31);
        let pose = |time: usize| {
            let share = ((time as f64 - 9.0) / 10.0).clamp(0.0, 1.0);
            let up = 0.1 * (std::f64::consts::PI * share).sin();
            let turn = DQuat::from_rotation_z(0.5 + 1.9 * share);
            (turn, DVec3::new(0.1 * share - 0.05, 0.0, size.z + up))
        };
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(pose).collect();
        let views = views(solid(&places, |_| [0.8, 0.5, 0.2], 0.006), &truth, moving);
        let found = outlines(&views, Some(&FLOOR), TIMES);
        let leaves = found.iter().find(|outline| !outline.air.is_empty()).unwrap();
        assert!((0..9).chain(21..TIMES).all(|time| !leaves.air.contains(&time)), "{:?}", leaves.air);
        assert!((12..17).all(|time| leaves.air.contains(&time)), "{:?}", leaves.air);
        for mut rest in [0..9, 21..TIMES] {
            let first = leaves.path[&rest.start];
            assert!(rest.all(|time| leaves.path[&time].distance(first) < 0.01), "{:?}", leaves.path);
        }
    }

    #[test]
    fn what_touches_whole_masks_is_behind_them() {
        // Lifted off the floor while nothing touches its mask, and seen beside something where it stands.
        let up = |time: usize| 0.12 * ((time as f64 - 8.0) / 3.0).clamp(0.0, 1.0);
        let place = |time: usize| DVec3::new(0.004 * time as f64 - 0.05, 0.0, RADIUS + up(time));
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
        let mut views = views(solid(&sphere_places(RADIUS), |_| [0.8, 0.5, 0.2], 0.006), &truth, moving);
        views.iter_mut().filter(|view| view.time_index < 12).for_each(|view| view.touched = 0.3);
        let error = |views: &[ObjectView]| {
            let found = on_plane(views, &FLOOR, Stance::MayLeave).unwrap();
            let errors = found.path.iter().map(|(time, centre)| (*centre - place(*time)).length());
            errors.fold(0.0, f64::max)
        };
        assert!(error(&views) < 0.03, "{} m", error(&views));
        // Hidden in part, they do not show its size.
        views.iter_mut().filter(|view| view.time_index < 12).for_each(|view| view.visible = 0.6);
        assert!(error(&views) > 0.1, "{} m", error(&views));
    }

    #[test]
    fn a_ball_that_looks_larger_comes_nearer() {
        let up = |time: usize| 0.25 * (1.0 - ((time as f64 - 14.0) / 7.0).powi(2)).max(0.0);
        let place = |time: usize| DVec3::new(0.004 * time as f64 - 0.05, 0.0, RADIUS + up(time));
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
        let thrown = views(solid(&sphere_places(RADIUS), |_| [0.8, 0.5, 0.2], 0.006), &truth, moving);
        let found = outlines(&thrown, Some(&FLOOR), TIMES);
        assert!(found.iter().all(|outline| outline.air.len() > 5), "{} outlines", found.len());
        // One that stays has no other outline, and does not fall over where its masks lose their upper halves.
        let mut resting = ball(TIMES, moving);
        for view in &mut resting[..8] {
            let middle = view.centroid.y as u32;
            view.pixels.retain(|[_, y]| *y > middle);
        }
        let found = outlines(&resting, Some(&FLOOR), TIMES);
        assert!(found.len() == 1 && found[0].air.is_empty(), "{} outlines", found.len());
    }

    #[test]
    fn what_one_of_several_cameras_sees_stands_where_it_is_between_meetings() {
        let place = |time: usize| DVec3::new(0.006 * time as f64 - 0.09, 0.0, RADIUS);
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
        let mut views = views(solid(&sphere_places(RADIUS), |_| [0.8, 0.5, 0.2], 0.006), &truth, rig);
        let camera = views[0].camera_key;
        views.retain(|view| view.time_index > 5 || view.camera_key == camera);
        let found = outlines(&views, Some(&FLOOR), TIMES).remove(0);
        assert_eq!(found.held, (0..6).collect::<Vec<_>>());
        for time in 0..6 {
            assert!((found.path[&time] - place(time)).length() < 0.004, "{:?}", found.path[&time]);
        }
    }

    #[test]
    fn rough_masks_of_a_ball_tell_its_size() {
        let mut views = ball(TIMES, moving);
        let mut rng = stream(0, Purpose::Objects, 3);
        for view in &mut views {
            // The outline goes in and out by some pixels.
            let phase = rng.random::<f64>() * 6.0;
            let middle = view.centroid;
            view.pixels.retain(|[x, y]| {
                let d = DVec2::new(f64::from(*x) + 0.5, f64::from(*y) + 0.5) - middle;
                d.length() < RADIUS * 240.0 * (1.0 + 0.04 * (3.0 * d.y.atan2(d.x) + phase).sin())
            });
        }
        let found = outlines(&views, Some(&FLOOR), TIMES);
        let [found] = &found[..] else { panic!("{} outlines", found.len()) };
        assert!((found.height / found.radius - 1.0).abs() < 0.06, "{} and {}", found.height, found.radius);
    }

    #[test]
    fn what_rays_show_above_where_it_stands_is_off_the_plane() {
        let lifted = |time: usize| match time {
            10..20 => 0.03 * time.min(29 - time).saturating_sub(9) as f64,
            _ => 0.0,
        };
        let seen = |lowest: f64| {
            let place = |time: usize| DVec3::new(0.005 * time as f64 - 0.07, 0.0, lowest + lifted(time));
            let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
            views(solid(&sphere_places(RADIUS), |_| [0.8, 0.5, 0.2], 0.006), &truth, jumping)
        };
        let views = seen(RADIUS);
        let found = outlines(&views, Some(&FLOOR), TIMES);
        let crossing = found.iter().find(|outline| outline.is_surrounded).unwrap();
        assert!((11..19).all(|time| crossing.air.contains(&time)), "{:?}", crossing.air);
        assert!(crossing.air.len() < 16, "{:?}", crossing.air);
        // Nothing stands higher than it reaches.
        let found = outlines(&seen(1.5 * RADIUS), Some(&FLOOR), TIMES);
        let crossing = found.iter().find(|outline| outline.is_surrounded).unwrap();
        assert_eq!(crossing.air.len(), crossing.path.len());
        // Without a plane nothing shows it.
        let found = outlines(&views, None, TIMES);
        assert!(found[0].is_surrounded && found[0].air.is_empty());
    }

    #[test]
    fn what_several_cameras_see_stands_as_high_as_at_its_lowest() {
        let lifted = |time: usize| (time, DVec3::new(0.1, 0.0, 0.05 + 0.02 * time.saturating_sub(6) as f64));
        let met: BTreeMap<usize, DVec3> = (0..TIMES).map(lifted).collect();
        assert_eq!(standing_height(&met, &FLOOR, 0.07), Some(0.05));
        // Rough masks put it too low as often as too high.
        let rough =
            |time: usize| (time, DVec3::new(0.1, 0.0, 0.05 + 0.001 * ((7 * time) % 5) as f64 - 0.002));
        let found = standing_height(&(0..TIMES).map(rough).collect(), &FLOOR, 0.05).unwrap();
        assert!((found - 0.05).abs() < 5e-4, "{found}");
        // Too high to stand, by its outlines; too few times.
        assert_eq!(standing_height(&met, &FLOOR, 0.02), None);
        assert_eq!(standing_height(&(4..10).map(lifted).collect(), &FLOOR, 0.07), None);
        // Unless all are as high.
        assert_eq!(standing_height(&(0..5).map(lifted).collect(), &FLOOR, 0.07), Some(0.05));
        // Outlines of a ball give its height less well than the places where its rays meet.
        let found = outlines(&ball(TIMES, rig), Some(&FLOOR), TIMES).remove(0);
        assert!((found.height - RADIUS).abs() < 0.002, "{}", found.height);
    }
}
