//! Heads: what the instance stage learns about instances, and how pixels tell it back.
//!
//! | file | holds |
//! |---|---|
//! | `cif` | the head of the paper |
//! | `dr_splat`, `gaussian_grouping`, `sa4d`, `vlgs`, `trace3d` | those of the systems that it is compared with |
//! | `lang_splat` | that of a system which tells no instances apart, but answers questions |
//! | `classifier` | codes told apart by a linear classifier, and neighbours that agree: what several of these share |
//! | `tensors` | what heads learn, with gradients and moments |
//! | `views` | the training views as heads may look at them between steps |
//! | `decoder` | the head of a finished scene |
//!
//! A head of another system declares tensors of its own ([`Parameter`]s, beside the table of the field), the C values
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
pub mod lang_splat;
mod sa4d;
mod tensors;
mod trace3d;
mod views;
mod vlgs;

use std::sync::Arc;

use cif_field::parameters::Parameter;
use cif_field::{Field, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::cpu::Renderer;
use cif_render::{BlendRequest, BlendedImage, Blending, InstanceImage, InstanceSettings, RenderSettings};
use rand_pcg::Pcg64;

pub use self::cif::Cif;
pub use self::decoder::Decoder;
pub use self::dr_splat::DrSplat;
pub use self::gaussian_grouping::GaussianGrouping;
pub use self::lang_splat::LangSplat;
pub use self::sa4d::Sa4d;
pub use self::tensors::HeadTensors;
pub use self::trace3d::Trace3d;
pub use self::views::TrainingViews;
pub use self::vlgs::Vlgs;
use crate::adam::EPSILON;
use crate::config::{HeadConfig, HeadName, TrainConfig};
use crate::density::Rearrangement;
use crate::error::TrainError;

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

/// Way from the Gaussians to the labels of pixels.
pub enum Pass<'a> {
    /// The identity rows of the field, whose blending and loss the renderers do in one pass, free of the number of
    /// instances. Rows are estimated before the stage, and Gaussians may be relocated in it.
    Identities(InstanceSettings),
    /// Values of the head, blended as they are.
    Values(&'a dyn ValueHead),
}

/// A head of the instance stage.
pub trait Head: Send + Sync {
    /// Name in saved runs and messages.
    fn name(&self) -> &'static str;

    /// Its way from the Gaussians to the labels of pixels.
    fn pass(&self, config: &TrainConfig) -> Pass<'_>;
}

/// Loss of a head on a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HeadLoss {
    /// The loss, as the head normalises it.
    pub loss: f64,
    /// Labelled pixels that nothing of the head covers.
    pub unsupported: f64,
}

/// What the blended values of a head are held to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Target {
    /// Labels of masks, which it tells back.
    #[default]
    Labels,
    /// Feature maps that were given ([`HeadConfig::maps`]); it tells no labels.
    Features,
}

/// A view of a step, blended.
#[derive(Clone, Copy, Debug)]
pub struct HeadView<'a> {
    /// The values of the head.
    pub blended: &'a BlendedImage,
    /// Dense indices + 1, 0 where there is none.
    pub labels: &'a PixelGrid<u16>,
    /// The feature map, 0 in all channels where there is no feature; `None` without maps.
    pub features: Option<&'a PixelGrid<[f32; 3]>>,
    /// Names the random choices of the head in this view and step.
    pub seed: u64,
}

/// A step of the stage.
#[derive(Clone, Copy)]
pub struct HeadStep<'a> {
    /// Gives the centres of the Gaussians at the time of its first view, world metres.
    pub positions: &'a dyn Fn() -> Vec<[f32; 3]>,
    /// Step of the stage, from 1.
    pub step: u32,
    /// Steps of the stage.
    pub steps: u32,
    /// Names the random choices of the head in this step.
    pub seed: u64,
}

/// Trained part in a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    /// The head; the field stays as it is.
    #[default]
    Head,
    /// The field, by colours alone, as in the stage before; the head stays as it is.
    Field,
}

/// Opacities of its own that a head with [`Blending::Own`] learns: they are the occupancies of the field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnOpacity {
    /// At the start of the stage, in (0, 1).
    pub start: f32,
    /// Learning rate of their logits.
    pub rate: f32,
}

