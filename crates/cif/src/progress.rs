//! Progress of a training run: a bar on terminals, plain lines elsewhere, JSON lines in a log.

use std::fs::{File, OpenOptions};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cif_train::TrainEvent;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::error::Error;

/// Pause between two plain lines of one stage.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Shows and logs the events of a run.
pub struct Progress {
    bar: Option<ProgressBar>,
    quiet: bool,
    last_line: Option<Instant>,
    miou: Option<f64>,
    start: Instant,
    log: Option<(PathBuf, File)>,
    log_failure: Option<Error>,
}

impl Progress {
    /// Draws on stderr unless `quiet`, and logs to `log`, behind what is there when `append` is set.
    ///
    /// # Errors
    /// When the log cannot be opened.
    pub fn new(quiet: bool, log: Option<&Path>, append: bool) -> Result<Self, Error> {
        let log = log
            .map(|path| {
                let file =
                    OpenOptions::new().create(true).write(true).append(append).truncate(!append).open(path);
                file.map(|file| (path.to_owned(), file)).map_err(Error::io("open the log", path))
            })
            .transpose()?;
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{prefix:>8} [{bar:30}] {pos}/{len} {wide_msg}");
            bar.set_style(style.expect("the template is valid").progress_chars("=> "));
            bar
        });
        Ok(Self { bar, quiet, last_line: None, miou: None, start: Instant::now(), log, log_failure: None })
    }

    /// Takes one event.
    pub fn event(&mut self, event: &TrainEvent) {
        self.write_log(event);
        match event {
            TrainEvent::StageStarted { stage, iteration, iterations, gaussians } => {
                self.last_line = None;
                if let Some(bar) = &self.bar {
                    bar.set_prefix(stage.name());
                    bar.set_length(u64::from(*iterations));
                    bar.set_position(u64::from(*iteration));
                    bar.set_message("");
                }
                // Identity estimation has no steps and tells its result itself.
                if *iterations > 0 {
                    self.plain(&format!(
                        "{stage}: {iterations} steps from step {iteration}, {gaussians} Gaussians"
                    ));
                }
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
                let miou = self.miou.map_or(String::new(), |miou| format!("  mIoU {miou:.1}"));
                let text = format!(
                    "{iterations_per_second:.1} it/s  ETA {}  loss {loss:.4}  {gaussians} Gaussians  PSNR {psnr:.2}{miou}",
                    duration(*eta_s)
                );
                if let Some(bar) = &self.bar {
                    bar.set_position(u64::from(*iteration));
                    bar.set_message(text);
                } else if self.last_line.is_none_or(|last| last.elapsed() >= LINE_EVERY)
                    || iteration == iterations
                {
                    self.last_line = Some(Instant::now());
                    self.plain(&format!("{stage} {iteration}/{iterations}  {text}"));
                }
            }
            TrainEvent::IdentityEstimated { frames, instances, unseen, empty_instances, .. } => {
                self.line(&format!("identities of {instances} instances from {frames} frames; {unseen} Gaussians were never seen on a labelled pixel"));
                if !empty_instances.is_empty() {
                    let ids: Vec<String> = empty_instances.iter().map(u16::to_string).collect();
                    self.line(&format!("warning: no Gaussian belongs to mask id {}", ids.join(", ")));
                }
            }
            TrainEvent::Evaluated { stage, iteration, frames, psnr, miou, .. } => {
                self.miou = miou.or(self.miou);
                self.line(&format!(
                    "{stage} {iteration}: {frames} held-out frames, PSNR {}, mIoU {}",
                    optional(*psnr),
                    optional(*miou)
                ));
            }
            TrainEvent::RolledBack { stage, iteration, fault, in_a_row, .. } => {
                let repeated = if *in_a_row > 1 { format!(" ({in_a_row} in a row)") } else { String::new() };
                self.line(&format!("warning: {stage} {iteration} rolled back{repeated}: {fault}"));
            }
            TrainEvent::Measured { point, .. } => self.miou = point.miou.or(self.miou),
            TrainEvent::Warning { message } => self.line(&format!("warning: {message}")),
            TrainEvent::Finished {
                wall_s, iterations, gaussians, psnr, peak_rss_mb, rolled_back, ..
            } => {
                self.clear();
                let memory = peak_rss_mb.map_or(String::new(), |mb| format!(", peak memory {mb:.0} MB"));
                if *rolled_back > 0 {
                    self.line(&format!(
                        "warning: {rolled_back} of {iterations} steps met values that are not finite and were rolled \
                         back; the scene's record names the last"
                    ));
                }
                self.plain_or_bar(&format!(
                    "trained {iterations} steps in {}: {gaussians} Gaussians, PSNR of training views {psnr:.2}{memory}",
                    duration(*wall_s)
                ));
            }
            TrainEvent::Densified { .. }
            | TrainEvent::Resampled { .. }
            | TrainEvent::Settled { .. }
            | TrainEvent::Judged { .. }
            | TrainEvent::CheckpointDue { .. } => {}
        }
    }

    /// Writes a line without tearing the bar.
    pub fn line(&self, text: &str) {
        self.plain_or_bar(text);
    }

    /// Removes the bar; the first failure to write the log, if there was one.
    ///
    /// # Errors
    /// When an event could not be logged.
    pub fn finish(&mut self) -> Result<(), Error> {
        self.clear();
        self.log_failure.take().map_or(Ok(()), Err)
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
        let Some((path, file)) = &mut self.log else { return };
        let mut value = serde_json::to_value(event).expect("events are plain data");
        value["time_s"] = serde_json::json!((self.start.elapsed().as_secs_f64() * 1e3).round() / 1e3);
        if let Err(error) = writeln!(file, "{value}") {
            // Reported once, at the end: a full disk must not end the training.
            self.log_failure = Some(Error::io("write the log", path)(error));
            self.log = None;
        }
    }
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
    fn logs_are_json_lines_and_can_be_appended_to() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.jsonl");
        for append in [false, true] {
            let mut progress = Progress::new(true, Some(&path), append).unwrap();
            progress.event(&TrainEvent::Warning { message: "one \"two\"".into() });
            progress.finish().unwrap();
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
