//! The heads by the names that settings have for them.

use std::sync::Arc;

use super::head::{Head, Pass};
use super::{Cif, DrSplat, GaussianGrouping, LangSplat, Sa4d, Trace3d, Vlgs};
use crate::config::{HeadConfig, HeadName, TrainConfig};

/// The head that settings name.
#[must_use]
pub fn configured(config: &HeadConfig) -> Arc<dyn Head> {
    match config.name {
        HeadName::Cif => Arc::new(Cif),
        HeadName::DrSplat => Arc::new(DrSplat::new(config.contributors)),
        HeadName::GaussianGrouping => Arc::new(GaussianGrouping),
        HeadName::Sa4d => Arc::new(Sa4d::new(&config.camera)),
        HeadName::Vlgs => Arc::new(Vlgs),
        HeadName::Trace3d => Arc::new(Trace3d),
        HeadName::LangSplat => Arc::new(LangSplat),
    }
}

/// Implements [`Head`] for heads that blend values of their own, under the name that settings have for them.
macro_rules! value_heads {
    ($($head:ident),*) => {
        $(impl Head for $head {
            fn name(&self) -> &'static str {
                HeadName::$head.name()
            }

            fn pass(&self, _config: &TrainConfig) -> Pass<'_> {
                Pass::Values(self)
            }
        })*
    };
}

value_heads!(DrSplat, GaussianGrouping, LangSplat, Sa4d, Trace3d, Vlgs);
