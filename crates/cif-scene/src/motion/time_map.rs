//! Time codes to frames and normalised times, and back.

use cif_field::Field;

use crate::{SceneError, TimeCodes};

/// More frames than this are not filled in between the samples of a file.
const MOST_FRAMES: f64 = 1e5;

/// Time codes of a file against the frames of a field's timeline.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TimeMap {
    /// Time code of every frame.
    codes: Vec<f64>,
    /// Normalised time of every frame.
    times: Vec<f64>,
}

impl TimeMap {
    /// The timeline of a field.
    pub(crate) fn of_field(field: &Field) -> Self {
        Self { codes: field.time_codes(), times: field.timeline.times.clone() }
    }

    /// A timeline that holds every sampled time code, and whole codes between them where the samples are whole.
    ///
    /// Codes count from 0 as frames do where the times leave room for the frames before the first sample;
    /// otherwise the first sample is frame 0.
    pub(crate) fn of_file(time_codes: &TimeCodes) -> Result<Self, SceneError> {
        let (codes, mut times) = (time_codes.samples.clone(), time_codes.times.clone());
        let ascend = |values: &[f64]| {
            values.iter().all(|value| value.is_finite()) && values.windows(2).all(|pair| pair[0] < pair[1])
        };
        if codes.is_empty() || codes.len() != times.len() || !ascend(&codes) || !ascend(&times) {
            return Err(SceneError::Import {
                object: "the timeline".to_owned(),
                what: "its time codes do not ascend, or have no times".to_owned(),
            });
        }
        let (first, last) = (times[0], times[times.len() - 1]);
        if first < 0.0 || last > 1.0 {
            let span = if last > first { last - first } else { 1.0 };
            times.iter_mut().for_each(|time| *time = ((*time - first) / span).clamp(0.0, 1.0));
        }
        let (start, end) = (codes[0], codes[codes.len() - 1]);
        let whole = codes.iter().all(|code| code.fract() == 0.0) && start >= 0.0 && end < MOST_FRAMES;
        let samples = Self { codes, times };
        if !whole {
            return Ok(samples);
        }
        let leading = if samples.times[0] > 0.0 { start as usize } else { 0 };
        let frames = (start as usize - leading)..=end as usize;
        let time = |code: usize| {
            if (code as f64) < start {
                samples.times[0] * (code as f64 / start)
            } else {
                samples.time(code as f64)
            }
        };
        let times = frames.clone().map(time).collect();
        Ok(Self { codes: frames.map(|code| code as f64).collect(), times })
    }

    /// Normalised times of all frames.
    pub(crate) fn times(&self) -> &[f64] {
        &self.times
    }

    /// Time codes of all frames.
    pub(crate) fn codes(&self) -> &[f64] {
        &self.codes
    }

    /// Normalised time of a code; beyond the ends the line goes on.
    pub(crate) fn time(&self, code: f64) -> f64 {
        line(&self.codes, &self.times, code)
    }

    /// Time code of a normalised time.
    pub(crate) fn code(&self, time: f64) -> f64 {
        line(&self.times, &self.codes, time)
    }

    /// Frame nearest to a code.
    pub(crate) fn nearest_frame(&self, code: f64) -> usize {
        let after = self.codes.partition_point(|other| *other < code).min(self.codes.len() - 1);
        let before = after.saturating_sub(1);
        if code - self.codes[before] < self.codes[after] - code { before } else { after }
    }
}

/// The broken line through `(from[k], to[k])` at `x`; exact at its corners.
fn line(from: &[f64], to: &[f64], x: f64) -> f64 {
    if from.len() < 2 {
        return to[0] + (x - from[0]);
    }
    let after = from.partition_point(|corner| *corner <= x).clamp(1, from.len() - 1);
    let (a, b) = (after - 1, after);
    if x == from[b] {
        return to[b];
    }
    to[a] + (x - from[a]) / (from[b] - from[a]) * (to[b] - to[a])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn codes(samples: &[f64], times: &[f64]) -> TimeCodes {
        TimeCodes { samples: samples.to_vec(), times: times.to_vec(), frames_per_second: 24.0 }
    }

    #[test]
    fn frames_are_filled_in_and_codes_stay_frames() {
        let map = TimeMap::of_file(&codes(&[0.0, 2.0, 4.0, 5.0], &[0.0, 0.5, 0.9, 1.0])).unwrap();
        assert_eq!(map.times(), [0.0, 0.25, 0.5, 0.7, 0.9, 1.0]);
        assert_eq!((map.time(2.0), map.code(0.9), map.nearest_frame(3.4)), (0.5, 4.0, 3));
        // A part of a longer scene keeps its frame numbers.
        let part = TimeMap::of_file(&codes(&[2.0, 3.0], &[0.5, 0.75])).unwrap();
        assert_eq!(part.times(), [0.0, 0.25, 0.5, 0.75]);
        assert_eq!(part.time(4.0), 1.0);
        // Another program's frames 1 to 3.
        let other = TimeMap::of_file(&codes(&[1.0, 3.0], &[0.0, 1.0])).unwrap();
        assert_eq!((other.times(), other.codes()), (&[0.0, 0.5, 1.0][..], &[1.0, 2.0, 3.0][..]));
    }

    #[test]
    fn odd_timelines_are_taken_as_they_are_or_refused() {
        let halves = TimeMap::of_file(&codes(&[0.5, 1.25], &[0.0, 1.0])).unwrap();
        assert_eq!(halves.codes(), [0.5, 1.25]);
        let far = TimeMap::of_file(&codes(&[0.0, 1e9], &[0.0, 1.0])).unwrap();
        assert_eq!(far.codes().len(), 2);
        let seconds = TimeMap::of_file(&codes(&[0.0, 10.0, 20.0], &[0.0, 4.0, 8.0])).unwrap();
        assert_eq!((seconds.times().len(), seconds.time(5.0)), (21, 0.25));
        let single = TimeMap::of_file(&codes(&[7.0], &[0.0])).unwrap();
        assert_eq!((single.times(), single.nearest_frame(99.0)), (&[0.0][..], 0));
        for bad in [codes(&[], &[]), codes(&[0.0, 0.0], &[0.0, 1.0]), codes(&[0.0], &[f64::NAN])] {
            assert!(TimeMap::of_file(&bad).is_err(), "{bad:?}");
        }
    }
}
