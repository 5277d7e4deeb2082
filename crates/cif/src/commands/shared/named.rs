//! Presets and heads by their names.

use cif_train::{HeadName, Preset};
use clap::ValueEnum;
use clap::builder::PossibleValue;

use crate::error::Error;

/// The preset of a name that was given at a place, such as `--preset`.
///
/// # Errors
/// When there is none of this name.
pub(in crate::commands) fn preset(name: &str, place: &str) -> Result<Preset, Error> {
    serde_json::from_value(serde_json::Value::String(name.to_owned())).map_err(|_| {
        Error::failed(
            format!("{place}: there is no preset `{name}`"),
            "presets: draft, standard, best, paper",
        )
    })
}

/// A head by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::commands) struct HeadArgument(HeadName);

impl HeadArgument {
    const ALL: [Self; HeadName::ALL.len()] = {
        let mut all = [Self(HeadName::Cif); HeadName::ALL.len()];
        let mut k = 0;
        while k < all.len() {
            all[k] = Self(HeadName::ALL[k]);
            k += 1;
        }
        all
    };

    pub(in crate::commands) fn head(self) -> HeadName {
        self.0
    }
}

impl ValueEnum for HeadArgument {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.0.name()))
    }
}
