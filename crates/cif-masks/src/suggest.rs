//! Which frame to paint next.

use std::collections::BTreeMap;

use crate::Mask;

/// Doubt about the mask of a frame: the mean, over the objects that it shows, of 1 - confidence of their pixels, so that
/// small objects count as much as large ones. 0 where it shows none.
#[must_use]
pub fn doubt(mask: &Mask) -> f64 {
    let mut objects: BTreeMap<u16, (u64, u64)> = BTreeMap::new();
    for (id, confidence) in mask.ids.pixels.iter().zip(&mask.confidence.pixels).filter(|(id, _)| **id != 0) {
        let (pixels, unsure) = objects.entry(*id).or_default();
        *pixels += 1;
        *unsure += u64::from(255 - confidence);
    }
    let shares = objects.values().map(|(pixels, unsure)| *unsure as f64 / (255.0 * *pixels as f64));
    shares.sum::<f64>() / objects.len().max(1) as f64
}

/// The frame whose painting helps most, and the sum of doubts that it would settle. A keyframe settles all doubt at its
/// own place and ever less around it, none from half the gap between the neighbouring keyframes (or the ends of the clip)
/// on. `doubts` are those of all frames of a clip, in order. `None` where every frame is a keyframe or
/// nothing is in doubt.
#[must_use]
pub fn next_keyframe(doubts: &[f64], keyframes: &[usize]) -> Option<(usize, f64)> {
    let settled = |frame: usize| {
        let before = keyframes.iter().filter(|key| **key < frame).max();
        let after = keyframes.iter().filter(|key| **key > frame).min();
        let low = before.map_or(0, |key| key + 1);
        let high = after.copied().unwrap_or(doubts.len());
        let reach = (high + 1 - low) as f64 / 2.0;
        (low..high)
            .map(|other| doubts[other] * (1.0 - frame.abs_diff(other) as f64 / reach).max(0.0))
            .sum::<f64>()
    };
    let mut best: Option<(usize, f64)> = None;
    for frame in (0..doubts.len()).filter(|frame| !keyframes.contains(frame)) {
        let gain = settled(frame);
        if gain > best.map_or(0.0, |(_, most)| most) {
            best = Some((frame, gain));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use cif_geometry::PixelGrid;

    use super::*;

    #[test]
    fn small_objects_count_as_large_ones() {
        let mask = Mask {
            ids: PixelGrid::from_pixels(5, 1, vec![0, 1, 1, 1, 2]),
            confidence: PixelGrid::from_pixels(5, 1, vec![0, 255, 255, 255, 0]),
        };
        assert!((doubt(&mask) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn the_middle_of_the_worst_gap_comes_next() {
        let mut doubts = vec![0.1; 41];
        doubts[20..41].fill(0.3);
        for key in [0, 20, 40] {
            doubts[key] = 0.0;
        }
        assert_eq!(next_keyframe(&doubts, &[0, 20, 40]).unwrap().0, 30);
        // A frame that is much worse than the others is worth more than the middle.
        doubts[25] = 5.0;
        assert_eq!(next_keyframe(&doubts, &[0, 20, 40]).unwrap().0, 25);
        assert_eq!(next_keyframe(&[0.0; 5], &[0]), None);
        assert_eq!(next_keyframe(&[1.0; 2], &[0, 1]), None);
    }
}
