//! Masses of bodies, from the volume that their splats fill.
//!
//! A convex hull is the outside of an object: that of a bent napkin holds litres of air. The volume of a body is
//! estimated from where its splats are, in a grid over its colliders. What lies between splats counts as filled: an
//! empty cell between splats along two of the three axes that is open on one side at most (nobody sees the bottoms of
//! things), one with splats that has such cells or splats all around, and the cells with splats around these. Other
//! cells with splats are a sheet, as thick as the splats are; by so much as these cells stick out of it, up to two times
//! as much. No body is larger than its colliders. Whether a closed thing is hollow no picture shows: [`DENSITY`] is
//! chosen between the two.

use std::collections::BTreeMap;

use cif_geometry::quaternion;
use glam::{DVec3, IVec3};

use crate::shape::convex_hull::hull_volume;
use crate::{ConvexHull, Motion, Node, SceneGraph};
use cif_geometry::stats::weighted_quantile;

/// Density of bodies over the volume that they fill, kg/m^3, where nobody gives another: chosen between what is hollow
/// (a pitcher or a ball, below 100) and what is full (a can or a fruit, about 1000).
pub const DENSITY: f64 = 300.0;
/// Least mass of a collider, kg; chosen: contacts of lighter things are stiff in simulators.
pub const LEAST_MASS: f64 = 1e-3;
/// Most cells of the grid along the longest side; chosen, fine enough to distinguish a mug from its hull.
const MOST_CELLS: f64 = 24.0;
/// Fewest cells along the longest side: one inside, and one on each side of it.
const FEWEST_CELLS: f64 = 3.0;
/// Splats per cell of the surface of a cube that its grid is chosen for, so that a surface has few holes.
const PER_CELL: f64 = 4.0;
/// Fainter splats fill nothing; chosen.
const OPAQUE: f32 = 0.1;
/// Standard deviations that a sheet is thick: one on either side of the centres of its splats.
const SHEET_SIGMAS: f64 = 2.0;

/// Mass of every collider of a node, kg: the volume that each body fills times `density` (kg/m^3), shared among its
/// colliders by their volumes. Bodies are the parts of a node, where it has some, else the node. `graph` is that of the
/// node, and states its unit.
#[must_use]
pub fn masses(graph: &SceneGraph, node: &Node, density: f64) -> Vec<f64> {
    let volumes: Vec<f64> =
        node.colliders.iter().map(|hull| hull_volume(std::slice::from_ref(hull))).collect();
    // Share of the colliders of a body that is filled.
    let mut shares: BTreeMap<Option<usize>, f64> = BTreeMap::new();
    for part in node.colliders.iter().map(|hull| hull.part) {
        shares.entry(part).or_insert_with(|| {
            let hulls = || node.colliders.iter().zip(&volumes).filter(|(hull, _)| hull.part == part);
            let whole: f64 = hulls().map(|(_, volume)| volume).sum();
            let filled = || filled_volume(node, part, hulls().map(|(hull, _)| hull), whole) / whole;
            if whole > 0.0 { filled() } else { 0.0 }
        });
    }
    let kilograms = density * (graph.meters_per_unit / graph.frame.scale).powi(3);
    let hulls = node.colliders.iter().zip(&volumes);
    hulls.map(|(hull, volume)| (shares[&hull.part] * volume * kilograms).max(LEAST_MASS)).collect()
}

