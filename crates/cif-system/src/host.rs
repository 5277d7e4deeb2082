//! The name of this machine.

use crate::environment;

/// Name of this machine among others; empty where it has none.
#[must_use]
pub fn host() -> String {
    let named = std::fs::read_to_string("/proc/sys/kernel/hostname").ok();
    let named = named
        .or_else(|| [environment::HOSTNAME, environment::COMPUTERNAME].iter().find_map(|name| name.text()));
    named.map(|name| name.trim().to_owned()).unwrap_or_default()
}
