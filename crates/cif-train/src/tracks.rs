//! Where objects travel, from masks alone: a path of the centre per instance, before any motion is learnt.
//!
//! One moving camera does not show how far away a moving object is. Three things do, each roughly: an object that
//! stands on something is as far away as what is seen right below it (the contact), its apparent size says how its
//! distance changes, and real objects neither jump nor change speed without cause. The path is the robust
//! least-squares solution of all three with the directions in which the mask's centre is seen.

use cif_geometry::rays::nearest_point;
use cif_geometry::stats::median;
use cif_geometry::{PinholeCamera, Ray};
use glam::{DVec2, DVec3};

mod misfits;

pub use misfits::misfits;

/// An instance as one frame shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the frame's time.
    pub time_index: usize,
    /// The frame's camera.
    pub camera: PinholeCamera,
    /// Mean of the mask's pixel centres, pixels.
    pub centroid_px: DVec2,
    /// Pixels of the mask.
    pub area_px: f64,
    /// True along the columns, and the rows, of the image where the mask touches its border, so that nothing shows how far
    /// the object reaches beyond it.
    pub cut: [bool; 2],
    /// Camera depth of what is seen just outside the mask where that is nearest, metres.
    pub contact_depth: Option<f64>,
}

impl Observation {
    /// True when the border cuts the mask, so that its area says nothing.
    #[must_use]
    pub fn is_cut(&self) -> bool {
        self.cut != [false, false]
    }

    /// The ray through the centre of the mask.
    fn ray(&self) -> Ray {
        Ray::through(&self.camera, self.centroid_px)
    }

    /// The same as far as the border leaves the centre in place; `None` where it does not.
    fn placed_ray(&self) -> Option<Ray> {
        let seen = (self.centroid_px - self.camera.principal_px) / self.camera.focal_px;
        let axis = match self.cut {
            [false, false] => return Some(self.ray()),
            [true, true] => return None,
            [true, false] => DVec3::new(0.0, 1.0, -seen.y),
            [false, true] => DVec3::new(1.0, 0.0, -seen.x),
        };
        Some(self.ray().only_along((self.camera.camera_from_world.rotation.transpose() * axis).normalize()))
    }

    /// Distance of a point from the centre of the mask, pixels, as far as the border leaves that in place.
    fn miss_px(&self, point: DVec3) -> f64 {
        let left = self.cut.map(|cut| if cut { 0.0 } else { 1.0 });
        let apart = |(pixel, _): (DVec2, f64)| (DVec2::from(left) * (pixel - self.centroid_px)).length();
        self.camera.project(point).map_or(f64::INFINITY, apart)
    }

    /// Radius of a disc as large as the mask, pixels.
    fn radius_px(&self) -> f64 {
        (self.area_px / std::f64::consts::PI).sqrt()
    }
}

/// A path of an instance's centre.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Indices of the times at which it was seen, ascending.
    pub time_indices: Vec<usize>,
    /// Centre at each of them, world, metres.
    pub centres: Vec<DVec3>,
    /// Radius of the disc that would look as large, metres.
    pub radius: f64,
}

/// Standard deviation of the direction of a mask's centre, in units of the focal length.
const DIRECTION_SIGMA: f64 = 0.004;
/// Relative standard deviation of the depth that apparent size and contact say.
const DEPTH_SIGMA: f64 = 0.03;
/// Relative standard deviation of the depth of an object without contacts, which keeps its path from shrinking
/// into that of the camera.
const GUESS_SIGMA: f64 = 0.3;
/// Typical change of speed per time step, relative to the distance of the camera.
const ACCELERATION_SIGMA: f64 = 0.002;
/// Typical speed per time step, relative to the distance of the camera.
const SPEED_SIGMA: f64 = 0.02;
/// Rounds of reweighting.
const ROUNDS: usize = 16;
/// Rounds in which what is far off still counts, and round from which a path without contacts has a size.
const TOLERANT: i32 = 4;
const LATE: usize = 8;
/// Observations that a path needs.
const FEWEST: usize = 5;

