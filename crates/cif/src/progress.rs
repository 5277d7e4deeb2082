//! Progress of a training run: a bar on terminals, plain lines elsewhere, JSON lines in a log.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cif_train::{Phase, TrainEvent};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::error::Error;

/// Pause between two plain lines of one stage.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Pause between two drawings of the bar, whose clock goes on while nothing else changes.
const TICK: Duration = Duration::from_millis(500);

/// Share of the time of a run below which the times of phases are summed up.
const SHORT: f64 = 0.005;

/// Time that a phase goes on before it is worth a line or the bar.
const WORTH_SHOWING_S: f64 = 2.0;

/// Shows and logs the events of a run.
pub struct Progress {
    bar: Option<ProgressBar>,
    quiet: bool,
    last_line: Option<Instant>,
    iou: Option<f64>,
    start: Instant,
    log: Log,
    log_failure: Option<Error>,
    /// Phases under way, the innermost last, with the text of the bar for each.
    phases: Vec<(Phase, Shown)>,
    /// Summary of the trained scene, once there is one.
    trained: Option<String>,
}

/// State of the bar.
#[derive(Clone, Debug, Default)]
struct Shown {
    prefix: &'static str,
    done: u64,
    total: u64,
    message: String,
}

/// Destination of the log of events.
enum Log {
    /// It is not known yet; lines so far.
    Undecided(Vec<String>),
    File(PathBuf, File),
    Nowhere,
}

/// A line of the log of `cif train --log`: an event, and when it happened.
#[derive(Serialize)]
struct LogLine<'a> {
    #[serde(flatten)]
    event: &'a TrainEvent,
    /// Time since the start of this run, seconds.
    time_s: f64,
}

