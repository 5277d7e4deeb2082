//! A few rigid parts, found by clustering the paths of Gaussians.
//!
//! Every part is a rigid motion. A Gaussian fits a part as well as it stands still in the part's moving frame:
//! its cost is the RMS distance, over time, from its own mean place there, so that no shape has to be known.
//! Parts are found one after the other: the worst part is split by several criteria (by the main mode of its
//! residuals, by their size, and across the axes of its shape), all parts are refined by alternating between
//! fitting motions and choosing parts, and the best split is kept. Gaussians that several parts fit equally well
//! follow their neighbours, so that parts hang together.
//!
//! Nothing is drawn at random. Outliers weigh in by the kernel of [`cif_geometry::align::procrustes`]; they make no parts
//! of their own unless they are many enough.

use cif_geometry::RigidTransform;
use cif_geometry::align::procrustes::weighted_procrustes;
use cif_geometry::stats::weighted_quantile;
use glam::{DMat3, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::field_motion::frames::Frame;
use crate::motion::residuals::trimmed_rms;
use crate::shape::proxy::systematic;
use crate::vectors::vector;

/// Gaussians that parts are found from.
const SAMPLED_GAUSSIANS: usize = 512;
/// Times that parts are found from.
const SAMPLED_TIMES: usize = 16;
/// Sweeps of refinement at most.
const SWEEPS: usize = 6;
/// Least Gaussians of a part; fewer fix no rotation that holds up against noise.
const LEAST: usize = 4;
/// Neighbours that a Gaussian may follow.
const NEIGHBOURS: usize = 8;
/// Parts whose cost is within this factor of the best one, or below a quarter of the tolerance, fit as well.
const AS_WELL: f64 = 1.15;

/// Parts for every position of a group.
#[derive(Clone, Debug, PartialEq)]
pub struct Partition {
    /// Part of every position.
    pub labels: Vec<usize>,
    /// Number of parts, each with at least one position.
    pub count: usize,
    /// Decisive residual among the Gaussians and times that the parts were found from.
    pub decisive: f64,
}

/// Paths of the sampled Gaussians: `[time][Gaussian]`.
struct Paths {
    points: Vec<Vec<DVec3>>,
    weights: Vec<f64>,
    trim: f64,
    tolerance: f64,
    least: usize,
}

/// A rigid motion: `world_from_part` at every sampled time.
type Poses = Vec<RigidTransform>;

/// Parts, and how well they fit.
#[derive(Clone)]
struct Solution {
    labels: Vec<usize>,
    motions: Vec<Poses>,
    /// Mean over the times of the squared trimmed RMS.
    objective: f64,
    decisive: f64,
}

/// Partitions into 2, 3, ... parts, at most `max_parts`, until one is inside the tolerance.
///
/// `frames` hold the group's Gaussians alone, in its order; `weights` are theirs. Fewer come back where a
/// group has too few Gaussians, or more parts do not fit better; none where it cannot be split at all.
#[must_use]
pub fn partitions(
    frames: &[Frame],
    weights: &[f64],
    tolerance: f64,
    trim: f64,
    max_parts: usize,
) -> Vec<Partition> {
    let count = weights.len();
    let least = (count / (2 * max_parts)).clamp(1, LEAST);
    if count < 2 * least || frames.len() < 2 {
        return Vec::new();
    }
    let order: Vec<u32> = (0..count as u32).collect();
    let picked =
        if count <= SAMPLED_GAUSSIANS { order } else { systematic(&order, weights, SAMPLED_GAUSSIANS) };
    let times = spread(frames.len(), SAMPLED_TIMES);
    let paths = Paths {
        points: times
            .iter()
            .map(|&time| picked.iter().map(|&k| vector(frames[time].means[k as usize])).collect())
            .collect(),
        weights: picked.iter().map(|&k| weights[k as usize]).collect(),
        trim,
        tolerance,
        least,
    };
    let all: Vec<usize> = (0..picked.len()).collect();
    let mut solution = paths.evaluate(vec![0; picked.len()], vec![paths.fit(&all)]);
    let mut found = Vec::new();
    while solution.motions.len() < max_parts && solution.decisive > tolerance {
        let Some(finer) = paths.split(&solution) else { break };
        solution = finer;
        found.push(assign_all(frames, &times, tolerance, &solution));
    }
    found.retain(|partition| partition.count > 1);
    found
}

/// At most `limit` of `count` positions, evenly spread, ends included.
fn spread(count: usize, limit: usize) -> Vec<usize> {
    if count <= limit {
        return (0..count).collect();
    }
    (0..limit).map(|k| k * (count - 1) / (limit - 1)).collect()
}

impl Paths {
    /// Rigid motion of some Gaussians: against their shape at the first time, then twice against their mean
    /// shape, with outliers weighing less.
    fn fit(&self, members: &[usize]) -> Poses {
        let first = &self.points[0];
        let centre = members.iter().map(|&k| first[k]).sum::<DVec3>() / members.len().max(1) as f64;
        let mut shape: Vec<DVec3> = members.iter().map(|&k| first[k] - centre).collect();
        let mut weights: Vec<f64> = members.iter().map(|&k| self.weights[k]).collect();
        if weights.iter().sum::<f64>() <= 0.0 {
            weights.fill(1.0);
        }
        let base = weights.clone();
        let rest = RigidTransform { translation: centre, ..RigidTransform::IDENTITY };
        let mut poses = vec![rest; self.points.len()];
        for _ in 0..3 {
            let mut rotation = DMat3::IDENTITY;
            for (pose, points) in poses.iter_mut().zip(&self.points) {
                let target: Vec<DVec3> = members.iter().map(|&k| points[k]).collect();
                if let Some(fit) = weighted_procrustes(&shape, &target, &weights, rotation) {
                    *pose = fit;
                    rotation = fit.rotation;
                }
            }
            let costs: Vec<f64> = members
                .iter()
                .zip(&mut shape)
                .map(|(&k, place)| {
                    let (mean, cost) = self.stillness(k, &poses);
                    *place = mean;
                    cost
                })
                .collect();
            let kernel = (2.5 * weighted_quantile(&costs, &base, 0.5)).max(1e-3 * self.tolerance).max(1e-12);
            for ((weight, base), cost) in weights.iter_mut().zip(&base).zip(&costs) {
                *weight = base / (1.0 + (cost / kernel).powi(2)).powi(2);
            }
        }
        poses
    }

    /// Mean place of a Gaussian in a moving frame, and its RMS distance from there.
    fn stillness(&self, gaussian: usize, poses: &[RigidTransform]) -> (DVec3, f64) {
        let places = self.points.iter().zip(poses).map(|(points, pose)| local(pose, points[gaussian]));
        let count = poses.len() as f64;
        let mean = places.clone().sum::<DVec3>() / count;
        let square = places.map(|place| (place - mean).length_squared()).sum::<f64>() / count;
        (mean, square.sqrt())
    }

    /// Scores a partition: mean of the squared trimmed RMS over the times, and trimmed RMS at the worst time.
    fn evaluate(&self, labels: Vec<usize>, motions: Vec<Poses>) -> Solution {
        let means: Vec<DVec3> =
            labels.iter().enumerate().map(|(k, &part)| self.stillness(k, &motions[part]).0).collect();
        let (mut objective, mut decisive) = (0.0, 0.0_f64);
        for (time, points) in self.points.iter().enumerate() {
            let distances: Vec<f64> = labels
                .iter()
                .enumerate()
                .map(|(k, &part)| (local(&motions[part][time], points[k]) - means[k]).length())
                .collect();
            let (rms, _) = trimmed_rms(&distances, &self.weights, self.trim);
            objective += rms * rms / self.points.len() as f64;
            decisive = decisive.max(rms);
        }
        Solution { labels, motions, objective, decisive }
    }

    /// Alternates between fitting motions and choosing parts; parts that become too small are given up.
    fn refine(&self, mut labels: Vec<usize>, count: usize) -> Solution {
        let mut motions: Vec<Poses> = (0..count).map(|part| self.fit(&members(&labels, part))).collect();
        for _ in 0..SWEEPS {
            let chosen: Vec<usize> = (0..labels.len()).map(|k| self.best(k, &motions)).collect();
            let smallest = (0..motions.len()).map(|part| (members(&chosen, part).len(), part)).min();
            match smallest {
                Some((size, part)) if size < self.least && motions.len() > 1 => {
                    motions.remove(part);
                    labels = (0..labels.len()).map(|k| self.best(k, &motions)).collect();
                }
                _ if chosen == labels => break,
                _ => labels = chosen,
            }
            for (part, motion) in motions.iter_mut().enumerate() {
                let members = members(&labels, part);
                if !members.is_empty() {
                    *motion = self.fit(&members);
                }
            }
        }
        self.evaluate(labels, motions)
    }

    fn best(&self, gaussian: usize, motions: &[Poses]) -> usize {
        let costs = motions.iter().map(|motion| self.stillness(gaussian, motion).1);
        let first = |best: (usize, f64), next: (usize, f64)| if next.1 < best.1 { next } else { best };
        costs.enumerate().fold((0, f64::INFINITY), first).0
    }

    /// The best of several ways to split the worst part in two.
    fn split(&self, solution: &Solution) -> Option<Solution> {
        let parts = solution.motions.len();
        let costs: Vec<f64> = solution
            .labels
            .iter()
            .enumerate()
            .map(|(k, &part)| self.stillness(k, &solution.motions[part]).1)
            .collect();
        // Outliers beyond the trimmed weight do not call for a split.
        let cap = weighted_quantile(&costs, &self.weights, 1.0 - self.trim);
        let loss = |part: usize| {
            members(&solution.labels, part)
                .iter()
                .map(|&k| self.weights[k] * costs[k].min(cap).powi(2))
                .sum::<f64>()
        };
        let mut worst: Vec<(usize, f64)> = (0..parts)
            .filter(|&part| members(&solution.labels, part).len() >= 2 * self.least)
            .map(|part| (part, loss(part)))
            .collect();
        worst.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        for (part, _) in worst.into_iter().take(2) {
            let inside = members(&solution.labels, part);
            let ways = self.ways(&inside, &solution.motions[part], &costs);
            let refined: Vec<Solution> = ways
                .par_iter()
                .filter(|apart| apart.contains(&true) && apart.contains(&false))
                .map(|apart| {
                    let mut labels = solution.labels.clone();
                    for (&k, apart) in inside.iter().zip(apart) {
                        if *apart {
                            labels[k] = parts;
                        }
                    }
                    self.refine(labels, parts + 1)
                })
                .collect();
            let best = refined.into_iter().min_by(|a, b| a.objective.total_cmp(&b.objective));
            if let Some(best) = best.filter(|best| best.objective < solution.objective) {
                return Some(best);
            }
        }
        None
    }

    /// Ways to take some members of a part away.
    fn ways(&self, members: &[usize], motion: &Poses, costs: &[f64]) -> Vec<Vec<bool>> {
        let weights: Vec<f64> = members.iter().map(|&k| self.weights[k]).collect();
        let above = |values: &[f64], cut: f64| values.iter().map(|value| *value > cut).collect::<Vec<_>>();
        let median = |values: &[f64]| weighted_quantile(values, &weights, 0.5);
        let mut ways = Vec::new();
        // By the main mode of the residual paths.
        let means: Vec<DVec3> = members.iter().map(|&k| self.stillness(k, motion).0).collect();
        let residual = |time: usize, k: usize| local(&motion[time], self.points[time][members[k]]) - means[k];
        let worst = (0..members.len()).max_by(|&a, &b| {
            (costs[members[a]] * weights[a]).total_cmp(&(costs[members[b]] * weights[b])).then(b.cmp(&a))
        });
        if let Some(worst) = worst {
            let mut mode: Vec<DVec3> = (0..motion.len()).map(|time| residual(time, worst)).collect();
            let score = |mode: &[DVec3], k: usize| {
                mode.iter()
                    .enumerate()
                    .map(|(time, direction)| residual(time, k).dot(*direction))
                    .sum::<f64>()
            };
            let mut scores = vec![0.0; members.len()];
            for _ in 0..4 {
                scores = (0..members.len()).map(|k| score(&mode, k)).collect();
                let norm = scores.iter().zip(&weights).map(|(s, w)| w * s * s).sum::<f64>().sqrt();
                if norm <= 0.0 {
                    break;
                }
                for (time, direction) in mode.iter_mut().enumerate() {
                    *direction = (0..members.len())
                        .map(|k| weights[k] * scores[k] / norm * residual(time, k))
                        .sum::<DVec3>();
                }
            }
            let (low, high) =
                scores.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), s| (l.min(*s), h.max(*s)));
            ways.push(above(&scores, median(&scores)));
            ways.push(above(&scores, (low + high) / 2.0));
        }
        // By the size of the residuals.
        let sizes: Vec<f64> = members.iter().map(|&k| costs[k]).collect();
        ways.push(above(&sizes, 2.5 * median(&sizes)));
        ways.push(above(&sizes, weighted_quantile(&sizes, &weights, 0.75)));
        // Across the shape.
        for axis in axes(&means, &weights) {
            let along: Vec<f64> = means.iter().map(|mean| axis.dot(*mean)).collect();
            ways.push(above(&along, median(&along)));
        }
        ways
    }
}

