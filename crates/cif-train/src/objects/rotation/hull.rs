//! Soft visual hull of an object under the poses that a hypothesis gives it, and the surface points that pixels see on
//! it. Everything is in the frame of the object. Source: motion reference, second part, 5.

use std::collections::BTreeMap;

use glam::DVec3;

use super::super::shape::Pose;
use super::super::view::{ObjectView, Seen};
use super::evidence::{Evidence, Look};

/// Share of the views that see a voxel which may show it outside the mask: masks are a pixel off here and there.
const OUTSIDE: f64 = 0.12;

/// Share of all views that must see a voxel, so that what lies beyond the images is not full.
const SEEN: f64 = 0.3;

/// Level of the smoothed occupancy that is the surface.
const SURFACE: f32 = 0.5;

/// Step along a ray, in voxels.
const STEP: f64 = 0.7;

/// Standard deviation of the smoothing is one voxel; its kernel ends after three.
const KERNEL: [f32; 4] = [0.399_05, 0.242_04, 0.054_01, 0.004_43];

/// Most views that carve: more do not change the hull.
const CARVING: usize = 48;

/// Edge of a voxel, in pixels at the distance of the object: cells of paint are as fine as what is seen of them. Most
/// voxels along an object, and edge of those of a first rough hull, of its size.
const VOXEL: f64 = 1.5;
const MOST_ALONG: f64 = 64.0;
const ROUGH: f64 = 0.12;

/// Reach of the first hull, in sizes of the object.
const REACH: f64 = 1.3;

/// Share of a ring around an axis that is inside a hull, from which a solid of revolution has it, and steps by which the
/// axis is moved, in voxels.
const RING: f64 = 0.85;
const MOVED: [f64; 3] = [2.0, 1.0, 0.5];

/// Voxels that a solid reaches beyond its last full ring: of four things that roll 0.06, 0.14, 0.3 and 0.55.
const BEYOND: f64 = 0.25;

/// Half voxels by which a solid is moved deeper, or towards the cameras, onto its support.
const DEEPER: i32 = 24;

/// A support on which a solid lies, in the frame of the object.
pub(super) struct Contact {
    /// Its unit normal, and the height of the origin above it, metres.
    pub(super) up: DVec3,
    pub(super) height: f64,
    /// Unit, away from the cameras and across the axis.
    pub(super) depth: DVec3,
}

/// A hypothesis: world from object by time.
pub(in super::super) type Course = BTreeMap<usize, Pose>;

/// A regular grid of voxels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// Corner of the first voxel.
    origin: DVec3,
    /// Edge of a voxel, metres.
    voxel: f64,
    dims: [usize; 3],
}

impl Grid {
    /// The grid over a box, widened by two voxels on every side.
    pub(super) fn over(low: DVec3, high: DVec3, voxel: f64) -> Self {
        let cells = ((high - low) / voxel).ceil() + 4.0;
        let origin = 0.5 * (low + high) - 0.5 * voxel * cells;
        Self { origin, voxel, dims: cells.to_array().map(|count| count as usize) }
    }

    fn len(&self) -> usize {
        self.dims.iter().product()
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.dims[1] + y) * self.dims[2] + z
    }

    fn centre(&self, at: [usize; 3]) -> DVec3 {
        let [x, y, z] = at.map(|k| k as f64 + 0.5);
        self.origin + self.voxel * DVec3::new(x, y, z)
    }

    fn places(&self) -> impl Iterator<Item = [usize; 3]> {
        let [a, b, c] = self.dims;
        (0..a).flat_map(move |x| (0..b).flat_map(move |y| (0..c).map(move |z| [x, y, z])))
    }

    fn is_border(&self, at: [usize; 3]) -> bool {
        at.iter().zip(self.dims).any(|(k, dim)| *k == 0 || k + 1 == dim)
    }
}

/// Occupancy of a grid.
pub(super) struct Hull {
    pub(super) grid: Grid,
    /// Smoothed occupancy of each voxel.
    field: Vec<f32>,
    /// Voxels inside, before smoothing.
    inside: Vec<bool>,
}

