//! Ctrl-C: the first one asks a run to stop after its step, the second one ends the process.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static REQUESTED: AtomicBool = AtomicBool::new(false);
static INSTALLED: OnceLock<bool> = OnceLock::new();

/// Starts to watch for Ctrl-C and SIGTERM; forgets an earlier one.
pub fn watch() {
    REQUESTED.store(false, Ordering::SeqCst);
    INSTALLED.get_or_init(|| {
        ctrlc::set_handler(|| {
            if REQUESTED.swap(true, Ordering::SeqCst) {
                std::process::exit(130);
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
