//! Programs that do part of the work: run to their end, or killed when the caller asks to stop.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

use crate::Error;

/// Time between two looks whether the program has ended.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Last lines of its standard error that are kept.
const KEPT_LINES: usize = 12;

/// Answer of a program.
pub(crate) struct Answer<T = Vec<u8>> {
    /// Everything it wrote to standard output, or what a reader made of it.
    pub(crate) output: T,
    /// How it ended.
    pub(crate) status: ExitStatus,
    /// Its last lines on standard error.
    pub(crate) last_words: String,
}

impl<T> Answer<T> {
    /// True where it ended with exit code 0.
    pub(crate) fn succeeded(&self) -> bool {
        self.status.success()
    }
}

/// How a program ended, as the predicate of a sentence.
pub(crate) fn ending(status: ExitStatus) -> String {
    // `signal: 9 (SIGKILL)`, with `(core dumped)` where there is one.
    let words = status.to_string();
    match (status.code(), words.strip_prefix("signal: ")) {
        (Some(code), _) => format!("ended with exit code {code}"),
        (None, Some(signal)) => format!("was killed by signal {signal}"),
        (None, None) => format!("ended: {words}"),
    }
}

/// Runs a program with `input` on its standard input, which stays open until the program ends: where this process is
/// killed, the program reads the end of it, and can end too. Every line that it writes to standard error goes to `line`.
///
/// # Errors
/// When it cannot be started (`Ok(None)` where there is no such program), or `should_stop` says so: it is
/// killed then.
pub(crate) fn run_attended(
    command: &mut Command,
    input: &[u8],
    should_stop: &dyn Fn() -> bool,
    line: impl FnMut(&str) + Send,
) -> Result<Option<Answer>, Error> {
    run_with(command, input, true, should_stop, line, everything)
}

/// All that a program writes.
fn everything(stdout: &mut dyn Read) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    stdout.read_to_end(&mut bytes).map(|_| bytes)
}

/// Runs a program as [`run_attended`] does, with an input that ends, whose standard output goes to `read` while it
/// works. A reader that has enough returns
/// before the end: what the program writes after that is lost.
///
/// # Errors
/// As [`run_attended`], and when `read` fails.
pub(crate) fn run_reading<T: Send>(
    command: &mut Command,
    input: &[u8],
    should_stop: &dyn Fn() -> bool,
    line: impl FnMut(&str) + Send,
    read: impl FnOnce(&mut dyn Read) -> io::Result<T> + Send,
) -> Result<Option<Answer<T>>, Error> {
    run_with(command, input, false, should_stop, line, read)
}

fn run_with<T: Send>(
    command: &mut Command,
    input: &[u8],
    stays_open: bool,
    should_stop: &dyn Fn() -> bool,
    mut line: impl FnMut(&str) + Send,
    read: impl FnOnce(&mut dyn Read) -> io::Result<T> + Send,
) -> Result<Option<Answer<T>>, Error> {
    let name = command.get_program().to_string_lossy().into_owned();
    let lost = |error: io::Error| Error::refused(format!("{name} was lost: {error}"), "try again");
    let started = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let mut child = match started {
        Ok(child) => child,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(lost(error)),
    };
    let (stdin, stdout, stderr) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
    std::thread::scope(|scope| {
        let written = scope.spawn(move || {
            let mut stdin = stdin?;
            // A program that ends before it has read everything says why by itself.
            let _ = stdin.write_all(input);
            stays_open.then_some(stdin)
        });
        let output = scope.spawn(move || match stdout {
            Some(mut stdout) => read(&mut stdout),
            None => read(&mut io::empty()),
        });
        let words = scope.spawn(move || {
            let mut kept: Vec<String> = Vec::new();
            let mut reader = BufReader::new(stderr.into_iter().next()?);
            let mut bytes = Vec::new();
            while reader.read_until(b'\n', &mut bytes).is_ok_and(|read| read > 0) {
                let text = String::from_utf8_lossy(&bytes).trim_end().to_owned();
                line(&text);
                if !text.is_empty() {
                    kept.push(text);
                }
                if kept.len() > KEPT_LINES {
                    kept.remove(0);
                }
                bytes.clear();
            }
            Some(kept.join("\n"))
        });
        let status = loop {
            if let Some(status) = child.try_wait().map_err(lost)? {
                break status;
            }
            if should_stop() {
                let _ = child.kill();
                let _ = child.wait();
                return Err(Error::Stopped);
            }
            std::thread::sleep(LOOK_EVERY);
        };
        drop(written.join());
        // Ctrl-C reaches all programs of a terminal: this one may have ended by it first.
        if !status.success() && should_stop() {
            return Err(Error::Stopped);
        }
        let gone = || io::Error::other("its output could not be read");
        let output = output.join().map_err(|_| lost(gone()))?;
        let last_words = words.join().ok().flatten().unwrap_or_default();
        match output {
            Ok(output) => Ok(Some(Answer { output, status, last_words })),
            // What it wrote ends where it died.
            Err(_) if !status.success() => Err(died(&name, status, &last_words)),
            Err(error) => Err(lost(error)),
        }
    })
}

