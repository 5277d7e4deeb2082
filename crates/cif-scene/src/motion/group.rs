//! Gaussians of one node, with the fits of a static model and of one rigid body.

use cif_field::Gaussians;
use cif_geometry::align::procrustes::{residuals, robust_procrustes};
use cif_geometry::stats::weighted_quantile;
use cif_geometry::{RigidTransform, quaternion};
use glam::DVec3;

use super::keys::one_hemisphere;
use super::residuals::{ResidualSum, add_turns_between};
use crate::field_motion::frames::Frame;
use crate::graph::{PoseSample, ResidualStatistics};
use crate::shape::proxy::systematic;
use crate::vectors::{dot, quaternion_of, vector};

/// Most points that a pose is fitted to; residuals are taken over all.
const FIT_POINTS: usize = 4096;
/// Weight left out on each side when the size of a group is taken.
const SIZE_TRIM: f64 = 0.02;

/// Gaussians of one node, and what is learnt about their motion.
#[derive(Clone, Debug)]
pub struct MovingGroup {
    /// Rows of the field.
    pub rows: Vec<u32>,
    /// Weights: opacity times geometric-mean size.
    pub weights: Vec<f64>,
    /// Origin of the local frame at the reference time, world.
    pub pivot: DVec3,
    /// True when one rigid body may be fitted; the background is not one body.
    pub is_body: bool,
    /// True where all but the outliers stand still as far as a picture shows ([`crate::motion::loose`]).
    pub stands_still: bool,
    /// True where some splats travel that may show what passes over it ([`crate::motion::loose`]).
    pub is_passed: bool,
    /// True of splats of the background that move as far as a picture shows, each on a path of its own
    /// ([`crate::motion::loose`]).
    pub is_loose: bool,
    /// Share of the weight that may be outliers.
    pub trim: f64,
    /// Largest decisive residual allowed, world units.
    pub tolerance: f64,
    /// Mean shape, standing still: local frame with axes of the world.
    pub static_shape: MeanShape,
    /// Mean shape in the moving frame.
    pub rigid_shape: MeanShape,
    /// Poses `world_from_local` at the sampled times.
    pub poses: Vec<RigidTransform>,
    /// Residuals of standing still.
    pub static_residual: ResidualSum,
    /// Residuals of the rigid body.
    pub rigid_residual: ResidualSum,
    /// Residuals of rigid parts, where they were tried.
    pub parts_residual: Option<ResidualStatistics>,
    /// Track groups of the field whose poses the node has as they are, ascending; empty where its motion is fitted
    /// ([`crate::motion::recorded`]).
    pub recorded: Vec<u32>,
    /// Seconds spent on the group.
    pub seconds: f64,
    reference: Vec<DVec3>,
    fit_points: Vec<u32>,
}

/// Splats in a local frame, averaged over time.
#[derive(Clone, Debug, Default)]
pub struct MeanShape {
    /// Centres.
    pub means: Vec<DVec3>,
    /// Unit quaternions (w, x, y, z).
    pub orientations: Vec<[f64; 4]>,
    /// Log-scales.
    pub log_scales: Vec<DVec3>,
    count: f64,
}

impl MeanShape {
    /// Adds one time, seen from a local frame.
    fn add(&mut self, local_from_world: &RigidTransform, rows: &[u32], gaussians: &Frame) {
        let n = rows.len();
        if self.means.is_empty() {
            *self = Self {
                means: vec![DVec3::ZERO; n],
                orientations: vec![[0.0; 4]; n],
                log_scales: vec![DVec3::ZERO; n],
                count: 0.0,
            };
        }
        let turn = quaternion_of(&local_from_world.rotation);
        for (k, &row) in rows.iter().enumerate() {
            let row = row as usize;
            self.means[k] += local_from_world.apply(vector(gaussians.means[row]));
            self.log_scales[k] += vector(gaussians.log_scales[row]);
            if let Some(unit) = quaternion::try_normalize(gaussians.quaternions[row].map(f64::from)) {
                let local = quaternion::multiply(turn, unit);
                let sum = &mut self.orientations[k];
                let sign = if dot(*sum, local) < 0.0 { -1.0 } else { 1.0 };
                for (sum, component) in sum.iter_mut().zip(local) {
                    *sum += sign * component;
                }
            }
        }
        self.count += 1.0;
    }

