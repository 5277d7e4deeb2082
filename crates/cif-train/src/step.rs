//! A step as data: the plan that decides it, and the report of what came of it. What computes it, and where, is no
//! part of either.

use std::sync::Arc;

use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::{BlendedImage, RenderSettings, UNLABELLED};

use crate::adam::PlaneWeights;
use crate::config::TrainConfig;
use crate::frames::TrainFrame;
use crate::guard::Fault;
use crate::heads::{Head, HeadLoss, HeadStep, HeadTensors, HeadView, ValueHead, value_head};
use crate::optimiser::StepRates;
use crate::random::{Purpose, derive};
use crate::stage::Stage;

/// Switch for the blending of identities in the steps of the instance stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum InstancePass {
    /// As in training.
    #[default]
    On,
    /// Colour only, on the same view.
    Off,
}

/// A view of a step.
#[derive(Clone)]
pub(crate) struct StepView {
    /// Index of its frame in the capture.
    pub index: usize,
    /// Its image, whole or of half the size.
    pub frame: Arc<TrainFrame>,
    /// Camera of that image.
    pub camera: PinholeCamera,
    /// True when the pixels that effects are judged by train nothing.
    pub leaves_judged: bool,
}

/// A camera whose blended values train a head, and the frames that they are held to with the weight of each.
#[derive(Clone)]
pub(crate) struct HeadTarget {
    pub camera: PinholeCamera,
    pub time: f64,
    pub masks: Vec<(Arc<TrainFrame>, f32)>,
}

impl HeadTarget {
    /// Loss of a head on what it blends to, and its gradient times `weight`; `seed` names its random choices.
    pub(crate) fn loss(
        &self,
        head: &dyn ValueHead,
        tensors: &mut HeadTensors,
        blended: &BlendedImage,
        seed: u64,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        let mut sum = HeadLoss::default();
        for (frame, share) in &self.masks {
            let unlabelled;
            let labels = match &frame.labels {
                Some(labels) => labels,
                None => {
                    unlabelled = PixelGrid::filled(blended.width, blended.height, UNLABELLED);
                    &unlabelled
                }
            };
            let view = HeadView { blended, labels, features: frame.features.as_deref(), seed };
            let HeadLoss { loss, unsupported } = head.loss(tensors, &view, weight * share, v_blended);
            sum.loss += f64::from(*share) * loss;
            sum.unsupported += unsupported;
        }
        sum
    }
}

/// A step.
#[derive(Clone)]
pub(crate) struct StepPlan {
    pub stage: Stage,
    /// Step of the stage, from 1.
    pub iteration: u32,
    pub views: Vec<StepView>,
    /// Labelled pixels of all views.
    pub labelled: usize,
    /// Settings of views with labels; those without have no instances.
    pub settings: RenderSettings,
    /// True when a head that blends values of its own is trained, and what it is trained on.
    pub trains_head: bool,
    pub head_targets: Vec<HeadTarget>,
    /// False when only the instance loss is differentiated.
    pub trains_colors: bool,
    /// Weights of the pulls to paths, and to where Gaussians are.
    pub pulls: [f32; 2],
    pub rates: StepRates,
    /// Rate of the poses of groups; 0 where they stay.
    pub pose_rate: f64,
    /// Learning rate of the exposures; `None` where none are learnt.
    pub exposure_rate: Option<f32>,
    pub weights: PlaneWeights,
    /// True when only rows that some view shows move.
    pub visible_rows_only: bool,
    /// True when densification counts what the step sees.
    pub counts_statistics: bool,
    /// Limits of the occupancy logits after the step (row 42).
    pub occupancy_limits: Option<[f32; 2]>,
    /// Largest magnitude of a calibration after the step (methods reference 5.3).
    pub calibration_limit: Option<f32>,
    /// True when raw quaternions become unit ones after the step.
    pub renormalises: bool,
}

impl StepPlan {
    /// Share of the colour loss that a view has.
    pub(crate) fn view_weight(&self) -> f32 {
        1.0 / self.views.len() as f32
    }

