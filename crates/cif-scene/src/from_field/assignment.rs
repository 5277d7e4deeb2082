//! Which node a Gaussian belongs to.
//!
//! 1. A Gaussian's instance is its most probable one (ties to the lowest index).
//! 2. It is *background* when the part of its image that was seen on labelled pixels (see
//!    [`cif_field::Identities::labelled_shares`]) is below that at which the silhouette of its instance is best, or
//!    when its instance mass gamma = pi p_max is below [`SceneOptions::background_threshold`], where one is asked
//!    for. Pixels without a label give no loss, so Gaussians outside all masks have identity rows too (methods
//!    reference 4.4, 5.4 and A2).
//!
//!    The silhouette: with d the image of a Gaussian (opacity times area) and s its labelled share, the Gaussians O
//!    that an instance owns cover sum_O d s of what its masks show and sum_O d (1 - s) beside it. The intersection
//!    over union of both, sum_O d s / (sum d s + sum_O d (1 - s)) over all Gaussians of the instance, is largest
//!    where O has those with s > v / (1 + v), v the largest value itself (Dinkelbach's method for ratios). So a
//!    compact object takes what lies in its masks by about half, and a wire narrower than the Gaussians that draw it
//!    takes softer ones too, without which it would not be seen.
//! 3. Gaussians inside an object are hardly ever seen, so that they keep their first occupancy. One below the
//!    threshold that lies in the box of its instance's Gaussians, and whose nearest neighbours are mostly of
//!    that instance, is *enclosed* and goes back to it; else it would stay behind when the object moves.
//! 4. Where most of the image of an instance moves by poses of its own, that is all of it ([`super::posed`]).
//!
//! Rows that have an owner ([`cif_field::Owner`]: they came from a file that names its objects) belong to it,
//! whatever their occupancy.
//!
//! Where occupancy is the same for all Gaussians (never trained, or an ablation), opacity takes its place.
//! Without identities everything is background.

use cif_field::{Field, Owner};
use cif_geometry::scalar::direct_sigmoid;
use cif_geometry::{Bounds, overlap};
use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::posed;
use crate::SceneOptions;

/// Neighbours that vote on an enclosed Gaussian.
const NEIGHBOURS: usize = 8;
/// Votes that enclose.
const ENCLOSING: usize = 6;
/// Rounds of enclosing; each reaches about one Gaussian deeper.
const ROUNDS: usize = 4;
/// Occupancies that differ by less are the same.
const SAME_OCCUPANCY: f32 = 1e-4;
/// Share of its image on labelled pixels from which a Gaussian may be enclosed by an instance.
const LABELLED_SHARE: f32 = 0.5;
/// Smallest share that may make an instance at all, however little of it there is.
const LEAST_SHARE: f64 = 0.2;

/// Most probable instance of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Identity {
    /// Dense instance index.
    pub index: usize,
    /// Its probability p_max.
    pub probability: f32,
    /// See [`cif_field::Identities::labelled_shares`].
    pub labelled_share: f32,
}

/// Most probable instance of every row; `None` for rows without entries.
#[must_use]
pub fn most_probable(field: &Field) -> Vec<Option<Identity>> {
    let Some(identities) = &field.identities else {
        return vec![None; field.gaussians.len()];
    };
    let probabilities = identities.probabilities();
    let labelled_shares = identities.labelled_shares();
    (0..identities.len())
        .map(|row| {
            let mut best: Option<Identity> = None;
            for entry in identities.range(row) {
                let probability = probabilities[entry];
                // NaN never wins; labels ascend, so the lowest index wins ties.
                if probability > best.map_or(0.0, |best| best.probability) {
                    let index = usize::from(identities.labels[entry]);
                    best = Some(Identity { index, probability, labelled_share: 1.0 });
                }
            }
            best.map(|best| Identity { labelled_share: labelled_shares[row], ..best })
        })
        .collect()
}

/// Owner of every row of `visible`: a dense instance index, or `None` for the background.
#[must_use]
pub fn assign(
    field: &Field,
    identities: &[Option<Identity>],
    visible: &[u32],
    options: &SceneOptions,
) -> Vec<Option<usize>> {
    let occupancy = occupancies(field, visible);
    let candidate = |position: usize| identities[visible[position] as usize];
    // Candidates with enough instance mass.
    let candidates: Vec<Option<Identity>> = (0..visible.len())
        .map(|position| {
            candidate(position)
                .filter(|identity| occupancy[position] * identity.probability >= options.background_threshold)
        })
        .collect();
    let needed = needed_shares(field, visible, &candidates);
    let mut owners: Vec<Option<usize>> = candidates
        .iter()
        .map(|identity| {
            let identity = (*identity)?;
            (f64::from(identity.labelled_share) > needed[identity.index]).then_some(identity.index)
        })
        .collect();
    let owner_of = |position: usize| match &field.identities {
        Some(identities) => identities.owner(visible[position] as usize),
        None => Owner::Estimated,
    };
    for (position, owner) in owners.iter_mut().enumerate() {
        match owner_of(position) {
            Owner::Estimated => {}
            Owner::Instance(index) => *owner = Some(usize::from(index)),
            Owner::Background => *owner = None,
        }
    }
    let open = |position: usize| candidate(position).filter(|_| owner_of(position) == Owner::Estimated);
    enclose(field, visible, &open, &mut owners);
    posed::settle(field, visible, &|position| owner_of(position) == Owner::Estimated, &mut owners);
    owners
}

