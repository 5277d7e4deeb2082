//! The run as those see it who wait for it: in which phase it is, how far, how long each phase took, and a way to
//! stop it.
//!
//! One handle is passed through everything that takes time. Each piece of work enters its [`Phase`], counts what it
//! has done, and asks whether it may go on. Time is credited to the innermost phase that is entered, so that the
//! phases of a run add up to its time on the clock.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::budget::Budget;
use crate::clock::{Clock, Seconds, SystemClock};
use crate::error::TrainError;
use crate::events::{Control, TrainEvent};
use crate::phase::Phase;
use crate::stop::Stop;

/// Least time between two reports of progress of one phase.
const REPORT_EVERY: Duration = Duration::from_millis(200);

/// Receiver of the events of phases. It is called from whichever thread does the work, one call at a time.
type Reporter = dyn Fn(&TrainEvent) -> Control + Send + Sync;

/// Phases of a run; copies are one and the same.
#[derive(Clone, Default)]
pub struct Phases(Arc<Shared>);

#[derive(Default)]
struct Shared {
    stop: Stop,
    reporter: Option<Box<Reporter>>,
    /// The reporter has asked to stop.
    is_stopped: AtomicBool,
    ledger: Mutex<Ledger>,
    /// Of the present phase: units done, units in all, and steps inside them.
    done: AtomicU64,
    total: AtomicU64,
    steps: AtomicU64,
    /// Last report of the present phase.
    reported: Mutex<Option<Instant>>,
}

/// Time by phase, up to `since`, when the present one began or went on.
struct Ledger {
    clock: Arc<dyn Clock>,
    present: Option<Phase>,
    since: Seconds,
    /// Entry into the present phase.
    entered: Seconds,
    spent: BTreeMap<Phase, Seconds>,
    deadline: Option<Deadline>,
}

impl Default for Ledger {
    fn default() -> Self {
        Self {
            clock: Arc::new(SystemClock::start()),
            present: None,
            since: Seconds::default(),
            entered: Seconds::default(),
            spent: BTreeMap::new(),
            deadline: None,
        }
    }
}

impl Ledger {
    /// Credits the time until now to the present phase; the present time.
    fn settle(&mut self) -> Seconds {
        let now = self.clock.now();
        if let Some(phase) = self.present {
            *self.spent.entry(phase).or_default() += now - self.since;
        }
        self.since = now;
        now
    }

    /// Time spent in a phase so far.
    fn of(&self, phase: Phase) -> Seconds {
        self.spent.get(&phase).copied().unwrap_or_default()
    }
}

/// Time of a budget by which a phase is to end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Deadline {
    /// Budget.
    pub budget: Budget,
    /// Seconds of it.
    pub at_s: f64,
}

impl Deadline {
    fn has_passed(&self, now: Seconds) -> bool {
        self.budget.used(now) >= self.at_s
    }
}

impl From<Stop> for Phases {
    fn from(stop: Stop) -> Self {
        Self::new(Arc::new(SystemClock::start()), stop)
    }
}

impl Phases {
    /// Phases on a clock, of a run that `stop` stops.
    #[must_use]
    pub fn new(clock: Arc<dyn Clock>, stop: Stop) -> Self {
        let ledger = Mutex::new(Ledger { clock, ..Ledger::default() });
        Self(Arc::new(Shared { stop, ledger, ..Shared::default() }))
    }

    /// The same with a receiver of [`TrainEvent::PhaseStarted`], [`TrainEvent::PhaseProgress`] and
    /// [`TrainEvent::PhaseEnded`]; [`Control::Stop`] in reply to any of them stops the run. It may be called from
    /// any thread, one call at a time, and must not enter phases itself.
    ///
    /// # Panics
    /// When other copies are in use already.
    #[must_use]
    pub fn reported_to(self, reporter: impl Fn(&TrainEvent) -> Control + Send + Sync + 'static) -> Self {
        let mut shared = Arc::into_inner(self.0).expect("phases are reported from their start");
        shared.reporter = Some(Box::new(reporter));
        Self(Arc::new(shared))
    }

    /// Reads time from another clock from now on.
    pub(crate) fn set_clock(&self, clock: Arc<dyn Clock>) {
        let mut ledger = self.ledger();
        if ledger.present.is_some() {
            ledger.settle();
            ledger.since = clock.now();
            ledger.entered = ledger.since;
        }
        ledger.clock = clock;
    }

    /// The present time on the clock of the run.
    #[must_use]
    pub fn now(&self) -> Seconds {
        let clock = Arc::clone(&self.ledger().clock);
        clock.now()
    }

    /// Enters a phase of so many units, 0 where they are not counted. It lasts until the guard is dropped; the phase
    /// that it interrupts then goes on. Phases are entered from the thread of the run alone.
    #[must_use = "the phase ends when this is dropped"]
    pub fn enter(&self, phase: Phase, total: usize) -> Entered {
        let shared = &self.0;
        let mut ledger = self.ledger();
        let now = ledger.settle();
        let before = ledger.of(phase);
        let outer = Outer {
            phase: ledger.present.replace(phase),
            entered: std::mem::replace(&mut ledger.entered, now),
            deadline: ledger.deadline.take(),
            counts: shared.counts(),
        };
        drop(ledger);
        shared.set_counts([0, total as u64, 0]);
        *shared.reported() = None;
        if phase != Phase::Other {
            self.send(&TrainEvent::PhaseStarted { phase, total: total as u64 });
        }
        Entered { phases: self.clone(), phase, before, outer }
    }

