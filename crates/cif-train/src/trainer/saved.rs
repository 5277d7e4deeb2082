//! Parts of a saved run that it is compared with, or that wait until it has what they belong to.

use std::collections::BTreeMap;

use cif_dataset::{Dataset, MadeFrom};
use cif_field::checkpoint::StateTensor;

/// The content of a capture, as a run keeps it.
pub(super) fn inputs_of(dataset: &Dataset) -> MadeFrom {
    // Without times of files, so that the same capture gives the same state.
    MadeFrom::new().capture(dataset, None).by_content()
}

/// A head that a run was saved with.
pub(super) struct SavedHead {
    pub(super) name: String,
    pub(super) tensors: BTreeMap<String, StateTensor>,
}
