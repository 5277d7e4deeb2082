//! Blending order. Source: methods reference 3.1, sorting.

use cif_geometry::Real;

use super::project::Splat2d;

/// Indices of the visible Gaussians, nearest first; equal keys keep the order of the Gaussians.
#[must_use]
pub fn sort<R: Real>(splats: &[Option<Splat2d<R>>]) -> Vec<u32> {
    let mut keyed: Vec<(R, u32)> = splats
        .iter()
        .enumerate()
        .filter_map(|(index, splat)| splat.as_ref().map(|splat| (splat.sort_key, index as u32)))
        .collect();
    // Keys are finite (projection culls everything else), so that the comparison always has an answer.
    keyed.sort_by(|a, b| a.0.partial_cmp(&b.0).unwrap_or(std::cmp::Ordering::Equal).then(a.1.cmp(&b.1)));
    keyed.into_iter().map(|(_, index)| index).collect()
}
