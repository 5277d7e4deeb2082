//! How much memory is free, and whether work fits in it.
//!
//! Linux shows it: the memory of the machine that programs can still take without swapping, the limits of the control groups
//! of this process (containers, jobs), and its own limit of addresses. Elsewhere nothing is known, and nothing refused.
//! Sources: `proc_meminfo(5)`, `proc_pid_limits(5)`, the kernel's `cgroup-v2.rst` and `cgroup-v1/memory.rst`.

use std::fmt;
use std::fs::read_to_string;
use std::path::{Path, PathBuf};

/// Memory that some work needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Need {
    /// Bytes.
    pub bytes: u64,
    /// How they come about, such as `4 planes x 1024 x 1024 values x 4 bytes`.
    pub arithmetic: String,
}

impl Need {
    /// Refuses work that needs more than is free.
    ///
    /// # Errors
    /// When too little is free. Where that is not known, nothing is refused.
    pub fn check(self) -> Result<(), TooLittle> {
        match available() {
            Some(free) if self.bytes > free => Err(TooLittle { need: self, free }),
            _ => Ok(()),
        }
    }
}

/// Work needs more memory than is free.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TooLittle {
    /// Memory that it needs.
    pub need: Need,
    /// Bytes that are free.
    pub free: u64,
}

impl fmt::Display for TooLittle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "it takes {} of memory ({}), and {} are free",
            Bytes(self.need.bytes),
            self.need.arithmetic,
            Bytes(self.free)
        )
    }
}

impl std::error::Error for TooLittle {}

/// Bytes, as people read them.
struct Bytes(u64);

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 as f64 {
            bytes if bytes < 1e6 => write!(f, "{:.1} kB", bytes / 1e3),
            bytes if bytes < 1e9 => write!(f, "{:.0} MB", bytes / 1e6),
            bytes => write!(f, "{:.1} GB", bytes / 1e9),
        }
    }
}

/// Bytes that this process can still take; `None` where the system does not report them.
#[must_use]
pub fn available() -> Option<u64> {
    let machine = read_to_string("/proc/meminfo").ok().and_then(|text| kilobytes(&text, "MemAvailable:"));
    let groups =
        read_to_string("/proc/self/cgroup").map(|text| left_of_groups(&text, Path::new("/sys/fs/cgroup")));
    machine.into_iter().chain(groups.unwrap_or(None)).chain(left_of_addresses()).min()
}

/// The value of a line `NAME 123 kB`, in bytes.
fn kilobytes(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

/// Addresses that this process may still take, where it has a limit (`ulimit -v`).
fn left_of_addresses() -> Option<u64> {
    let limits = read_to_string("/proc/self/limits").ok()?;
    let limit = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    // Without a limit, the word is `unlimited`.
    let limit: u64 = limit.split_whitespace().next()?.parse().ok()?;
    let taken = kilobytes(&read_to_string("/proc/self/status").ok()?, "VmSize:")?;
    Some(limit.saturating_sub(taken))
}

/// Least that the memory limits of control groups leave, from the groups of this process up; `groups` is
/// `/proc/self/cgroup`, `mounted` where they are mounted.
fn left_of_groups(groups: &str, mounted: &Path) -> Option<u64> {
    groups
        .lines()
        .filter_map(|line| {
            let mut parts = line.splitn(3, ':');
            let (_, controllers, path) = (parts.next()?, parts.next()?, parts.next()?);
            let path = Path::new(path.trim_start_matches('/'));
            // The names of files in version 2, which has no controllers here, and in version 1.
            if controllers.is_empty() {
                least(mounted, path, ["memory.max", "memory.current", "inactive_file"])
            } else if controllers.split(',').any(|controller| controller == "memory") {
                let files = ["memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"];
                least(&mounted.join("memory"), path, files)
            } else {
                None
            }
        })
        .min()
}

/// Least that a group and those above it leave. A container may see its own group as the root.
fn least(root: &Path, group: &Path, [limit, usage, cache]: [&str; 3]) -> Option<u64> {
    let number = |path: PathBuf| read_to_string(path).ok()?.trim().parse::<u64>().ok();
    group
        .ancestors()
        .map(|group| root.join(group))
        .filter_map(|group| {
            let limit = number(group.join(limit))?;
            let used = number(group.join(usage))?;
            // Files kept in memory go when it is needed.
            let stat = read_to_string(group.join("memory.stat")).unwrap_or_default();
            let kept = stat.lines().find_map(|line| line.strip_prefix(cache)?.trim().parse::<u64>().ok());
            Some(limit.saturating_sub(used.saturating_sub(kept.unwrap_or(0))))
        })
        .min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_of_the_groups_counts_and_kept_files_are_free() {
        let folder = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = folder.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let left = |groups: &str| left_of_groups(groups, folder.path());
        assert_eq!(left("0::/\n"), None, "no limit");
        write("job/memory.max", "1000\n");
        write("job/memory.current", "700\n");
        write("job/memory.stat", "anon 500\ninactive_file 200\n");
        write("job/step/memory.max", "max\n");
        write("job/step/memory.current", "600\n");
        assert_eq!(left("0::/job/step\n"), Some(500));
        write("memory/old/memory.limit_in_bytes", "300\n");
        write("memory/old/memory.usage_in_bytes", "100\n");
        assert_eq!(left("5:cpu,memory:/old\n0::/job/step\n"), Some(200));
        assert_eq!(left("5:cpu:/old\n"), None);
    }

    #[test]
    fn work_beyond_all_memory_is_refused_with_its_arithmetic() {
        let need = |bytes| Need { bytes, arithmetic: "2 halves x 2^61 bytes".to_owned() };
        assert_eq!(need(1).check(), Ok(()));
        assert_eq!(kilobytes("MemFree: 3 kB\nMemAvailable:   5 kB\n", "MemAvailable:"), Some(5120));
        if available().is_some() {
            let message = need(1 << 62).check().unwrap_err().to_string();
            assert!(
                message.contains("4611686018.4 GB") && message.contains("2 halves x 2^61 bytes"),
                "{message}"
            );
        }
    }
}