    /// One more unit of the present phase is done.
    pub fn advance(&self) {
        self.0.done.fetch_add(1, Ordering::Relaxed);
        self.report();
    }

    /// Sets the units that are done of the present phase.
    pub fn advance_to(&self, done: u64) {
        self.0.done.store(done, Ordering::Relaxed);
        self.report();
    }

    /// A step inside a unit is done; true where the work is to end, because of a stop or a deadline. Work that ends so
    /// has no result: [`Self::check`] fails from then on, and who asked for it must not take what came out.
    #[must_use]
    pub fn tick(&self) -> bool {
        self.0.steps.fetch_add(1, Ordering::Relaxed);
        self.report();
        self.is_over()
    }

    /// True once a stop is requested; stays true.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        self.0.is_stopped.load(Ordering::Relaxed) || self.0.stop.requested()
    }

    /// True once the present work is to end.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.is_stopped() || self.is_out_of_time()
    }

    /// True once the deadline of the present phase has passed.
    #[must_use]
    pub fn is_out_of_time(&self) -> bool {
        let deadline = self.ledger().deadline;
        deadline.is_some_and(|deadline| deadline.has_passed(self.now()))
    }

    /// Lets work go on.
    ///
    /// # Errors
    /// [`TrainError::Stopped`] once a stop is requested, [`TrainError::OutOfTime`] once the deadline of the present
    /// phase has passed.
    pub fn check(&self) -> Result<(), TrainError> {
        if self.is_stopped() {
            Err(TrainError::Stopped)
        } else if self.is_out_of_time() {
            Err(TrainError::OutOfTime)
        } else {
            Ok(())
        }
    }

    /// Time spent in every phase so far, the present one until now.
    #[must_use]
    pub fn times(&self) -> BTreeMap<Phase, Seconds> {
        let mut ledger = self.ledger();
        if ledger.present.is_some() {
            ledger.settle();
        }
        ledger.spent.clone()
    }

    /// Time spent in a phase so far.
    #[must_use]
    pub fn spent(&self, phase: Phase) -> Seconds {
        let mut ledger = self.ledger();
        if ledger.present == Some(phase) {
            ledger.settle();
        }
        ledger.of(phase)
    }

    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        self.0.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reports how far the present phase is, unless that was done just now, or by its steps.
    fn report(&self) {
        let shared = &self.0;
        if shared.reporter.is_none() {
            return;
        }
        let Ok(mut reported) = shared.reported.try_lock() else { return };
        if reported.is_some_and(|last| last.elapsed() < REPORT_EVERY) {
            return;
        }
        let (phase, entered) = {
            let ledger = self.ledger();
            (ledger.present, ledger.entered)
        };
        let Some(phase) = phase.filter(|phase| !phase.has_steps() && *phase != Phase::Other) else { return };
        let elapsed_s = (self.now() - entered).wall_s;
        let [done, total, steps] = shared.counts();
        let eta_s = (done > 0).then(|| elapsed_s * total.saturating_sub(done) as f64 / done as f64);
        let control = shared.reporter.as_ref().map(|reporter| {
            reporter(&TrainEvent::PhaseProgress { phase, done, total, steps, elapsed_s, eta_s })
        });
        shared.obey(control);
        *reported = Some(Instant::now());
    }

    fn send(&self, event: &TrainEvent) {
        let _one_at_a_time = self.0.reported();
        self.0.obey(self.0.reporter.as_ref().map(|reporter| reporter(event)));
    }
}

impl Shared {
    fn counts(&self) -> [u64; 3] {
        [&self.done, &self.total, &self.steps].map(|count| count.load(Ordering::Relaxed))
    }

    fn set_counts(&self, counts: [u64; 3]) {
        for (count, value) in [&self.done, &self.total, &self.steps].into_iter().zip(counts) {
            count.store(value, Ordering::Relaxed);
        }
    }

    fn reported(&self) -> MutexGuard<'_, Option<Instant>> {
        self.reported.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn obey(&self, control: Option<Control>) {
        if control == Some(Control::Stop) {
            self.is_stopped.store(true, Ordering::Relaxed);
        }
    }
}

/// A phase that lasts as long as this lives.
pub struct Entered {
    phases: Phases,
    phase: Phase,
    /// Time spent in the phase before.
    before: Seconds,
    outer: Outer,
}

/// The phase that was interrupted.
struct Outer {
    phase: Option<Phase>,
    entered: Seconds,
    deadline: Option<Deadline>,
    counts: [u64; 3],
}

impl Entered {
    /// Limits what follows in the phase, which can be left out: once the deadline has passed, [`Phases::check`] fails
    /// with [`TrainError::OutOfTime`].
    pub(crate) fn until(&self, deadline: Option<Deadline>) {
        self.phases.ledger().deadline = deadline;
    }
}

