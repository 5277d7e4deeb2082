//! The instance of every track group.
//!
//! Groups name theirs ([`cif_field::TrackGroup::instance`]). For those that do not, as in files before format 9, it is
//! found here, and nowhere else: the instance that owns most of the group's image, provided that such groups make more
//! than half of the image of that instance.

use std::collections::BTreeMap;

use cif_field::Field;

use super::image::image;

/// Share of the image of an instance that its groups make at least, where they are taken to be all of it.
const MOST_OF_IT: f64 = 0.5;

/// Dense index of the instance of every group; `None` for groups of the background, of parts of something that the
/// learned deformation moves, and without identities. `owners` are those of `visible` by their identity rows alone.
pub(super) fn of_groups(field: &Field, visible: &[u32], owners: &[Option<usize>]) -> Vec<Option<usize>> {
    let Some(tracks) = &field.tracks else { return Vec::new() };
    let mut instance_of: Vec<Option<usize>> = vec![None; tracks.groups.len()];
    if field.identities.is_none() {
        return instance_of;
    }
    let mut is_open = vec![false; tracks.groups.len()];
    for (index, group) in tracks.groups.iter().enumerate() {
        instance_of[index] = group.instance.and_then(|id| field.instance_by_id(id));
        is_open[index] = group.instance.is_none() && (!group.deformed || field.deformation.is_none());
    }
    if !is_open.contains(&true) {
        return instance_of;
    }
    let mut images = vec![0.0; field.instances.len()];
    let mut in_groups = images.clone();
    let mut shares: BTreeMap<(usize, usize), f64> = BTreeMap::new();
    for (row, owner) in visible.iter().zip(owners) {
        let Some(owner) = *owner else { continue };
        let image = image(field, *row as usize);
        images[owner] += image;
        match tracks.group(*row as usize) {
            Some(group) if is_open[group] => *shares.entry((body(field, group), owner)).or_default() += image,
            Some(group) if instance_of[group] == Some(owner) => in_groups[owner] += image,
            _ => {}
        }
    }
    let mut most: BTreeMap<usize, (usize, f64)> = BTreeMap::new();
    for ((body, owner), share) in shares {
        let found = most.entry(body).or_insert((owner, share));
        *found = if share > found.1 { (owner, share) } else { *found };
    }
    most.values().for_each(|(owner, share)| in_groups[*owner] += share);
    most.retain(|_, (owner, _)| in_groups[*owner] > MOST_OF_IT * images[*owner]);
    for group in (0..tracks.groups.len()).filter(|group| is_open[*group]) {
        instance_of[group] = most.get(&body(field, group)).map(|(owner, _)| *owner);
    }
    instance_of
}

/// The group that a group is tied to by joints, directly or through others; itself without.
fn body(field: &Field, mut group: usize) -> usize {
    let groups = field.tracks.as_ref().map_or(&[][..], |tracks| &tracks.groups);
    // Bases come before what is on them.
    while let Some(joint) = groups[group].joint {
        group = joint.base as usize;
    }
    group
}

#[cfg(test)]
mod tests {
    use cif_field::tracks::NO_GROUP;
    use cif_field::{Joint, JointKind};
    use glam::DVec3;

    use super::*;
    use crate::testing::{MEMBERS, recorded_field};

    /// Objects with one group each that name no instance, and the owners of all rows.
    fn unnamed() -> (Field, Vec<u32>, Vec<Option<usize>>) {
        let mut field = recorded_field(2, 5);
        for group in &mut field.tracks.as_mut().unwrap().groups {
            (group.deformed, group.instance) = (false, None);
        }
        let rows: Vec<u32> = (0..field.len() as u32).collect();
        let owners = (0..field.len()).map(|row| Some(row / MEMBERS).filter(|owner| *owner < 2)).collect();
        (field, rows, owners)
    }

    #[test]
    fn groups_without_a_name_are_of_the_instance_that_has_most_of_their_image() {
        let (mut field, rows, mut owners) = unnamed();
        // A shadow on the ground that the masks give to the first object, and a piece of it that they do not.
        (owners[2 * MEMBERS + 3], owners[5]) = (Some(0), None);
        assert_eq!(of_groups(&field, &rows, &owners), [Some(0), Some(1)]);
        // A part on a joint is its base's, whoever owns most of the part.
        let tracks = field.tracks.as_mut().unwrap();
        tracks.groups[1].joint = Some(Joint { base: 0, kind: JointKind::Revolute, axis: DVec3::Z });
        owners[..2 * MEMBERS].fill(Some(0));
        owners[MEMBERS..MEMBERS + 30].fill(Some(1));
        assert_eq!(of_groups(&field, &rows, &owners), [Some(0), Some(0)]);
        let (mut field, rows, owners) = unnamed();
        // Where the network moves most of an object, its few posed Gaussians are not all of it.
        field.tracks.as_mut().unwrap().group_of[..3 * MEMBERS / 4].fill(NO_GROUP);
        assert_eq!(of_groups(&field, &rows, &owners), [None, Some(1)]);
        // What groups say counts.
        field.tracks.as_mut().unwrap().groups[0].instance = Some(field.instances[1].id);
        assert_eq!(of_groups(&field, &rows, &owners), [Some(1), Some(1)]);
        field.identities = None;
        assert_eq!(of_groups(&field, &rows, &owners), [None, None]);
    }
}
