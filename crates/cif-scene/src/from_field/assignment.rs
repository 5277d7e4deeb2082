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
//! 4. Gaussians of a track group are those of its instance ([`cif_field::TrackGroup::instance`]). Where the learned
//!    deformation leaves the groups of an instance alone, what else its masks show (shadows of where it was) stays behind
//!    when it moves, and is background.
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

use super::group_instances;
use super::image::image;
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

/// Who owns what, by dense instance index; `None` is the background.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Assignment {
    /// Owner of every visible row.
    pub owners: Vec<Option<usize>>,
    /// Instance of every track group.
    pub groups: Vec<Option<usize>>,
}

/// Owners of the rows of `visible`, and instances of the track groups.
#[must_use]
pub fn assign(
    field: &Field,
    identities: &[Option<Identity>],
    visible: &[u32],
    options: &SceneOptions,
) -> Assignment {
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
    let groups = group_instances::of_groups(field, visible, &owners);
    let is_estimated = |position: &usize| owner_of(*position) == Owner::Estimated;
    let Some(tracks) = &field.tracks else { return Assignment { owners, groups } };
    let group_of = |position: &usize| tracks.group(visible[*position] as usize);
    let mut is_posed = vec![false; field.instances.len()];
    for group in (0..visible.len()).filter_map(|position| group_of(&position)) {
        if let (Some(instance), false) = (groups[group], tracks.groups[group].deformed) {
            is_posed[instance] = true;
        }
    }
    for position in (0..visible.len()).filter(is_estimated) {
        let stays = owners[position].filter(|owner| !is_posed[*owner]);
        owners[position] = group_of(&position).and_then(|group| groups[group]).or(stays);
    }
    Assignment { owners, groups }
}

/// Gaussians of every instance, ascending, as the nodes of a graph with these options have them, as far as opacities
/// do not change over time.
#[must_use]
pub fn members(field: &Field, options: &SceneOptions) -> Vec<Vec<u32>> {
    let is_visible = |row: &u32| field.gaussians.opacity(*row as usize) >= options.min_opacity;
    let visible: Vec<u32> = (0..field.len() as u32).filter(is_visible).collect();
    let mut members = vec![Vec::new(); field.instances.len()];
    let owners = assign(field, &most_probable(field), &visible, options).owners;
    for (row, owner) in visible.iter().zip(owners) {
        if let Some(owner) = owner {
            members[owner].push(*row);
        }
    }
    members
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

/// Occupancies of the visible rows, or opacities where occupancy says nothing.
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
                let nearest = std::num::NonZero::new(NEIGHBOURS + 1).expect("more than zero neighbours");
                let neighbours = tree
                    .query(&point)
                    .nearest_n::<SquaredEuclidean<f64>>(nearest)
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

#[cfg(test)]
mod tests {
    use cif_field::Identities;

    use super::*;
    use crate::testing::{MEMBERS, recorded_field};

    #[test]
    fn what_does_not_move_with_an_object_stays_behind() {
        let mut field = recorded_field(2, 5);
        field.tracks.as_mut().unwrap().groups.iter_mut().for_each(|group| group.deformed = false);
        // A shadow on the ground that the masks give to the first object, and pieces of it that they do not.
        let (shadow, piece, stray, given) = (2 * MEMBERS + 3, 5, 6, 2 * MEMBERS + 4);
        let mut rows = Identities::empty();
        for row in 0..field.len() {
            match row {
                _ if row == shadow => rows.push(Owner::Estimated, &[(0, 0.9)]),
                _ if row == piece => rows.push(Owner::Estimated, &[(0, 0.01)]),
                _ if row == stray => rows.push(Owner::Estimated, &[(1, 0.9)]),
                _ if row == given => rows.push(Owner::Instance(0), &[(0, 0.9)]),
                _ if row < 2 * MEMBERS => rows.push(Owner::Estimated, &[((row / MEMBERS) as u16, 0.9)]),
                _ => rows.push(Owner::Estimated, &[(0, 0.01)]),
            }
        }
        field.identities = Some(rows);
        field.validate().unwrap();
        let all: Vec<u32> = (0..field.len() as u32).collect();
        let owners =
            |field: &Field| assign(field, &most_probable(field), &all, &SceneOptions::default()).owners;
        let owner = |row: usize| Some(row / MEMBERS).filter(|owner| *owner < 2);
        let expected: Vec<_> =
            (0..field.len()).map(|row| if row == given { Some(0) } else { owner(row) }).collect();
        assert_eq!(owners(&field), expected);
        // A group without Gaussians is nothing of its instance.
        let tracks = field.tracks.as_mut().unwrap();
        tracks.group_of[..MEMBERS].fill(cif_field::tracks::NO_GROUP);
        let found = owners(&field);
        assert_eq!((found[shadow], found[0], found[stray]), (Some(0), Some(0), None));
        field.tracks.as_mut().unwrap().group_of[..MEMBERS].fill(0);
        // Where the network moves the object too, its shadow may be what it left out.
        field.tracks.as_mut().unwrap().groups[0].deformed = true;
        let found = owners(&field);
        assert_eq!((found[shadow], found[piece], found[stray]), (Some(0), Some(0), Some(0)));
    }
}
