//! Recorded motion of one Gaussian. See [`cif_field::tracks`].

use cif_field::gaussians::saturated_logit;
use cif_field::tracks::{GroupAtTime, HIDDEN_LOGIT};
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use cif_geometry::{Real, quaternion};

use super::scene::Gaussian;

/// Moves `posed`, a Gaussian with the learned deformation, as its group moves; `member` is its place in a
/// group whose members have samples.
pub fn follow<R: Real>(
    group: &GroupAtTime<'_>,
    member: usize,
    canonical: &Gaussian<R>,
    posed: &mut Gaussian<R>,
) {
    if !group.deformed {
        posed.clone_from(canonical);
    }
    if let Some(dense) = &group.dense {
        posed.mean = mix(dense.means(member), dense.fraction);
        posed.quaternion = mix(dense.quaternions(member), dense.fraction);
        if let Some(log_scales) = dense.log_scales(member) {
            posed.log_scale = mix(log_scales, dense.fraction);
        }
    }
    if let Some(opacities) = &group.opacities {
        let [before, after] = opacities.values(member).map(f64::from);
        let opacity = before + opacities.fraction * (after - before);
        posed.opacity_logit = R::of(f64::from(saturated_logit(opacity)));
    }
    if let Some(colors) = &group.colors {
        posed.sh = mix(colors.values(member), colors.fraction);
    }
    let turn = [group.rotation.w, group.rotation.x, group.rotation.y, group.rotation.z].map(R::of);
    let rotation = quaternion::to_rotation(turn);
    let (pivot, translation) = (group.pivot.to_array().map(R::of), group.translation.to_array().map(R::of));
    let offset: [R; 3] = std::array::from_fn(|k| posed.mean[k] - pivot[k]);
    posed.mean =
        std::array::from_fn(|r| (0..3).map(|c| rotation[r][c] * offset[c]).sum::<R>() + translation[r]);
    posed.quaternion = quaternion::multiply(turn, posed.quaternion);
    HarmonicsRotation::new(rotation).rotate(&mut posed.sh);
    if !group.visible {
        posed.opacity_logit = R::of(f64::from(HIDDEN_LOGIT));
        posed.occupancy_logit = R::of(f64::from(HIDDEN_LOGIT));
    }
}

fn mix<R: Real, const LENGTH: usize>([before, after]: [[f32; LENGTH]; 2], fraction: f64) -> [R; LENGTH] {
    let real = |value: f32| R::of(f64::from(value));
    std::array::from_fn(|k| R::of(1.0 - fraction) * real(before[k]) + R::of(fraction) * real(after[k]))
}
