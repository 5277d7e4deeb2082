//! Splats with a path of their own: a body each, as glTF has no other place for their motion. Its node turns and moves
//! as the splat does from its first sample on, and its scale, which is animated too, is the size of the splat over the
//! first one: the same along all axes, as some viewers (Spark) take nothing else.

use std::collections::BTreeMap;

use cif_scene::assemble::one_hemisphere;
use cif_scene::{DenseMotion, DenseSample, LOOSE_SPLATS, Motion, PoseSample, SceneGraph, Splats};
use glam::{DQuat, DVec3};

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
        let fits = |sample: &DenseSample| {
            let scales = sample.scales.as_ref().is_none_or(|scales| scales.len() == count);
            sample.means.len() == count && sample.orientations.len() == count && scales
        };
        if motion.samples.is_empty() || !motion.samples.iter().all(fits) {
            let what = "its samples do not fit to its splats".to_owned();
            return Err(GltfError::Inconsistent { node: node.name.clone(), what });
        }
        loose.insert(position, Splats { means: vec![[0.0; 3]; count], ..node.splats.clone() });
    }
    Ok(loose)
}

/// Path of a splat, and its size over that in the node where this changes.
pub(crate) fn path(motion: &DenseMotion, splat: usize, own: &Splats) -> (Vec<PoseSample>, Vec<[f32; 3]>) {
    let unturned = rotation(own.orientations[splat]).inverse();
    let pose = |sample: &DenseSample| PoseSample {
        time_code: sample.time_code,
        translation: DVec3::from_array(sample.means[splat].map(f64::from)),
        rotation: (rotation(sample.orientations[splat]) * unturned).normalize(),
    };
    let mut poses: Vec<PoseSample> = motion.samples.iter().map(pose).collect();
    one_hemisphere(&mut poses);
    let first = own.scales[splat];
    let size = |scales: &Vec<[f32; 3]>| {
        let thick = || (0..3).filter(|axis| first[*axis] > 0.0);
        let ratio: f32 = thick().map(|axis| scales[splat][axis] / first[axis]).product();
        [ratio.powf(1.0 / thick().count().max(1) as f32); 3]
    };
    let sizes: Option<Vec<[f32; 3]>> =
        motion.samples.iter().map(|sample| sample.scales.as_ref().map(size)).collect();
    (poses, sizes.unwrap_or_default())
}

fn rotation([w, x, y, z]: [f32; 4]) -> DQuat {
    DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into()).normalize()
}