/// Volume that the splats of a body fill within its colliders, cubic world units; at most `whole`, that of these.
fn filled_volume<'a>(
    node: &Node,
    part: Option<usize>,
    hulls: impl Iterator<Item = &'a ConvexHull>,
    whole: f64,
) -> f64 {
    let range = match (&node.motion, part) {
        (Motion::Parts(motion), Some(part)) => motion.parts.get(part).map(|part| part.splats.clone()),
        _ => None,
    };
    let range = range.unwrap_or(0..node.splats.len());
    let corners = hulls.flat_map(|hull| &hull.points).map(|point| DVec3::from_array(point.map(f64::from)));
    let (low, high) = corners
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), point| (low.min(point), high.max(point)));
    let (splats, size) = (&node.splats, high - low);
    let centre = |index: &usize| DVec3::from_array(splats.means[*index].map(f64::from));
    let opaque: Vec<usize> = range
        .filter(|index| splats.opacities[*index] >= OPAQUE)
        .filter(|index| {
            let centre = centre(index);
            centre.cmpge(low).all() && centre.cmple(high).all()
        })
        .collect();
    let longest = size.max_element();
    if opaque.is_empty() || !(longest.is_finite() && longest > 0.0) {
        return whole;
    }
    // A cube has six sides of cells squared.
    let cells = (opaque.len() as f64 / (6.0 * PER_CELL)).sqrt().clamp(FEWEST_CELLS, MOST_CELLS).floor();
    let edge = longest / cells;
    let mut grid = Grid::new((size / edge).ceil().as_ivec3().max(IVec3::ONE));
    for index in &opaque {
        // A splat covers its surroundings, as far as a standard deviation.
        let axes = quaternion::to_rotation(splats.orientations[*index].map(f64::from));
        let reaches = (0..3).flat_map(|axis| {
            let reach = DVec3::from_array(axes.map(|row| row[axis])) * f64::from(splats.scales[*index][axis]);
            [reach, -reach]
        });
        for place in reaches.chain([DVec3::ZERO]).map(|reach| centre(index) + reach) {
            grid.fill(((place - low) / edge).floor().as_ivec3());
        }
    }
    let (solid, sheet) = grid.solid_and_sheet();
    let least = |index: &usize| f64::from(splats.scales[*index].into_iter().fold(f32::INFINITY, f32::min));
    let sigmas: Vec<f64> = opaque.iter().map(least).collect();
    let thickness = SHEET_SIGMAS * weighted_quantile(&sigmas, &vec![1.0; sigmas.len()], 0.5);
    let filled = solid as f64 * edge.powi(3) + sheet as f64 * edge.powi(2) * thickness.min(edge);
    filled.min(whole)
}

/// Cells, each with splats or without.
struct Grid {
    size: IVec3,
    filled: Vec<bool>,
}

impl Grid {
    fn new(size: IVec3) -> Self {
        Self { size, filled: vec![false; (size.x * size.y * size.z) as usize] }
    }

    fn index(&self, cell: IVec3) -> usize {
        ((cell.z * self.size.y + cell.y) * self.size.x + cell.x) as usize
    }

    fn fill(&mut self, cell: IVec3) {
        // What lies on the sides belongs to the outer cells.
        let index = self.index(cell.clamp(IVec3::ZERO, self.size - 1));
        self.filled[index] = true;
    }

    fn cells(&self) -> impl Iterator<Item = IVec3> {
        let size = self.size;
        (0..size.z)
            .flat_map(move |z| (0..size.y).flat_map(move |y| (0..size.x).map(move |x| IVec3::new(x, y, z))))
    }

    /// Number of cells that are filled through, and of the others that have splats.
    fn solid_and_sheet(&self) -> (usize, usize) {
        // For every cell, along how many axes it has splats before and behind it.
        let mut between = vec![0_u8; self.filled.len()];
        for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
            let length = self.size.dot(axis);
            for start in self.cells().filter(|cell| cell.dot(axis) == 0) {
                let along = |step: i32| self.index(start + step * axis);
                let mut ends = (0..length).filter(|step| self.filled[along(*step)]);
                let (first, last) = (ends.next(), ends.next_back());
                if let (Some(first), Some(last)) = (first, last) {
                    (first + 1..last).for_each(|step| between[along(step)] += 1);
                }
            }
        }
        let enclosed = |index: usize| between[index] >= if self.filled[index] { 3 } else { 2 };
        let is_in = |cell: IVec3| cell.cmpge(IVec3::ZERO).all() && cell.cmplt(self.size).all();
        let is_open = |cell: IVec3| {
            !is_in(cell) || {
                let index = self.index(cell);
                !self.filled[index] && !enclosed(index)
            }
        };
        let steps: Vec<IVec3> = (-1..=1)
            .flat_map(|z| (-1..=1).flat_map(move |y| (-1..=1).map(move |x| IVec3::new(x, y, z))))
            .collect();
        let sides = [IVec3::X, IVec3::Y, IVec3::Z].map(|axis| [axis, -axis]);
        let inside = |cell: IVec3| {
            let index = self.index(cell);
            // Holes between the splats of a sheet are open on both of its sides, and steep sheets fill several cells.
            enclosed(index)
                && match self.filled[index] {
                    true => !steps.iter().any(|step| is_open(cell + *step)),
                    false => sides.as_flattened().iter().filter(|step| is_open(cell + **step)).count() <= 1,
                }
        };
        let around =
            |cell: IVec3| steps.iter().map(|step| cell + *step).any(|cell| is_in(cell) && inside(cell));
        let (mut solid, mut sheet) = (0, 0);
        for cell in self.cells() {
            let is_filled = self.filled[self.index(cell)];
            if inside(cell) || (is_filled && around(cell)) {
                solid += 1;
            } else if is_filled {
                sheet += 1;
            }
        }
        (solid, sheet)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::CaptureFrame;
    use crate::shape::colliders::colliders;
    use crate::testing::{graph_of, node_of};

