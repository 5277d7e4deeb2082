//! Which instance every object is.

use std::collections::{BTreeMap, BTreeSet};

use super::{AssembleError, Copies, Identity, Prim, PrimName};
use crate::NodeKind;

/// Kind of every prim, and whether it is a copy that got an id of its own: recorded ids stay, others get the lowest
/// free ones and places behind all recorded ones.
pub(super) fn kinds(
    prims: &[Prim],
    reserved: &BTreeMap<u16, usize>,
    copies: Copies,
    warnings: &mut Vec<String>,
) -> Result<Vec<(NodeKind, bool)>, AssembleError> {
    let recorded = prims.iter().filter_map(|prim| match prim.identity {
        Identity::Recorded { id, index, .. } => Some((id, index)),
        _ => None,
    });
    let mut taken: BTreeSet<u16> =
        reserved.keys().copied().chain(recorded.clone().map(|(id, _)| id)).collect();
    let places = reserved.values().copied().chain(recorded.filter_map(|(_, index)| index));
    let mut free_index = places.max().map_or(0, |index| index.saturating_add(1));
    let mut next_index = || {
        free_index += 1;
        free_index - 1
    };
    let mut lowest = 1_u16;
    let mut new_id = |place: &str| {
        while lowest < u16::MAX && taken.contains(&lowest) {
            lowest += 1;
        }
        match taken.insert(lowest) {
            true => Ok(lowest),
            false => {
                let what = "a scene holds 65535 objects; merge some of them";
                Err(AssembleError { place: place.to_owned(), what })
            }
        }
    };
    let mut holders: BTreeMap<u16, &Prim> = BTreeMap::new();
    let mut backgrounds: BTreeSet<&PrimName> = BTreeSet::new();
    let mut kinds = Vec::with_capacity(prims.len());
    for prim in prims {
        let repeated = match prim.identity {
            Identity::New => None,
            Identity::Background => (!backgrounds.insert(&prim.name)).then_some(prim),
            Identity::Recorded { id, original, .. } => match (holders.insert(id, prim), copies) {
                (Some(first), Copies::Keep) => {
                    let (holder, copy) = if original { (prim, first) } else { (first, prim) };
                    warnings.push(format!("{} is a copy of {} (instance {id})", copy.place, holder.place));
                    holders.insert(id, holder);
                    None
                }
                (first, Copies::Renumber) => first,
                (None, Copies::Keep) => None,
            },
        };
        let kind = match prim.identity {
            _ if copies == Copies::Renumber && repeated.is_some() => {
                let (id, index) = (new_id(&prim.place)?, next_index());
                let name = match &prim.name {
                    PrimName::Given(name) | PrimName::Exported(name) => name,
                    PrimName::OfLabel => &prim.label,
                };
                warnings.push(format!("{} repeats {name}: it becomes the instance {id}", prim.place));
                kinds.push((NodeKind::Instance { id, index }, true));
                continue;
            }
            Identity::Background => NodeKind::Background,
            Identity::Recorded { id, index, .. } => {
                NodeKind::Instance { id, index: index.unwrap_or_else(&mut next_index) }
            }
            Identity::New => NodeKind::Instance { id: new_id(&prim.place)?, index: next_index() },
        };
        kinds.push((kind, false));
    }
    Ok(kinds)
}