/// True when an instance travels: no fixed point explains the directions that its mask is seen in. The median
/// distance of that point from the mask's centre is compared with the mask's radius. Along the way out of the image the
/// centre of a mask that the border cuts says nothing.
#[must_use]
pub fn travels(observations: &[Observation]) -> bool {
    let point = fixed_point(observations);
    let placed = observations.iter().filter(|o| o.cut != [true, true]);
    let mut misses: Vec<f64> = placed.map(|o| o.miss_px(point) / o.radius_px()).collect();
    if misses.len() < FEWEST {
        return false;
    }
    misses.sort_by(f64::total_cmp);
    misses[misses.len() / 2] > TRAVEL
}

/// Median miss of the best fixed point, in radii of the mask, from which an instance travels.
const TRAVEL: f64 = 0.3;

/// The point nearest to all rays through the masks' centres.
fn fixed_point(observations: &[Observation]) -> DVec3 {
    // What the border cuts away moves centres, but they show about where it is.
    let about = observations.iter().map(|o| (o.ray(), ABOUT));
    let rays = observations.iter().filter_map(|o| Some((o.placed_ray()?, 1.0))).chain(about);
    let origin = observations.first().map_or(DVec3::ZERO, |o| o.camera.centre());
    nearest_point(rays, PARALLEL).unwrap_or(origin)
}

/// Weight of rays through the centres of masks whether or not the border cuts them.
const ABOUT: f64 = 1e-3;

/// Determinant below which rays count as parallel.
const PARALLEL: f64 = 1e-12;