/// The surface point that a pixel sees.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// Index of its voxel.
    pub(super) cell: u32,
    /// Outward unit normal, in the frame of the object.
    pub(super) normal: DVec3,
    /// Cosine between the normal and the direction to the camera.
    pub(super) facing: f64,
    /// The point, in the frame of the object.
    pub(super) place: DVec3,
}

/// Edge of a voxel, metres, of an object of this size on a course; `None` where no view has a pose.
pub(super) fn voxel(evidence: &Evidence<'_>, size: f64, course: &Course) -> Option<f64> {
    let footprint = |look: &Look<'_>| {
        let pose = course.get(&look.view.time_index)?;
        Some(look.footprint * (pose.translation - look.view.camera.centre()).length())
    };
    let mut footprints: Vec<f64> = evidence.looks.iter().filter_map(footprint).collect();
    let voxel = VOXEL * cif_geometry::stats::median(&mut footprints)?;
    Some(voxel.max(2.0 * REACH * size / MOST_ALONG))
}

impl Hull {
    /// The hull of an object of this size, in voxels of this edge, on a course.
    pub(super) fn of(evidence: &Evidence<'_>, size: f64, voxel: f64, course: &Course) -> Self {
        let views: Vec<&ObjectView> = evidence.looks.iter().map(|look| look.view).collect();
        let reach = DVec3::splat(REACH * size);
        let rough = Grid::over(-reach, reach, ROUGH * size);
        let bounds = Self::carved(rough, &views, course).bounds().unwrap_or((DVec3::ZERO, DVec3::ZERO));
        let margin = DVec3::splat(0.5 * ROUGH * size);
        let grid = Grid::over(bounds.0 - margin, bounds.1 + margin, voxel);
        Self::carved(grid, &views, course)
    }

    /// Middle of what is inside; `None` where there is nothing.
    fn middle(&self) -> Option<DVec3> {
        let full = self.grid.places().filter(|at| self.inside[self.grid.index(*at)]);
        let (sum, count) =
            full.fold((DVec3::ZERO, 0.0), |(sum, n), at| (sum + self.grid.centre(at), n + 1.0));
        (count > 0.0).then(|| sum / count)
    }

    /// Carves a grid by the masks of views whose times have poses; pixels of what may hide the object say nothing.
    fn carved(grid: Grid, views: &[&ObjectView], poses: &Course) -> Self {
        let posed: Vec<(&ObjectView, &Pose)> =
            views.iter().filter_map(|view| Some((*view, poses.get(&view.time_index)?))).collect();
        let looked: Vec<&(&ObjectView, &Pose)> =
            posed.iter().step_by(posed.len().div_ceil(CARVING).max(1)).collect();
        let is_inside = |at: [usize; 3]| {
            if grid.is_border(at) {
                return false;
            }
            let place = grid.centre(at);
            let (mut inside, mut outside) = (0.0, 0.0);
            for (view, pose) in &looked {
                match view.at(pose.rotation * place + pose.translation) {
                    Seen::Object(_) => inside += 1.0,
                    Seen::Nothing => outside += 1.0,
                    Seen::Other | Seen::Outside => {}
                }
                if outside > OUTSIDE * looked.len() as f64 {
                    return false;
                }
            }
            let seen = inside + outside;
            seen > SEEN * looked.len() as f64 && outside <= OUTSIDE * seen
        };
        let inside: Vec<bool> = grid.places().map(is_inside).collect();
        let field = smoothed(&grid, &inside);
        Self { grid, field, inside }
    }

