//! Displacement loss, which holds Gaussians to known motion: travelling objects to a path and to moving as one rigid
//! body, what deforms to nothing, everything else to its place.

use glam::{DMat3, DVec3};

/// Stands for the index of a pose + 1 where a Gaussian deforms: nothing holds it.
pub const FREE: u16 = u16::MAX;

/// Index of the pose that a Gaussian is held to; `None` where it is held in place, or by nothing.
#[must_use]
pub fn pose_index(pose_of: u16) -> Option<usize> {
    (pose_of != FREE).then(|| usize::from(pose_of).checked_sub(1)).flatten()
}

/// Motion that the Gaussians of one object are held to at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Displacement of the object's centre from its canonical place, metres.
    pub shift: DVec3,
    /// Rotation of the object; see [`rotation`].
    pub rotation: DMat3,
}

/// Strength with which Gaussians are held. A distance `r` costs `reach (sqrt(r^2 + reach^2) - reach)` in units of the
/// reach: as its square within the reach, as the distance beyond.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pull {
    /// Weight.
    pub weight: f64,
    /// Distance, metres.
    pub reach: f64,
}

impl Pull {
    fn cost(&self, r: DVec3) -> f64 {
        self.weight * ((r.length_squared() + self.reach * self.reach).sqrt() - self.reach)
    }

    fn gradient(&self, r: DVec3) -> DVec3 {
        r * (self.weight / (r.length_squared() + self.reach * self.reach).sqrt())
    }
}

/// Loss and its gradients by the displaced centres `[N]`. `pose_of` is the index into `poses` + 1 of each
/// Gaussian, 0 for what is held in place, or [`FREE`]. Per object, the mean of its centres is held to the path, and
/// each centre to the rigid body around the mean; rotations count as constants.
///
/// The loss is the mean over all Gaussians, relative to `extent` (metres).
#[must_use]
pub fn displacement_loss(
    displaced: &[[f32; 3]],
    canonical: &[[f32; 3]],
    pose_of: &[u16],
    poses: &[Pose],
    [path, place]: [Pull; 2],
    extent: f64,
) -> (f64, Vec<[f32; 3]>) {
    let scale = 1.0 / (displaced.len().max(1) as f64 * extent);
    let means = centre_pairs(displaced, canonical, pose_of, poses.len());
    let mut loss = 0.0;
    let mut v_means = vec![DVec3::ZERO; poses.len()];
    let rigid = |row: usize, of: usize| {
        let (_, now, before) = means[of];
        (point(displaced[row]) - now) - poses[of].rotation * (point(canonical[row]) - before)
    };
    for (row, of) in posed(pose_of) {
        v_means[of] += path.gradient(rigid(row, of));
    }
    for (of, (count, now, before)) in means.iter().enumerate().filter(|(_, (count, _, _))| *count > 0.0) {
        let away = *now - *before - poses[of].shift;
        loss += count * path.cost(away);
        // The mean moves with every centre, and every rigid body with the mean.
        v_means[of] = path.gradient(away) - v_means[of] / *count;
    }
    let gradients = (0..displaced.len())
        .map(|row| {
            let v = match pose_index(pose_of[row]) {
                None if pose_of[row] == FREE => DVec3::ZERO,
                None => {
                    let r = point(displaced[row]) - point(canonical[row]);
                    loss += place.cost(r);
                    place.gradient(r)
                }
                Some(of) => {
                    let r = rigid(row, of);
                    loss += path.cost(r);
                    path.gradient(r) + v_means[of]
                }
            };
            (v * scale).as_vec3().to_array()
        })
        .collect();
    (loss * scale, gradients)
}

