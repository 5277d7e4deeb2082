//! `--split`: frames that are trained on, or held out.

use cif_dataset::Split;
use clap::ValueEnum;

/// Splits by name.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(in crate::commands) enum SplitName {
    Train,
    Val,
}

impl From<SplitName> for Split {
    fn from(name: SplitName) -> Self {
        match name {
            SplitName::Train => Self::Train,
            SplitName::Val => Self::Val,
        }
    }
}
