//! The ball that masks of an object at rest show, as that of a globe on its stand: discs within them, of which all
//! views agree where they are, and how large.

use std::f64::consts::TAU;

use cif_geometry::rays::meeting_point;
use cif_geometry::{PinholeCamera, Ray};
use glam::DVec2;
use rand::RngExt;
use rand_pcg::Pcg64;

use super::rotation::Ball;
use super::view::{Crop, ObjectView, median};
use crate::random::{Purpose, stream};

/// Views below which discs agree by chance.
const FEWEST: usize = 8;

/// Pixels across of the smallest disc.
const SMALLEST: f64 = 8.0;

/// Circles that are drawn.
const DRAWN: usize = 200;

/// Distance of the outline of a mask from a circle, pixels and of its radius, up to which it is that of the circle; the
/// directions from its middle that are distinguished, and the share of these in which it must be.
const NEAR: [f64; 2] = [0.6, 0.02];
const SIDES: usize = 32;
const OUTLINED: f64 = 0.5;

/// Share of the disc within its outline that must be seen, and share of this that must be the object's own.
const WITHIN: f64 = 0.95;
const SEEN: f64 = 0.5;
const FULL: f64 = 0.97;

/// Distances from the outline of a disc, of its radius, between which a stand is looked for, and the share of what is there
/// that it may have.
const AROUND: [f64; 2] = [1.15, 1.35];
const STAND: f64 = 1.0 / 3.0;

/// Distance of the middle of discs from that of the ball, and difference of their radii, pixels and of the radius, up to
/// which they agree, and the share of those that show it whole which must. Of six rendered balls on stands all do, of other
/// things of eleven rendered captures at most 0.81.
const OFF: [f64; 2] = [0.1, 0.03];
const AGREEING: f64 = 0.9;

/// Share of the masks that the ball has at most: what is a ball as a whole has no stand.
const MOST: f64 = 0.9;

/// A disc in a crop, pixels.
#[derive(Clone, Copy, Debug)]
struct Disc {
    middle: DVec2,
    radius: f64,
    /// Share of what is seen around it that belongs to the object.
    around: f64,
    /// Share of the mask.
    share: f64,
}

