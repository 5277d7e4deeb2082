//! Ctrl-C and SIGTERM: a command that watches for them stops after its step, every other one ends at once, without
//! leaving unfinished files behind.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static WATCHED: AtomicBool = AtomicBool::new(false);
static REQUESTED: AtomicBool = AtomicBool::new(false);
static INSTALLED: OnceLock<bool> = OnceLock::new();

/// From here on signals end the process at once, and remove what it has not finished writing. For processes that are
/// nothing but the command.
pub fn end_cleanly() {
    INSTALLED.get_or_init(|| {
        ctrlc::set_handler(|| {
            if !WATCHED.load(Ordering::SeqCst) || REQUESTED.swap(true, Ordering::SeqCst) {
                end();
            }
            eprintln!("\nstopping after this step and saving; press Ctrl-C again to quit without saving");
        })
        .is_ok()
    });
}

/// Starts to watch for Ctrl-C and SIGTERM; forgets an earlier one.
pub fn watch() {
    REQUESTED.store(false, Ordering::SeqCst);
    WATCHED.store(true, Ordering::SeqCst);
    end_cleanly();
}

/// Whether Ctrl-C was pressed since [`watch`].
#[must_use]
pub fn requested() -> bool {
    REQUESTED.load(Ordering::SeqCst)
}

/// Ends the process as interrupted.
fn end() {
    cif_output::abandon();
    // No exit handlers: those of usd-core's libraries must not run while other threads are in them.
    signal_hook::low_level::exit(130);
}
