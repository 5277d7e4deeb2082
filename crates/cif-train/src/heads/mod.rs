//! Heads: what the instance stage learns about instances, and how pixels decode to labels.
//!
//! | file | holds |
//! |---|---|
//! | `head` | what a head is: traits, and what their functions take and give |
//! | `registry` | heads by name |
//! | `cif` | the head of the paper |
//! | `dr_splat`, `gaussian_grouping`, `sa4d`, `vlgs`, `trace3d` | those of the systems that it is compared with |
//! | `lang_splat` | that of a system which distinguishes no instances, but answers questions |
//! | `classifier` | codes distinguished by a linear classifier, and neighbours that agree: what several of these share |
//! | `tensors` | what heads learn, with gradients and moments |
//! | `views` | the training views as heads may look at them between steps |
//! | `labels` | blended values of a view, and labels of pixels and Gaussians |
//! | `decoder` | the head of a finished scene |
//!
//! A head of another system declares tensors of its own ([`Parameter`]s that the table of the field lacks), the C values
//! that they give every Gaussian, a loss on these values blended over a view, and how a blended pixel decodes to a
//! label. Its tensors follow the Gaussians when these are cloned, split, pruned or relocated, are saved with the run
//! and with the scene, and are stepped by the same optimiser, whichever engine blends. Gaussians and deformation stay
//! as they were reconstructed, but for steps that a head asks for ([`Phase::Field`]).
//!
//! Source: methods reference 8.

mod cif;
mod classifier;
mod decoder;
mod dr_splat;
mod gaussian_grouping;
mod head;
mod labels;
pub mod lang_splat;
mod registry;
mod sa4d;
mod tensors;
mod trace3d;
mod views;
mod vlgs;

pub use self::cif::Cif;
pub use self::decoder::Decoder;
pub use self::dr_splat::DrSplat;
pub use self::gaussian_grouping::GaussianGrouping;
pub use self::head::{
    CameraBlending, Head, HeadLoss, HeadStep, HeadValues, HeadView, OwnOpacity, Pass, Phase, Target,
    ValueHead,
};
pub(crate) use self::head::{step_tensors, tensors_at_start, value_head};
pub(crate) use self::labels::{blended, identities, instance_image};
pub use self::lang_splat::LangSplat;
pub use self::registry::configured;
pub use self::sa4d::Sa4d;
pub use self::tensors::HeadTensors;
pub use self::trace3d::Trace3d;
pub use self::views::TrainingViews;
pub use self::vlgs::Vlgs;

#[cfg(test)]
pub(crate) mod testing;
