//! When an object turns in place: from one image of a camera to the next its surface changes while it turns, and stays
//! while it pauses.

use std::collections::BTreeMap;

use glam::DVec3;

use super::evidence::{Evidence, Pixel};
use super::hull::Hit;

/// Cells that two images must share to be compared.
const COMMON: usize = 15;

/// Steps from which levels of change are told apart.
const FEWEST: usize = 6;

/// Change while an object turns, of that while it pauses, from which these are two levels and no noise around one: of
/// samples of one level the 90th percentile is below it unless they spread over more than half of their mean.
const LEVELS: f64 = 2.0;

/// Share of all turning that is done by each time, turning being even while there is any; `None` where no pauses are
/// seen. `hits` are those of the hull without turns.
pub(super) fn shares(evidence: &Evidence<'_>, hits: &[Option<Hit>]) -> Option<BTreeMap<usize, f64>> {
    let changes = changes(evidence, hits);
    let mut levels: Vec<f64> = changes.values().copied().collect();
    if levels.len() < FEWEST {
        return None;
    }
    levels.sort_by(f64::total_cmp);
    let at = |share: f64| levels[(share * (levels.len() - 1) as f64).round() as usize];
    let (low, high) = (at(0.1), at(0.9));
    if high < LEVELS * low {
        return None;
    }
    let threshold = (low * high).sqrt();
    let mut done = 0.0;
    let mut shares = BTreeMap::new();
    for ((from, to), change) in &changes {
        shares.entry(*from).or_insert(done);
        if *change > threshold {
            done += (to - from) as f64;
        }
        shares.insert(*to, done);
    }
    shares.values_mut().for_each(|share| *share /= done);
    Some(shares)
}

/// Mean change of the surface from each time to the next of the same camera, without that of the whole image.
fn changes(evidence: &Evidence<'_>, hits: &[Option<Hit>]) -> BTreeMap<(usize, usize), f64> {
    let mut first = 0;
    let mut last: BTreeMap<u32, (usize, BTreeMap<u32, DVec3>)> = BTreeMap::new();
    let mut sums: BTreeMap<(usize, usize), (f64, f64)> = BTreeMap::new();
    for look in &evidence.looks {
        let cells = cells(&look.pixels, &hits[first..first + look.pixels.len()]);
        first += look.pixels.len();
        let time = look.view.time_index;
        if let Some((before, others)) = last.get(&look.camera) {
            let both: Vec<DVec3> =
                cells.iter().filter_map(|(cell, value)| Some(*value - *others.get(cell)?)).collect();
            if both.len() >= COMMON && *before < time {
                let mean = both.iter().sum::<DVec3>() / both.len() as f64;
                let change = both.iter().map(|change| (*change - mean).length()).sum::<f64>();
                let (sum, count) = sums.entry((*before, time)).or_default();
                *sum += change / both.len() as f64;
                *count += 1.0;
            }
        }
        last.insert(look.camera, (time, cells));
    }
    sums.into_iter().map(|(step, (sum, count))| (step, sum / count)).collect()
}

/// Mean value of each cell that an image shows.
fn cells(pixels: &[Pixel], hits: &[Option<Hit>]) -> BTreeMap<u32, DVec3> {
    let mut sums: BTreeMap<u32, (DVec3, f64)> = BTreeMap::new();
    for (pixel, hit) in pixels.iter().zip(hits) {
        if let Some(hit) = hit {
            let (sum, count) = sums.entry(hit.cell).or_default();
            *sum += pixel.value;
            *count += 1.0;
        }
    }
    sums.into_iter().map(|(cell, (sum, count))| (cell, sum / count)).collect()
}
