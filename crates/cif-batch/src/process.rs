//! A job as a process of its own: asked to save and stop rather than ended, and measured while it runs.

use std::io;
use std::process::{Child, Command, ExitStatus};
use std::time::{Duration, Instant};

use crate::record::Spent;

/// Pauses between two looks at a process: short at first, so that short jobs wait for nobody.
const PAUSES: [Duration; 2] = [Duration::from_millis(5), Duration::from_millis(100)];

/// Time after which the longer pauses begin.
const BEGINNING: Duration = Duration::from_secs(1);

/// Runs a command to its end. Once `stop` says so it is asked to stop, once: it saves then, and may take its time.
///
/// # Errors
/// When it cannot be started.
pub fn run(command: &mut Command, stop: &dyn Fn() -> bool) -> io::Result<(ExitStatus, Spent)> {
    // In a group of its own Ctrl-C does not reach it a second time.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    let begun = Instant::now();
    let mut child = command.spawn()?;
    let mut spent = Spent::default();
    let mut is_asked = false;
    while !has_ended(&mut child)? {
        look(&child, &mut spent);
        if !is_asked && stop() {
            is_asked = true;
            ask_to_stop(&child);
        }
        std::thread::sleep(PAUSES[usize::from(begun.elapsed() > BEGINNING)]);
    }
    // Its times are final now, and still there.
    look(&child, &mut spent);
    spent.wall_s = begun.elapsed().as_secs_f64();
    Ok((child.wait()?, spent))
}

/// True once a process has ended; what it took is still there.
#[cfg(unix)]
fn has_ended(child: &mut Child) -> io::Result<bool> {
    use rustix::process::{WaitId, WaitIdOptions, waitid};
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    Ok(waitid(WaitId::Pid(pid(child)), options)?.is_some())
}

#[cfg(not(unix))]
fn has_ended(child: &mut Child) -> io::Result<bool> {
    Ok(child.try_wait()?.is_some())
}

#[cfg(unix)]
fn pid(child: &Child) -> rustix::process::Pid {
    rustix::process::Pid::from_child(child)
}

#[cfg(unix)]
fn ask_to_stop(child: &Child) {
    // It may have ended by itself.
    let _ = rustix::process::kill_process(pid(child), rustix::process::Signal::TERM);
}

/// A console hands Ctrl-C to all of its processes.
#[cfg(not(unix))]
fn ask_to_stop(_: &Child) {}

/// Adds what Linux shows of a process. Sources: `proc_pid_status(5)`, `proc_pid_stat(5)`, `proc_pid_io(5)`.
#[cfg(target_os = "linux")]
fn look(child: &Child, spent: &mut Spent) {
    let read =
        |name: &str| std::fs::read_to_string(format!("/proc/{}/{name}", child.id())).unwrap_or_default();
    let number = |text: &str, name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next()?.parse::<u64>().ok()
    };
    let most = |known: u64, found: Option<u64>| known.max(found.unwrap_or(0));
    spent.peak_bytes =
        most(spent.peak_bytes, number(&read("status"), "VmHWM:").map(|kilobytes| kilobytes * 1024));
    let moved = read("io");
    spent.read_bytes = most(spent.read_bytes, number(&moved, "rchar:"));
    spent.written_bytes = most(spent.written_bytes, number(&moved, "wchar:"));
    // The name of the program stands in brackets, whatever is in it.
    let stat = read("stat");
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    // Fields 14 to 17 of all, its own time and that of children that it has waited for.
    let ticks: u64 =
        fields.get(11..15).unwrap_or_default().iter().filter_map(|field| field.parse::<u64>().ok()).sum();
    spent.cpu_s = spent.cpu_s.max(ticks as f64 / rustix::param::clock_ticks_per_second() as f64);
}

#[cfg(not(target_os = "linux"))]
fn look(_: &Child, _: &mut Spent) {}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_measured() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        let script = "head -c 3000000 /dev/zero > \"$0\"; cat \"$0\" > /dev/null; i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done; exit 3";
        let (status, spent) = run(Command::new("sh").args(["-c", script]).arg(&file), &|| false).unwrap();
        assert_eq!(status.code(), Some(3));
        assert!(spent.cpu_s > 0.0 && spent.cpu_s <= spent.wall_s + 0.05, "{spent:?}");
        assert!(spent.peak_bytes > 100_000, "{spent:?}");
    }

    #[test]
    fn a_process_is_asked_to_stop_once() {
        let folder = tempfile::tempdir().unwrap();
        let ready = folder.path().join("ready");
        // It ends with 1 where it is asked twice.
        let script = "n=0; trap 'n=$((n+1))' TERM; : > \"$0\"; while [ $n -eq 0 ]; do sleep 0.01; done; sleep 0.3; \
                      [ $n -eq 1 ] && exit 130; exit 1";
        let mut command = Command::new("sh");
        let (status, _) = run(command.args(["-c", script]).arg(&ready), &|| ready.exists()).unwrap();
        assert_eq!(status.code(), Some(130));
    }
}