impl Drop for Entered {
    fn drop(&mut self) {
        let mut ledger = self.phases.ledger();
        ledger.settle();
        let Seconds { wall_s, cpu_s } = ledger.of(self.phase) - self.before;
        (ledger.present, ledger.entered, ledger.deadline) =
            (self.outer.phase, self.outer.entered, self.outer.deadline);
        drop(ledger);
        let [done, total, steps] = self.phases.0.counts();
        self.phases.0.set_counts(self.outer.counts);
        if self.phase != Phase::Other {
            let phase = self.phase;
            self.phases.send(&TrainEvent::PhaseEnded { phase, done, total, steps, wall_s, cpu_s });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::BudgetClock;
    use crate::clock::testing::Manual;

    fn on_a_clock() -> (Arc<Manual>, Phases) {
        let clock = Arc::new(Manual::default());
        (Arc::clone(&clock), Phases::new(clock, Stop::default()))
    }

    #[test]
    fn time_belongs_to_the_innermost_phase() {
        let (clock, phases) = on_a_clock();
        clock.pass(1.0);
        assert!(phases.times().is_empty(), "before the first phase nothing is counted");
        let outer = phases.enter(Phase::Fine, 10);
        clock.pass(2.0);
        let inner = phases.enter(Phase::Measure, 3);
        clock.pass(4.0);
        assert_eq!(phases.spent(Phase::Measure), Seconds { wall_s: 4.0, cpu_s: 8.0 }, "it goes on");
        drop(inner);
        clock.pass(8.0);
        drop(outer);
        clock.pass(16.0);
        let times = phases.times();
        assert_eq!((times[&Phase::Fine].wall_s, times[&Phase::Measure].wall_s), (10.0, 4.0));
    }

    #[test]
    fn events_tell_how_far_a_phase_is_and_what_it_took() {
        let (clock, phases) = on_a_clock();
        let events: Arc<Mutex<Vec<TrainEvent>>> = Arc::default();
        let phases = phases.reported_to({
            let events = Arc::clone(&events);
            move |event| {
                events.lock().unwrap().push(event.clone());
                Control::Continue
            }
        });
        let outer = phases.enter(Phase::Objects, 4);
        clock.pass(3.0);
        assert!(!phases.tick());
        phases.advance();
        // What comes between does not change how far it is.
        let inner = phases.enter(Phase::Save, 0);
        clock.pass(5.0);
        drop(inner);
        clock.pass(1.0);
        drop(outer);
        let (phase, total) = (Phase::Objects, 4);
        let events = events.lock().unwrap();
        assert_eq!(events[0], TrainEvent::PhaseStarted { phase, total });
        let progress =
            TrainEvent::PhaseProgress { phase, done: 0, total, steps: 1, elapsed_s: 3.0, eta_s: None };
        assert_eq!(events[1], progress);
        let ended = TrainEvent::PhaseEnded { phase, done: 1, total, steps: 1, wall_s: 4.0, cpu_s: 8.0 };
        assert_eq!(events.last(), Some(&ended));
        assert_eq!(events.len(), 5, "the second report comes too soon: {events:?}");
    }

    #[test]
    fn units_that_threads_finish_at_the_same_time_are_all_counted() {
        const UNITS: usize = 100_000;
        let ended: Arc<Mutex<Option<u64>>> = Arc::default();
        let phases = Phases::default().reported_to({
            let ended = Arc::clone(&ended);
            move |event| {
                if let TrainEvent::PhaseEnded { done, .. } = event {
                    *ended.lock().unwrap() = Some(*done);
                }
                Control::Continue
            }
        });
        let search = phases.enter(Phase::Search, 2 * UNITS);
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| (0..UNITS).for_each(|_| phases.advance()));
            }
        });
        drop(search);
        assert_eq!(*ended.lock().unwrap(), Some(2 * UNITS as u64));
    }

    #[test]
    fn work_ends_by_a_stop_or_by_its_deadline() {
        let (clock, phases) = on_a_clock();
        let phases = phases.reported_to(|event| match event {
            TrainEvent::PhaseStarted { phase: Phase::Fine, .. } => Control::Stop,
            _ => Control::Continue,
        });
        let budget = Budget { seconds: 10.0, clock: BudgetClock::Wall, threads: 1, start: phases.now() };
        let limited = phases.enter(Phase::Search, 2);
        limited.until(Some(Deadline { budget, at_s: 3.0 }));
        clock.pass(2.0);
        assert!(phases.check().is_ok() && !phases.tick());
        clock.pass(1.0);
        assert!(matches!(phases.check(), Err(TrainError::OutOfTime)) && phases.tick());
        drop(limited);
        assert!(phases.check().is_ok(), "the deadline is that of the phase");
        let fine = phases.enter(Phase::Fine, 2);
        assert!(matches!(phases.check(), Err(TrainError::Stopped)) && phases.tick());
        drop(fine);
        assert!(phases.is_stopped(), "for good");
    }
}