/// The path of an instance; `None` with too few observations. Without any contact it is taken to be about as
/// far as the fixed point that explains its masks best, and `None` where that is behind the cameras.
///
/// `observations` are in the order of their times; several cameras may see one time.
#[must_use]
pub fn fit(observations: &[Observation]) -> Option<Track> {
    if observations.len() < FEWEST {
        return None;
    }
    let mut depths: Vec<f64> = observations.iter().filter_map(|o| o.contact_depth).collect();
    let guess = depths.is_empty().then(|| fixed_point(observations));
    if let Some(point) = guess {
        depths = observations.iter().filter_map(|o| Some(o.camera.project(point)?.1)).collect();
    }
    depths.sort_by(f64::total_cmp);
    let distance = *depths.get(depths.len() / 2)?;
    let mut time_indices: Vec<usize> = observations.iter().map(|o| o.time_index).collect();
    time_indices.dedup();
    let slot = |o: &Observation| time_indices.partition_point(|index| *index < o.time_index);
    let n = time_indices.len();
    let mut centres = vec![DVec3::ZERO; n];
    for o in observations {
        let depth = o.contact_depth.unwrap_or(distance);
        centres[slot(o)] = o.camera.centre() + o.camera.ray(o.centroid_px) * depth;
    }
    // Depth of an object of unit size whose mask has this area.
    let unit_depth = |o: &Observation| (o.camera.focal_px.x * o.camera.focal_px.y / o.area_px).sqrt();
    let depth_at =
        |o: &Observation, centre: DVec3| o.camera.camera_from_world.apply(centre).z.max(0.05 * distance);
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let whole = || observations.iter().filter(|o| !o.is_cut());
    // Taken from contacts, the size cannot shrink together with the path.
    let by_contacts = median(whole().filter_map(|o| Some(o.contact_depth? / unit_depth(o))).collect());
    let mut size = by_contacts;
    for round in 0..ROUNDS {
        if by_contacts.is_none() && round >= LATE {
            size = median(whole().map(|o| depth_at(o, centres[slot(o)]) / unit_depth(o)).collect());
        }
        // Tolerant at first, so that wrong masks are outvoted before they are believed.
        let tolerance = 2.0_f64.powi(TOLERANT - round as i32).max(1.0);
        let mut system = Banded::zeros(3 * n);
        for o in observations {
            let at = slot(o);
            let depth = depth_at(o, centres[at]);
            let rotation = o.camera.camera_from_world.rotation;
            let origin = o.camera.centre();
            let [x, y, z] = [0, 1, 2].map(|row| rotation.row(row));
            let seen = (o.centroid_px - o.camera.principal_px) / o.camera.focal_px;
            let local = rotation * (centres[at] - origin);
            let sigma = DIRECTION_SIGMA * tolerance;
            let miss = (DVec2::new(local.x, local.y) / depth - seen).length() / sigma;
            let weight = 1.0 / ((1.0 + miss * miss) * (sigma * depth).powi(2));
            for (axis, seen) in [(x, seen.x), (y, seen.y)] {
                let row = axis - z * seen;
                system.add(&[(at, row)], row.dot(origin), weight);
            }
            let mut depth_says = |expected: f64, sigma: f64| {
                let sigma = sigma * tolerance;
                let miss = (depth - expected) / (sigma * depth);
                let weight = 1.0 / ((1.0 + miss * miss) * (sigma * depth).powi(2));
                system.add(&[(at, z)], z.dot(origin) + expected, weight);
            };
            if let Some(contact) = o.contact_depth {
                depth_says(contact, DEPTH_SIGMA);
            } else if guess.is_some() {
                depth_says(distance, GUESS_SIGMA);
            }
            if let (Some(size), false) = (size, o.is_cut()) {
                depth_says(size * unit_depth(o), DEPTH_SIGMA);
            }
        }
        let step = |j: usize| (time_indices[j + 1] - time_indices[j]) as f64;
        let acceleration_sigma = ACCELERATION_SIGMA * distance;
        for j in 1..n.saturating_sub(1) {
            let (before, after) = (step(j - 1), step(j));
            let scale = 1.0 / (before + after);
            let c = [scale / before, -scale / before - scale / after, scale / after];
            let value: DVec3 = (0..3).map(|k| centres[j - 1 + k] * c[k]).sum();
            let miss = value.length() / acceleration_sigma;
            let weight = 1.0 / ((1.0 + miss * miss).sqrt() * acceleration_sigma.powi(2));
            for axis in DVec3::AXES {
                system.add(&[(j - 1, axis * c[0]), (j, axis * c[1]), (j + 1, axis * c[2])], 0.0, weight);
            }
        }
        let speed_sigma = SPEED_SIGMA * distance;
        for j in 0..n - 1 {
            let h = step(j);
            let speed = (centres[j + 1] - centres[j]).length() / h;
            let weight = (1.0 / (1e-4 + speed / speed_sigma)).min(1e3) * 0.01 * h / speed_sigma.powi(2);
            for axis in DVec3::AXES {
                system.add(&[(j, -axis / h), (j + 1, axis / h)], 0.0, weight);
            }
        }
        let solution = system.solve()?;
        for (centre, value) in centres.iter_mut().zip(solution.chunks_exact(3)) {
            *centre = DVec3::from_slice(value);
        }
    }
    let radius = size.unwrap_or_default() / std::f64::consts::PI.sqrt();
    centres.iter().all(|centre| centre.is_finite()).then_some(Track { time_indices, centres, radius })
}

/// The path of an instance that does not travel (see [`travels`]): it stands where its masks agree best. `None` with too few
/// observations, and where some camera does not see that point.
pub(crate) fn resting(observations: &[Observation]) -> Option<Track> {
    if observations.len() < FEWEST {
        return None;
    }
    let point = fixed_point(observations);
    let depth = |o: &Observation| o.camera.project(point).map(|(_, depth)| depth);
    let depths: Vec<f64> = observations.iter().map(depth).collect::<Option<_>>()?;
    let radius = radius(observations, &depths);
    Some(Track { time_indices: vec![observations[0].time_index], centres: vec![point], radius })
}

