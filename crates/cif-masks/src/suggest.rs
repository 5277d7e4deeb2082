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

/// A camera of which masks were made.
pub struct Camera {
    /// Its frames, in order of time.
    pub frames: Vec<Propagated>,
}

/// A frame with a mask.
#[derive(Clone, Copy, Debug)]
pub struct Propagated {
    /// Its number, for the caller.
    pub frame: usize,
    /// Doubt about its mask, see [`doubt`].
    pub doubt: f64,
    /// It is a keyframe.
    pub painted: bool,
    /// It is trained on.
    pub trained: bool,
}

/// The frame of all cameras whose painting settles most doubt about frames that are trained on, itself one of these;
/// where there is none to be named, of all frames. The first of equals.
#[must_use]
pub fn next_frame(cameras: &[Camera]) -> Option<usize> {
    let best = |counts: &dyn Fn(&Propagated) -> bool| {
        let of_camera = |camera: &Camera| {
            let doubts: Vec<f64> =
                camera.frames.iter().map(|frame| if counts(frame) { frame.doubt } else { 0.0 }).collect();
            let places = |filter: &dyn Fn(&Propagated) -> bool| -> Vec<usize> {
                (0..camera.frames.len()).filter(|k| filter(&camera.frames[*k])).collect()
            };
            let (keyframes, candidates) = (places(&|frame| frame.painted), places(counts));
            next_keyframe(&doubts, &keyframes, &candidates).map(|(k, gain)| (camera.frames[k].frame, gain))
        };
        let found = cameras.iter().filter_map(of_camera);
        found.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))).map(|(frame, _)| frame)
    };
    best(&|frame| frame.trained).or_else(|| best(&|_| true))
}

/// The candidate whose painting helps most, and the sum of doubts that it would settle. A keyframe settles all doubt at its
/// own place and ever less around it, none from half the gap between the neighbouring keyframes (or the ends of the clip)
/// on. `doubts` are those of all frames of a clip, in order. `None` where every candidate is a keyframe or nothing is in
/// doubt.
fn next_keyframe(doubts: &[f64], keyframes: &[usize], candidates: &[usize]) -> Option<(usize, f64)> {
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
    for frame in candidates.iter().copied().filter(|frame| !keyframes.contains(frame)) {
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
        let all: Vec<usize> = (0..41).collect();
        let mut doubts = vec![0.1; 41];
        doubts[20..41].fill(0.3);
        for key in [0, 20, 40] {
            doubts[key] = 0.0;
        }
        assert_eq!(next_keyframe(&doubts, &[0, 20, 40], &all).unwrap().0, 30);
        // A frame that is much worse than the others is worth more than the middle.
        doubts[25] = 5.0;
        assert_eq!(next_keyframe(&doubts, &[0, 20, 40], &all).unwrap().0, 25);
        assert_eq!(next_keyframe(&[0.0; 5], &[0], &all[..5]), None);
        assert_eq!(next_keyframe(&[1.0; 2], &[0, 1], &all[..2]), None);
    }

    /// A camera whose frames begin with a number; `T` trained, `K` trained keyframe, `h` held out.
    fn camera(first: usize, kinds: &str, doubt: impl Fn(usize) -> f64) -> Camera {
        let frame = |(k, kind)| Propagated {
            frame: first + k,
            doubt: if kind == 'K' { 0.0 } else { doubt(k) },
            painted: kind == 'K',
            trained: kind != 'h',
        };
        Camera { frames: kinds.chars().enumerate().map(frame).collect() }
    }

    #[test]
    fn held_out_frames_are_not_named_while_a_trained_one_is_in_doubt() {
        // The worst frames are those of a camera that is only held out, then one between trained ones.
        let held_out = camera(20, "hhh", |_| 0.9);
        let trained = camera(0, "KTThTTK", |k| [0.0, 0.1, 0.1, 0.8, 0.1, 0.2, 0.0][k]);
        assert_eq!(next_frame(&[trained, held_out]), Some(4));
        // Doubt about held-out frames does not draw trained ones to itself.
        let pulled = camera(0, "KTTTTTThhhK", |k| if k < 7 { 0.1 } else { 0.9 });
        let alone = camera(0, "KTTTTTThhhK", |k| if k < 7 { 0.1 } else { 0.0 });
        assert_eq!(next_frame(&[pulled]), next_frame(&[alone]));
        // Where every trained frame is painted, held-out ones are all that is left.
        let painted = || camera(0, "KKK", |_| 0.0);
        assert_eq!(next_frame(&[painted(), camera(20, "hhh", |_| 0.9)]), Some(21));
        assert_eq!(next_frame(&[painted()]), None);
        assert_eq!(next_frame(&[]), None);
        // The first of equals, whatever the order of the cameras.
        let one = |first| camera(first, "KTK", |_| 0.5);
        assert_eq!(next_frame(&[one(10), one(0)]), Some(1));
    }
}
