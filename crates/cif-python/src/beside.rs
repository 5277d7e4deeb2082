//! Long work while the interpreter goes on: it runs in threads of its own, while the thread that asked for it answers
//! signals and callbacks. So signals stay with the handlers that the program has, and Ctrl-C is a
//! `KeyboardInterrupt`.

use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;

use cif::workers;
use pyo3::prelude::*;

use crate::error::cif_error;
use crate::process;

/// Longest time between two looks at signals.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Where work asks questions; it waits for the answers.
pub(crate) struct Questions<Q, A> {
    sender: Sender<(Q, Sender<A>)>,
}

impl<Q, A> Questions<Q, A> {
    /// Asks, and waits; `None` when nobody answers any more.
    pub(crate) fn ask(&self, question: Q) -> Option<A> {
        let (sender, answer) = channel();
        self.sender.send((question, sender)).ok()?;
        answer.recv().ok()
    }
}

/// Runs `work` in a thread of its own. Its questions are answered here, by `answer`; after the first exception, of an
/// answer or of a signal handler, `stop` asks the work to end and no question is answered any more. The exception is
/// raised once the work has ended.
pub(crate) fn run<T: Send, Q: Send, A: Send>(
    py: Python<'_>,
    stop: impl Fn(),
    mut answer: impl FnMut(Q) -> PyResult<A>,
    work: impl FnOnce(Questions<Q, A>) -> T + Send,
) -> PyResult<T> {
    process::enter()?;
    thread::scope(|scope| {
        let (sender, inbox) = channel();
        let worker = thread::Builder::new()
            .name("cif".to_owned())
            .spawn_scoped(scope, move || workers::run(None, move || work(Questions { sender })))?;
        let mut inbox: Receiver<(Q, Sender<A>)> = inbox;
        let mut failure = None;
        loop {
            let (received, back) = py.detach(move || (inbox.recv_timeout(LOOK_EVERY), inbox));
            inbox = back;
            let raised = match received {
                Ok((question, reply)) if failure.is_none() => match answer(question) {
                    // The work is gone if nobody takes it.
                    Ok(answer) => reply.send(answer).err().and(None),
                    Err(error) => Some(error),
                },
                Ok(_) | Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            if let Some(error) = raised.or_else(|| py.check_signals().err())
                && failure.is_none()
            {
                failure = Some(error);
                stop();
            }
        }
        match py.detach(|| worker.join()) {
            Ok(done) => failure.map_or_else(|| done.map_err(cif_error), Err),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}
