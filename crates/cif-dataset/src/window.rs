//! A window of time of a long capture.

use cif_geometry::TimeWindow;
use cif_geometry::time_window::FEWEST_OWN;

use crate::{CaptureWindow, Dataset, Error, Split};

impl Dataset {
    /// The frames that a window of time sees; times are normalised over it. Instances, points, and where the capture lies
    /// in the world, are those of the whole.
    ///
    /// # Errors
    /// When the capture has too few times for so many windows, or the window sees no training frame.
    pub(crate) fn during(mut self, window: TimeWindow) -> Result<Self, Error> {
        let times = self.times.len();
        if window.own(times).len() < FEWEST_OWN {
            let most = times / FEWEST_OWN;
            let fix = if most > 1 {
                format!("give at most {most} windows")
            } else {
                "train it as a whole".to_owned()
            };
            return Err(Error::invalid(
                &self.root,
                format!("its {times} times are too few for {} windows; {fix}", window.count()),
            ));
        }
        let seen = window.seen(times);
        let ends = [self.times[seen.start], self.times[seen.end - 1]];
        let normalised = |time: f64| (time - ends[0]) / (ends[1] - ends[0]);
        self.frames.retain(|frame| seen.contains(&frame.time_index));
        for frame in &mut self.frames {
            frame.time = normalised(frame.time);
            frame.time_index -= seen.start;
        }
        if !self.frames.iter().any(|frame| frame.split == Split::Train) {
            return Err(Error::invalid(
                &self.root,
                format!("window {window} sees no frame to train on; take fewer windows"),
            ));
        }
        self.times = self.times[seen.clone()].iter().map(|time| normalised(*time)).collect();
        self.window = Some(CaptureWindow { window, first: seen.start, times: ends });
        Ok(self)
    }
}