/// The ball of an object at rest that is a ball on a stand; `None` where its masks show none.
pub(super) fn ball<'a>(views: impl Iterator<Item = &'a ObjectView>) -> Option<Ball> {
    let mut rng = stream(0, Purpose::Objects, 0);
    let discs: Vec<(&ObjectView, Disc)> =
        views.filter_map(|view| Some((view, disc(&view.crops[0], &mut rng)?))).collect();
    if discs.len() < FEWEST {
        return None;
    }
    let camera = |view: &'a ObjectView| &view.crops[0].camera;
    let ray = |(view, disc): &(&'a ObjectView, Disc)| (Ray::through(camera(view), disc.middle), 1.0);
    let centre = meeting_point(&discs.iter().map(ray).collect::<Vec<_>>())?;
    let size = |(view, disc): &(&'a ObjectView, Disc)| {
        let distance = (centre - view.camera.centre()).length();
        distance * (disc.radius / camera(view).focal_px.x).atan().sin()
    };
    let is_there = |(view, disc): &&(&'a ObjectView, Disc)| {
        let seen = camera(view).project(centre);
        seen.is_some_and(|(pixel, _)| (pixel - disc.middle).length() < most_off(disc) * disc.radius)
    };
    let there: Vec<&(&ObjectView, Disc)> = discs.iter().filter(is_there).collect();
    let radius = median(&mut there.iter().map(|seen| size(seen)).collect::<Vec<_>>());
    let ball = Ball { centre, radius };
    let is_as_large =
        |seen: &&&(&'a ObjectView, Disc)| (size(seen) - radius).abs() < most_off(&seen.1) * radius;
    let agreeing: Vec<&Disc> = there.iter().filter(is_as_large).map(|seen| &seen.1).collect();
    let middle = |of: fn(&Disc) -> f64| median(&mut agreeing.iter().map(|disc| of(disc)).collect::<Vec<_>>());
    // In the image: a crop follows what is elsewhere.
    let is_whole = |seen: &&(&ObjectView, Disc)| shows_whole(&seen.0.camera, &ball);
    let whole = discs.iter().filter(is_whole).count();
    let are_most = agreeing.len() >= FEWEST && agreeing.len() as f64 > AGREEING * whole as f64;
    let stands = middle(|disc| disc.around) < STAND && middle(|disc| disc.share) < MOST;
    (are_most && stands).then_some(ball)
}

/// Share of its radius by which a disc may be off.
fn most_off(disc: &Disc) -> f64 {
    OFF[0] / disc.radius + OFF[1]
}

/// True where a ball lies within an image.
fn shows_whole(camera: &PinholeCamera, ball: &Ball) -> bool {
    camera.project(ball.centre).is_some_and(|(pixel, depth)| {
        let reach = DVec2::splat(ball.radius / depth * camera.focal_px.x);
        let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
        (pixel - reach).cmpge(DVec2::ZERO).all() && (pixel + reach).cmple(size).all()
    })
}

/// The disc in a mask along whose outline most of that of the mask lies, where this is enough.
fn disc(crop: &Crop, rng: &mut Pcg64) -> Option<Disc> {
    let (width, height) = (crop.camera.width as usize, crop.camera.height as usize);
    let is_own = |x: usize, y: usize| crop.mask[y * width + x] > 0.5;
    let is_known = |x: usize, y: usize| crop.known[y * width + x] > 0.5;
    let centre = |x: usize, y: usize| DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
    // Between pixels of the object and adjacent ones of nothing.
    let mut outline = Vec::new();
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        for (a, b) in [(x + 1, y), (x, y + 1)] {
            let is_seen = a < width && b < height && is_known(x, y) && is_known(a, b);
            if is_seen && is_own(x, y) != is_own(a, b) {
                outline.push(0.5 * (centre(x, y) + centre(a, b)));
            }
        }
    }
    let (middle, radius) = likeliest_circle(&outline, rng)?;
    let (mut own, mut seen, mut all) = ([0_u32; 2], [0_u32; 2], 0_u32);
    let reach = (AROUND[1] * radius).ceil() as i64;
    let (column, row) = (middle.x as i64, middle.y as i64);
    for (x, y) in
        (row - reach..=row + reach).flat_map(|y| (column - reach..=column + reach).map(move |x| (x, y)))
    {
        let apart = DVec2::new(x as f64 + 0.5, y as f64 + 0.5).distance(middle) / radius;
        let place = usize::from(apart > WITHIN);
        if apart > WITHIN && !(AROUND[0]..AROUND[1]).contains(&apart) {
            continue;
        }
        all += u32::from(place == 0);
        if x < 0 || y < 0 || x >= width as i64 || y >= height as i64 {
            continue;
        }
        let (x, y) = (x as usize, y as usize);
        if is_own(x, y) || is_known(x, y) {
            seen[place] += 1;
            own[place] += u32::from(is_own(x, y));
        }
    }
    let share = |place: usize| f64::from(own[place]) / f64::from(seen[place].max(1));
    let pixels = crop.mask.iter().filter(|mask| **mask > 0.5).count();
    let is_disc = share(0) > FULL && f64::from(seen[0]) > SEEN * f64::from(all);
    let of_mask = f64::from(own[0]) / (WITHIN * WITHIN * pixels as f64);
    is_disc.then_some(Disc { middle, radius, around: share(1), share: of_mask })
}

/// The circle along which points lie in most directions from its middle, of those through three of them.
fn likeliest_circle(points: &[DVec2], rng: &mut Pcg64) -> Option<(DVec2, f64)> {
    let near = |(middle, radius): (DVec2, f64)| {
        let most = NEAR[0] + NEAR[1] * radius;
        points.iter().filter(move |point| (point.distance(middle) - radius).abs() < most)
    };
    let sides = |of: (DVec2, f64)| {
        let mut seen = [false; SIDES];
        for point in near(of) {
            let apart = *point - of.0;
            let side = (apart.y.atan2(apart.x) / TAU).rem_euclid(1.0) * SIDES as f64;
            seen[(side as usize).min(SIDES - 1)] = true;
        }
        seen.iter().filter(|seen| **seen).count()
    };
    if points.len() < SIDES {
        return None;
    }
    let any = |rng: &mut Pcg64| points[rng.random_range(0..points.len())];
    let drawn = (0..DRAWN).filter_map(|_| {
        let found = circle(&[any(rng), any(rng), any(rng)])?;
        (2.0 * found.1 >= SMALLEST && found.1 < points.len() as f64).then(|| (found, sides(found)))
    });
    let (best, most) = drawn.max_by_key(|(_, sides)| *sides)?;
    if (most as f64) < OUTLINED * SIDES as f64 {
        return None;
    }
    circle(&near(best).copied().collect::<Vec<_>>())
}

/// The circle that is nearest to points in the sense of least squares of `x^2 + y^2 - 2 a x - 2 b y - c` (Kåsa 1976).
fn circle(points: &[DVec2]) -> Option<(DVec2, f64)> {
    let middle = points.iter().sum::<DVec2>() / points.len().max(1) as f64;
    let (mut normal, mut right) = (nalgebra::Matrix3::zeros(), nalgebra::Vector3::zeros());
    for point in points {
        let d = *point - middle;
        let row = nalgebra::Vector3::new(2.0 * d.x, 2.0 * d.y, 1.0);
        normal += row * row.transpose();
        right += row * d.length_squared();
    }
    let found = normal.cholesky()?.solve(&right);
    let offset = DVec2::new(found[0], found[1]);
    Some((middle + offset, (found[2] + offset.length_squared()).sqrt()))
}
