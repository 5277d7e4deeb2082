//! Initial points: read, thinned, coloured, or drawn where the cameras look.

mod color;
mod made_up;
mod random;
mod sight;

use std::collections::HashMap;

use cif_geometry::Bounds;
use glam::DVec3;

pub(crate) use color::sample_colors;
pub(crate) use made_up::are_made_up;
pub(crate) use random::draw;
pub(crate) use sight::unseen_warning;

use crate::PointCloud;

/// First voxel edges of the thinning between points that lie evenly on a surface.
const VOXELS_PER_POINT: f64 = 8.0;

/// Growth of the voxel edge per round of the thinning.
const VOXEL_GROWTH: f64 = 1.2;

/// Voxel edge of a cloud without any size, in its unit.
const SMALLEST_VOXEL: f64 = 1e-9;

/// Colour of points whose source has none and that no image shows.
pub(crate) const GREY: [u8; 3] = [128; 3];

/// Side of a cloud's box, in sides of the box of its middle half, from which the points far outside are outliers.
/// A uniform cube has 2, a normal distribution of a million points about 7.
const MOST_SPREAD: f64 = 30.0;

/// Half side of the box that is kept then, in sides of the box of the middle half.
const KEPT_SPREAD: f64 = 10.0;

impl PointCloud {
    /// Box of the cloud. Where some points lie far outside what holds the middle half of them (wrong matches, a sky
    /// dome), the box of the others: what is measured in sizes of the box, such as voxels and planes, would hold
    /// everything else in one cell.
    #[must_use]
    pub fn core_bounds(&self) -> Bounds {
        let place = |p: &[f32; 3]| DVec3::from_array(p.map(f64::from));
        let whole = Bounds::around(self.positions.iter().map(place));
        let n = self.positions.len();
        if n < 8 {
            return whole;
        }
        let quartiles = [0, 1, 2].map(|axis| {
            let mut along: Vec<f32> = self.positions.iter().map(|p| p[axis]).collect();
            along.sort_unstable_by(f32::total_cmp);
            [along[n / 4], along[3 * n / 4]].map(f64::from)
        });
        let side = quartiles.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
        // A cloud of one place has no scale of its own.
        if side <= 0.0 || side.is_nan() || whole.size().max_element() <= MOST_SPREAD * side {
            return whole;
        }
        let middle = DVec3::from_array(quartiles.map(|[low, high]| f64::midpoint(low, high)));
        let is_near = |p: &DVec3| (*p - middle).abs().max_element() <= KEPT_SPREAD * side;
        Bounds::around(self.positions.iter().map(place).filter(is_near))
    }

    /// The cloud with at most `limit` points, at least one: where there are more, the points inside one voxel
    /// become their mean, in the order of their first points. Voxels start small for the cloud's box and grow by a
    /// fifth until few enough are occupied, so that the unit of length does not matter.
    #[must_use]
    pub fn thinned(&self, limit: usize) -> Self {
        let limit = limit.max(1);
        if self.positions.len() <= limit {
            return self.clone();
        }
        let bounds = self.core_bounds();
        // Of N points on a surface, a voxel of 1 / sqrt(N) of the box holds about one; start well below.
        let mut voxel =
            (bounds.size().max_element() / (limit as f64).sqrt() / VOXELS_PER_POINT).max(SMALLEST_VOXEL);
        loop {
            let cloud = self.averaged_in_voxels(voxel);
            if cloud.positions.len() <= limit {
                return cloud;
            }
            voxel *= VOXEL_GROWTH;
        }
    }

