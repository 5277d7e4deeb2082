//! Splats with a path of their own: a body each, as glTF has no other place for their motion. Its node turns and moves
//! as the splat does, and its scale, which is animated too, is the size of the splat over the first one. Nodes scale
//! along their own axes: those of the splat, which lies in its node unturned.

use std::collections::BTreeMap;

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_scene::assemble::{Bake, one_hemisphere};
use cif_scene::{DenseMotion, LOOSE_SPLATS, Motion, PoseSample, SceneGraph, Splats};
use glam::{DAffine3, DQuat, DVec3};

use crate::GltfError;

/// Splats of the nodes that move splat by splat, each in the frame of its body; by the position of the node.
///
/// # Errors
/// When such a node has more splats than files hold, or samples that do not fit to them.
pub(crate) fn in_own_frames(graph: &SceneGraph) -> Result<BTreeMap<usize, Splats>, GltfError> {
    let mut loose = BTreeMap::new();
    for (position, node) in graph.nodes.iter().enumerate() {
        let Motion::Dense(motion) = &node.motion else { continue };
        let count = node.splats.len();
        if count > LOOSE_SPLATS {
            return Err(GltfError::Dense { node: node.name.clone() });
        }
        let fits = |sample: &cif_scene::DenseSample| {
            let scales = sample.scales.as_ref().is_none_or(|scales| scales.len() == count);
            sample.means.len() == count && sample.orientations.len() == count && scales
        };
        if motion.samples.is_empty() || !motion.samples.iter().all(fits) {
            let what = "its samples do not fit to its splats".to_owned();
            return Err(GltfError::Inconsistent { node: node.name.clone(), what });
        }
        loose.insert(position, unturned(&node.splats));
    }
    Ok(loose)
}

/// Splats in frames of their own, at the origin along the axes.
fn unturned(splats: &Splats) -> Splats {
    let mut own = splats.clone();
    own.means.fill([0.0; 3]);
    own.orientations.fill([1.0, 0.0, 0.0, 0.0]);
    let coefficients = 3 * coefficient_count(splats.sh_degree);
    for (sh, orientation) in own.sh_coefficients.chunks_exact_mut(coefficients).zip(&splats.orientations) {
        Bake::new(DAffine3::from_quat(rotation(*orientation).inverse())).harmonics(sh, splats.sh_degree);
    }
    own
}

/// Path of a splat, and its size over that in the node where this changes.
pub(crate) fn path(motion: &DenseMotion, splat: usize, own: &Splats) -> (Vec<PoseSample>, Vec<[f32; 3]>) {
    let pose = |sample: &cif_scene::DenseSample| PoseSample {
        time_code: sample.time_code,
        translation: DVec3::from_array(sample.means[splat].map(f64::from)),
        rotation: rotation(sample.orientations[splat]),
    };
    let mut poses: Vec<PoseSample> = motion.samples.iter().map(pose).collect();
    one_hemisphere(&mut poses);
    let first = own.scales[splat];
    let size = |scales: &Vec<[f32; 3]>| [0, 1, 2].map(|axis| scales[splat][axis] / first[axis]);
    let sizes: Option<Vec<[f32; 3]>> =
        motion.samples.iter().map(|sample| sample.scales.as_ref().map(size)).collect();
    (poses, sizes.unwrap_or_default())
}

fn rotation([w, x, y, z]: [f32; 4]) -> DQuat {
    DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into()).normalize()
}
