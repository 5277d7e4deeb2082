//! Progress of `cif capture`: a bar on terminals, plain lines elsewhere.

use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use cif_capture::Progress;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Pause between two plain lines of one phase.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Shows what is being done.
pub(super) struct Shown {
    bar: Option<ProgressBar>,
    is_quiet: bool,
    phase: Mutex<Phase>,
}

/// Text that was shown last.
struct Phase {
    words: String,
    line: Instant,
}

impl Shown {
    /// Draws on standard error, unless `quiet`.
    pub(super) fn new(quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(Some(0), ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{msg} [{bar:30}] {pos}/{len}");
            bar.set_style(style.expect("the template is valid").progress_chars("=> "));
            bar
        });
        Self { bar, is_quiet: quiet, phase: Mutex::new(Phase { words: String::new(), line: Instant::now() }) }
    }

    /// Takes what is being done.
    pub(super) fn show(&self, progress: Progress<'_>) {
        let mut phase = self.phase.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = phase.words != progress.words;
        if is_new {
            progress.words.clone_into(&mut phase.words);
        }
        match (progress.count, &self.bar) {
            (Some((done, total)), Some(bar)) => {
                if is_new {
                    bar.reset();
                    bar.set_message(progress.words.to_owned());
                }
                bar.set_length(total as u64);
                bar.set_position(done as u64);
            }
            (count, _) if !self.is_quiet => {
                if let Some(line) = plain(progress.words, count, is_new, phase.line.elapsed()) {
                    phase.line = Instant::now();
                    self.clear();
                    eprintln!("{line}");
                }
            }
            _ => {}
        }
    }

    /// Removes the bar, before something else is written.
    pub(super) fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// The line that is written without a bar, if one is due.
fn plain(words: &str, count: Option<(usize, usize)>, is_new: bool, since: Duration) -> Option<String> {
    match count {
        None => is_new.then(|| format!("{words} ...")),
        Some((done, total)) if is_new || since >= LINE_EVERY || done == total => {
            Some(format!("{words}: {done} of {total}"))
        }
        Some(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_written_at_the_beginning_of_a_phase_now_and_then_and_at_its_end() {
        let (now, later) = (Duration::ZERO, LINE_EVERY);
        let line = |count, is_new, since| plain("features of images", count, is_new, since);
        assert_eq!(line(None, true, now).as_deref(), Some("features of images ..."));
        assert_eq!(line(None, false, later), None);
        assert_eq!(line(Some((0, 150)), true, now).as_deref(), Some("features of images: 0 of 150"));
        assert_eq!(line(Some((8, 150)), false, now), None);
        assert_eq!(line(Some((48, 150)), false, later).as_deref(), Some("features of images: 48 of 150"));
        assert_eq!(line(Some((150, 150)), false, now).as_deref(), Some("features of images: 150 of 150"));
    }
}
