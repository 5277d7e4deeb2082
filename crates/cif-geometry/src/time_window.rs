//! Windows of time that a long capture is trained in.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Share of its own times that a window sees of each neighbour. Poses of objects are carried over the times that two windows
/// share, a fifth of what each sees, for a quarter more work.
const OVERLAP: f64 = 0.125;

/// Fewest times that a window sees of each neighbour: a pose and a velocity.
const FEWEST_SHARED: usize = 2;

/// Fewest times of its own that a window has.
pub const FEWEST_OWN: usize = 4;

/// One of the windows of time that a long capture is divided into, as in `2/4`. Each time belongs to one window; to be
/// trained, a window sees some times of its neighbours as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct TimeWindow {
    number: u32,
    count: u32,
}

impl TimeWindow {
    /// Window `number` of `count`, the first one being 1; `None` where there is no such window.
    #[must_use]
    pub fn new(number: u32, count: u32) -> Option<Self> {
        (1..=count).contains(&number).then_some(Self { number, count })
    }

    /// All windows, in the order of time.
    pub fn all(count: u32) -> impl Iterator<Item = Self> {
        (1..=count).map(move |number| Self { number, count })
    }

    /// Position in the order of time, from 1 on.
    #[must_use]
    pub fn number(self) -> u32 {
        self.number
    }

    /// Number of windows.
    #[must_use]
    pub fn count(self) -> u32 {
        self.count
    }

    /// Its own of so many times, which no other window has.
    #[must_use]
    pub fn own(self, times: usize) -> Range<usize> {
        let end = |number: u32| (times as u64 * u64::from(number) / u64::from(self.count)) as usize;
        end(self.number - 1)..end(self.number)
    }

    /// The times that it sees of so many: its own, and on each side [`OVERLAP`] of them.
    #[must_use]
    pub fn seen(self, times: usize) -> Range<usize> {
        let own = self.own(times);
        let more = ((own.len() as f64 * OVERLAP).round() as usize).max(FEWEST_SHARED);
        own.start.saturating_sub(more)..(own.end + more).min(times)
    }
}

impl fmt::Display for TimeWindow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.count)
    }
}

impl FromStr for TimeWindow {
    type Err = String;

    /// `2/4` is the second of four.
    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text
            .split_once('/')
            .and_then(|(number, count)| Self::new(number.trim().parse().ok()?, count.trim().parse().ok()?));
        numbers.ok_or_else(|| format!("`{text}` is no window; 2/4 is the second of four"))
    }
}

impl TryFrom<String> for TimeWindow {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<TimeWindow> for String {
    fn from(window: TimeWindow) -> Self {
        window.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_time_belongs_to_one_window_and_neighbours_share_some() {
        for (times, count) in [(1_200, 4), (103, 5), (16, 4), (8, 1)] {
            let windows: Vec<TimeWindow> = TimeWindow::all(count).collect();
            let own: Vec<usize> = windows.iter().flat_map(|window| window.own(times)).collect();
            assert_eq!(own, (0..times).collect::<Vec<_>>());
            for pair in windows.windows(2) {
                let (before, after) = (pair[0].seen(times), pair[1].seen(times));
                let boundary = pair[1].own(times).start;
                let shared = [boundary - after.start, before.end - boundary];
                assert!(shared.iter().all(|shared| *shared >= FEWEST_SHARED), "{times} {count}: {shared:?}");
                assert!(shared[0].abs_diff(shared[1]) <= 1, "the boundary is in the middle");
            }
        }
        assert_eq!(TimeWindow::new(2, 4).unwrap().seen(1_200), 262..638);
        assert_eq!(TimeWindow::new(1, 1).unwrap().seen(8), 0..8);
    }

    #[test]
    fn windows_are_read_as_they_are_written() {
        let second: TimeWindow = "2/4".parse().unwrap();
        assert_eq!((second, second.to_string().as_str()), (TimeWindow::new(2, 4).unwrap(), "2/4"));
        for wrong in ["0/4", "5/4", "2", "a/4", "1/0", "-1/2"] {
            assert!(wrong.parse::<TimeWindow>().is_err(), "{wrong}");
        }
    }
}