    /// The largest solid of revolution about an axis of this direction inside the hull, and a point of the axis. How deep it
    /// lies outlines from one side hardly show: it touches what it lies on.
    pub(super) fn revolved(&self, axis: DVec3, contact: Option<&Contact>) -> Option<(Self, DVec3)> {
        let mut best = self.middle().map(|middle| (self.rings(axis, middle), middle))?;
        let (first, second) = axis.any_orthonormal_pair();
        for step in MOVED {
            loop {
                let moved =
                    [first, -first, second, -second].map(|aside| best.1 + step * self.grid.voxel * aside);
                let tried = moved.map(|middle| (self.rings(axis, middle), middle));
                let larger = tried.into_iter().max_by_key(|(rings, _)| volume_of(rings));
                match larger {
                    Some(larger) if volume_of(&larger.0) > volume_of(&best.0) => best = larger,
                    _ => break,
                }
            }
        }
        if let Some(contact) = contact {
            let most = volume_of(&best.0);
            let step = 0.5 * self.grid.voxel * contact.depth;
            let deeper = (-DEEPER..=DEEPER).map(|k| best.1 + f64::from(k) * step);
            let solids = deeper.map(|middle| (self.rings(axis, middle), middle));
            let off = |(rings, middle): &(BTreeMap<i64, i64>, DVec3)| {
                (contact.height + contact.up.dot(*middle) - self.radius(rings)).abs()
            };
            let solids = solids.filter(|(rings, _)| 2 * volume_of(rings) > most);
            best = solids.min_by(|a, b| off(a).total_cmp(&off(b)))?;
        }
        let (rings, middle) = best;
        let is_inside = |at: [usize; 3]| {
            let (along, out) = self.ring(axis, self.grid.centre(at) - middle);
            rings.get(&along).is_some_and(|full| out < *full)
        };
        let inside: Vec<bool> = self.grid.places().map(is_inside).collect();
        let field = smoothed(&self.grid, &inside);
        Some((Self { grid: self.grid, field, inside }, middle))
    }

    /// Largest radius of rings, metres.
    fn radius(&self, rings: &BTreeMap<i64, i64>) -> f64 {
        rings.values().max().map_or(0.0, |rings| (*rings as f64 + BEYOND) * self.grid.voxel)
    }

    /// Radius of the solid about an axis through a point, metres.
    pub(super) fn radius_about(&self, axis: DVec3, middle: DVec3) -> f64 {
        self.radius(&self.rings(axis, middle))
    }

    /// Distances along an axis and from it, in voxels.
    fn ring(&self, axis: DVec3, place: DVec3) -> (i64, i64) {
        let along = place.dot(axis);
        let out = (place - along * axis).length();
        ((along / self.grid.voxel).floor() as i64, (out / self.grid.voxel).floor() as i64)
    }

    /// How many rings around an axis are inside, from the axis on, by the distance along it.
    fn rings(&self, axis: DVec3, middle: DVec3) -> BTreeMap<i64, i64> {
        let mut found: BTreeMap<(i64, i64), (u32, u32)> = BTreeMap::new();
        for at in self.grid.places() {
            let (inside, all) = found.entry(self.ring(axis, self.grid.centre(at) - middle)).or_default();
            *inside += u32::from(self.inside[self.grid.index(at)]);
            *all += 1;
        }
        let mut rings: BTreeMap<i64, i64> = BTreeMap::new();
        for ((along, out), (inside, all)) in found {
            let full = rings.entry(along).or_default();
            if out <= *full && f64::from(inside) >= RING * f64::from(all) {
                *full = out + 1;
            }
        }
        rings
    }

    /// Volume, cubic metres.
    pub(super) fn volume(&self) -> f64 {
        self.inside.iter().filter(|inside| **inside).count() as f64 * self.grid.voxel.powi(3)
    }

