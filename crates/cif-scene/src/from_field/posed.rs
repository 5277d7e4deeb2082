//! Gaussians of objects that move by poses of their own.

use std::collections::BTreeMap;

use cif_field::Field;

use super::assignment::image;

/// Share of the image of an instance that its posed Gaussians make at least, where they are taken to be all of it.
const MOST_OF_IT: f64 = 0.5;

/// Gives the Gaussians of a group with poses to the instance that has most of their image, and takes those without such
/// a group away from an instance of which these are the most: they do not move with it. A moving object leaves shadows
/// and what else its masks show where it was; these stay with the background. Only rows that are `open` change owners.
pub(super) fn settle(
    field: &Field,
    visible: &[u32],
    open: &impl Fn(usize) -> bool,
    owners: &mut [Option<usize>],
) {
    let Some(tracks) = &field.tracks else { return };
    let group_of = |position: usize| {
        let group = tracks.group(visible[position] as usize)?;
        (!tracks.groups[group].deformed).then_some(group)
    };
    let image = |position: usize| image(field, visible[position] as usize);
    let mut shares: BTreeMap<(usize, usize), f64> = BTreeMap::new();
    let mut images = vec![0.0; field.instances.len()];
    for (position, owner) in owners.iter().enumerate() {
        let Some(owner) = *owner else { continue };
        images[owner] += image(position);
        if let Some(group) = group_of(position) {
            *shares.entry((group, owner)).or_default() += image(position);
        }
    }
    let mut instance_of: BTreeMap<usize, (usize, f64)> = BTreeMap::new();
    for ((group, owner), share) in shares {
        let most = instance_of.entry(group).or_insert((owner, share));
        *most = if share > most.1 { (owner, share) } else { *most };
    }
    let mut posed = vec![0.0; images.len()];
    instance_of.values().for_each(|(owner, share)| posed[*owner] += share);
    let is_posed: Vec<bool> = posed.iter().zip(&images).map(|(own, all)| *own > MOST_OF_IT * all).collect();
    for position in (0..owners.len()).filter(|position| open(*position)) {
        let of_group = group_of(position).and_then(|group| instance_of.get(&group));
        match (of_group, owners[position]) {
            (Some((instance, _)), _) if is_posed[*instance] => owners[position] = Some(*instance),
            (_, Some(owner)) if is_posed[owner] => owners[position] = None,
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use cif_field::tracks::NO_GROUP;

    use super::*;
    use crate::testing::{MEMBERS, recorded_field};

    #[test]
    fn what_does_not_move_with_an_object_stays_behind() {
        let mut field = recorded_field(2, 5);
        let tracks = field.tracks.as_mut().unwrap();
        tracks.groups.iter_mut().for_each(|group| group.deformed = false);
        let rows: Vec<u32> = (0..field.len() as u32).collect();
        let mut owners: Vec<Option<usize>> =
            (0..field.len()).map(|row| Some(row / MEMBERS).filter(|owner| *owner < 2)).collect();
        let expected = owners.clone();
        // A shadow on the ground that the masks give to the first object, and a piece of it that they do not.
        let (shadow, piece, told) = (2 * MEMBERS + 3, 5, 2 * MEMBERS + 4);
        (owners[shadow], owners[piece], owners[told]) = (Some(0), None, Some(0));
        let open = |position: usize| position != told;
        settle(&field, &rows, &open, &mut owners);
        assert_eq!(owners[told], Some(0));
        owners[told] = None;
        assert_eq!(owners, expected);
        // An object that is mostly deformed by the network keeps what it has.
        let tracks = field.tracks.as_mut().unwrap();
        tracks.group_of[..3 * MEMBERS / 4].fill(NO_GROUP);
        owners[shadow] = Some(0);
        settle(&field, &rows, &open, &mut owners);
        assert_eq!((owners[0], owners[shadow]), (Some(0), Some(0)));
    }
}
