//! Initial points: read, thinned, coloured, or drawn where the cameras look.

mod color;
mod random;

use std::collections::BTreeMap;
use std::path::Path;

pub(crate) use color::sample_colors;
pub(crate) use random::draw;

use crate::files::npy;
use crate::{Error, PointCloud};

/// First voxel edge of the thinning, metres (methods reference 1.1).
const VOXEL: f64 = 0.02;

/// Growth of the voxel edge per round, metres (methods reference 1.1).
const VOXEL_STEP: f64 = 0.01;

/// Colour of points whose source has none and that no image shows.
pub(crate) const GREY: [u8; 3] = [128; 3];

/// Points of a file.
pub(crate) struct RawPoints {
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) colors: Option<Vec<[u8; 3]>>,
}

/// Reads `points.npy`: `[P, 3]` world positions.
///
/// # Errors
/// When the file is not an array of that shape.
pub(crate) fn read_npy(path: &Path) -> Result<RawPoints, Error> {
    let matrix = npy::read_matrix(path)?;
    if matrix.columns != 3 {
        return Err(Error::invalid(
            path,
            format!("shape [{}, {}] where [points, 3] is expected", matrix.rows, matrix.columns),
        ));
    }
    Ok(RawPoints {
        positions: matrix.values.chunks_exact(3).map(|p| [p[0] as f32, p[1] as f32, p[2] as f32]).collect(),
        colors: None,
    })
}

impl RawPoints {
    /// Drops points that are not finite, and says how many.
    pub(crate) fn retain_finite(&mut self) -> usize {
        let keep: Vec<bool> = self.positions.iter().map(|p| p.iter().all(|v| v.is_finite())).collect();
        let dropped = keep.iter().filter(|keep| !**keep).count();
        if dropped > 0 {
            let mut flags = keep.iter();
            self.positions.retain(|_| *flags.next().expect("one flag per point"));
            if let Some(colors) = &mut self.colors {
                let mut flags = keep.iter();
                colors.retain(|_| *flags.next().expect("one flag per point"));
            }
        }
        dropped
    }
}

impl PointCloud {
    /// The cloud with at most `limit` points: while there are more, points inside one voxel become their mean,
    /// with an edge of 0.02 m, growing by 0.01 m a round (methods reference 1.1). After fifty rounds the edge
    /// grows by a quarter a round instead, so that clouds in other units end too.
    #[must_use]
    pub fn thinned(&self, limit: usize) -> Self {
        let mut cloud = self.clone();
        let mut voxel = VOXEL;
        let mut round = 0;
        while cloud.positions.len() > limit.max(1) {
            cloud = cloud.averaged_in_voxels(voxel);
            round += 1;
            voxel = if round < 50 { voxel + VOXEL_STEP } else { voxel * 1.25 };
        }
        cloud
    }

    /// One mean point per occupied voxel, ordered by voxel. The grid starts half a voxel below the lowest
    /// corner of the cloud.
    fn averaged_in_voxels(&self, voxel: f64) -> Self {
        struct Sum {
            position: [f64; 3],
            color: [u64; 3],
            count: u64,
        }
        let low: [f64; 3] = std::array::from_fn(|axis| {
            self.positions.iter().map(|p| f64::from(p[axis])).fold(f64::INFINITY, f64::min) - voxel / 2.0
        });
        let mut sums: BTreeMap<[i64; 3], Sum> = BTreeMap::new();
        for (position, color) in self.positions.iter().zip(&self.colors) {
            let key =
                std::array::from_fn(|axis| ((f64::from(position[axis]) - low[axis]) / voxel).floor() as i64);
            let sum = sums.entry(key).or_insert(Sum { position: [0.0; 3], color: [0; 3], count: 0 });
            for axis in 0..3 {
                sum.position[axis] += f64::from(position[axis]);
                sum.color[axis] += u64::from(color[axis]);
            }
            sum.count += 1;
        }
        Self {
            positions: sums.values().map(|s| s.position.map(|v| (v / s.count as f64) as f32)).collect(),
            colors: sums.values().map(|s| s.color.map(|v| ((v + s.count / 2) / s.count) as u8)).collect(),
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
        // Points 1 mm apart: the first voxel starts 1 cm below the first point and holds ten of them.
        let thinned = line(100, 1e-3).thinned(99);
        assert_eq!(thinned.positions.len(), 6);
        assert!((thinned.positions[0][0] - 0.0045).abs() < 1e-6, "{:?}", thinned.positions[0]);
        assert_eq!(thinned.colors[0], [5, 10, 20]);
        assert!(line(100, 1e-3).thinned(3).positions.len() <= 3);
    }

    #[test]
    fn clouds_in_other_units_end() {
        let thinned = line(1000, 1e6).thinned(7);
        assert!((1..=7).contains(&thinned.positions.len()));
    }

    #[test]
    fn coincident_points_become_one() {
        assert_eq!(line(50, 0.0).thinned(1).positions.len(), 1);
    }

    #[test]
    fn non_finite_points_are_dropped_with_their_colors() {
        let mut points = RawPoints {
            positions: vec![[0.0; 3], [f32::NAN, 0.0, 0.0], [2.0; 3]],
            colors: Some(vec![[1; 3], [2; 3], [3; 3]]),
        };
        assert_eq!(points.retain_finite(), 1);
        assert_eq!(points.positions, vec![[0.0; 3], [2.0; 3]]);
        assert_eq!(points.colors, Some(vec![[1; 3], [3; 3]]));
    }
}
