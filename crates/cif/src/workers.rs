//! Threads that share the work of a command.

use crate::error::Error;

/// Stack of a thread, as main threads have it.
const STACK_BYTES: usize = 8 << 20;

/// Does `work` on one of so many threads, by default as many as there are processors: what it shares with the others it begins
/// at once, where a thread from outside would sleep until it is done, some twenty times in a training step. The pool is its
/// own, because a command may run several times in one process.
///
/// # Errors
/// When the threads cannot be started.
pub fn run<T: Send>(threads: Option<u32>, work: impl FnOnce() -> T + Send) -> Result<T, Error> {
    let count = threads.unwrap_or(0) as usize;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(count).stack_size(STACK_BYTES).build();
    let pool = pool.map_err(|error| {
        let threads = threads.map_or(String::new(), |threads| format!("{threads} "));
        Error::plain(format!("cannot start {threads}threads: {error}"))
    })?;
    Ok(pool.install(work))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_is_done_by_one_of_the_threads() {
        let outside = std::thread::current().id();
        for threads in [None, Some(3)] {
            let (inside, index, count) = run(threads, || {
                let thread = std::thread::current().id();
                (thread, rayon::current_thread_index(), rayon::current_num_threads())
            })
            .unwrap();
            assert!(inside != outside && index.is_some());
            assert!(threads.is_none_or(|threads| count == threads as usize), "{count}");
        }
    }
}
