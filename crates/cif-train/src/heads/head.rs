//! Traits of heads: the loss, values and tensors that a head declares.

use std::sync::Arc;

use cif_field::Field;
use cif_field::parameters::Parameter;
use cif_geometry::PixelGrid;
use cif_render::{BlendedImage, Blending, InstanceSettings};
use rand_pcg::Pcg64;

use super::tensors::HeadTensors;
use super::views::TrainingViews;
use crate::adam::EPSILON;
use crate::config::TrainConfig;
use crate::density::Rearrangement;
use crate::error::TrainError;

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

    /// Its path from the Gaussians to the labels of pixels.
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
    /// Labels of masks, which it reproduces.
    #[default]
    Labels,
    /// Feature maps that were given ([`HeadConfig::maps`]); it decodes no labels.
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
    /// Weight of their loss relative to that of a view, times the similarity (SSIM) of the two images.
    pub weight: f32,
    /// Limits of the place of such a camera on the path from the first view to the second, in [0, 1].
    pub ratio: [f32; 2],
}

/// Values of layers of a network, `[places, width]` each, the inputs first.
pub(super) type Layers = Vec<Vec<f32>>;

/// Values of a head at a time.
#[derive(Clone, Debug, Default)]
pub struct HeadValues {
    /// `[N, C]`; 0 in rows that were not asked for, where a head leaves them out.
    pub values: Vec<f32>,
    /// Rows that a network evaluated, and its layers there, for the backward pass.
    pub(super) layers: (Vec<u32>, Vec<Layers>),
}

impl From<Vec<f32>> for HeadValues {
    fn from(values: Vec<f32>) -> Self {
        Self { values, layers: Default::default() }
    }
}

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

    /// The values of some rows, ascending, at a time, and what the backward pass needs of them. Heads whose values cost
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
        _step: u32,
        _steps: u32,
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

/// The tensors of a head at the start of the instance stage.
pub(crate) fn tensors_at_start(head: &dyn ValueHead, field: &Field, seed: u64) -> HeadTensors {
    let start = |parameter: Parameter| {
        let values = head.start(&parameter, field, seed);
        (parameter, values)
    };
    HeadTensors::new(head.parameters().into_iter().map(start))
}

/// Moves the tensors of a head at a step (from 1) of the `steps` of the stage; their gradients become zero.
pub(crate) fn step_tensors(head: &dyn ValueHead, tensors: &mut HeadTensors, step: u32, steps: u32) {
    tensors.step(|parameter| (head.rate(parameter, step, steps), head.epsilon(parameter)));
}