    /// Points of a sequence that is spread out, in [0, 1)^2.
    fn spread(count: usize) -> impl Iterator<Item = (f64, f64)> {
        let steps = (0.754_877_666_246_693, 0.569_840_290_998_053);
        (1..=count).map(move |k| ((steps.0 * k as f64).fract(), (steps.1 * k as f64).fract()))
    }

    /// Mass of splats of 2 mm at some places, kg, at 1000 kg/m^3, and of their hull.
    fn mass(places: &[DVec3]) -> (f64, f64) {
        let mut node = node_of(places, [0.008, 0.008, 0.002]);
        node.colliders = colliders(&node, 1);
        (masses(&graph_of(Vec::new()), &node, 1000.0).iter().sum(), 1000.0 * hull_volume(&node.colliders))
    }

    /// Places on the faces of a box of 0.3 x 0.2 x 0.2 m, without those that are left out.
    fn faces(without: &[usize]) -> Vec<DVec3> {
        let size = DVec3::new(0.3, 0.2, 0.2);
        let faces = (0..6).filter(|face| !without.contains(face));
        faces
            .flat_map(|face| {
                spread(900).map(move |(u, v)| {
                    let side = f64::from(face as u8 % 2);
                    let at = match face / 2 {
                        0 => DVec3::new(side, u, v),
                        1 => DVec3::new(u, side, v),
                        _ => DVec3::new(u, v, side),
                    };
                    at * size
                })
            })
            .collect()
    }

    #[test]
    fn a_closed_box_is_full_also_where_nobody_saw_its_bottom() {
        for without in [&[][..], &[4]] {
            let (mass, hull) = mass(&faces(without));
            assert!((10.5..=hull).contains(&mass), "{mass} of {hull} kg");
        }
    }

    #[test]
    fn a_bent_cloth_weighs_its_sheet_and_not_its_hull() {
        // 0.4 x 0.4 m, bent upwards by 0.15 m: 0.2 m^2 of 4 mm.
        let places: Vec<DVec3> = spread(5000)
            .map(|(u, v)| DVec3::new(0.4 * (u - 0.5), 0.4 * (v - 0.5), 0.6 * (u - 0.5) * (u - 0.5)))
            .collect();
        // A ring of the same width: nothing fills its hole.
        let ring: Vec<DVec3> = spread(9000)
            .map(|(u, v)| DVec3::new((u * TAU).cos(), (u * TAU).sin(), 0.0) * (0.15 + 0.05 * v))
            .collect();
        let (ring, disc) = mass(&ring);
        assert!(ring < 0.8 * disc, "{ring} of {disc} kg");
        let (mass, hull) = mass(&places);
        assert!(hull > 8.0, "{hull}");
        assert!((0.6..2.0).contains(&mass), "{mass} of {hull} kg");
    }

    #[test]
    fn small_things_keep_a_mass_that_simulators_take_and_units_count() {
        let places: Vec<DVec3> = faces(&[]).iter().map(|place| 0.01 * *place).collect();
        let mut node = node_of(&places, [1e-5; 3]);
        node.colliders = colliders(&node, 1);
        let graph = graph_of(Vec::new());
        assert_eq!(masses(&graph, &node, DENSITY), [LEAST_MASS]);
        let in_hundreds = SceneGraph { meters_per_unit: 100.0, ..graph.clone() };
        let scale = CaptureFrame { scale: 0.01, ..CaptureFrame::default() };
        for graph in [in_hundreds, SceneGraph { frame: scale, ..graph }] {
            let hundredfold = masses(&graph, &node, DENSITY)[0];
            assert!((3.0..4.0).contains(&hundredfold), "{hundredfold} kg");
        }
    }
}