impl Progress {
    /// Draws on stderr unless `quiet`.
    #[must_use]
    pub fn new(quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            let style =
                ProgressStyle::with_template("{prefix:>9} [{bar:30}] {pos}/{len}  {elapsed} {wide_msg}");
            bar.set_style(style.expect("the template is valid").progress_chars("=> "));
            bar.enable_steady_tick(TICK);
            bar
        });
        Self {
            bar,
            quiet,
            last_line: None,
            iou: None,
            start: Instant::now(),
            log: Log::Undecided(Vec::new()),
            log_failure: None,
            phases: Vec::new(),
            trained: None,
        }
    }

    /// Logs to a file, behind what is there when `append` is set, or nowhere; events from before are logged too.
    ///
    /// # Errors
    /// When the log cannot be opened.
    pub fn log_to(&mut self, log: Option<&Path>, append: bool) -> Result<(), Error> {
        let earlier = std::mem::replace(&mut self.log, Log::Nowhere);
        let Some(path) = log else { return Ok(()) };
        let file = OpenOptions::new().create(true).write(true).append(append).truncate(!append).open(path);
        self.log = Log::File(path.to_owned(), file.map_err(Error::io("open the log", path))?);
        if let Log::Undecided(lines) = earlier {
            lines.into_iter().for_each(|line| self.log_line(line));
        }
        Ok(())
    }

    /// Takes one event.
    pub fn event(&mut self, event: &TrainEvent) {
        self.write_log(event);
        match event {
            TrainEvent::PhaseStarted { phase, total } => self.phase_started(*phase, *total),
            TrainEvent::PhaseProgress { phase, done, total, steps, elapsed_s, eta_s } => {
                if *elapsed_s >= WORTH_SHOWING_S || self.phases.len() == 1 {
                    self.phase_progress(*phase, [*done, *total, *steps], *elapsed_s, *eta_s);
                }
            }
            TrainEvent::PhaseEnded { phase, done, wall_s, .. } => self.phase_ended(*phase, *done, *wall_s),
            TrainEvent::StageStarted { stage, iteration, iterations, gaussians } => {
                self.last_line = None;
                let (done, total) = (u64::from(*iteration), u64::from(*iterations));
                self.show(Shown { prefix: stage.name(), done, total, message: String::new() });
                // Stages without steps report what they find.
                if *iterations > 0 {
                    self.plain(&format!(
                        "{stage}: {iterations} steps from step {iteration}, {gaussians} Gaussians"
                    ));
                }
            }
            TrainEvent::StageEnded { stage, wall_s, .. } => {
                self.plain(&format!("{stage} took {}", duration(*wall_s)));
            }
            TrainEvent::Step {
                stage,
                iteration,
                iterations,
                loss,
                gaussians,
                psnr,
                iterations_per_second,
                eta_s,
                ..
            } => {
                let iou = self.iou.map_or(String::new(), |iou| format!("  IoU {iou:.1}"));
                let message = format!(
                    "{iterations_per_second:.1} it/s  ETA {}  loss {loss:.4}  {gaussians} Gaussians  PSNR {psnr:.2}{iou}",
                    duration(*eta_s)
                );
                if self.is_line_due() || iteration == iterations {
                    self.last_line = Some(Instant::now());
                    self.plain(&format!("{stage} {iteration}/{iterations}  {message}"));
                }
                let (done, total) = (u64::from(*iteration), u64::from(*iterations));
                self.show(Shown { prefix: stage.name(), done, total, message });
            }
            TrainEvent::IdentityEstimated { frames, instances, unseen, .. } => {
                self.line(&format!("identities of {instances} instances from {frames} frames; {unseen} Gaussians were never seen on a labelled pixel"));
            }
            TrainEvent::Evaluated { stage, iteration, frames, psnr, iou, .. } => {
                self.iou = iou.or(self.iou);
                self.line(&format!(
                    "{stage} {iteration}: {frames} held-out frames, PSNR {}, IoU {}",
                    optional(*psnr),
                    optional(*iou)
                ));
            }
            TrainEvent::RolledBack { stage, iteration, fault, in_a_row, .. } => {
                let repeated = if *in_a_row > 1 { format!(" ({in_a_row} in a row)") } else { String::new() };
                self.line(&format!("warning: {stage} {iteration} rolled back{repeated}: {fault}"));
            }
            TrainEvent::Measured { point, .. } => self.iou = point.iou.or(self.iou),
            TrainEvent::Warning { message } => self.line(&format!("warning: {message}")),
            TrainEvent::Note { message } => self.line(&format!("note: {message}")),
            TrainEvent::Finished { iterations, gaussians, psnr, peak_rss_mb, rolled_back, .. } => {
                let memory = peak_rss_mb.map_or(String::new(), |mb| format!(", peak memory {mb:.0} MB"));
                if *rolled_back > 0 {
                    self.line(&format!(
                        "warning: {rolled_back} of {iterations} steps met values that are not finite and were rolled \
                         back; the scene's record names the last"
                    ));
                }
                self.trained =
                    Some(format!("{gaussians} Gaussians, PSNR of training views {psnr:.2}{memory}"));
            }
            TrainEvent::Densified { .. }
            | TrainEvent::Resampled { .. }
            | TrainEvent::Settled { .. }
            | TrainEvent::Judged { .. }
            | TrainEvent::CheckpointDue { .. } => {}
        }
    }

    fn phase_started(&mut self, phase: Phase, total: u64) {
        let shown = Shown { prefix: phase.name(), done: 0, total, message: phase.describe().to_owned() };
        // What interrupts a stage is mostly over at once.
        if self.phases.is_empty() && !phase.has_steps() {
            self.last_line = Some(Instant::now());
            if let Some(bar) = &self.bar {
                draw(bar, &shown);
            } else if total == 0 && phase == Phase::Open {
                self.plain(phase.describe());
            }
        }
        self.phases.push((phase, shown));
    }

    fn phase_progress(
        &mut self,
        phase: Phase,
        [done, total, steps]: [u64; 3],
        elapsed_s: f64,
        eta_s: Option<f64>,
    ) {
        let steps = if steps > 0 {
            format!("  {steps} steps, {:.0}/s", steps as f64 / elapsed_s.max(1e-9))
        } else {
            String::new()
        };
        let eta =
            eta_s.filter(|_| total > 0).map_or(String::new(), |eta_s| format!("  ETA {}", duration(eta_s)));
        let message = format!("{}{steps}{eta}", phase.describe());
        if elapsed_s >= WORTH_SHOWING_S && self.is_line_due() {
            self.last_line = Some(Instant::now());
            let count = if total > 0 { format!(" {done}/{total} {}", phase.unit()) } else { String::new() };
            self.plain(&format!("{phase}{count}  {message}"));
        }
        self.show(Shown { prefix: phase.name(), done, total, message });
    }

    fn phase_ended(&mut self, phase: Phase, done: u64, wall_s: f64) {
        self.phases.pop();
        if let (Some(bar), Some((_, outer))) = (&self.bar, self.phases.last()) {
            draw(bar, outer);
        }
        if wall_s >= LINE_EVERY.as_secs_f64() && !phase.has_steps() {
            let count = if done > 0 { format!(" {done} {}", phase.unit()) } else { String::new() };
            self.plain(&format!("{phase}:{count} in {}", duration(wall_s)));
        }
    }

    /// Shows the progress of the innermost phase.
    fn show(&mut self, shown: Shown) {
        if let Some(bar) = &self.bar {
            draw(bar, &shown);
        }
        if let Some((_, kept)) = self.phases.last_mut() {
            *kept = shown;
        }
    }

    fn is_line_due(&self) -> bool {
        self.last_line.is_none_or(|last| last.elapsed() >= LINE_EVERY)
    }

    /// Removes the bar, and says what was trained in which time, phase by phase, where it was; the first failure to write
    /// the log, if there was one.
    ///
    /// # Errors
    /// When an event could not be logged.
    pub fn finish(&mut self, steps: u64, times: &BTreeMap<String, f64>) -> Result<(), Error> {
        self.clear();
        if let Some(trained) = self.trained.take() {
            let total: f64 = times.values().sum();
            self.line(&format!("trained {steps} steps in {}: {trained}", duration(total)));
            self.line(&format!("time: {}", phase_times(times)));
        }
        self.log_failure.take().map_or(Ok(()), Err)
    }

    /// Writes a line without tearing the bar.
    pub fn line(&self, text: &str) {
        self.plain_or_bar(text);
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn plain(&self, text: &str) {
        if self.bar.is_none() && !self.quiet {
            eprintln!("{text}");
        }
    }

    fn plain_or_bar(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None if !self.quiet => eprintln!("{text}"),
            None => {}
        }
    }

    /// One JSON object per line: the event with `time_s` since the start of this run.
    fn write_log(&mut self, event: &TrainEvent) {
        if matches!(self.log, Log::Nowhere) {
            return;
        }
        let time_s = (self.start.elapsed().as_secs_f64() * 1e3).round() / 1e3;
        let line = serde_json::to_value(LogLine { event, time_s }).expect("events are plain data");
        self.log_line(line.to_string());
    }

    fn log_line(&mut self, line: String) {
        match &mut self.log {
            Log::Undecided(lines) => lines.push(line),
            Log::File(path, file) => {
                if let Err(error) = writeln!(file, "{line}") {
                    // The reader of a pipe may leave; the run is not its concern.
                    let has_left = error.kind() == std::io::ErrorKind::BrokenPipe;
                    // Reported once, at the end: a full disk must not end the training.
                    self.log_failure = (!has_left).then(|| Error::io("write the log", path)(error));
                    self.log = Log::Nowhere;
                }
            }
            Log::Nowhere => {}
        }
    }
}

