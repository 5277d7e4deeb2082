//! Where masks show the instances of a capture, camera by camera, and which of them appear or vanish inside the view.

use std::collections::BTreeMap;

use crate::tracks::Observation;

/// Share of its median area from which an instance counts as seen whole.
const WHOLE: f64 = 0.5;

/// Pixels below which masks come and go with the tracker.
const FEWEST_PIXELS: f64 = 40.0;

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

    /// True of an instance that no camera sees from the start, and most of those which see it see appear inside their
    /// images at full size: what comes in from the side is cut first, what comes from behind something starts small.
    pub(crate) fn appears(&self, instance: u16) -> bool {
        self.most_see(instance, |times, seen| {
            let first = seen.first().filter(|first| first.time_index > times[0])?;
            Some(is_whole(first, &seen[1..]))
        })
    }

    /// True of an instance that no camera sees to the end, and most of those which see it see vanish likewise.
    pub(crate) fn vanishes(&self, instance: u16) -> bool {
        self.most_see(instance, |times, seen| {
            let last = seen.last().filter(|last| last.time_index < times[times.len() - 1])?;
            Some(is_whole(last, &seen[..seen.len() - 1]))
        })
    }

    /// True where most cameras that see an instance show something, and none contradicts.
    fn most_see(&self, instance: u16, shows: impl Fn(&[usize], &[Observation]) -> Option<bool>) -> bool {
        let Some(cameras) = self.of.get(&instance) else { return false };
        let shown = cameras.iter().map(|(camera, seen)| shows(&self.times[camera], seen));
        let shown: Option<Vec<bool>> = shown.collect();
        shown.is_some_and(|shown| 2 * shown.iter().filter(|shows| **shows).count() > shown.len())
    }
}

/// True when an instance is seen as large as in the other frames, away from the border.
fn is_whole(observation: &Observation, others: &[Observation]) -> bool {
    let mut areas: Vec<f64> = others.iter().map(|other| other.area_px).collect();
    areas.sort_by(f64::total_cmp);
    let Some(median) = areas.get(areas.len() / 2) else { return false };
    !observation.is_cut() && observation.area_px >= FEWEST_PIXELS.max(WHOLE * median)
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic;
    use glam::DVec2;

    use super::*;

    /// An instance of so many pixels at every time, 0 where it is not seen, by camera.
    fn seen(areas: &[&[u32]]) -> [bool; 2] {
        let names: Vec<String> = (0..areas.len()).map(|camera| camera.to_string()).collect();
        let mut observations = Sightings::default();
        for time in 0..areas[0].len() {
            for (camera, areas) in areas.iter().enumerate() {
                let observation = Observation {
                    time_index: time,
                    camera: synthetic::generate(&synthetic::SyntheticConfig::default()).camera,
                    centroid_px: DVec2::splat(10.0),
                    area_px: f64::from(areas[time]),
                    cut: [false; 2],
                    contact_depth: None,
                };
                let seen = (areas[time] > 0).then_some((1, observation));
                observations.add(&names[camera], time, seen.into_iter().collect());
            }
        }
        [observations.appears(1), observations.vanishes(1)]
    }

    #[test]
    fn what_most_cameras_lose_at_full_size_vanishes() {
        let (whole, hides, stays) = ([80, 80, 80, 0, 0], [80, 80, 20, 0, 0], [80, 80, 80, 80, 80]);
        assert_eq!(seen(&[&whole]), [false, true]);
        assert_eq!(seen(&[&whole, &hides, &whole]), [false, true]);
        assert_eq!(seen(&[&whole, &hides]), [false, false]);
        assert_eq!(seen(&[&whole, &whole, &stays]), [false, false]);
        assert_eq!(seen(&[&[0, 0, 80, 80, 80], &[0, 70, 80, 80, 0]]), [true, false]);
        assert_eq!(seen(&[&[0, 0, 80, 80, 0]]), [true, true]);
        assert_eq!(seen(&[&[0, 0, 20, 20, 0]]), [false, false], "too few pixels");
    }
}