/// The path along the rays through the masks of an instance, as deep as its contacts or, where a mask has none, as the
/// median of those or as the `middle` of the scene. It jumps where depths do, but shows up inside every mask.
///
/// # Panics
/// Without observations.
pub(crate) fn on_rays(observations: &[Observation], middle: DVec3) -> Track {
    let mut contacts: Vec<f64> = observations.iter().filter_map(|o| o.contact_depth).collect();
    let median_depth = median(&mut contacts);
    let depth_of = |o: &Observation| {
        let known = o.contact_depth.or(median_depth);
        known.unwrap_or_else(|| (middle - o.camera.centre()).length())
    };
    let depths: Vec<f64> = observations.iter().map(depth_of).collect();
    let radius = radius(observations, &depths);
    let (mut time_indices, mut centres) = (Vec::new(), Vec::new());
    // Where several cameras see a time, the largest mask counts.
    let of_times = observations.iter().zip(depths);
    for seen in of_times.collect::<Vec<_>>().chunk_by(|(a, _), (b, _)| a.time_index == b.time_index) {
        if let Some((o, depth)) = seen.iter().max_by(|(a, _), (b, _)| a.area_px.total_cmp(&b.area_px)) {
            time_indices.push(o.time_index);
            centres.push(o.camera.centre() + o.camera.ray(o.centroid_px) * *depth);
        }
    }
    Track { time_indices, centres, radius }
}

/// Radius of a disc as large as the masks at these depths, metres: the median.
fn radius(observations: &[Observation], depths: &[f64]) -> f64 {
    let focal_px = |o: &Observation| (o.camera.focal_px.x * o.camera.focal_px.y).sqrt();
    let radii = observations.iter().zip(depths).map(|(o, depth)| depth * o.radius_px() / focal_px(o));
    median(&mut radii.collect::<Vec<_>>()).unwrap_or_default()
}

impl Track {
    /// Centre at a time between two of `times`, by their indices; before the first and after the last
    /// observation it stands still.
    #[must_use]
    pub fn at(&self, times: &[f64], time: f64) -> DVec3 {
        let after = self.time_indices.partition_point(|index| times[*index] <= time);
        if after == 0 {
            return self.centres[0];
        }
        if after == self.centres.len() {
            return self.centres[after - 1];
        }
        let (a, b) = (times[self.time_indices[after - 1]], times[self.time_indices[after]]);
        self.centres[after - 1].lerp(self.centres[after], (time - a) / (b - a))
    }
}

/// Half bandwidth: three neighbouring points of three coordinates.
const BAND: usize = 9;

/// Symmetric positive definite band matrix, and a right-hand side.
struct Banded {
    /// `[n, BAND]`: entry (i, i - k) at `i * BAND + k`.
    lower: Vec<f64>,
    right: Vec<f64>,
}

impl Banded {
    fn zeros(n: usize) -> Self {
        Self { lower: vec![0.0; n * BAND], right: vec![0.0; n] }
    }

    /// Adds `weight (sum row . x - value)^2`; rows are of neighbouring points.
    fn add(&mut self, rows: &[(usize, DVec3)], value: f64, weight: f64) {
        let entries = || rows.iter().flat_map(|(at, row)| (0..3).map(move |axis| (3 * at + axis, row[axis])));
        for (i, a) in entries() {
            self.right[i] += weight * a * value;
            for (j, b) in entries().filter(|(j, _)| *j <= i) {
                self.lower[i * BAND + i - j] += weight * a * b;
            }
        }
    }

    /// Solves by Cholesky's decomposition; `None` where the matrix is not positive definite.
    fn solve(mut self) -> Option<Vec<f64>> {
        let n = self.right.len();
        for i in 0..n {
            let first = (i + 1).saturating_sub(BAND);
            for j in first..=i {
                let mut sum = self.lower[i * BAND + i - j];
                for k in first.max((j + 1).saturating_sub(BAND))..j {
                    sum -= self.lower[i * BAND + i - k] * self.lower[j * BAND + j - k];
                }
                self.lower[i * BAND + i - j] = if i == j {
                    if sum <= 0.0 {
                        return None;
                    }
                    sum.sqrt()
                } else {
                    sum / self.lower[j * BAND]
                };
            }
            let mut sum = self.right[i];
            for k in first..i {
                sum -= self.lower[i * BAND + i - k] * self.right[k];
            }
            self.right[i] = sum / self.lower[i * BAND];
        }
        for i in (0..n).rev() {
            let mut sum = self.right[i];
            for k in i + 1..n.min(i + BAND) {
                sum -= self.lower[k * BAND + k - i] * self.right[k];
            }
            self.right[i] = sum / self.lower[i * BAND];
        }
        Some(self.right)
    }
}

#[cfg(test)]
mod tests;
