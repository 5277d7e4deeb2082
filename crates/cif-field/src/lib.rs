//! The dynamic Gaussian field.
//!
//! | module | answers |
//! |---|---|
//! | [`gaussians`] | what is stored per Gaussian |
//! | [`deformation`] | how Gaussians move: hexplane and MLP parameters, and their evaluation |
//! | [`identity`] | whose a Gaussian is |
//! | [`instance`] | what the instances are called |
//! | [`timeline`] | which times were captured, and from which cameras |
//! | [`field`] | all of it together |

pub mod checkpoint;
pub mod deformation;
pub mod field;
pub mod gaussians;
pub mod identity;
pub mod instance;
pub mod neighbours;
pub mod query;
#[cfg(test)]
mod testing;
pub mod timeline;
pub mod validate;

pub use checkpoint::{Checkpoint, CheckpointError, StateTensor, TrainingState};
pub use deformation::{Deformation, DeformationConfig, Heads, TimeEncoding};
pub use field::{Field, SortMetric};
pub use gaussians::Gaussians;
pub use identity::Identities;
pub use instance::Instance;
pub use query::{FieldAtTime, QueryResult};
pub use timeline::{RecordedCamera, Timeline};
pub use validate::FieldError;
