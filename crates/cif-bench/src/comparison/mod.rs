//! The tables of the paper: the method compared with other systems, and without its parts, on one reconstruction per
//! capture and seed.
//!
//! | file | answers |
//! |---|---|
//! | `record` | what is kept of a run, so that a comparison can be interrupted |
//! | `run` | how a run is trained and scored |
//! | `published` | what the paper published, taken against other masks |
//! | `tables` | means, spreads and the best of them, as text, CSV, JSON and LaTeX |
//! | `queries` | how questions in words are answered |
//! | `text` | tables as Markdown and LaTeX |
//! | `crops` | the part of a picture in which the runs differ most |
//! | `page` | the page |
//!
//! Source: methods reference 8.7 (fairness rules) and 9 (metrics).

mod crops;
pub mod page;
mod published;
pub mod queries;
pub mod record;
pub mod run;
pub mod tables;
mod text;

use cif_train::{Ablation, HeadName};

/// A run of a comparison: a head, or the method without one of its parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contender {
    /// A head.
    Head(HeadName),
    /// The head of the paper without a part.
    Without(Ablation),
}

/// Ablations of the paper, with the number that it gives them. Source: methods reference 8.7.
pub const ABLATIONS: [(Ablation, &str); 4] = [
    (Ablation::ConstantOccupancy, "i"),
    (Ablation::OpacityOccupancy, "ii"),
    (Ablation::NoCalibration, "iii"),
    (Ablation::NoResampling, "iv"),
];

impl Contender {
    /// Name in files and tables of numbers.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Head(head) => head.name(),
            Self::Without(ablation) => {
                ABLATIONS.into_iter().find(|(other, _)| *other == ablation).map_or("", |(_, number)| number)
            }
        }
    }

    /// The head, where nothing of it is left out.
    #[must_use]
    pub fn whole(&self) -> Option<HeadName> {
        match self {
            Self::Head(head) => Some(*head),
            Self::Without(_) => None,
        }
    }

    /// The head that it trains.
    #[must_use]
    pub fn head(self) -> HeadName {
        match self {
            Self::Head(head) => head,
            Self::Without(_) => HeadName::Cif,
        }
    }
}

/// Name of a row for readers, by the name in tables of numbers; `camera` is the only one that SA4D trained on, where it
/// is not empty.
#[must_use]
pub fn title(name: &str, camera: &str) -> String {
    match name {
        "cif" => "CIF".to_owned(),
        "dr-splat" => "Dr. Splat".to_owned(),
        "gaussian-grouping" => "Gaussian Grouping".to_owned(),
        "sa4d" if camera.is_empty() => "SA4D (all cameras)".to_owned(),
        "sa4d" => format!("SA4D (camera {camera})"),
        "vlgs" => "VLGS (re-implementation)".to_owned(),
        "trace3d" => "Trace3D".to_owned(),
        "4d-langsplat" => "4D LangSplat (time-agnostic)".to_owned(),
        "i" => "(i) constant occupancy".to_owned(),
        "ii" => "(ii) opacity as occupancy".to_owned(),
        "iii" => "(iii) no calibration".to_owned(),
        "iv" => "(iv) no resampling".to_owned(),
        "v" => "(v) full".to_owned(),
        other => other.to_owned(),
    }
}
