//! Nearest neighbours in point sets of any kind, among them clouds with thousands of coincident points.

use std::num::NonZeroUsize;

use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// A point found by [`NearestNeighbours`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Row in the points that were indexed.
    pub row: u32,
    /// Squared distance, metres^2.
    pub squared_distance: f64,
}

/// An index of points in space.
///
/// Coincident points share one node of a k-d tree, which cannot split them; each node lists its rows.
pub struct NearestNeighbours {
    /// Over the distinct points; `None` when there are none.
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Distinct points.
    distinct: Vec<[f64; 3]>,
    /// Rows of distinct point d, ascending: `rows[row_offsets[d]..row_offsets[d + 1]]`.
    row_offsets: Vec<u32>,
    rows: Vec<u32>,
    /// Distinct point of every row.
    distinct_of_row: Vec<u32>,
}

impl NearestNeighbours {
    /// Indexes finite points.
    ///
    /// # Panics
    /// When a point is not finite, or there are 2^32 or more.
    #[must_use]
    pub fn new(points: &[[f32; 3]]) -> Self {
        assert!(points.as_flattened().iter().all(|value| value.is_finite()), "points must be finite");
        let count = u32::try_from(points.len()).expect("rows are 32-bit");
        // Adding zero makes -0 and 0 the same point.
        let point = |row: u32| points[row as usize].map(|value| f64::from(value) + 0.0);
        let compare = |a: [f64; 3], b: [f64; 3]| {
            a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(a[2].total_cmp(&b[2]))
        };
        let mut rows: Vec<u32> = (0..count).collect();
        rows.sort_unstable_by(|&a, &b| compare(point(a), point(b)).then(a.cmp(&b)));
        let mut distinct: Vec<[f64; 3]> = Vec::new();
        let mut row_offsets = Vec::new();
        let mut distinct_of_row = vec![0; points.len()];
        for (at, &row) in rows.iter().enumerate() {
            if distinct.last() != Some(&point(row)) {
                distinct.push(point(row));
                row_offsets.push(at as u32);
            }
            distinct_of_row[row as usize] = distinct.len() as u32 - 1;
        }
        row_offsets.push(count);
        let tree = (!distinct.is_empty()).then(|| {
            ImmutableKdTree::new_from_slice(&distinct).expect("distinct points are counted in 32 bits")
        });
        Self { tree, distinct, row_offsets, rows, distinct_of_row }
    }

    /// The `count` nearest points (all, when there are fewer), nearest first, then by row.
    #[must_use]
    pub fn nearest(&self, point: [f64; 3], count: usize) -> Vec<Neighbour> {
        self.search(point, count, None)
    }

    /// The `count` nearest points to an indexed row, without the row itself.
    #[must_use]
    pub fn nearest_to_row(&self, row: usize, count: usize) -> Vec<Neighbour> {
        self.search(self.distinct[self.distinct_of_row[row] as usize], count, Some(row as u32))
    }

    fn search(&self, point: [f64; 3], count: usize, without: Option<u32>) -> Vec<Neighbour> {
        // Where the row itself is left out, its own node may hold nothing else.
        let nodes = (count + usize::from(without.is_some())).min(self.distinct.len());
        let (Some(tree), Some(nodes)) = (&self.tree, NonZeroUsize::new(nodes)) else { return Vec::new() };
        let mut found = Vec::new();
        for node in tree.query(&point).nearest_n::<SquaredEuclidean<f64>>(nodes).execute() {
            let node_index = node.item as usize;
            let range = self.row_offsets[node_index] as usize..self.row_offsets[node_index + 1] as usize;
            let rows = self.rows[range].iter().filter(|&&row| Some(row) != without);
            // A node's rows ascend, so its first `count` are the ones that can be needed.
            found.extend(rows.take(count).map(|&row| Neighbour { row, squared_distance: node.distance }));
        }
        found.sort_by(|a, b| a.squared_distance.total_cmp(&b.squared_distance).then(a.row.cmp(&b.row)));
        found.truncate(count);
        found
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    fn brute_force(points: &[[f32; 3]], row: usize, count: usize) -> Vec<f64> {
        let squared_distance = |other: &[f32; 3]| {
            (0..3).map(|k| (f64::from(other[k]) - f64::from(points[row][k])).powi(2)).sum::<f64>()
        };
        let others = points.iter().enumerate().filter(|(other, _)| *other != row);
        let mut distances: Vec<f64> = others.map(|(_, point)| squared_distance(point)).collect();
        distances.sort_by(f64::total_cmp);
        distances.truncate(count);
        distances
    }

    fn check(points: &[[f32; 3]], rows: impl Iterator<Item = usize>) {
        let index = NearestNeighbours::new(points);
        for row in rows {
            let found = index.nearest_to_row(row, 3);
            assert!(found.iter().all(|neighbour| neighbour.row as usize != row));
            let found: Vec<f64> = found.iter().map(|neighbour| neighbour.squared_distance).collect();
            assert_eq!(found, brute_force(points, row, 3), "row {row}");
        }
    }

    #[test]
    fn random_points_agree_with_brute_force() {
        let mut rng = Pcg64::seed_from_u64(1);
        let points: Vec<[f32; 3]> =
            (0..3000).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
        check(&points, (0..points.len()).step_by(37));
    }

    #[test]
    fn coincident_points_agree_with_brute_force() {
        let mut rng = Pcg64::seed_from_u64(2);
        // Few distinct places, all of them crowded, with zeros of both signs.
        let points: Vec<[f32; 3]> = (0..2000)
            .map(|_| std::array::from_fn(|_| [-0.0, 0.0, 0.5, 1.0][rng.random_range(0..4_usize)]))
            .collect();
        check(&points, (0..points.len()).step_by(97));
    }

    #[test]
    fn planes_and_lines_agree_with_brute_force() {
        let plane: Vec<[f32; 3]> = (0..4096).map(|i| [(i % 64) as f32, 2.0, (i / 64) as f32]).collect();
        check(&plane, (0..plane.len()).step_by(211));
        let line: Vec<[f32; 3]> = (0..4000).map(|i| [1.0, (i * i) as f32 * 1e-4, 1.0]).collect();
        check(&line, (0..line.len()).step_by(211));
    }

    #[test]
    fn ten_thousand_identical_points_are_at_distance_zero() {
        let index = NearestNeighbours::new(&vec![[1.5, -2.0, 0.25]; 10_000]);
        let found = index.nearest_to_row(1, 3);
        let expected: Vec<Neighbour> = [0, 2, 3].map(|row| Neighbour { row, squared_distance: 0.0 }).to_vec();
        assert_eq!(found, expected);
    }

    #[test]
    fn too_few_points_give_what_there_is() {
        assert!(NearestNeighbours::new(&[]).nearest([0.0; 3], 3).is_empty());
        let one = NearestNeighbours::new(&[[1.0, 0.0, 0.0]]);
        assert!(one.nearest_to_row(0, 3).is_empty());
        assert_eq!(one.nearest([0.0; 3], 3), [Neighbour { row: 0, squared_distance: 1.0 }]);
        assert!(one.nearest([0.0; 3], 0).is_empty());
    }
}
