//! A process that runs one model or tokenizer for this one, so that a file which ends it ends nothing else: it does
//! [`serve`](super::serve()) and ends with its input.

use std::io::{self, BufReader};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use super::messages::{Answer, Question, receive, send};
use crate::Tensor;

/// Longest time that loading the library may take; of a file that is none, it may never come back. Chosen: it takes less
/// than a second from a disk.
const LIBRARY_TIME: Duration = Duration::from_secs(60);

type Message = io::Result<(Answer, Vec<Tensor>)>;

/// Such a process, and the channels to it.
#[derive(Debug)]
pub(super) struct Worker {
    child: Child,
    questions: ChildStdin,
    answers: Receiver<Message>,
}

impl Worker {
    /// Starts a process.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(super) fn start(command: &mut Command) -> io::Result<Self> {
        // Ctrl-C is for the process that asks, which may have something to save first.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(command, 0);
        let started = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut child = started?;
        let gone = || io::Error::other("it has no input and output");
        let questions = child.stdin.take().ok_or_else(gone)?;
        let mut output = BufReader::new(child.stdout.take().ok_or_else(gone)?);
        let (sender, answers) = channel();
        std::thread::spawn(move || {
            while let Some(answer) = receive(&mut output).transpose() {
                let is_last = answer.is_err();
                if sender.send(answer).is_err() || is_last {
                    break;
                }
            }
        });
        Ok(Self { child, questions, answers })
    }

    /// Asks, and waits for the answer.
    ///
    /// # Errors
    /// Message of the process, or that it has ended, in words.
    pub(super) fn ask(
        &mut self,
        question: &Question,
        tensors: Vec<Tensor>,
    ) -> Result<(Answer, Vec<Tensor>), String> {
        if send(&mut self.questions, question, &tensors).is_err() {
            return Err(self.ended());
        }
        let answer = if matches!(question, Question::Library(_)) {
            self.answers.recv_timeout(LIBRARY_TIME)
        } else {
            self.answers.recv().map_err(|_| RecvTimeoutError::Disconnected)
        };
        match answer {
            Ok(Ok((Answer::Failed(problem), _))) => Err(problem),
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => Err(self.ended()),
            Err(RecvTimeoutError::Timeout) => {
                Err(format!("it was not loaded after {} s", LIBRARY_TIME.as_secs()))
            }
        }
    }

    /// How the process ended.
    fn ended(&mut self) -> String {
        match self.child.wait() {
            Ok(status) => format!("it ended the process that ran it ({status})"),
            Err(error) => format!("the process that ran it was lost ({error})"),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // Nothing that it has is worth waiting for.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_ends_is_an_error() {
        for (script, expected) in
            [("kill -SEGV $$", "signal: 11"), ("read -r line; exit 3", "exit status: 3")]
        {
            let mut worker = Worker::start(Command::new("sh").args(["-c", script])).unwrap();
            let problem = worker.ask(&Question::Read("text".to_owned()), Vec::new()).unwrap_err();
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
