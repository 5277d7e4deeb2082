//! Time as a run reads it: replaceable, so that what depends on time can be tested without waiting.

use std::ops::Sub;
use std::time::Instant;

use cpu_time::ProcessTime;
use serde::{Deserialize, Serialize};

/// Seconds on both clocks, from any origin: only differences mean something.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Seconds {
    /// Time that passed.
    pub wall_s: f64,
    /// Time that processors worked for this process, all threads together.
    pub cpu_s: f64,
}

impl Sub for Seconds {
    type Output = Self;

    fn sub(self, earlier: Self) -> Self {
        Self { wall_s: self.wall_s - earlier.wall_s, cpu_s: self.cpu_s - earlier.cpu_s }
    }
}

impl std::ops::AddAssign for Seconds {
    fn add_assign(&mut self, other: Self) {
        self.wall_s += other.wall_s;
        self.cpu_s += other.cpu_s;
    }
}

/// Something to read time from.
pub trait Clock: Send + Sync {
    /// The present time.
    fn now(&self) -> Seconds;
}

/// The clocks of the machine.
#[derive(Clone, Copy, Debug)]
pub struct SystemClock {
    start: Instant,
}

impl SystemClock {
    /// A clock that begins now.
    #[must_use]
    pub fn start() -> Self {
        Self { start: Instant::now() }
    }
}

impl Clock for SystemClock {
    fn now(&self) -> Seconds {
        Seconds {
            wall_s: self.start.elapsed().as_secs_f64(),
            cpu_s: ProcessTime::now().as_duration().as_secs_f64(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_clocks_run_forwards() {
        let clock = SystemClock::start();
        let before = clock.now();
        let work: f64 = (0..2_000_000).map(|k| f64::from(k).sqrt()).sum();
        let spent = clock.now() - before;
        assert!(work > 0.0 && spent.wall_s > 0.0 && spent.cpu_s >= 0.0, "{spent:?}");
    }
}

#[cfg(test)]
pub(crate) mod testing {
    use std::sync::Mutex;

    use super::{Clock, Seconds};

    /// A clock that stands still until time passes on it; two processors are busy.
    #[derive(Default)]
    pub(crate) struct Manual(Mutex<f64>);

    impl Manual {
        /// So many seconds pass.
        pub(crate) fn pass(&self, seconds: f64) {
            *self.0.lock().unwrap() += seconds;
        }
    }

    impl Clock for Manual {
        fn now(&self) -> Seconds {
            let wall_s = *self.0.lock().unwrap();
            Seconds { wall_s, cpu_s: 2.0 * wall_s }
        }
    }
}
