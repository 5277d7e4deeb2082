//! The command, run as people run it.

use std::ffi::OsStr;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

/// What a run of the command left behind.
#[derive(Debug)]
pub struct Run {
    /// Exit code; `None` when killed.
    pub code: Option<i32>,
    /// Everything on stdout.
    pub stdout: String,
    /// Everything on stderr.
    pub stderr: String,
}

impl Run {
    fn from(output: &Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }

    /// Asserts success.
    ///
    /// # Panics
    /// When the command failed.
    #[track_caller]
    pub fn succeeds(self) -> Self {
        assert_eq!(self.code, Some(0), "expected success:\n{}\n{}", self.stdout, self.stderr);
        self
    }

    /// Asserts an exit code and that stderr holds every one of `words`.
    ///
    /// # Panics
    /// When it does not.
    #[track_caller]
    pub fn fails(self, code: i32, words: &[&str]) {
        assert_eq!(self.code, Some(code), "expected exit code {code}:\n{}\n{}", self.stdout, self.stderr);
        for word in words {
            assert!(self.stderr.contains(word), "expected {word:?} in:\n{}", self.stderr);
        }
    }
}

/// Runs `program` with arguments in `folder`, nothing of a terminal around it.
///
/// # Panics
/// When the program cannot be started.
#[must_use]
pub fn run<S: AsRef<OsStr>>(program: &str, folder: &Path, arguments: impl IntoIterator<Item = S>) -> Run {
    let mut command = Command::new(program);
    command.args(arguments).current_dir(folder).env("NO_COLOR", "1");
    Run::from(&command.output().expect("the program starts"))
}

/// Settings of a small model without fits of objects, for runs whose quality does not matter.
pub const SMALL_MODEL: &str = "--set model.spatial_resolution=[8,8,8] --set model.width=16 --set model.channels=4 \
                               --set motion.rigid=false --set motion.parts=false --set motion.rehearsal=20";

/// Runs `program` in `folder` with the words of a line, split at blanks.
///
/// # Panics
/// As [`run`].
#[must_use]
pub fn run_line(program: &str, folder: &Path, line: &str) -> Run {
    run(program, folder, line.split_whitespace())
}

/// A command in the background, killed in the end.
#[derive(Debug)]
pub struct Background(Child);

impl Background {
    /// Starts `program` in `folder` with the words of a line.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn start(program: &str, folder: &Path, line: &str) -> Self {
        let mut command = Command::new(program);
        command.args(line.split_whitespace()).current_dir(folder).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().expect("the command starts"))
    }

    /// Waits until `what` holds, while the command runs.
    ///
    /// # Panics
    /// When the command ends before.
    pub fn until(&mut self, what: impl Fn() -> bool) {
        while !what() {
            let ended = self.0.try_wait().expect("the process can be asked");
            assert!(ended.is_none(), "it ended too early");
            sleep(Duration::from_millis(10));
        }
    }

    /// Its process.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.0.id()
    }

    /// Waits for its end; the exit code, `None` when killed.
    ///
    /// # Panics
    /// When it cannot be waited for.
    pub fn ends(&mut self) -> Option<i32> {
        self.0.wait().expect("the process can be waited for").code()
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// JSON that the command wrote.
///
/// # Panics
/// When it is none.
#[must_use]
#[track_caller]
pub fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}
