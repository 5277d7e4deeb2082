//! Directions of what objects look like, for questions in words.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Embeddings of instances, all by one model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Embeddings {
    /// Name of the model; texts have to be embedded by the same.
    pub model: String,
    /// Vectors of length 1 by the id of the instance; instances that no view shows have none.
    pub of: BTreeMap<u16, Vec<f32>>,
}
