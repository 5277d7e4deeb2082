//! Progress of a batch: a line for each job that ends, and on a terminal one for each that runs.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Read, Seek, SeekFrom};
use std::path::Path;
use std::time::{Duration, Instant};

use cif_batch::Batch;
use cif_batch::record::Spent;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::one::Outcome;
use crate::messages;

/// Bytes at the end of a log in which its last line is looked for.
const TAIL: u64 = 2_000;

/// Longest part of a log that a line shows, characters.
const LONGEST: usize = 60;

/// The lines.
pub(super) struct Board<'a> {
    batch: &'a Batch,
    bars: Option<MultiProgress>,
    whole: ProgressBar,
    running: BTreeMap<usize, (ProgressBar, Instant)>,
    ended: usize,
    begun: Instant,
    /// Seconds of the jobs that were done here.
    spent_s: f64,
    done_here: usize,
}

/// Seconds as people read them.
pub(super) fn duration(seconds: f64) -> String {
    if seconds < 60.0 {
        return format!("{seconds:.1} s");
    }
    humantime::format_duration(Duration::from_secs(seconds.min(1e12) as u64)).to_string()
}

/// Resources that a job took, in a few words.
pub(super) fn shown(spent: &Spent) -> String {
    let mut text = duration(spent.wall_s);
    if spent.cpu_s > 0.0 {
        text += &format!(", {:.1} processor s, {:.0} MB", spent.cpu_s, spent.peak_bytes as f64 / 1e6);
    }
    text
}

impl<'a> Board<'a> {
    pub(super) fn new(batch: &'a Batch) -> Self {
        let is_shown = std::io::stderr().is_terminal() && !messages::is_quiet();
        let bars = is_shown.then(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr()));
        let whole = ProgressBar::hidden();
        let whole = bars.as_ref().map_or(whole.clone(), |bars| bars.add(whole));
        whole.set_length(batch.jobs.len() as u64);
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg}") {
            whole.set_style(style);
        }
        let running = BTreeMap::new();
        Self { batch, bars, whole, running, ended: 0, begun: Instant::now(), spent_s: 0.0, done_here: 0 }
    }

    pub(super) fn begins(&mut self, job: usize, threads: u32) {
        if let Some(bars) = &self.bars {
            let bar = bars.insert_before(&self.whole, ProgressBar::new_spinner());
            let of = if threads == 1 { "1 thread".to_owned() } else { format!("{threads} threads") };
            bar.set_prefix(format!("{} ({of})", self.batch.jobs[job].id));
            if let Ok(style) = ProgressStyle::with_template("{spinner} {prefix} {elapsed} {wide_msg}") {
                bar.set_style(style);
            }
            self.running.insert(job, (bar, Instant::now()));
        }
    }

    /// Shows what the logs of the jobs that run say.
    pub(super) fn refresh(&self, at_once: usize) {
        for (job, (bar, _)) in &self.running {
            if let Some(line) = last_line(&self.batch.file_of(&self.batch.jobs[*job], "log")) {
                bar.set_message(line);
            }
            bar.tick();
        }
        if self.done_here > 0 {
            let left = self.batch.jobs.len().saturating_sub(self.ended) as f64;
            let each = self.spent_s / self.done_here as f64;
            let rest = duration((left * each / at_once.max(1) as f64).ceil());
            self.whole.set_message(format!(
                "{} passed, about {rest} left",
                duration(self.begun.elapsed().as_secs_f64())
            ));
        }
    }

    /// A job will not run now.
    pub(super) fn pauses(&mut self, job: usize) {
        if let Some((bar, _)) = self.running.remove(&job) {
            bar.finish_and_clear();
        }
    }

    pub(super) fn ends(&mut self, job: usize, outcome: &Outcome) {
        self.pauses(job);
        self.ended += 1;
        let id = &self.batch.jobs[job].id;
        let line = match outcome {
            Outcome::Done(spent) => {
                self.spent_s += spent.wall_s;
                self.done_here += 1;
                format!("{id}: done in {}", shown(spent))
            }
            Outcome::Kept => format!("{id}: kept"),
            Outcome::Failed(why) => format!("{id}: failed: {why}"),
            Outcome::Elsewhere | Outcome::Interrupted => return,
        };
        self.line(&line);
        self.whole.set_position(self.ended as u64);
    }

    /// A job is left out.
    pub(super) fn leaves_out(&mut self, job: usize, because: usize) {
        self.ended += 1;
        let [left_out, failed] = [job, because].map(|job| &self.batch.jobs[job].id);
        self.line(&format!("{left_out}: left out, because {failed} failed"));
        self.whole.set_position(self.ended as u64);
    }

    fn line(&self, line: &str) {
        let line = format!("[{}/{}] {line}", self.ended, self.batch.jobs.len());
        match &self.bars {
            Some(bars) => {
                // Only the line is lost where it cannot be shown.
                let _ = bars.println(messages::plain(&line));
            }
            None => messages::outcome!("{line}"),
        }
    }

    pub(super) fn close(&self) {
        self.whole.finish_and_clear();
    }
}

/// Last line of a log.
fn last_line(log: &Path) -> Option<String> {
    let mut file = std::fs::File::open(log).ok()?;
    let length = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL))).ok()?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail).ok()?;
    let text = String::from_utf8_lossy(&tail);
    let line = text.lines().rfind(|line| !line.trim().is_empty())?.trim();
    Some(messages::plain(&line.chars().take(LONGEST).collect::<String>()).into_owned())
}
