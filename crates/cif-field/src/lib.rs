//! The dynamic Gaussian field: what a trained scene is, where it is stored, and what can be asked of it.
//!
//! | module | answers |
//! |---|---|
//! | [`gaussians`] | what is stored per Gaussian, and how fresh ones begin |
//! | [`parameters`] | which tensors are learnt: the table that everything else loops over |
//! | [`neighbours`] | which points are nearest, coincident ones included |
//! | [`deformation`] | how Gaussians move: hexplane and MLP parameters, and their evaluation |
//! | [`tracks`] | what moves by recorded poses rather than by learned deformation |
//! | [`identity`] | whose a Gaussian is |
//! | [`instance`] | what the instances are called |
//! | [`timeline`] | which times were captured, and from which cameras |
//! | [`record`] | how a field came about, and how it has to be drawn |
//! | [`embedding`] | what objects look like, for questions in words |
//! | [`exposure`] | what cameras make of colours |
//! | [`field`] | all of it together |
//! | [`fingerprint`] | whether two fields are the same |
//! | [`error`] | which rules every field keeps ([`Field::validate`]) |
//! | [`health`] | what is numerically broken or odd, and how broken parts are repaired |
//! | [`query`] | what exists at a place and time, and whose it is |
//! | [`checkpoint`] | how `.cif` files are laid out, read and written |
//!
//! A scene of one red Gaussian, saved, read and asked:
//!
//! ```
//! use cif_field::{Field, Gaussians, Identities, Instance, Record, SortMetric, Timeline};
//! use glam::DVec3;
//!
//! let field = Field {
//!     gaussians: Gaussians::from_points(&[[0.0, 0.0, 1.0]], &[[0.9, 0.1, 0.1]])?,
//!     deformation: None,
//!     tracks: None,
//!     identities: Some(Identities {
//!         row_offsets: vec![0, 1],
//!         labels: vec![0],
//!         log_estimates: vec![0.0],
//!         log_calibrations: vec![0.0],
//!         owners: Vec::new(),
//!     }),
//!     instances: vec![Instance { id: 7, label: "red mug".into(), category: "mug".into(), taxonomies: Default::default() }],
//!     timeline: Timeline { times: vec![0.0], frames_per_second: 24.0 },
//!     cameras: Vec::new(),
//!     sh_degree: 0,
//!     background: [1.0; 3],
//!     sort_metric: SortMetric::Z,
//!     extent: 1.0,
//!     record: Record::default(),
//! };
//! let folder = tempfile::tempdir()?;
//! field.save(folder.path().join("mug.cif"))?;
//!
//! let field = Field::load(folder.path().join("mug.cif"))?;
//! let found = &field.query(&[DVec3::new(0.0, 0.0, 1.0)], 0.0)[0];
//! assert_eq!(found.instance(), Some(0));
//! assert!((found.existence - 0.02).abs() < 1e-6, "fresh Gaussians have an occupancy of 2 %");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod checkpoint;
pub mod deformation;
pub mod embedding;
pub mod error;
pub mod exposure;
pub mod field;
pub mod fingerprint;
pub mod gaussians;
pub mod health;
pub mod identity;
pub mod instance;
pub mod neighbours;
pub mod parameters;
pub mod query;
pub mod record;
#[cfg(test)]
mod testing;
pub mod timeline;
pub mod tracks;
mod validate;

pub use checkpoint::{Checkpoint, CheckpointError, StateTensor, TrainingState};
pub use deformation::{Deformation, DeformationConfig, Heads, TimeEncoding};
pub use embedding::{Embedding, Embeddings};
pub use error::FieldError;
pub use exposure::{Exposure, TimedExposure};
pub use field::{Field, SortMetric};
pub use gaussians::{Gaussians, GaussiansMut};
pub use identity::{Identities, Owner};
pub use instance::Instance;
pub use parameters::Parameter;
pub use query::{FieldAtTime, QueryResult};
pub use record::{Declared, Drawing, FrameCodes, Record, RecordError, Run};
pub use timeline::{RecordedCamera, Timeline};
pub use tracks::{Joint, JointKind, RotationEvidence, TrackGroup, Tracks};