/// Rotation of each object's displaced centres against its canonical ones, about their means: the nearest
/// rotation to their correlation, drawn a little towards none, which decides where the points do not.
#[must_use]
pub fn rotations(
    displaced: &[[f32; 3]],
    canonical: &[[f32; 3]],
    pose_of: &[u16],
    poses: usize,
) -> Vec<DMat3> {
    let means = centre_pairs(displaced, canonical, pose_of, poses);
    let mut correlations = vec![DMat3::ZERO; poses];
    for (row, of) in posed(pose_of) {
        let (_, now, before) = means[of];
        let (a, b) = (point(displaced[row]) - now, point(canonical[row]) - before);
        correlations[of] += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    }
    correlations.into_iter().map(nearest_rotation).collect()
}

/// Towards no rotation, relative to the size of the correlation.
pub(crate) const NO_ROTATION: f64 = 0.02;

/// Newton's iteration for the orthogonal factor of the polar decomposition; none where a reflection is nearer.
fn nearest_rotation(correlation: DMat3) -> DMat3 {
    let size = correlation.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    let mut matrix = correlation + DMat3::from_diagonal(DVec3::splat(NO_ROTATION * size));
    if !(matrix.determinant() > 1e-9 * size.powi(3) && size > 0.0) {
        return DMat3::IDENTITY;
    }
    matrix *= 1.0 / matrix.determinant().cbrt();
    for _ in 0..40 {
        let next = (matrix + matrix.inverse().transpose()) * 0.5;
        let change = (next - matrix).to_cols_array().iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        matrix = next;
        if change < 1e-12 {
            break;
        }
    }
    if matrix.is_finite() { matrix } else { DMat3::IDENTITY }
}

/// Count, mean displaced and mean canonical centre of each object.
fn centre_pairs(
    displaced: &[[f32; 3]],
    canonical: &[[f32; 3]],
    pose_of: &[u16],
    poses: usize,
) -> Vec<(f64, DVec3, DVec3)> {
    let mut sums = vec![(0.0, DVec3::ZERO, DVec3::ZERO); poses];
    for (row, of) in posed(pose_of) {
        let (count, now, before) = &mut sums[of];
        *count += 1.0;
        *now += point(displaced[row]);
        *before += point(canonical[row]);
    }
    let mean =
        |(count, now, before): (f64, DVec3, DVec3)| (count, now / count.max(1.0), before / count.max(1.0));
    sums.into_iter().map(mean).collect()
}

/// Rows that are held to a pose, and which.
fn posed(pose_of: &[u16]) -> impl Iterator<Item = (usize, usize)> {
    pose_of.iter().enumerate().filter_map(|(row, pose)| Some((row, pose_index(*pose)?)))
}

