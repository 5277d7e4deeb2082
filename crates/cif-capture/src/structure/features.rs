//! Which features are looked for: on how many pixels, and down to which contrast.
//!
//! COLMAP finds features on images of twice the size. Time grows with the pixels, that of matches with the square of the
//! features, and poses do not get better by more features than [`ENOUGH`]: so images are reduced to the size on which
//! they have about as many.

use crate::Error;

/// Settings of features that are tried.
pub(super) const SETTINGS: usize = PEAKS.len();

/// Thresholds of features, in order: COLMAP's own (1/150), and lower ones for more features.
const PEAKS: [Option<f64>; 3] = [None, Some(0.002), Some(0.001)];

/// Larger sides that images are reduced to, pixels; some only, so that features are found again by later requests.
const SIDES: [u32; 8] = [320, 400, 480, 640, 800, 960, 1280, 1600];

/// Side on which features of a few images are counted first.
const SAMPLE_SIDE: u32 = 480;

/// Images whose features are counted first.
const SAMPLE: usize = 6;

/// Features of an image in the median that are enough for poses.
const ENOUGH: f64 = 1500.0;

/// Features to look for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Features {
    /// Images are reduced to this larger side, pixels.
    pub(super) side: u32,
    /// Threshold; COLMAP's own where there is none.
    pub(super) peak: Option<f64>,
}

impl Features {
    /// The most features that images of this larger side are searched for at COLMAP's own threshold.
    pub(super) fn all(largest: u32) -> Self {
        Self { side: largest.min(SIDES[SIDES.len() - 1]), peak: None }
    }

    /// The setting of that number, from 0 to [`SETTINGS`]: the first as it is, the others on twice the side at most.
    pub(super) fn more(self, number: usize, largest: u32) -> Self {
        match number {
            0 => self,
            _ => Self { side: Self::all(largest).side.min(2 * self.side), peak: PEAKS[number] },
        }
    }
}

/// Features to begin with, for `images` images of which the largest has this larger side; `count` finds features of some
/// of them.
///
/// # Errors
/// Those of `count`.
pub(super) fn chosen(
    largest: u32,
    images: usize,
    count: impl FnOnce(&[usize], Features) -> Result<Vec<usize>, Error>,
) -> Result<Features, Error> {
    let all = Features::all(largest);
    if all.side <= SIDES[0] || images == 0 {
        return Ok(all);
    }
    let of_sample = Features { side: all.side.min(SAMPLE_SIDE), ..all };
    let taken = images.min(SAMPLE);
    // The middle of every sixth of the images.
    let sample: Vec<usize> = (0..taken).map(|k| (2 * k + 1) * images / (2 * taken)).collect();
    let found = median(count(&sample, of_sample)?).max(1) as f64;
    // Features grow as the area does.
    let needed = f64::from(of_sample.side) * (ENOUGH / found).sqrt();
    let side = SIDES.into_iter().find(|side| f64::from(*side) >= needed).unwrap_or(all.side);
    Ok(Features { side: side.min(all.side), ..all })
}

/// The median of some counts; 0 of none.
pub(super) fn median(mut counts: Vec<usize>) -> usize {
    counts.sort_unstable();
    counts.get(counts.len() / 2).copied().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The side that is chosen for images with so many features on [`SAMPLE_SIDE`].
    fn side(largest: u32, found: usize) -> u32 {
        let count = |sample: &[usize], features: Features| {
            assert!(sample.len() == 6 && features.side == largest.min(480), "{sample:?} {features:?}");
            Ok(vec![0, found, found, found, found, 9_000])
        };
        chosen(largest, 150, count).unwrap().side
    }

    #[test]
    fn images_are_reduced_until_they_have_enough_features() {
        assert_eq!(side(1920, 1500), 480);
        // Four times the features on four times the area.
        assert_eq!(side(1920, 375), 960);
        assert_eq!(side(1920, 6000), 320);
        // Never enlarged, and no more than what COLMAP searches in a minute or two.
        assert_eq!((side(1920, 20), side(854, 20), side(400, 20)), (1600, 854, 400));
        assert_eq!((side(854, 1400), side(4000, 0)), (640, 1600));
    }

    #[test]
    fn small_images_are_taken_as_they_are() {
        let count = |_: &[usize], _: Features| -> Result<Vec<usize>, Error> { panic!("counted") };
        assert_eq!(chosen(256, 50, count).unwrap(), Features { side: 256, peak: None });
    }

    #[test]
    fn later_settings_have_more_features() {
        let first = Features { side: 480, peak: None };
        assert_eq!(first.more(0, 1920), first);
        assert_eq!(first.more(1, 1920), Features { side: 960, peak: Some(0.002) });
        assert_eq!(first.more(2, 640), Features { side: 640, peak: Some(0.001) });
    }

    #[test]
    fn samples_are_spread_and_few_images_are_all_counted() {
        let seen = std::cell::RefCell::new(Vec::new());
        let count = |sample: &[usize], _: Features| {
            *seen.borrow_mut() = sample.to_vec();
            Ok(vec![500; sample.len()])
        };
        chosen(640, 60, count).unwrap();
        assert_eq!(*seen.borrow(), [5, 15, 25, 35, 45, 55]);
        chosen(640, 3, count).unwrap();
        assert_eq!(*seen.borrow(), [0, 1, 2]);
    }
}
