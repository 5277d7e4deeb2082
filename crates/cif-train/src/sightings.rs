//! Where masks show the instances of a capture, camera by camera, and which of them appear or vanish inside the view.

use std::collections::BTreeMap;

use crate::tracks::Observation;

/// Share of its usual area from which an instance counts as seen whole.
const WHOLE: f64 = 0.5;

/// Observations of instances in the frames that were looked at.
#[derive(Debug, Default)]
pub(crate) struct Sightings<'a> {
    /// Times of the frames looked at, by camera, in ascending order.
    times: BTreeMap<&'a str, Vec<usize>>,
    /// Per instance, camera by camera.
    of: BTreeMap<u16, BTreeMap<&'a str, Vec<Observation>>>,
}

impl<'a> Sightings<'a> {
    /// Adds what a frame shows, by instance; frames come in the order of time.
    pub(crate) fn add(&mut self, camera: &'a str, time_index: usize, seen: BTreeMap<u16, Observation>) {
        self.times.entry(camera).or_default().push(time_index);
        for (instance, observation) in seen {
            self.of.entry(instance).or_default().entry(camera).or_default().push(observation);
        }
    }

    /// What is seen of an instance, in the order of time.
    pub(crate) fn of(&self, instance: u16) -> Vec<Observation> {
        let cameras = self.of.get(&instance).into_iter().flat_map(BTreeMap::values);
        let mut all: Vec<Observation> = cameras.flatten().copied().collect();
        all.sort_by_key(|observation| observation.time_index);
        all
    }

    /// True of an instance that every camera which sees it sees appear inside its image at full size: what comes in
    /// from the side is cut first, what comes from behind something starts small.
    pub(crate) fn appears(&self, instance: u16) -> bool {
        self.all_cameras(instance, |times, seen| {
            let (Some(first), Some(start)) = (seen.first(), times.first()) else { return false };
            first.time_index > *start && is_whole(first, &seen[1..])
        })
    }

    /// True of an instance that every camera which sees it sees vanish likewise.
    pub(crate) fn vanishes(&self, instance: u16) -> bool {
        self.all_cameras(instance, |times, seen| {
            let (Some(last), Some(end)) = (seen.last(), times.last()) else { return false };
            last.time_index < *end && is_whole(last, &seen[..seen.len() - 1])
        })
    }

    fn all_cameras(&self, instance: u16, shows: impl Fn(&[usize], &[Observation]) -> bool) -> bool {
        let cameras = self.of.get(&instance);
        cameras.is_some_and(|cameras| cameras.iter().all(|(camera, seen)| shows(&self.times[camera], seen)))
    }
}

/// True when an instance is seen as large as in the other frames, away from the border.
fn is_whole(observation: &Observation, others: &[Observation]) -> bool {
    let mut areas: Vec<f64> = others.iter().map(|other| other.area_px).collect();
    areas.sort_by(f64::total_cmp);
    let Some(median) = areas.get(areas.len() / 2) else { return false };
    !observation.cut && observation.area_px >= WHOLE * median
}