    /// One mean point per occupied voxel, in the order of their first points.
    fn averaged_in_voxels(&self, voxel: f64) -> Self {
        struct Sum {
            position: [f64; 3],
            color: [u64; 3],
            count: u64,
        }
        let mut slots = HashMap::<[i64; 3], usize>::new();
        let mut sums: Vec<Sum> = Vec::new();
        for (position, color) in self.positions.iter().zip(&self.colors) {
            let key = position.map(|v| (f64::from(v) / voxel).floor() as i64);
            let slot = *slots.entry(key).or_insert(sums.len());
            if slot == sums.len() {
                sums.push(Sum { position: [0.0; 3], color: [0; 3], count: 0 });
            }
            let sum = &mut sums[slot];
            for axis in 0..3 {
                sum.position[axis] += f64::from(position[axis]);
                sum.color[axis] += u64::from(color[axis]);
            }
            sum.count += 1;
        }
        Self {
            positions: sums.iter().map(|s| s.position.map(|v| (v / s.count as f64) as f32)).collect(),
            colors: sums.iter().map(|s| s.color.map(|v| ((v + s.count / 2) / s.count) as u8)).collect(),
            source: self.source.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PointSource;

    fn line(count: usize, step: f32) -> PointCloud {
        PointCloud {
            positions: (0..count).map(|k| [k as f32 * step, 0.0, 0.0]).collect(),
            colors: (0..count).map(|k| [(k % 200) as u8, 10, 20]).collect(),
            source: PointSource::Random,
        }
    }

    #[test]
    fn small_clouds_are_kept() {
        let cloud = line(10, 1e-4);
        assert_eq!(cloud.thinned(10), cloud);
    }

    #[test]
    fn thinning_averages_inside_voxels() {
        // Points a unit apart: the first voxel small enough has an edge of 16.76 and holds 0 to 16.
        let thinned = line(100, 1.0).thinned(7);
        assert_eq!(thinned.positions[0], [8.0, 0.0, 0.0]);
        assert_eq!(thinned.colors[0], [8, 10, 20]);
        assert_eq!(thinned.positions.len(), 6);
    }

    #[test]
    fn thinning_keeps_the_shape_and_most_of_the_limit() {
        let grid = PointCloud {
            positions: (0..40_000).map(|k| [(k % 200) as f32 * 0.01, (k / 200) as f32 * 0.01, 1.0]).collect(),
            colors: (0..40_000).map(|k| [(k % 200) as u8, (k / 200) as u8, 128]).collect(),
            source: PointSource::Random,
        };
        let thinned = grid.thinned(5_000);
        assert!((2_001..=5_000).contains(&thinned.positions.len()), "{}", thinned.positions.len());
        for (position, color) in thinned.positions.iter().zip(&thinned.colors) {
            for axis in 0..2 {
                assert!(
                    (position[axis] * 100.0 - f32::from(color[axis])).abs() < 0.51,
                    "{position:?} {color:?}"
                );
            }
            assert!((position[2] - 1.0).abs() < 1e-6 && color[2] == 128);
        }
    }

    #[test]
    fn outliers_neither_stretch_the_box_nor_swallow_the_scene() {
        let grid = |outliers: usize| {
            let mut positions: Vec<[f32; 3]> =
                (0..10_000).map(|k| [(k % 100) as f32 * 0.01, (k / 100) as f32 * 0.01, 0.3]).collect();
            positions.extend((0..outliers).map(|k| [(k as f32 - 1000.0) * 3.0, 900.0, -(k as f32)]));
            PointCloud { colors: vec![[9; 3]; positions.len()], positions, source: PointSource::Random }
        };
        let bounds = grid(2000).core_bounds();
        assert_eq!(bounds, grid(0).core_bounds());
        assert!((bounds.size() - DVec3::new(0.99, 0.99, 0.0)).length() < 1e-6, "{bounds:?}");
        // A fifth of the points lies far away; what is left of them still leaves room for the scene.
        let thinned = grid(2000).thinned(4000);
        let inside = thinned.positions.iter().filter(|p| p[1] < 1.0).count();
        assert!(inside > 1000, "{inside} of {} points are the scene's", thinned.positions.len());
        assert!(thinned.positions.len() <= 4000);
    }

    #[test]
    fn the_unit_of_length_does_not_matter() {
        for step in [1e-6, 1e-3, 1e6] {
            let thinned = line(1000, step).thinned(40);
            assert!((20..=40).contains(&thinned.positions.len()), "{step}: {}", thinned.positions.len());
        }
    }

    #[test]
    fn coincident_points_become_one() {
        assert_eq!(line(50, 0.0).thinned(1).positions.len(), 1);
    }
}
