//! Broken rules of a field.

/// A shape that no deformation can have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the deformation's `{name}` is {value}, expected {expected}")]
pub struct ConfigError {
    /// Setting.
    pub name: &'static str,
    /// Its value.
    pub value: String,
    /// The range.
    pub expected: String,
}

/// A broken rule of [`crate::Field`].
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FieldError {
    /// Arrays that must have the same length do not.
    #[error("`{array}` has {found} entries, expected {expected}")]
    Length {
        /// The array.
        array: &'static str,
        /// Its length.
        found: usize,
        /// The length that follows from the rest.
        expected: usize,
    },
    /// More Gaussians or entries than 32-bit indices address.
    #[error("`{array}` has {found} entries, more than 32-bit indices can address")]
    TooMany {
        /// The array.
        array: &'static str,
        /// Its length.
        found: usize,
    },
    /// A NaN or infinite parameter.
    #[error("`{array}` holds {value} at row {row}, column {column}, where a finite value must be")]
    NotFinite {
        /// The array.
        array: &'static str,
        /// First such row.
        row: usize,
        /// Column in the row.
        column: usize,
        /// The value.
        value: f32,
    },
    /// The shape of the deformation is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The box of the deformation is empty, flat or not finite.
    #[error("the deformation's box {low:?} to {high:?} must be finite and have a volume")]
    Bounds {
        /// Smallest corner.
        low: [f64; 3],
        /// Largest corner.
        high: [f64; 3],
    },
    /// An identity row is out of order, not inside the entries, or owned by nobody.
    #[error("identity row {row} {problem}")]
    IdentityRow {
        /// The row.
        row: usize,
        /// The problem.
        problem: String,
    },
    /// The instance table is inconsistent.
    #[error("instance {index} ({label:?}) {problem}")]
    Instance {
        /// Position in the table.
        index: usize,
        /// Its label.
        label: String,
        /// The problem, as the predicate of the message.
        problem: String,
    },
    /// A group of recorded motion is inconsistent.
    #[error("track group {index} ({name:?}) {problem}")]
    Track {
        /// Position in [`crate::Tracks::groups`].
        index: usize,
        /// Its name.
        name: String,
        /// The problem, as the predicate of the message.
        problem: String,
    },
    /// A captured time or rate is out of range.
    #[error("the timeline is broken: {problem}")]
    Timeline {
        /// The problem.
        problem: String,
    },
    /// A recorded camera is unusable.
    #[error("camera {name:?} (record {index}) {problem}")]
    Camera {
        /// Position in the list.
        index: usize,
        /// Its name.
        name: String,
        /// The problem, as the predicate of the message.
        problem: String,
    },
    /// A single value is out of range.
    #[error("`{name}` is {value}, expected {expected}")]
    Value {
        /// The value's name.
        name: &'static str,
        /// The value.
        value: String,
        /// The range.
        expected: &'static str,
    },
}

pub(crate) fn finite(array: &'static str, values: &[f32], columns: usize) -> Result<(), FieldError> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(at) => {
            Err(FieldError::NotFinite { array, row: at / columns, column: at % columns, value: values[at] })
        }
    }
}