    /// Gaussians as they are, around the origin of each.
    pub(crate) fn of(gaussians: &Gaussians, rows: &[u32], origin: impl Fn(u32) -> DVec3) -> Self {
        let orientation =
            |row: &u32| quaternion::try_normalize(gaussians.quaternions[*row as usize].map(f64::from));
        Self {
            means: rows.iter().map(|&row| vector(gaussians.means[row as usize]) - origin(row)).collect(),
            orientations: rows.iter().map(|row| orientation(row).unwrap_or([1.0, 0.0, 0.0, 0.0])).collect(),
            log_scales: rows.iter().map(|&row| vector(gaussians.log_scales[row as usize])).collect(),
            count: 1.0,
        }
    }

    fn finish(&mut self) {
        for mean in self.means.iter_mut().chain(&mut self.log_scales) {
            *mean /= self.count;
        }
        for orientation in &mut self.orientations {
            *orientation = quaternion::try_normalize(*orientation).unwrap_or([1.0, 0.0, 0.0, 0.0]);
        }
    }

    /// Moves the shape into another frame.
    fn transform(&mut self, target_from_local: &RigidTransform) {
        let turn = quaternion_of(&target_from_local.rotation);
        for mean in &mut self.means {
            *mean = target_from_local.apply(*mean);
        }
        for orientation in &mut self.orientations {
            *orientation = quaternion::multiply(turn, *orientation);
        }
    }
}

/// Box of the centres of rows without the outermost weight on each side.
pub(crate) fn trimmed_box(rows: &[u32], weights: &[f64], means: &[[f32; 3]]) -> (DVec3, DVec3) {
    let mut low = DVec3::ZERO;
    let mut high = DVec3::ZERO;
    for axis in 0..3 {
        let values: Vec<f64> = rows.iter().map(|&row| f64::from(means[row as usize][axis])).collect();
        low[axis] = weighted_quantile(&values, weights, SIZE_TRIM);
        high[axis] = weighted_quantile(&values, weights, 1.0 - SIZE_TRIM).max(low[axis]);
    }
    (low, high)
}

impl MovingGroup {
    /// A group of rows, with its shape at the reference time; `means` are those of all rows then.
    #[must_use]
    pub fn new(
        rows: Vec<u32>,
        weights: Vec<f64>,
        pivot: DVec3,
        is_body: bool,
        trim: f64,
        tolerance: f64,
        means: &[[f32; 3]],
    ) -> Self {
        let reference = rows.iter().map(|&row| vector(means[row as usize]) - pivot).collect();
        let order: Vec<u32> = (0..rows.len() as u32).collect();
        let fit_points =
            if rows.len() <= FIT_POINTS { order } else { systematic(&order, &weights, FIT_POINTS) };
        Self {
            rows,
            weights,
            pivot,
            is_body,
            stands_still: false,
            is_passed: false,
            is_loose: false,
            trim,
            tolerance,
            static_shape: MeanShape::default(),
            rigid_shape: MeanShape::default(),
            poses: Vec::new(),
            static_residual: ResidualSum::default(),
            rigid_residual: ResidualSum::default(),
            parts_residual: None,
            recorded: Vec::new(),
            seconds: 0.0,
            reference,
            fit_points,
        }
    }

    /// The local frame at the reference time.
    #[must_use]
    pub fn rest_pose(&self) -> RigidTransform {
        RigidTransform { translation: self.pivot, ..RigidTransform::IDENTITY }
    }

