//! A process that runs one model or tokenizer for another, so that a file which ends it ends nothing else.
//!
//! Questions go to its standard input, answers come from its standard output: a line of JSON, then the values of tensors
//! as they lie in memory. It ends with its input.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::Reading;
use super::place::Place;
use super::signature::Declared;
use crate::Tensor;
use crate::tensor::Values;

/// Longest time that loading the library may take; of a file that is none, it may never come back. Chosen: it takes less
/// than a second from a disk.
const LIBRARY_TIME: Duration = Duration::from_secs(60);

#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Question {
    /// Load the library.
    Library(PathBuf),
    /// Open a model.
    Model { file: PathBuf, threads: usize },
    /// Run it on the tensors that follow, for the outputs of these names.
    Run { names: Vec<String>, wanted: Vec<String> },
    /// Open a tokenizer, the text of its file.
    Tokenizer(String),
    /// Read a text.
    Read(String),
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Answer {
    Ready,
    Declared([Vec<Declared>; 2]),
    /// The tensors that follow.
    Outputs,
    Reading(Reading),
    Failed(String),
}

/// A tensor that follows a message.
#[derive(Serialize, Deserialize)]
struct Head {
    shape: Vec<usize>,
    integers: bool,
}

/// The line of a message.
#[derive(Serialize, Deserialize)]
struct Line<T> {
    message: T,
    tensors: Vec<Head>,
}

fn send<T: Serialize>(to: &mut impl Write, message: T, tensors: &[Tensor]) -> io::Result<()> {
    let head = |tensor: &Tensor| Head {
        shape: tensor.shape().to_vec(),
        integers: matches!(tensor.values(), Values::Integers(_)),
    };
    let mut bytes = serde_json::to_vec(&Line { message, tensors: tensors.iter().map(head).collect() })?;
    bytes.push(b'\n');
    to.write_all(&bytes)?;
    for tensor in tensors {
        to.write_all(match tensor.values() {
            Values::Floats(values) => bytemuck::cast_slice(values),
            Values::Integers(values) => bytemuck::cast_slice(values),
        })?;
    }
    to.flush()
}

/// The next message; `None` at the end.
fn receive<T: DeserializeOwned>(from: &mut impl BufRead) -> io::Result<Option<(T, Vec<Tensor>)>> {
    let mut line = Vec::new();
    if from.read_until(b'\n', &mut line)? == 0 {
        return Ok(None);
    }
    let Line { message, tensors } = serde_json::from_slice(&line)?;
    let tensors = tensors.into_iter().map(|head| tensor(from, head)).collect::<io::Result<_>>()?;
    Ok(Some((message, tensors)))
}

fn tensor(from: &mut impl Read, Head { shape, integers }: Head) -> io::Result<Tensor> {
    let length = shape.iter().try_fold(1, |product: usize, length| product.checked_mul(*length));
    let length = length.ok_or_else(|| io::Error::other("a tensor is too large"))?;
    Ok(if integers {
        let mut values = vec![0_i64; length];
        from.read_exact(bytemuck::cast_slice_mut(&mut values))?;
        Tensor::integers(shape, values)
    } else {
        let mut values = vec![0.0_f32; length];
        from.read_exact(bytemuck::cast_slice_mut(&mut values))?;
        Tensor::floats(shape, values)
    })
}

/// Answers the questions of another process until they end.
///
/// # Errors
/// When that process is gone.
pub fn serve(questions: impl Read, mut answers: impl Write) -> io::Result<()> {
    let mut questions = BufReader::new(questions);
    let mut place = Place::here();
    while let Some((question, tensors)) = receive(&mut questions)? {
        let (answer, outputs) = match answer(&mut place, question, tensors) {
            Ok(answered) => answered,
            Err(problem) => (Answer::Failed(problem), Vec::new()),
        };
        send(&mut answers, answer, &outputs)?;
    }
    Ok(())
}

fn answer(
    place: &mut Place,
    question: Question,
    tensors: Vec<Tensor>,
) -> Result<(Answer, Vec<Tensor>), String> {
    let answer = match question {
        Question::Library(library) => place.load_library(&library).map(|()| Answer::Ready)?,
        Question::Model { file, threads } => Answer::Declared(place.open_with(&file, threads)?),
        Question::Run { names, wanted } => {
            let given = names.into_iter().zip(tensors).collect();
            return Ok((Answer::Outputs, place.run(given, &wanted)?));
        }
        Question::Tokenizer(text) => place.open_tokenizer(text).map(|()| Answer::Ready)?,
        Question::Read(text) => Answer::Reading(place.read(&text)?),
    };
    Ok((answer, Vec::new()))
}

type Message = io::Result<(Answer, Vec<Tensor>)>;

/// Such a process, and the way to it.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_with_their_tensors() {
        let tensors = [
            Tensor::floats([2, 1], vec![1.5, f32::NEG_INFINITY]),
            Tensor::integers(Vec::new(), vec![i64::MIN]),
            Tensor::floats([0, 7], vec![]),
        ];
        let mut bytes = Vec::new();
        send(&mut bytes, Answer::Outputs, &tensors).unwrap();
        send(&mut bytes, Answer::Ready, &[]).unwrap();
        let mut from = &*bytes;
        let (answer, read) = receive::<Answer>(&mut from).unwrap().unwrap();
        assert!(matches!(answer, Answer::Outputs));
        assert_eq!(read, tensors);
        assert!(matches!(receive::<Answer>(&mut from).unwrap(), Some((Answer::Ready, _))));
        assert!(receive::<Answer>(&mut from).unwrap().is_none());
        assert!(receive::<Answer>(&mut &bytes[..bytes.len() / 2]).is_err());
    }

    #[cfg(unix)]
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
