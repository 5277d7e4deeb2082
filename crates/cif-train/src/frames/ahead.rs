//! Frames that do not fit into memory, decoded on threads of their own while steps are computed.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use cif_dataset::{Dataset, Error};

use super::{Decoding, TrainFrame};

/// Most frames that are decoded, or wait to be taken, at a time; they are beyond the budget of the store.
pub(crate) const MOST: usize = 8;

/// Frames under way, by index in the capture.
///
/// A thread for each, instead of the pool of the renderer: a step waits for its frame, and a thread of the pool that
/// waits for a task of the same pool may wait for ever.
pub(crate) struct Ahead {
    dataset: Arc<Dataset>,
    begun: Mutex<BTreeMap<usize, Handle>>,
}

type Handle = JoinHandle<Result<TrainFrame, Error>>;

impl Ahead {
    pub(crate) fn of(dataset: &Dataset) -> Self {
        Self { dataset: Arc::new(dataset.clone()), begun: Mutex::default() }
    }

    /// Begins the first [`MOST`] of some frames that are not begun, and gives up all that are not among them.
    pub(crate) fn expect(&self, coming: impl Iterator<Item = usize>, decoding: &Arc<Decoding>) {
        let mut needed: Vec<usize> = Vec::new();
        for index in coming {
            if needed.len() == MOST {
                break;
            }
            if !needed.contains(&index) {
                needed.push(index);
            }
        }
        let mut begun = self.lock();
        // A thread that runs ends by itself; its frame is dropped.
        begun.retain(|index, _| needed.contains(index));
        for index in needed {
            begun.entry(index).or_insert_with(|| {
                let (dataset, decoding) = (Arc::clone(&self.dataset), Arc::clone(decoding));
                std::thread::spawn(move || decoding.load(&dataset, index))
            });
        }
    }

    /// A frame that was begun, as soon as it is there; `None` where it was not.
    pub(crate) fn take(&self, index: usize) -> Option<Result<TrainFrame, Error>> {
        let handle = self.lock().remove(&index)?;
        Some(handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    }

    /// Gives all frames up, for example because their labels have changed.
    pub(crate) fn give_up(&self) {
        self.lock().clear();
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<usize, Handle>> {
        self.begun.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Frames under way, by index in the capture.
    #[cfg(test)]
    pub(crate) fn begun(&self) -> Vec<usize> {
        self.lock().keys().copied().collect()
    }
}
