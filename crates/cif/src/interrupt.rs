//! Ctrl-C and SIGTERM: a command that watches for them stops after its step, every other one ends at once, without
//! leaving unfinished files behind.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static REQUESTED: AtomicBool = AtomicBool::new(false);
static INSTALLED: OnceLock<bool> = OnceLock::new();

/// Until [`watch`], signals end the process at once, and remove what it has not finished writing; those that it was
/// started to ignore, as by `nohup`, stay ignored. For processes that are nothing but the command.
#[cfg(unix)]
pub fn end_cleanly() {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    let ignored = ignored_signals();
    let heeded = [SIGHUP, SIGINT, SIGTERM].into_iter().filter(|signal| ignored & (1 << (signal - 1)) == 0);
    // Where this fails, what is left is removed at the next run.
    if let Ok(mut signals) = signal_hook::iterator::Signals::new(heeded) {
        std::thread::spawn(move || {
            if signals.forever().next().is_some() {
                end();
            }
        });
    }
}

/// As on Unix, but what is not finished is removed at the next run.
#[cfg(not(unix))]
pub fn end_cleanly() {}

/// Bit k - 1 for signal k, as far as the system tells.
#[cfg(unix)]
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

/// Starts to watch for Ctrl-C and SIGTERM; forgets an earlier one.
pub fn watch() {
    REQUESTED.store(false, Ordering::SeqCst);
    INSTALLED.get_or_init(|| {
        ctrlc::set_handler(|| {
            if REQUESTED.swap(true, Ordering::SeqCst) {
                end();
            }
            eprintln!("\nstopping after this step and saving; press Ctrl-C again to quit without saving");
        })
        .is_ok()
    });
}

/// Whether Ctrl-C was pressed since [`watch`].
#[must_use]
pub fn requested() -> bool {
    REQUESTED.load(Ordering::SeqCst)
}

/// Ends the process as interrupted, without unfinished files.
fn end() {
    cif_output::abandon();
    // No exit handlers: those of usd-core's libraries must not run while other threads are in them.
    signal_hook::low_level::exit(130);
}