fn draw(bar: &ProgressBar, shown: &Shown) {
    bar.set_prefix(shown.prefix);
    bar.set_length(shown.total);
    bar.set_position(shown.done);
    bar.set_message(shown.message.clone());
}

/// Times of phases in words, in the order of a run, without those that are too short to matter.
#[must_use]
pub fn phase_times(times: &BTreeMap<String, f64>) -> String {
    let total: f64 = times.values().sum();
    let mut known: Vec<(Option<Phase>, &str, f64)> = Vec::new();
    for (name, seconds) in times {
        let phase = serde_json::from_value(serde_json::Value::String(name.clone())).ok();
        known.push((phase, name, *seconds));
    }
    known.sort_by_key(|(phase, ..)| *phase);
    let (long, short): (Vec<_>, Vec<_>) = known.into_iter().partition(|(.., s)| *s >= SHORT * total);
    let mut words: Vec<String> = long.iter().map(|(_, name, s)| format!("{name} {}", duration(*s))).collect();
    let rest: f64 = short.iter().map(|(.., seconds)| seconds).sum();
    if rest >= 0.5 {
        words.push(format!("others {}", duration(rest)));
    }
    words.join(", ")
}

/// Progress of work on frames, whose number is known: a bar on terminals, a line every ten seconds elsewhere.
pub struct FrameProgress {
    bar: Option<ProgressBar>,
    quiet: bool,
    done: u64,
    frames: u64,
    start: Instant,
    last_line: Instant,
}

