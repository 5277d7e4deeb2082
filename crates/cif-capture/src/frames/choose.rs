//! Which frames of a video are taken.

use std::collections::BTreeMap;

use crate::picture::Impression;

/// Frames that are taken of a video where nothing else is asked for.
const DEFAULT_COUNT: usize = 150;

/// How frames are chosen.
#[derive(Clone, Debug, Default)]
pub struct Choice {
    /// Frames per second.
    pub rate: Option<f64>,
    /// Frames in all, of every video.
    pub count: Option<usize>,
    /// First second that is taken.
    pub from_s: Option<f64>,
    /// Last second that is taken.
    pub to_s: Option<f64>,
    /// Larger sides of frames are reduced to this many pixels.
    pub max_side: Option<u32>,
    /// True takes the sharpest frame of every window, false the one nearest to its middle. Cameras that record
    /// together need the latter, and have it where this is `None`.
    pub sharpest: Option<bool>,
    /// Seconds by which cameras began to record after the others, by their names; 0 for those that are not there.
    /// Seconds of the capture are those of their streams plus these.
    pub offsets_s: BTreeMap<String, f64>,
}

/// A frame of a video as it was looked at.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Seconds in the stream, with the offset of the camera.
    pub time: f64,
    /// Its looks.
    pub impression: Impression,
}

/// Numbers of the frames to take, ascending: time is cut into windows of equal length, and each gives one
/// frame, unless all of it is black or of one colour.
#[must_use]
pub fn choose(seen: &[Seen], choice: &Choice) -> Vec<usize> {
    let usable: Vec<usize> = (0..seen.len())
        .filter(|k| {
            let time = seen[*k].time;
            let is_in = choice.from_s.is_none_or(|from| time >= from - 1e-9)
                && choice.to_s.is_none_or(|to| time <= to + 1e-9);
            is_in && !seen[*k].impression.is_empty()
        })
        .collect();
    let (Some(first), Some(last)) = (usable.first(), usable.last()) else { return Vec::new() };
    let start = choice.from_s.unwrap_or(seen[*first].time);
    let span = seen[*last].time - start;
    let windows = match (choice.rate, choice.count) {
        // The window around the last frame counts too.
        (Some(rate), _) => ((span * rate + 1e-6).floor() as usize).saturating_add(1),
        (None, count) => count.unwrap_or(DEFAULT_COUNT),
    };
    if windows >= usable.len() && choice.rate.is_none() {
        return usable;
    }
    let length = match choice.rate {
        Some(rate) => 1.0 / rate,
        None => span / windows as f64,
    };
    let mut taken: Vec<usize> = Vec::new();
    let mut candidates = usable.iter().copied().peekable();
    for window in 0..windows {
        // With a rate, frame k is the one at k / rate: windows lie around it.
        let middle = if choice.rate.is_some() { window as f64 } else { window as f64 + 0.5 };
        let (middle, end) = (start + middle * length, start + (middle + 0.5) * length);
        let mut best: Option<(f64, usize)> = None;
        let is_last = window + 1 == windows;
        while let Some(k) = candidates.next_if(|k| seen[*k].time < end - 1e-9 || is_last) {
            let merit = if choice.sharpest.unwrap_or(true) {
                seen[k].impression.sharpness
            } else {
                -(seen[k].time - middle).abs()
            };
            // The first of equals, so that the choice does not hang on rounding.
            if best.is_none_or(|(other, _)| merit > other + 1e-12) {
                best = Some((merit, k));
            }
        }
        taken.extend(best.map(|(_, k)| k));
    }
    taken
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::tests::board;
    use crate::picture::{HEIGHT, WIDTH};

    /// Frames at 10 per second; those of `sharp` are sharper, those of `black` black.
    fn video(frames: usize, sharp: &[usize], black: &[usize]) -> Vec<Seen> {
        let of = |grey: &[u8]| Impression::of(grey);
        let (fine, coarse, none) = (of(&board(8, 0)), of(&board(40, 0)), of(&vec![0; WIDTH * HEIGHT]));
        (0..frames)
            .map(|k| Seen {
                time: k as f64 * 0.1,
                impression: if black.contains(&k) {
                    none.clone()
                } else if sharp.contains(&k) {
                    fine.clone()
                } else {
                    coarse.clone()
                },
            })
            .collect()
    }

    #[test]
    fn the_sharpest_frame_of_every_window_is_taken() {
        let seen = video(40, &[3, 17, 22, 38], &[]);
        let choice = Choice { count: Some(4), ..Choice::default() };
        assert_eq!(choose(&seen, &choice), [3, 17, 22, 38]);
        // In the middle of their windows instead.
        let choice = Choice { sharpest: Some(false), ..choice };
        assert_eq!(choose(&seen, &choice), [5, 15, 24, 34]);
    }

    #[test]
    fn a_rate_takes_frames_at_its_multiples() {
        let choice = Choice { rate: Some(2.5), sharpest: Some(false), ..Choice::default() };
        assert_eq!(choose(&video(21, &[], &[]), &choice), [0, 4, 8, 12, 16, 20]);
        let choice = Choice { from_s: Some(0.4), to_s: Some(1.3), ..choice };
        assert_eq!(choose(&video(21, &[], &[]), &choice), [4, 8, 12]);
        // More than the video has: every frame once.
        let choice = Choice { rate: Some(100.0), ..Choice::default() };
        assert_eq!(choose(&video(5, &[], &[]), &choice), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn black_frames_are_left_out_and_few_frames_are_all_taken() {
        let seen = video(6, &[], &[0, 5]);
        assert_eq!(choose(&seen, &Choice::default()), [1, 2, 3, 4]);
        assert!(choose(&video(3, &[], &[0, 1, 2]), &Choice::default()).is_empty());
    }
}