fn local(pose: &RigidTransform, point: DVec3) -> DVec3 {
    pose.rotation.transpose() * (point - pose.translation)
}

fn members(labels: &[usize], part: usize) -> Vec<usize> {
    (0..labels.len()).filter(|&k| labels[k] == part).collect()
}

/// Principal axes of weighted points.
fn axes(points: &[DVec3], weights: &[f64]) -> [DVec3; 3] {
    let total = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let mean = points.iter().zip(weights).map(|(p, w)| *w * *p).sum::<DVec3>() / total;
    let mut covariance = Matrix3::zeros();
    for (point, weight) in points.iter().zip(weights) {
        let d = nalgebra::Vector3::from((*point - mean).to_array());
        covariance += d * d.transpose() * (*weight / total);
    }
    if !covariance.iter().all(|value| value.is_finite()) {
        return [DVec3::X, DVec3::Y, DVec3::Z];
    }
    let eigen = covariance.symmetric_eigen().eigenvectors;
    std::array::from_fn(|k| DVec3::new(eigen[(0, k)], eigen[(1, k)], eigen[(2, k)]))
}

/// Parts of all Gaussians of the group; heavier parts come first.
fn assign_all(frames: &[Frame], times: &[usize], tolerance: f64, solution: &Solution) -> Partition {
    let count = frames[0].means.len();
    let paths = Paths {
        points: times.iter().map(|&time| frames[time].means.iter().map(|m| vector(*m)).collect()).collect(),
        weights: Vec::new(),
        trim: 0.0,
        tolerance,
        least: 1,
    };
    let motions = &solution.motions;
    let costs: Vec<Vec<f64>> =
        (0..count).map(|k| motions.iter().map(|motion| paths.stillness(k, motion).1).collect()).collect();
    let best = |costs: &[f64]| (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
    let mut labels: Vec<usize> = costs.iter().map(|costs| best(costs)).collect();
    follow_neighbours(&paths.points[0], &costs, tolerance, &mut labels);
    // Number the parts that are left by their size.
    let mut sizes: Vec<(usize, usize)> =
        (0..motions.len()).map(|part| (members(&labels, part).len(), part)).collect();
    sizes.retain(|(size, _)| *size > 0);
    sizes.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut number = vec![0; motions.len()];
    for (position, (_, part)) in sizes.iter().enumerate() {
        number[*part] = position;
    }
    for label in &mut labels {
        *label = number[*label];
    }
    Partition { labels, count: sizes.len(), decisive: solution.decisive }
}

/// Gives Gaussians that several parts fit as well the part of most of their neighbours.
fn follow_neighbours(points: &[DVec3], costs: &[Vec<f64>], tolerance: f64, labels: &mut Vec<usize>) {
    let coordinates: Vec<[f64; 3]> = points.iter().map(|point| point.to_array()).collect();
    // Only degenerate point sets (thousands of equal centres) have no tree.
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&coordinates) else { return };
    let nearest = std::num::NonZero::new(NEIGHBOURS + 1).expect("more than zero neighbours");
    let neighbours: Vec<Vec<usize>> = coordinates
        .iter()
        .enumerate()
        .map(|(k, point)| {
            let found = tree.query(point).nearest_n::<SquaredEuclidean<f64>>(nearest).execute();
            found.into_iter().map(|found| found.item as usize).filter(|&other| other != k).collect()
        })
        .collect();
    for _ in 0..3 {
        let next: Vec<usize> = (0..labels.len())
            .map(|k| {
                let lowest = costs[k].iter().copied().fold(f64::INFINITY, f64::min);
                let enough = (AS_WELL * lowest).max(0.25 * tolerance);
                let votes = |part: usize| {
                    neighbours[k].iter().filter(|&&other| labels[other] == part).count()
                        + usize::from(labels[k] == part)
                };
                let mut best = labels[k];
                for part in 0..costs[k].len() {
                    if costs[k][part] <= enough && votes(part) > votes(best) {
                        best = part;
                    }
                }
                best
            })
            .collect();
        if next == *labels {
            break;
        }
        *labels = next;
    }
}
