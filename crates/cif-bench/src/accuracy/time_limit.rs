//! Time limit of a quick report: decides which rungs still fit.

use cif_train::Clock;

/// Wall time of the rungs of a quick report, seconds; what remains of five minutes is for the rest.
pub const QUICK_SECONDS: f64 = 270.0;

/// Allowance for rungs that cost more per step than those before.
const CAUTION: f64 = 1.3;

/// Decides what still fits.
#[derive(Debug)]
pub struct TimeLimit<C> {
    clock: C,
    begin_s: f64,
    seconds: f64,
    /// Largest wall time of a step so far, scoring included.
    step_s: f64,
}

impl<C: Clock> TimeLimit<C> {
    /// So many seconds from now on.
    #[must_use]
    pub fn start(clock: C, seconds: f64) -> Self {
        let begin_s = clock.now().wall_s;
        Self { clock, begin_s, seconds, step_s: 0.0 }
    }

    /// Wall time since the start, seconds.
    #[must_use]
    pub fn elapsed_s(&self) -> f64 {
        self.clock.now().wall_s - self.begin_s
    }

    /// True when so many training steps fit; what trains nothing takes no time to speak of.
    #[must_use]
    pub fn has_time_for(&self, steps: u64) -> bool {
        steps == 0 || self.elapsed_s() + CAUTION * self.step_s * steps as f64 <= self.seconds
    }

    /// Takes note of a rung of so many steps that began then and has just ended.
    pub fn learn(&mut self, steps: u64, begin_s: f64) {
        if steps > 0 {
            self.step_s = self.step_s.max((self.elapsed_s() - begin_s) / steps as f64);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use cif_train::Seconds;

    use super::*;

    #[derive(Clone, Debug, Default)]
    struct Hand(Arc<AtomicU64>);

    impl Hand {
        fn advance(&self, seconds: u64) {
            self.0.fetch_add(seconds, Ordering::Relaxed);
        }
    }

    impl Clock for Hand {
        fn now(&self) -> Seconds {
            Seconds { wall_s: 1e6 + self.0.load(Ordering::Relaxed) as f64, cpu_s: 0.0 }
        }
    }

    #[test]
    fn only_what_fits_is_begun() {
        let hand = Hand::default();
        let mut limit = TimeLimit::start(hand.clone(), 100.0);
        assert!(limit.has_time_for(1_000_000), "nothing is known yet");
        hand.advance(20);
        limit.learn(1000, 0.0);
        // 20 s are gone, 1000 steps take 20 s and a little more.
        assert!(limit.has_time_for(3000) && !limit.has_time_for(3200));
        hand.advance(10);
        limit.learn(1000, 20.0);
        assert!(!limit.has_time_for(2700), "a cheap rung does not make the others cheap");
        hand.advance(69);
        assert!(!limit.has_time_for(200) && limit.has_time_for(0));
    }
}
