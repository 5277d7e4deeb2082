//! Some of a node's splats as a node.

use crate::graph::{Appearance, AppearanceSample, DenseMotion, DenseSample, Motion, PartsMotion};
use crate::{Node, Part, Splats};

/// The node with the splats at `positions` alone, which ascend; parts that lose all their splats go.
pub(super) fn subset(node: &Node, positions: &[usize]) -> Node {
    if positions.len() == node.splats.len() {
        return node.clone();
    }
    let motion = match &node.motion {
        Motion::Parts(parts) => {
            let mut start = 0;
            let parts_left = parts.parts.iter().map(|part| {
                let count = positions.iter().filter(|at| part.splats.contains(*at)).count();
                let splats = start..start + count;
                start += count;
                Part { splats, ..part.clone() }
            });
            let mut parts_left: Vec<Part> = parts_left.filter(|part| !part.splats.is_empty()).collect();
            if parts_left.len() < parts.parts.len() {
                // Joints count parts that are gone.
                parts_left.iter_mut().for_each(|part| part.joint = None);
            }
            Motion::Parts(PartsMotion { track: parts.track.clone(), parts: parts_left })
        }
        Motion::Dense(dense) => Motion::Dense(DenseMotion {
            track: dense.track.clone(),
            samples: dense
                .samples
                .iter()
                .map(|sample| DenseSample {
                    means: pick(&sample.means, positions),
                    orientations: pick(&sample.orientations, positions),
                    scales: sample.scales.as_ref().map(|scales| pick(scales, positions)),
                    ..*sample
                })
                .collect(),
        }),
        other => other.clone(),
    };
    let per_splat = node.splats.sh_coefficients.len() / node.splats.len().max(1);
    let appearance = Appearance {
        opacities: samples(&node.appearance.opacities, 1, positions),
        colors: samples(&node.appearance.colors, per_splat, positions),
    };
    Node {
        motion,
        splats: some(&node.splats, positions),
        appearance,
        proxy: None,
        colliders: Vec::new(),
        ..node.clone()
    }
}

fn some(splats: &Splats, positions: &[usize]) -> Splats {
    // Arrays that readers may leave empty stay empty.
    fn optional<T: Copy>(values: &[T], n: usize, positions: &[usize]) -> Vec<T> {
        if values.len() == n { pick(values, positions) } else { Vec::new() }
    }
    let n = splats.len();
    Splats {
        means: pick(&splats.means, positions),
        orientations: pick(&splats.orientations, positions),
        scales: pick(&splats.scales, positions),
        opacities: pick(&splats.opacities, positions),
        sh_degree: splats.sh_degree,
        sh_coefficients: positions
            .iter()
            .flat_map(|at| crate::diff::splats::coefficients(splats, *at))
            .copied()
            .collect(),
        occupancies: optional(&splats.occupancies, n, positions),
        identity_probabilities: optional(&splats.identity_probabilities, n, positions),
        identities: optional(&splats.identities, n, positions),
        rows: optional(&splats.rows, n, positions),
    }
}

fn samples(of: &[AppearanceSample], stride: usize, positions: &[usize]) -> Vec<AppearanceSample> {
    of.iter()
        .map(|sample| AppearanceSample {
            time_code: sample.time_code,
            values: positions
                .iter()
                .flat_map(|at| &sample.values[at * stride..(at + 1) * stride])
                .copied()
                .collect(),
        })
        .collect()
}

fn pick<T: Copy>(values: &[T], positions: &[usize]) -> Vec<T> {
    positions.iter().map(|at| values[*at]).collect()
}
