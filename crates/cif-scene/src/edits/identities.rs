//! Instance table and identity rows of an edited field.

use std::collections::BTreeMap;

use cif_field::{Field, Identities, Instance};

use super::plan::{Plan, instance_of};

/// Instance of the base table (or one added after it), or none.
pub(super) type Owner = Option<u16>;

/// Where the identity of a row comes from.
#[derive(Clone, Copy, Debug)]
pub(super) enum RowIdentity {
    /// The row of this number of the gathered base.
    Kept(u32),
    /// Its owner is given.
    Given(Owner),
}

/// The table without what was removed, and rows that name only what is left. `instances` is the base's table
/// with new entries at its end.
pub(super) fn rebuild(
    plan: &Plan<'_>,
    instances: Vec<Instance>,
    gathered: Option<&Identities>,
    rows: &[RowIdentity],
) -> (Vec<Instance>, Option<Identities>) {
    let mut next = 0;
    let renumbered: Vec<Owner> = (0..instances.len())
        .map(|index| {
            let stays = !plan.removed.contains(&index);
            next += u16::from(stays);
            stays.then(|| next - 1)
        })
        .collect();
    let instances: Vec<Instance> = instances
        .into_iter()
        .zip(&renumbered)
        .filter_map(|(instance, index)| index.map(|_| instance))
        .collect();
    if instances.is_empty() {
        return (instances, None);
    }
    let mut is_owned = vec![false; plan.base.len()];
    for node in plan.exported.nodes.iter().filter(|node| instance_of(node).is_some()) {
        node.splats.rows.iter().for_each(|row| is_owned[*row as usize] = true);
    }
    let mut identities = Identities::empty();
    for row in rows {
        match (*row, gathered) {
            (RowIdentity::Given(owner), _) => {
                identities.push_certain(owner.and_then(|owner| renumbered[usize::from(owner)]));
            }
            (RowIdentity::Kept(_), None) => identities.push_certain(None),
            (RowIdentity::Kept(row), Some(gathered)) => {
                let owned = is_owned[plan.sources[row as usize] as usize];
                keep(&mut identities, gathered, row as usize, &renumbered, owned);
            }
        }
    }
    (instances, Some(identities))
}

/// Keeps what groups say of their instances ([`cif_field::TrackGroup::instance`]): rows with an owner have theirs, and a
/// group whose instance was removed names none.
pub(super) fn follow_groups(field: &mut Field) {
    let Some(tracks) = &mut field.tracks else { return };
    let index_of: BTreeMap<u16, u16> =
        field.instances.iter().zip(0..).map(|(instance, index)| (instance.id, index)).collect();
    for group in &mut tracks.groups {
        group.instance = group.instance.filter(|id| index_of.contains_key(id));
    }
    let owners = field.identities.iter_mut().flat_map(|identities| &mut identities.owners);
    for (row, owner) in owners.enumerate().filter(|(_, owner)| **owner != cif_field::Owner::Estimated) {
        let id = tracks.group(row).and_then(|group| tracks.groups[group].instance);
        *owner = id.map_or(*owner, |id| cif_field::Owner::Instance(index_of[&id]));
    }
}

/// A row without the entries of removed instances. A row that belongs to one that stays keeps its labelled
/// share, so that it goes on belonging to it; one of the background does not fall to its second best.
fn keep(to: &mut Identities, from: &Identities, row: usize, renumbered: &[Owner], owned: bool) {
    let new_label = |label: u16| renumbered[usize::from(label)];
    let owner = match from.owner(row) {
        cif_field::Owner::Instance(label) => {
            new_label(label).map_or(cif_field::Owner::Background, cif_field::Owner::Instance)
        }
        other => other,
    };
    let score = |entry: &(u16, f32, f32)| entry.1 + entry.2;
    let best = from.entries(row).max_by(|a, b| score(a).total_cmp(&score(b)));
    if !owned && best.is_some_and(|(label, ..)| new_label(label).is_none()) {
        to.push_certain(None);
        return;
    }
    let mut entries: Vec<(u16, f32, f32)> = from
        .entries(row)
        .filter_map(|(label, estimate, calibration)| {
            new_label(label).map(|label| (label, estimate, calibration))
        })
        .collect();
    match (entries.is_empty(), owner) {
        (true, cif_field::Owner::Instance(label)) => return to.push_certain(Some(label)),
        (true, _) => return to.push_certain(None),
        (false, _) => {}
    }
    let share =
        |entries: &[(u16, f32, f32)]| entries.iter().map(|(_, log, _)| f64::from(*log).exp()).sum::<f64>();
    let all: Vec<(u16, f32, f32)> = from.entries(row).collect();
    if owned && entries.len() < all.len() {
        let factor = (share(&all) / share(&entries)).ln() as f32;
        if factor.is_finite() {
            entries.iter_mut().for_each(|(_, log, _)| *log += factor);
        }
    }
    to.push_entries(owner, entries);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn background_does_not_fall_to_the_second_best_of_what_is_removed() {
        let mut from = Identities::empty();
        from.labels.extend([0, 1]);
        from.log_estimates.extend([0.3_f32.ln(), 0.1_f32.ln()]);
        from.log_calibrations.extend([0.0, 0.0]);
        from.row_offsets.push(2);
        let kept = |renumbered: &[Owner], owned| {
            let mut to = Identities::empty();
            keep(&mut to, &from, 0, renumbered, owned);
            to
        };
        assert_eq!(kept(&[None, Some(0)], false).owners, [cif_field::Owner::Background]);
        let second = kept(&[Some(0), None], false);
        assert_eq!((second.owners, second.labels), (Vec::new(), vec![0]));
        let owned = kept(&[None, Some(0)], true);
        assert!((owned.labelled_shares()[0] - 0.4).abs() < 1e-6, "an owned row keeps its share");
    }
}