    /// Corners of the box around the voxels inside; `None` where there are none.
    pub(super) fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let half = DVec3::splat(0.5 * self.grid.voxel);
        let full = self.grid.places().filter(|at| self.inside[self.grid.index(*at)]);
        full.map(|at| self.grid.centre(at)).fold(None, |bounds: Option<(DVec3, DVec3)>, centre| {
            let (low, high) = bounds.unwrap_or((centre, centre));
            Some((low.min(centre - half), high.max(centre + half)))
        })
    }

    /// Number of voxels.
    pub(super) fn cells(&self) -> usize {
        self.grid.len()
    }

    /// The point of the object in a pose that a ray in the world meets; `None` where it passes by.
    pub(super) fn met(&self, pose: &Pose, origin: DVec3, ray: DVec3) -> Option<Hit> {
        let back = pose.rotation.inverse();
        self.hit(back * (origin - pose.translation), back * ray)
    }

    /// The first point of the surface along a ray; `None` where it passes by.
    fn hit(&self, origin: DVec3, ray: DVec3) -> Option<Hit> {
        let grid = &self.grid;
        // In voxels, with integers at their centres.
        let from = (origin - grid.origin) / grid.voxel - 0.5;
        let direction = ray.normalize();
        let last = DVec3::from(grid.dims.map(|dim| dim as f64 - 1.0));
        let (near, far) = ((-from) / direction, (last - from) / direction);
        let enter = near.min(far).max_element().max(0.0);
        let leave = near.max(far).min_element();
        let (mut along, mut before) = (enter, 0.0_f32);
        while along < leave {
            let value = self.at(from + along * direction);
            if value >= SURFACE {
                if along > enter && value > before {
                    along -= STEP * f64::from((value - SURFACE) / (value - before));
                }
                return self.surface(from + along * direction, direction);
            }
            before = value;
            along += STEP;
        }
        None
    }

    fn surface(&self, at: DVec3, direction: DVec3) -> Option<Hit> {
        let slope = |axis: DVec3| f64::from(self.at(at + axis) - self.at(at - axis));
        let normal = -DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).try_normalize()?;
        let cell = (at + 0.5).floor().max(DVec3::ZERO).to_array();
        let cell = [0, 1, 2].map(|axis| (cell[axis] as usize).min(self.grid.dims[axis] - 1));
        let place = self.grid.origin + self.grid.voxel * (at + 0.5);
        Some(Hit { cell: self.grid.index(cell) as u32, normal, facing: -normal.dot(direction), place })
    }

    /// The field between the centres of voxels.
    fn at(&self, place: DVec3) -> f32 {
        let floor = place.floor();
        let first = floor.to_array();
        let dims = self.grid.dims;
        if (0..3).any(|axis| first[axis] < 0.0 || first[axis] as usize + 1 >= dims[axis]) {
            return 0.0;
        }
        let base = self.grid.index(first.map(|value| value as usize));
        let (along_x, along_y) = (dims[1] * dims[2], dims[2]);
        let share = (place - floor).as_vec3();
        let line = |from: usize| self.field[from] + share.z * (self.field[from + 1] - self.field[from]);
        let plane = |from: usize| {
            let (a, b) = (line(from), line(from + along_y));
            a + share.y * (b - a)
        };
        let (a, b) = (plane(base), plane(base + along_x));
        a + share.x * (b - a)
    }
}

/// Volume of rings, up to a factor.
fn volume_of(rings: &BTreeMap<i64, i64>) -> i64 {
    rings.values().map(|out| out * out).sum()
}

/// Occupancy smoothed by a Gaussian of one voxel.
fn smoothed(grid: &Grid, inside: &[bool]) -> Vec<f32> {
    let mut field: Vec<f32> = inside.iter().map(|inside| f32::from(*inside)).collect();
    let strides = [grid.dims[1] * grid.dims[2], grid.dims[2], 1];
    for axis in 0..3 {
        let (stride, dim) = (strides[axis], grid.dims[axis]);
        let mut line = vec![0.0; dim];
        for start in grid.places().filter(|at| at[axis] == 0).map(|at| grid.index(at)) {
            for (k, value) in line.iter_mut().enumerate() {
                *value = field[start + k * stride];
            }
            for k in 0..dim {
                let neighbours = |distance: usize| {
                    let before = k.checked_sub(distance).map_or(0.0, |k| line[k]);
                    before + line.get(k + distance).copied().unwrap_or(0.0)
                };
                let sum: f32 =
                    (1..KERNEL.len()).map(|distance| KERNEL[distance] * neighbours(distance)).sum();
                field[start + k * stride] = KERNEL[0] * line[k] + sum;
            }
        }
    }
    field
}