    fn fit(&self, shape: &[DVec3], gaussians: &Frame, initial: RigidTransform) -> RigidTransform {
        let pick = |points: &[DVec3]| -> Vec<DVec3> {
            self.fit_points.iter().map(|&k| points[k as usize]).collect()
        };
        let target: Vec<DVec3> = self
            .fit_points
            .iter()
            .map(|&k| vector(gaussians.means[self.rows[k as usize] as usize]))
            .collect();
        let weights: Vec<f64> = self.fit_points.iter().map(|&k| self.weights[k as usize]).collect();
        robust_procrustes(&pick(shape), &target, &weights, initial)
    }

    /// First pass: one time.
    pub fn gather_shape(&mut self, gaussians: &Frame) {
        let rest = self.rest_pose();
        self.static_shape.add(&rest.inverse(), &self.rows, gaussians);
        if self.is_body {
            let initial = self.poses.last().copied().unwrap_or(rest);
            let pose = self.fit(&self.reference, gaussians, initial);
            self.rigid_shape.add(&pose.inverse(), &self.rows, gaussians);
            self.poses.push(pose);
        }
    }

    /// Between the passes: finishes the mean shapes and puts the rigid one where it fits the reference time,
    /// so that the pose there is the rest pose.
    pub fn finish_shape(&mut self, reference: &Frame) {
        self.static_shape.finish();
        if self.is_body {
            self.rigid_shape.finish();
            let rest = self.rest_pose();
            let pose = self.fit(&self.rigid_shape.means, reference, rest);
            self.rigid_shape.transform(&rest.inverse().compose(&pose));
        }
        self.poses.clear();
    }

    /// Does something with the group, and adds the seconds that it took.
    pub(crate) fn timed(&mut self, action: impl FnOnce(&mut Self)) {
        let start = std::time::Instant::now();
        action(self);
        self.seconds += start.elapsed().as_secs_f64();
    }

    /// Second pass: one time. Gives the distances from the rigid body; none where there is no body.
    pub fn gather_residuals(&mut self, gaussians: &Frame) -> Vec<f64> {
        let target: Vec<DVec3> = self.rows.iter().map(|&row| vector(gaussians.means[row as usize])).collect();
        let rest = self.rest_pose();
        let distances = residuals(&rest, &self.static_shape.means, &target);
        self.static_residual.add(&distances, &self.weights, self.trim, self.tolerance);
        let shape = &self.static_shape.orientations;
        add_turns(&mut self.static_residual, &rest, shape, &self.rows, &self.weights, gaussians);
        if self.is_body {
            let initial = self.poses.last().copied().unwrap_or(rest);
            let pose = self.fit(&self.rigid_shape.means, gaussians, initial);
            let distances = residuals(&pose, &self.rigid_shape.means, &target);
            self.rigid_residual.add(&distances, &self.weights, self.trim, self.tolerance);
            let shape = &self.rigid_shape.orientations;
            add_turns(&mut self.rigid_residual, &pose, shape, &self.rows, &self.weights, gaussians);
            self.poses.push(pose);
            return distances;
        }
        Vec::new()
    }

    /// The poses as a track, quaternions in one hemisphere.
    #[must_use]
    pub fn track(&self, time_codes: &[f64]) -> Vec<PoseSample> {
        let poses = self.poses.iter().zip(time_codes);
        let mut track: Vec<PoseSample> =
            poses.map(|(pose, &time_code)| PoseSample::new(time_code, pose)).collect();
        // The first one in the hemisphere of the identity.
        if let Some(first) = track.first_mut().filter(|first| first.rotation.w < 0.0) {
            first.rotation = -first.rotation;
        }
        one_hemisphere(&mut track);
        track
    }
}

/// Adds the turns between the orientations of a shape under a pose and the trained ones.
fn add_turns(
    sum: &mut ResidualSum,
    pose: &RigidTransform,
    orientations: &[[f64; 4]],
    rows: &[u32],
    weights: &[f64],
    gaussians: &Frame,
) {
    let turn = quaternion_of(&pose.rotation);
    let turned: Vec<[f64; 4]> =
        orientations.iter().map(|orientation| quaternion::multiply(turn, *orientation)).collect();
    add_turns_between(sum, &turned, rows, weights, gaussians);
}
