//! Gradients of Gaussians that move with the pose of a group: carried back to the frame of the group, and summed for
//! the pose.

use cif_field::Gaussians;
use cif_field::tracks::{GroupAtTime, Tracks, TracksAtTime};
use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::Gradients;
use crate::poses::{GroupedGaussian, PoseGradient};

/// Gaussians handled by one task.
const CHUNK: usize = 512;

/// A group at the time of the view, as gradients pass it.
struct Turn {
    /// World from group.
    rotation: DMat3,
    /// Unit quaternion of the inverse rotation (w, x, y, z).
    back: [f64; 4],
    pivot: DVec3,
    /// Harmonics of the inverse rotation, where the group turns.
    harmonics: Option<HarmonicsRotation<f32>>,
}

impl Turn {
    fn new(group: &GroupAtTime<'_>) -> Self {
        let rotation = DMat3::from_quat(group.rotation);
        let q = group.rotation;
        // Rows of the inverse are columns of the rotation.
        let inverse = rotation.to_cols_array_2d().map(|row| row.map(|value| value as f32));
        Self {
            rotation,
            back: [q.w, -q.x, -q.y, -q.z],
            pivot: group.pivot,
            harmonics: group.turned.then(|| HarmonicsRotation::new(inverse)),
        }
    }
}

/// Adds what reaches the rows of groups, `v_posed`, to the gradients of their canonical centres, quaternions and
/// harmonics (where these are posed), and of the poses. Other parameters do not move with a group.
pub(super) fn groups_backward(
    tracks: &Tracks,
    at: &TracksAtTime<'_>,
    time: f64,
    canonical: &Gaussians,
    v_posed: &mut Gaussians,
    gradients: &mut Gradients,
) {
    let turns: Vec<Turn> = at.groups.iter().map(Turn::new).collect();
    let n = canonical.len();
    let rows = gradients.gaussians.rows_mut().chunks(CHUNK, n).into_par_iter();
    let sums: Vec<Vec<(u32, PoseGradient)>> = rows
        .zip(v_posed.rows_mut().chunks(CHUNK, n))
        .enumerate()
        .map(|(chunk, (total, v))| {
            let mut sums: Vec<(u32, PoseGradient)> = Vec::new();
            for k in 0..v.means.len() {
                let row = chunk * CHUNK + k;
                let Some(group) = tracks.group(row) else { continue };
                let still = v.means[k] == [0.0; 3] && v.quaternions[k] == [0.0; 4];
                if still && v.sh_coefficients.get(k).is_none_or(|sh| sh.iter().all(|v| *v == 0.0)) {
                    continue;
                }
                let turn = &turns[group];
                let v_mean = turn.rotation.transpose() * DVec3::from_array(v.means[k].map(f64::from));
                let v_mean = v_mean.to_array().map(|value| value as f32);
                let v_quaternion = quaternion::multiply(turn.back, v.quaternions[k].map(f64::from));
                let v_quaternion = v_quaternion.map(|value| value as f32);
                let v_sh = v.sh_coefficients.get_mut(k).map(|sh| {
                    if let Some(back) = &turn.harmonics {
                        back.rotate(&mut sh[..]);
                    }
                    &*sh
                });
                let mean = DVec3::from_array(canonical.means[row].map(f64::from)) - turn.pivot;
                let offset = mean.to_array().map(|value| value as f32);
                if sums.last().is_none_or(|(last, _)| *last != group as u32) {
                    sums.push((group as u32, PoseGradient::default()));
                }
                if let Some((_, sum)) = sums.last_mut() {
                    let (quaternion, sh) = (canonical.quaternions[row], &canonical.sh_coefficients[row]);
                    sum.add(&GroupedGaussian { offset, quaternion, sh }, v_mean, v_quaternion, v_sh);
                }
                for axis in 0..3 {
                    total.means[k][axis] += v_mean[axis];
                }
                for axis in 0..4 {
                    total.quaternions[k][axis] += v_quaternion[axis];
                }
            }
            sums
        })
        .collect();
    let mut by_group = vec![None::<PoseGradient>; tracks.groups.len()];
    for (group, sum) in sums.into_iter().flatten() {
        let total = &mut by_group[group as usize];
        *total = Some(total.map_or(sum, |total| total.sum(sum)));
    }
    let mut first = 0;
    for ((group, turn), sum) in tracks.groups.iter().zip(&turns).zip(by_group) {
        if let (Some(keys), Some(sum)) = (group.keys(time), sum) {
            for (key, share) in keys.into_iter().filter(|(_, share)| *share > 0.0) {
                let pose = &mut gradients.poses[first + key];
                pose.turn += share * sum.turn;
                pose.translation += share * (turn.rotation * sum.translation);
                gradients.pose_views[first + key] += 1;
            }
        }
        first += group.poses.len();
    }
}
