//! Content of a file besides the field.

use std::collections::BTreeMap;

use crate::Field;

/// A scene and, when its training may go on, where the training stood.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// The scene.
    pub field: Field,
    /// State of the run; `None` in a finished scene.
    pub training: Option<TrainingState>,
    /// Tensors by which a finished scene labels pixels other than by its identity rows: the head that
    /// it was trained with, by name, and what that learnt. `None` where its rows label them.
    pub head: Option<TrainingState>,
}

/// State with the field: that from which a run goes on exactly as if it had not been interrupted, or that of a head.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrainingState {
    /// Counters, settings, random generators.
    pub json: serde_json::Value,
    /// Moments and other per-parameter state, by name.
    pub tensors: BTreeMap<String, StateTensor>,
}

/// A flat tensor of a [`TrainingState`].
#[derive(Clone, Debug, PartialEq)]
pub enum StateTensor {
    /// Single precision.
    F32(Vec<f32>),
    /// Double precision.
    F64(Vec<f64>),
    /// 32-bit counters.
    U32(Vec<u32>),
    /// 64-bit counters.
    U64(Vec<u64>),
}

/// Contents that are written with a field.
#[derive(Clone, Copy, Default)]
pub(super) struct States<'a> {
    pub(super) training: Option<&'a TrainingState>,
    pub(super) head: Option<&'a TrainingState>,
}