    /// True when a view trains identity rows.
    pub(crate) fn trains_instances(&self, view: &StepView) -> bool {
        self.settings.instances.is_some() && !self.trains_head && view.frame.labelled > 0
    }

    /// The head that the step trains, where it blends values of its own.
    pub(crate) fn head<'a>(
        &self,
        head: &'a Arc<dyn Head>,
        config: &TrainConfig,
    ) -> Option<&'a dyn ValueHead> {
        value_head(head, config).filter(|_| self.trains_head)
    }

    /// Names the random choices of a head on a target of the step.
    pub(crate) fn head_seed(&self, config: &TrainConfig, target: usize) -> u64 {
        derive(config.seed, Purpose::HeadSteps, u64::from(self.iteration) << 16 | target as u64)
    }

    /// Pairs of Gaussians that the regulariser of a head compares by the values of a target: those of the first, of which
    /// `positions` gives the centres.
    pub(crate) fn compared(
        &self,
        head: &dyn ValueHead,
        config: &TrainConfig,
        target: usize,
        positions: &dyn Fn() -> Vec<[f32; 3]>,
    ) -> Vec<[u32; 2]> {
        if target > 0 {
            return Vec::new();
        }
        head.compared(&HeadStep {
            positions,
            step: self.iteration,
            steps: config.stages.instance,
            seed: self.head_seed(config, self.head_targets.len()),
        })
    }

    /// Share of the labelled pixels of the step that a view has (A4).
    pub(crate) fn label_share(&self, view: &StepView) -> f64 {
        view.frame.labelled as f64 / self.labelled.max(1) as f64
    }
}

/// Losses of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StepLoss {
    /// Mean over the views.
    pub color: f64,
    /// Mean over the labelled pixels of all views, or as a head says.
    pub instance: Option<f64>,
    /// Share of them that no covering Gaussian supports.
    pub unsupported: Option<f64>,
    /// The sum that is minimised.
    pub total: f64,
}

/// Measurements of a view of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ViewReport {
    /// Of the picture, where one was rendered.
    pub psnr: Option<f64>,
    /// Mean over the pixels of the view.
    pub color_loss: f64,
    /// Summed over its labelled pixels; that of the view where a head says what it is.
    pub instance_loss: f64,
    /// Labelled pixels that no covering Gaussian supports.
    pub unsupported: f64,
}

impl ViewReport {
    /// Of a view that trained a head alone.
    pub(crate) fn of_head(loss: HeadLoss) -> Self {
        Self { instance_loss: loss.loss, unsupported: loss.unsupported, ..Self::default() }
    }
}

impl StepLoss {
    /// Of the views of a step; `lambda_instance` weighs the instance loss.
    pub(crate) fn new(plan: &StepPlan, views: &[ViewReport], lambda_instance: f32) -> Self {
        let sum = |of: fn(&ViewReport) -> f64| views.iter().map(of).sum::<f64>();
        let trains_labels = plan.trains_head || plan.settings.instances.is_some();
        let is_labelled = plan.stage == Stage::Instance && trains_labels && plan.labelled > 0;
        let of_labelled = |sum: f64| is_labelled.then(|| sum / plan.labelled as f64);
        let of_views = |sum: f64| sum * f64::from(plan.view_weight());
        let color = of_views(sum(|view| view.color_loss));
        let (instance, weight) = match plan.trains_head {
            true => (Some(of_views(sum(|view| view.instance_loss))), 1.0),
            false => (of_labelled(sum(|view| view.instance_loss)), f64::from(lambda_instance)),
        };
        Self {
            color,
            instance,
            unsupported: of_labelled(sum(|view| view.unsupported)),
            total: color + weight * instance.unwrap_or(0.0),
        }
    }
}

/// A step that is done, or could not be taken.
pub(crate) struct StepReport {
    pub plan: StepPlan,
    /// As many as were rendered.
    pub views: Vec<ViewReport>,
    /// A value that is not finite: the step has moved nothing then.
    pub fault: Option<Fault>,
}
