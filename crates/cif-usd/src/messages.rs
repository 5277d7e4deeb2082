//! Warnings of usd-core, shown once each: it repeats them whenever a stage is opened, and one command opens a stage several
//! times.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use pyo3::prelude::*;

/// Messages that this process has shown.
static SHOWN: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// Messages of usd-core that are kept from stderr; shown there at the end, but for those that were shown before.
pub(crate) struct Messages<'py> {
    py: Python<'py>,
    /// The delegate that takes them, where this USD has one.
    delegate: Option<Bound<'py, PyAny>>,
}

impl<'py> Messages<'py> {
    /// Takes the messages from here on; `usd_utils` is the module `pxr.UsdUtils`.
    pub(crate) fn of(usd_utils: &Bound<'py, PyModule>) -> Self {
        let class = usd_utils.getattr("CoalescingDiagnosticDelegate");
        Self { py: usd_utils.py(), delegate: class.and_then(|class| class.call0()).ok() }
    }

    fn taken(&self) -> PyResult<Vec<String>> {
        let Some(delegate) = &self.delegate else { return Ok(Vec::new()) };
        let taken = delegate.call_method0("TakeUncoalescedDiagnostics")?;
        taken.try_iter()?.map(|message| message?.getattr("commentary")?.extract()).collect()
    }
}

impl Drop for Messages<'_> {
    fn drop(&mut self) {
        // Python's stream, which notebooks show; where nobody reads it, messages reach nobody.
        let stderr = self.py.import("sys").and_then(|sys| sys.getattr("stderr"));
        let (Ok(messages), Ok(stderr)) = (self.taken(), stderr) else { return };
        for message in messages.iter().map(|message| without_addresses(message)) {
            let is_new = SHOWN.lock().unwrap_or_else(PoisonError::into_inner).insert(message.clone());
            if is_new {
                stderr.call_method1("write", (format!("warning: USD: {message}\n"),)).ok();
            }
        }
    }
}

/// A message without the places of stages in memory, `<0x55d0a1b2>`, which differ whenever it comes.
fn without_addresses(message: &str) -> String {
    let mut rest = message;
    let mut text = String::new();
    while let Some((before, after)) = rest.split_once("<0x") {
        let Some((digits, behind)) = after.split_once('>') else { break };
        if !digits.chars().all(|digit| digit.is_ascii_hexdigit()) {
            break;
        }
        text.push_str(before.trim_end());
        rest = behind;
    }
    text.push_str(rest.trim_end());
    text
}

#[cfg(test)]
mod tests {
    use super::without_addresses;

    #[test]
    fn messages_that_differ_by_a_place_in_memory_are_one() {
        let message =
            "In </A>: Unresolved reference (instantiating stage on stage @a.usda@ <0x55bb5cf9bba0>)";
        let expected = "In </A>: Unresolved reference (instantiating stage on stage @a.usda@)";
        assert_eq!(without_addresses(message), expected);
        for kept in ["In </A/0x1>", "a < b", "<0xyz> and <0x12", ""] {
            assert_eq!(without_addresses(kept), kept);
        }
    }
}