/// The error of a program that died, with its last lines.
pub(crate) fn died(name: &str, status: ExitStatus, last_words: &str) -> Error {
    let words =
        if last_words.is_empty() { "; it gave no reason".to_owned() } else { format!(":\n{last_words}") };
    // Signal 9 on Linux is mostly the kernel's, for want of memory.
    Error::refused(
        format!("{name} {}{words}", ending(status)),
        "try fewer or smaller images where memory may be short (signal 9); if it happens again, report it with these lines",
    )
}

#[cfg(all(test, unix))]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn output_and_lines_come_back() {
        let mut shell = Command::new("sh");
        shell.args(["-c", "echo one >&2; cat; echo two >&2; exit 3"]);
        let mut lines = Vec::new();
        let answer =
            run_reading(&mut shell, b"given", &|| false, |line| lines.push(line.to_owned()), everything)
                .unwrap()
                .unwrap();
        assert_eq!(answer.output, b"given");
        assert_eq!(ending(answer.status), "ended with exit code 3");
        assert_eq!(answer.last_words, "one\ntwo");
        assert_eq!(lines, ["one", "two"]);
    }

    #[test]
    fn a_reader_may_have_enough_before_the_end() {
        let mut endless = Command::new("sh");
        endless.args(["-c", "while :; do echo line; done"]);
        let first = |stdout: &mut dyn Read| {
            let mut bytes = [0; 4];
            stdout.read_exact(&mut bytes).map(|()| bytes)
        };
        let answer = run_reading(&mut endless, b"", &|| false, |_| (), first).unwrap().unwrap();
        assert_eq!((&answer.output, answer.succeeded()), (b"line", false));
    }

    #[test]
    fn the_input_of_an_attended_program_ends_with_its_caller() {
        // `cat` ends at once where the input has an end.
        let script = "read -r line; (sleep 0.3; echo late; kill $$) & cat; echo early";
        let first = |attended: bool| {
            let mut shell = Command::new("sh");
            shell.args(["-c", script]);
            let answer =
                run_with(&mut shell, b"given\n", attended, &|| false, |_| (), everything).unwrap().unwrap();
            String::from_utf8(answer.output).unwrap().lines().next().map(str::to_owned)
        };
        assert_eq!(first(true).as_deref(), Some("late"));
        assert_eq!(first(false).as_deref(), Some("early"));
    }

    #[test]
    fn a_program_that_dies_says_how() {
        let mut shell = Command::new("sh");
        shell.args(["-c", "echo half; echo out of room >&2; kill -9 $$"]);
        let answer = run_attended(&mut shell, b"", &|| false, |_| ()).unwrap().unwrap();
        assert_eq!(ending(answer.status), "was killed by signal 9 (SIGKILL)");
        // The reader fails by what is missing, the program by what killed it.
        let whole = |stdout: &mut dyn Read| stdout.read_exact(&mut [0; 100]);
        let error = run_reading(&mut shell, b"", &|| false, |_| (), whole).err().unwrap().to_string();
        assert!(error.contains("sh was killed by signal 9 (SIGKILL):\nout of room"), "{error}");
    }

    #[test]
    fn a_missing_program_is_distinguished_from_a_failing_one() {
        assert!(
            run_attended(&mut Command::new("no-such-program-here"), b"", &|| false, |_| ())
                .unwrap()
                .is_none()
        );
    }

    #[test]
    fn a_program_is_killed_when_the_caller_stops() {
        let begun = Instant::now();
        let mut sleep = Command::new("sleep");
        let stopped = run_attended(sleep.arg("600"), b"", &|| true, |_| ());
        assert!(matches!(stopped, Err(Error::Stopped)));
        assert!(begun.elapsed().as_secs() < 300, "it was not waited for");
    }
}