impl FrameProgress {
    /// Draws on stderr unless `quiet`.
    #[must_use]
    pub fn new(quiet: bool, frames: usize) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(Some(frames as u64), ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("[{bar:30}] {pos}/{len} frames {wide_msg}");
            bar.set_style(style.expect("the template is valid").progress_chars("=> "));
            bar
        });
        Self { bar, quiet, done: 0, frames: frames as u64, start: Instant::now(), last_line: Instant::now() }
    }

    /// One more frame is done.
    pub fn step(&mut self) {
        self.done += 1;
        let rate = self.done as f64 / self.start.elapsed().as_secs_f64().max(1e-9);
        let left = self.frames.saturating_sub(self.done) as f64 / rate;
        let text = format!("{rate:.1} frames/s  ETA {}", duration(left));
        match &self.bar {
            Some(bar) => {
                bar.set_position(self.done);
                bar.set_message(text);
            }
            None if !self.quiet && self.last_line.elapsed() >= LINE_EVERY => {
                self.last_line = Instant::now();
                eprintln!("{}/{} frames  {text}", self.done, self.frames);
            }
            None => {}
        }
    }
}

impl Drop for FrameProgress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// `2 h 05 min`, `3 min 20 s` or `12 s`.
#[must_use]
pub fn duration(seconds: f64) -> String {
    if !seconds.is_finite() {
        return "?".to_owned();
    }
    let total = seconds.round().max(0.0) as u64;
    match (total / 3600, total / 60 % 60, total % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s:02} s"),
        (h, m, _) => format!("{h} h {m:02} min"),
    }
}

fn optional(value: Option<f64>) -> String {
    value.map_or("n/a".to_owned(), |value| format!("{value:.2}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_read_well() {
        for (seconds, text) in [
            (11.6, "12 s"),
            (200.0, "3 min 20 s"),
            (7500.0, "2 h 05 min"),
            (f64::INFINITY, "?"),
            (-1.0, "0 s"),
        ] {
            assert_eq!(duration(seconds), text);
        }
    }

    #[test]
    fn times_of_phases_are_reported_in_their_order_and_add_up() {
        let times = [("fine", 120.0), ("objects", 61.0), ("save", 0.4), ("open", 0.3), ("later", 3.0)];
        let times = times.into_iter().map(|(name, s)| (name.to_owned(), s)).collect();
        // Phases of other versions are kept by their names.
        assert_eq!(phase_times(&times), "later 3 s, objects 1 min 01 s, fine 2 min 00 s, others 1 s");
    }

    #[test]
    fn logs_are_json_lines_and_can_be_appended_to() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.jsonl");
        for append in [false, true] {
            let mut progress = Progress::new(true);
            // Events come before it is known whether the file may be written.
            progress.event(&TrainEvent::Warning { message: "one \"two\"".into() });
            progress.log_to(Some(&path), append).unwrap();
            progress.finish(0, &BTreeMap::new()).unwrap();
        }
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), 2);
        for line in text.lines() {
            let value: serde_json::Value = serde_json::from_str(line).unwrap();
            assert_eq!(value["event"], "warning");
            assert_eq!(value["message"], "one \"two\"");
            assert!(value["time_s"].is_number());
        }
    }
}