/// Gaussians of every instance, ascending, as the nodes of a graph with these options have them, as far as opacities
/// do not change over time.
#[must_use]
pub fn members(field: &Field, options: &SceneOptions) -> Vec<Vec<u32>> {
    let is_visible = |row: &u32| field.gaussians.opacity(*row as usize) >= options.min_opacity;
    let visible: Vec<u32> = (0..field.len() as u32).filter(is_visible).collect();
    let mut members = vec![Vec::new(); field.instances.len()];
    for (row, owner) in visible.iter().zip(assign(field, &most_probable(field), &visible, options)) {
        if let Some(owner) = owner {
            members[owner].push(*row);
        }
    }
    members
}

/// Image of a Gaussian seen from its broad side: opacity times area, world units.
pub(super) fn image(field: &Field, row: usize) -> f64 {
    let [x, y, z] = field.gaussians.log_scales[row].map(f64::from);
    f64::from(field.gaussians.opacity(row)) * (x + y).max(y + z).max(x + z).exp()
}

/// Labelled share above which the Gaussians of every instance make the best silhouette of it.
fn needed_shares(field: &Field, visible: &[u32], candidates: &[Option<Identity>]) -> Vec<f64> {
    // Image and labelled share of the Gaussians of each instance.
    let mut members: Vec<Vec<(f64, f64)>> = vec![Vec::new(); field.instances.len()];
    for (&row, identity) in visible.iter().zip(candidates) {
        let Some(identity) = identity else { continue };
        members[identity.index].push((image(field, row as usize), f64::from(identity.labelled_share)));
    }
    members.iter().map(|members| overlap::bound(members).max(LEAST_SHARE)).collect()
}

/// Occupancies of the visible rows, or opacities where occupancy tells nothing.
fn occupancies(field: &Field, visible: &[u32]) -> Vec<f32> {
    let sigmoid_of = |logits: &[f32]| -> Vec<f32> {
        visible.iter().map(|&row| direct_sigmoid(logits[row as usize])).collect()
    };
    let occupancy = sigmoid_of(&field.gaussians.occupancy_logits);
    let lowest = occupancy.iter().copied().fold(f32::INFINITY, f32::min);
    let highest = occupancy.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if highest - lowest > SAME_OCCUPANCY { occupancy } else { sigmoid_of(&field.gaussians.opacity_logits) }
}

/// Gives enclosed background Gaussians back to their instance.
fn enclose(
    field: &Field,
    visible: &[u32],
    candidate: &(impl Fn(usize) -> Option<Identity> + Sync),
    owners: &mut [Option<usize>],
) {
    let open: Vec<usize> = (0..visible.len())
        .filter(|&position| {
            owners[position].is_none()
                && candidate(position).is_some_and(|identity| identity.labelled_share >= LABELLED_SHARE)
        })
        .collect();
    if open.is_empty() || owners.iter().all(Option::is_none) {
        return;
    }
    let centre = |position: usize| field.gaussians.means[visible[position] as usize].map(f64::from);
    let mut boxes = vec![Bounds::EMPTY; field.instances.len()];
    for (position, owner) in owners.iter().enumerate() {
        if let Some(index) = owner {
            boxes[*index] = boxes[*index].including(DVec3::from_array(centre(position)));
        }
    }
    let points: Vec<[f64; 3]> = (0..visible.len()).map(centre).collect();
    // Only degenerate point sets (thousands of equal centres) have no tree; nothing is enclosed then.
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&points) else {
        return;
    };
    let inside: Vec<(usize, usize, Vec<usize>)> = open
        .par_iter()
        .filter_map(|&position| {
            let index = candidate(position)?.index;
            let (bounds, point) = (boxes[index], points[position]);
            let held = (0..3).all(|axis| (bounds.low[axis]..=bounds.high[axis]).contains(&point[axis]));
            held.then(|| {
                let wanted = std::num::NonZero::new(NEIGHBOURS + 1).expect("more than zero neighbours");
                let neighbours = tree
                    .query(&point)
                    .nearest_n::<SquaredEuclidean<f64>>(wanted)
                    .execute()
                    .into_iter()
                    .map(|found| found.item as usize)
                    .filter(|&other| other != position)
                    .take(NEIGHBOURS)
                    .collect();
                (position, index, neighbours)
            })
        })
        .collect();
    for _ in 0..ROUNDS {
        let joined: Vec<(usize, usize)> = inside
            .iter()
            .filter(|(position, index, neighbours)| {
                owners[*position].is_none()
                    && neighbours.iter().filter(|&&other| owners[other] == Some(*index)).count() >= ENCLOSING
            })
            .map(|(position, index, _)| (*position, *index))
            .collect();
        if joined.is_empty() {
            break;
        }
        for (position, index) in joined {
            owners[position] = Some(index);
        }
    }
}
