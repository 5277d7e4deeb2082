//! When a run asks to be saved by time: rarely enough that saving does not show.

/// Least time between two states, in units of what saving the last one took: saving costs at most a hundredth of
/// the time of a run, however slow the disk.
const COSTS_APART: f64 = 100.0;

/// Time of the next state, seconds of the run's clock.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Saving {
    next_s: f64,
}

impl Saving {
    /// Counts `every` seconds from now on.
    pub(super) fn begin(every: u32, now_s: f64) -> Self {
        Self { next_s: now_s + f64::from(every) }
    }

    /// True where a state is due; never with `every` 0.
    pub(super) fn is_due(self, every: u32, now_s: f64) -> bool {
        every > 0 && now_s >= self.next_s
    }

    /// A state was saved from `start_s` to `end_s`.
    pub(super) fn saved(&mut self, every: u32, start_s: f64, end_s: f64) {
        self.next_s = end_s + f64::from(every).max(COSTS_APART * (end_s - start_s));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_are_as_far_apart_as_asked_and_farther_where_they_cost_much() {
        let mut saving = Saving::begin(300, 50.0);
        assert!(!saving.is_due(300, 349.0) && saving.is_due(300, 350.0) && !saving.is_due(0, 1e9));
        saving.saved(300, 350.0, 350.1);
        assert!(!saving.is_due(300, 650.0) && saving.is_due(300, 650.2));
        saving.saved(300, 700.0, 710.0);
        assert!(!saving.is_due(300, 1_709.0) && saving.is_due(300, 1_710.0));
    }
}
