//! When a node can be seen, from the recorded motion of its Gaussians.

use std::collections::BTreeSet;

use cif_field::Field;

use crate::VisibilitySample;
use crate::motion::time_map::TimeMap;

/// Changes of visibility of rows of a field: they are seen while any of them is. Empty where they always are.
pub(crate) fn of_rows(field: &Field, rows: &[u32]) -> Vec<VisibilitySample> {
    let Some(tracks) = &field.tracks else { return Vec::new() };
    let groups: BTreeSet<Option<usize>> = rows.iter().map(|&row| tracks.group(row as usize)).collect();
    // A row without a group, or one that never hides, keeps the node in sight.
    let steps = |group: &Option<usize>| group.map_or(&[][..], |group| &tracks.groups[group].visibility);
    if groups.iter().any(|group| steps(group).is_empty()) {
        return Vec::new();
    }
    let mut times: Vec<f64> =
        groups.iter().flat_map(|group| steps(group).iter().map(|step| step.time)).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let codes = TimeMap::of_field(field);
    let visible = |time: f64| groups.iter().flatten().any(|&group| tracks.groups[group].is_visible(time));
    let mut samples: Vec<VisibilitySample> = Vec::new();
    for time in times {
        let sample = VisibilitySample { time_code: codes.code(time), visible: visible(time) };
        if samples.last().is_none_or(|last| last.visible != sample.visible) {
            samples.push(sample);
        }
    }
    if samples.iter().all(|sample| sample.visible) { Vec::new() } else { samples }
}
