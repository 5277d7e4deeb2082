//! The most important splats of a node, for viewers that want fewer.

use crate::{Motion, Node, Splats};

impl Splats {
    /// Importance of every splat: opacity times the product of its two larger standard deviations, which is its area
    /// from its broad side up to a factor.
    #[must_use]
    pub fn importance(&self) -> Vec<f64> {
        self.opacities
            .iter()
            .zip(&self.scales)
            .map(|(opacity, scale)| {
                let [x, y, z] = scale.map(f64::from);
                f64::from(*opacity) * (x * y).max(y * z).max(x * z)
            })
            .collect()
    }
}

/// Ascending indices into [`Node::splats`] of the most important `share` of them, rounded up.
///
/// A smaller share is always held by a larger one. Every part keeps its most important splat, and a node keeps
/// at least one, whatever the share; ties go to the lower index.
#[must_use]
pub fn level_of_detail(node: &Node, share: f64) -> Vec<u32> {
    let importance = node.splats.importance();
    let mut order: Vec<u32> = (0..node.splats.len() as u32).collect();
    order
        .sort_unstable_by(|&a, &b| importance[b as usize].total_cmp(&importance[a as usize]).then(a.cmp(&b)));
    // The best of every part first; the rest keep their order.
    let mut kept_first = 1;
    if let Motion::Parts(motion) = &node.motion {
        kept_first = motion.parts.len();
        let mut has_best = vec![false; motion.parts.len()];
        let (best, rest): (Vec<u32>, Vec<u32>) = order.into_iter().partition(|&index| {
            let part = motion.parts.iter().position(|part| part.splats.contains(&(index as usize)));
            part.is_some_and(|part| !std::mem::replace(&mut has_best[part], true))
        });
        order = [best, rest].concat();
    }
    let count = (share.clamp(0.0, 1.0) * order.len() as f64).ceil() as usize;
    order.truncate(count.max(kept_first));
    order.sort_unstable();
    order
}