/// Cameras between two training views of one time, supervised with the labels of both.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraBlending {
    /// Weight of their loss beside that of a view, times the similarity (SSIM) of the two images.
    pub weight: f32,
    /// Limits of the place of such a camera on the way from the first view to the second, in [0, 1].
    pub ratio: [f32; 2],
}

/// Values of a head at a time.
#[derive(Clone, Debug, Default)]
pub struct HeadValues {
    /// `[N, C]`; 0 in rows that were not asked for, where a head leaves them out.
    pub values: Vec<f32>,
    /// Rows that a network evaluated, and its layers there, for the way back.
    layers: (Vec<u32>, Vec<sa4d::Layers>),
}

impl From<Vec<f32>> for HeadValues {
    fn from(values: Vec<f32>) -> Self {
        Self { values, layers: Default::default() }
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

/// A head that blends values of its own. Gradients reach its tensors, and its own opacities where it has such.
pub trait ValueHead: Send + Sync {
    /// What its blended values are held to.
    fn target(&self) -> Target {
        Target::Labels
    }

    /// Tensors: with a row per Gaussian, or of a fixed size.
    fn parameters(&self) -> Vec<Parameter>;

    /// Values of one of them at the start of the instance stage, whole rows.
    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32>;

    /// Learning rate of one of them at a step (from 1) of the `steps` of the stage; 0 for what no step learns.
    fn rate(&self, parameter: &Parameter, step: u32, steps: u32) -> f32;

    /// Number that Adam adds to the root of the second moment of one of them.
    fn epsilon(&self, _parameter: &Parameter) -> f32 {
        EPSILON
    }

    /// Opacities of its own that it learns.
    fn own_opacity(&self) -> Option<OwnOpacity> {
        None
    }

    /// Cameras between views that it trains on too.
    fn camera_blending(&self) -> Option<CameraBlending> {
        None
    }

    /// True when frames of a camera train it.
    fn trains_on(&self, _camera: &str) -> bool {
        true
    }

    /// Trained part in a step (from 1) of the `steps` of the stage.
    fn phase(&self, _step: u32, _steps: u32) -> Phase {
        Phase::Head
    }

    /// Tensor whose rows are the values of the Gaussians at all times. Heads that compute values in another manner have
    /// none, and their own [`Self::channels`], [`Self::values`] and [`Self::values_backward`].
    ///
    /// # Panics
    /// Where a head has neither.
    fn codes(&self) -> Parameter {
        panic!("a head has codes, or values of its own")
    }

    /// Number of values C per Gaussian.
    fn channels(&self, _field: &Field) -> usize {
        self.codes().width()
    }

    /// Weights that the values are blended with.
    fn blending(&self) -> Blending {
        Blending::Color
    }

    /// The values at a time, `[N, C]`.
    fn values(&self, tensors: &HeadTensors, _field: &Field, _time: f64) -> Vec<f32> {
        tensors.values(&self.codes()).to_vec()
    }

    /// The values of some rows, ascending, at a time, and what the way back needs of them. Heads whose values cost
    /// nothing give those of all rows.
    fn values_of(&self, tensors: &HeadTensors, field: &Field, time: f64, _rows: &[u32]) -> HeadValues {
        self.values(tensors, field, time).into()
    }

    /// Adds the gradients of its tensors by those of the values of [`Self::values_of`], `[N, C]`.
    fn values_backward(
        &self,
        tensors: &mut HeadTensors,
        _field: &Field,
        _values: &HeadValues,
        v_values: &[f32],
    ) {
        tensors.add_gradients(&self.codes(), v_values);
    }

    /// Loss of a view. Its gradient times `weight` by the blended values is added to `v_blended`, `[height, width,
    /// C]`; gradients by tensors that the loss itself uses are added too.
    fn loss(
        &self,
        tensors: &mut HeadTensors,
        view: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss;

    /// Pairs of Gaussians that the regulariser of a step compares.
    fn compared(&self, _step: &HeadStep<'_>) -> Vec<[u32; 2]> {
        Vec::new()
    }

    /// The regulariser of a step on pairs; its value. Its gradients by the values, `[N, C]`, and by tensors that it uses
    /// itself are added.
    fn regularise(
        &self,
        _tensors: &mut HeadTensors,
        _pairs: &[[u32; 2]],
        _values: &[f32],
        _v_values: &mut [f32],
    ) -> f64 {
        0.0
    }

    /// Label of a pixel (dense index + 1, 0 for none) and its probability, by its blended values.
    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32);

    /// Label of every Gaussian (dense index + 1, 0 for none), for export: that of a pixel that shows it alone, at the
    /// first time.
    fn label_of_rows(&self, tensors: &HeadTensors, field: &Field) -> Vec<u16> {
        let values = self.values(tensors, field, 0.0);
        values.chunks_exact(self.channels(field)).map(|values| self.decode(tensors, values).0).collect()
    }

    /// Prepares the first step.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    fn begin(&self, _tensors: &mut HeadTensors, _views: &mut TrainingViews<'_>) -> Result<(), TrainError> {
        Ok(())
    }

    /// Concludes the last step; what it sets is set anew when it is called again.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    fn finish(&self, _tensors: &mut HeadTensors, _views: &mut TrainingViews<'_>) -> Result<(), TrainError> {
        Ok(())
    }