fn point(p: [f32; 3]) -> DVec3 {
    DVec3::from(p.map(f64::from))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 40 points: 15 and 10 of two objects, 5 free, the others at rest.
    fn scene() -> (Vec<[f32; 3]>, Vec<[f32; 3]>, Vec<u16>) {
        let wave = |k: usize, s: f64| (k as f64 * s).sin();
        let canonical: Vec<[f32; 3]> =
            (0..40).map(|k| [wave(k, 1.3) as f32, wave(k, 2.1) as f32, wave(k, 0.7) as f32]).collect();
        let turn = DMat3::from_rotation_z(0.9) * DMat3::from_rotation_x(-0.4);
        let displaced = (0..40)
            .map(|k| {
                let noise = DVec3::new(wave(k, 5.1), wave(k, 3.3), wave(k, 4.7)) * 0.03;
                let p = point(canonical[k]);
                let moved = if k < 15 { turn * p + DVec3::new(0.4, -0.2, 0.1) } else { p };
                (moved + noise).as_vec3().to_array()
            })
            .collect();
        let pose_of = [(15, 1), (10, 2), (10, 0), (5, FREE)];
        let pose_of =
            pose_of.into_iter().flat_map(|(count, pose)| std::iter::repeat_n(pose, count)).collect();
        (displaced, canonical, pose_of)
    }

    const PULLS: [Pull; 2] = [Pull { weight: 3.0, reach: 0.02 }, Pull { weight: 0.7, reach: 0.01 }];

    #[test]
    fn gradients_are_those_of_the_loss() {
        let (displaced, canonical, pose_of) = scene();
        let shift = DVec3::new(0.35, -0.1, 0.2);
        let poses: Vec<Pose> = rotations(&displaced, &canonical, &pose_of, 2)
            .into_iter()
            .map(|rotation| Pose { shift, rotation })
            .collect();
        let loss = |d: &[[f32; 3]]| displacement_loss(d, &canonical, &pose_of, &poses, PULLS, 1.7);
        let (_, gradients) = loss(&displaced);
        let mut largest = 0.0_f64;
        assert_eq!(gradients[35..], [[0.0; 3]; 5], "what is free is held by nothing");
        for row in [0, 7, 14, 15, 24, 25, 34, 39] {
            for axis in 0..3 {
                // Differences of what single precision stores, in double precision.
                let (mut low, mut high) = (displaced.clone(), displaced.clone());
                low[row][axis] -= 1e-4;
                high[row][axis] += 1e-4;
                let step = f64::from(high[row][axis]) - f64::from(low[row][axis]);
                let expected = (loss(&high).0 - loss(&low).0) / step;
                let found = f64::from(gradients[row][axis]);
                assert!(
                    (found - expected).abs() < 1e-5 * (1.0 + expected.abs()),
                    "{row} {axis}: {found} {expected}"
                );
                largest = largest.max(expected.abs());
            }
        }
        assert!(largest > 1e-2, "the test would not see a wrong gradient: {largest}");
    }

    #[test]
    fn a_rigid_body_on_its_path_costs_nothing() {
        let (_, canonical, pose_of) = scene();
        let turn = DMat3::from_rotation_y(2.5);
        let centre = |points: &[[f32; 3]]| points[..15].iter().map(|p| point(*p)).sum::<DVec3>() / 15.0;
        let shift = DVec3::new(1.0, 2.0, -3.0);
        let about = centre(&canonical);
        let mut displaced = canonical.clone();
        for row in 0..15 {
            let moved = turn * (point(canonical[row]) - about) + about + shift;
            displaced[row] = moved.as_vec3().to_array();
        }
        let found = rotations(&displaced, &canonical, &pose_of, 2);
        assert!(found[1].abs_diff_eq(DMat3::IDENTITY, 1e-9));
        // The draw towards no rotation leaves little of a turn this large.
        assert!(found[0].abs_diff_eq(turn, 0.1), "{}", found[0]);
        let poses = [Pose { shift, rotation: turn }, Pose { shift: DVec3::ZERO, rotation: DMat3::IDENTITY }];
        let (loss, gradients) = displacement_loss(&displaced, &canonical, &pose_of, &poses, PULLS, 1.0);
        assert!(loss < 1e-9, "{loss}");
        assert!(gradients.as_flattened().iter().all(|v| v.abs() < 1e-5));
        let astray = [Pose { shift: DVec3::ZERO, ..poses[0] }, poses[1]];
        assert!(displacement_loss(&displaced, &canonical, &pose_of, &astray, PULLS, 1.0).0 > 1.0);
    }

    #[test]
    fn rotations_of_degenerate_objects_are_proper() {
        let line: Vec<[f32; 3]> = (0..5).map(|k| [k as f32, 0.0, 0.0]).collect();
        let mirrored: Vec<[f32; 3]> = scene().1.iter().map(|p| [-p[0], -p[1], -p[2]]).collect();
        let point_like = vec![[1.0, 2.0, 3.0]; 4];
        for (displaced, canonical) in
            [(line.clone(), line.clone()), (mirrored, scene().1), (point_like.clone(), point_like)]
        {
            let all = vec![1; canonical.len()];
            for rotation in rotations(&displaced, &canonical, &all, 2) {
                assert!((rotation.determinant() - 1.0).abs() < 1e-9, "{rotation}");
                assert!((rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-9));
            }
        }
    }
}