    /// Changes of the set of Gaussians that fall behind a step (from 1) of the `steps` of the stage, one after
    /// another.
    fn rearrangements(&self, _step: u32, _steps: u32) -> u32 {
        0
    }

    /// One of them; `None` where nothing changes.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    fn rearrange(
        &self,
        _part: u32,
        _step: (u32, u32),
        _views: &mut TrainingViews<'_>,
        _random: &mut Pcg64,
    ) -> Result<Option<Rearrangement>, TrainError> {
        Ok(None)
    }
}

/// A head that blends values of its own.
pub(crate) fn value_head<'a>(head: &'a Arc<dyn Head>, config: &TrainConfig) -> Option<&'a dyn ValueHead> {
    match head.pass(config) {
        Pass::Identities(_) => None,
        Pass::Values(head) => Some(head),
    }
}

/// The values of a head blended over a view by `renderer`, which `settings` without instances are for.
pub(crate) fn blended(
    renderer: &mut Renderer,
    (head, tensors): (&dyn ValueHead, &HeadTensors),
    field: &Field,
    (camera, time): (&PinholeCamera, f64),
    settings: &RenderSettings,
) -> BlendedImage {
    let instances = (head.blending() == Blending::Own).then(InstanceSettings::default);
    renderer.prepare(field, camera, time, &RenderSettings { instances, ..*settings });
    let values = head.values(tensors, field, time);
    let (channels, blending) = (head.channels(field), head.blending());
    renderer.blend(&BlendRequest { values: &values[..], channels, blending })
}

/// Instance outputs of blended values.
pub(crate) fn instance_image(
    head: &dyn ValueHead,
    tensors: &HeadTensors,
    blended: &BlendedImage,
    alpha: &PixelGrid<f32>,
) -> InstanceImage {
    let decoded: Vec<(u16, f32)> = blended.pixels().map(|pixel| head.decode(tensors, pixel)).collect();
    let (width, height) = (blended.width, blended.height);
    let grid = |values: Vec<f32>| PixelGrid::from_pixels(width, height, values);
    let probability: Vec<f32> = decoded.iter().map(|(_, probability)| *probability).collect();
    let entropy = |p: &f32| if *p > 0.0 { -p * p.ln() } else { 0.0 };
    InstanceImage {
        label: PixelGrid::from_pixels(width, height, decoded.iter().map(|(label, _)| *label).collect()),
        entropy: grid(probability.iter().map(entropy).collect()),
        foreground: grid(probability.clone()),
        probability: grid(probability),
        coverage: alpha.clone(),
    }
}

/// Identity rows that say what a head says of every Gaussian.
pub(crate) fn identities(labels: &[u16]) -> Identities {
    let mut identities = Identities::empty();
    for label in labels {
        identities.push_certain(label.checked_sub(1));
    }
    identities
}

/// The place of the largest value, the first of equals.
pub(crate) fn largest(values: impl IntoIterator<Item = f32>) -> Option<(usize, f32)> {
    let numbered = values.into_iter().enumerate();
    numbered.reduce(|best, next| if next.1 > best.1 { next } else { best })
}

#[cfg(test)]
pub(crate) mod testing;
