//! Saving and resuming: everything that the next step depends on.

use std::collections::BTreeMap;
use std::sync::Arc;

use cif_dataset::{Dataset, MadeFrom, Split};
use cif_field::Field;
use cif_field::checkpoint::{Checkpoint, StateTensor, TrainingState};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

use super::Trainer;
use super::measured_frames::MeasuredFrames;
use super::saved::{SavedHead, inputs_of};
use crate::config::TrainConfig;
use crate::density::DensifyStatistics;
use crate::error::TrainError;
use crate::heads::{Cif, Head, tensors_at_start, value_head};
use crate::objects::KnownObjects;
use crate::optimiser::Optimiser;
use crate::phase::Phase;
use crate::progress::Progress;
use crate::stage::Stage;
use crate::start::Start;
use crate::state::State;

/// Version of the state. Version 1 does not hold which objects travel: they are searched anew.
const VERSION: u32 = 2;

/// The JSON part of what is saved.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SavedState {
    version: u32,
    #[serde(deserialize_with = "recorded")]
    pub(super) config: TrainConfig,
    pub(super) progress: Progress,
    capture: Capture,
    /// Name of the head that the instance stage trains.
    #[serde(default = "name_of_cif", skip_serializing_if = "is_cif")]
    head: String,
    /// Objects that were fitted, before the field takes them over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    objects: Option<Value>,
    /// Per label (dense index + 1), whether the instance travels; empty before that is known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    travelling: Vec<bool>,
    /// Steps per parameter group.
    pub(super) adam_steps: BTreeMap<String, u32>,
}

/// Properties of the capture that must be equal for a saved run to be resumed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Capture {
    layout: String,
    training_frames: usize,
    times: usize,
    image_size: [u32; 2],
    instance_ids: Vec<u16>,
    /// Content of images, masks, cameras, points and labels; `None` in runs of older versions, which are not compared by
    /// it, and where another capture is accepted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    inputs: Option<MadeFrom>,
}

fn recorded<'de, D: Deserializer<'de>>(settings: D) -> Result<TrainConfig, D::Error> {
    TrainConfig::recorded(Value::deserialize(settings)?).map_err(D::Error::custom)
}

impl SavedState {
    pub(super) fn parse(json: serde_json::Value) -> Result<Self, TrainError> {
        let version = json.get("version").and_then(serde_json::Value::as_u64);
        if !version.is_some_and(|version| (1..=u64::from(VERSION)).contains(&version)) {
            return Err(unusable("it was written by another version of the trainer"));
        }
        let state: Self = serde_json::from_value(json).map_err(|error| unusable(error.to_string()))?;
        state.progress.problem().map_or(Ok(state), |problem| Err(unusable(problem)))
    }

    /// True where it is known that the run was of the same capture, masks included.
    pub(super) fn is_known_of(&self, dataset: &Dataset, inputs: &MadeFrom) -> bool {
        self.capture.inputs.is_some() && self.capture.check(&Capture::of(dataset, inputs), dataset).is_ok()
    }
}

impl Capture {
    pub(super) fn of(dataset: &Dataset, inputs: &MadeFrom) -> Self {
        let first = dataset.frames.iter().find(|f| f.split == Split::Train);
        Self {
            layout: format!("{:?}", dataset.layout),
            training_frames: dataset.frames.iter().filter(|f| f.split == Split::Train).count(),
            times: dataset.times.len(),
            image_size: first.map_or([0; 2], |frame| [frame.camera.width, frame.camera.height]),
            instance_ids: dataset.instances.iter().map(|instance| instance.id).collect(),
            inputs: Some(inputs.clone()),
        }
    }

    /// Refuses another capture.
    fn check(&self, found: &Self, dataset: &Dataset) -> Result<(), TrainError> {
        let differs = |what, expected: String, found: String| {
            if expected == found {
                return Ok(());
            }
            Err(TrainError::OtherCapture { what, expected, found, root: dataset.root.clone() })
        };
        let show = |size: [u32; 2]| format!("{} x {}", size[0], size[1]);
        let ids = |ids: &[u16]| format!("{ids:?}");
        differs("the layout", self.layout.clone(), found.layout.clone())?;
        let frames = |count: usize| count.to_string();
        differs(
            "the number of training frames",
            frames(self.training_frames),
            frames(found.training_frames),
        )?;
        differs("the number of times", frames(self.times), frames(found.times))?;
        differs("the image size", show(self.image_size), show(found.image_size))?;
        differs("the list of instance ids", ids(&self.instance_ids), ids(&found.instance_ids))?;
        let difference = self.inputs.as_ref().zip(found.inputs.as_ref());
        match difference.and_then(|(before, now)| before.difference(now)) {
            Some(difference) => Err(TrainError::ChangedCapture { difference, root: dataset.root.clone() }),
            None => Ok(()),
        }
    }
}

/// Refuses a scene that was trained with other instances than the capture has.
pub(super) fn check_instances(field: &Field, dataset: &Dataset) -> Result<(), TrainError> {
    let expected: Vec<u16> = field.instances.iter().map(|instance| instance.id).collect();
    let found: Vec<u16> = dataset.instances.iter().map(|instance| instance.id).collect();
    if expected == found {
        return Ok(());
    }
    Err(TrainError::OtherCapture {
        what: "the list of instance ids",
        expected: format!("{expected:?}"),
        found: format!("{found:?}"),
        root: dataset.root.clone(),
    })
}

/// Lets a saved run go on with images, masks, cameras, points and labels that have changed since, and a run begin with the
/// Gaussians of a scene whose images have; frames, times and, of a saved run, sizes and ids of instances must be the
/// same all the same.
pub fn accept_changes(checkpoint: &mut Checkpoint) {
    checkpoint.field.record.images = None;
    let capture = checkpoint.training.as_mut().and_then(|training| training.json.get_mut("capture"));
    if let Some(capture) = capture.and_then(Value::as_object_mut) {
        capture.remove("inputs");
    }
}

fn unusable(reason: impl Into<String>) -> TrainError {
    TrainError::BadState { reason: reason.into() }
}

impl Trainer {
    /// The field as it is now; with state, what [`Trainer::resume`] needs as well.
    #[must_use]
    pub fn checkpoint(&self, with_state: bool) -> Checkpoint {
        let mut field = self.state.field.clone();
        field.record = self.provenance();
        let head = if with_state { None } else { self.saved_decoder() };
        Checkpoint { field, training: with_state.then(|| self.training_state()), head }
    }

    /// Takes the moments of poses out of a saved run.
    pub(super) fn restore_poses(
        &mut self,
        tensors: &mut BTreeMap<String, StateTensor>,
    ) -> Result<(), TrainError> {
        let fits = self.state.pose_moments.restore(tensors);
        fits.ok_or_else(|| unusable("the moments of poses do not fit"))
    }

    /// Paths that objects are held to.
    pub(super) fn restore_guidance(
        &mut self,
        tensors: &mut BTreeMap<String, StateTensor>,
    ) -> Result<(), TrainError> {
        let (n, times) = (self.state.field.gaussians.len(), self.state.dataset.times.len());
        self.state
            .guidance
            .restore(tensors, n, times)
            .ok_or_else(|| unusable("the paths of objects do not fit the capture"))
    }

    fn training_state(&self) -> TrainingState {
        let mut tensors = BTreeMap::new();
        let mut adam_steps = BTreeMap::new();
        for (parameter, moments) in self.state.optimiser.groups() {
            let name = parameter.rate;
            tensors.insert(format!("adam.{name}.first"), StateTensor::F32(moments.first.clone()));
            tensors.insert(format!("adam.{name}.second"), StateTensor::F32(moments.second.clone()));
            adam_steps.insert(name.to_owned(), moments.steps);
        }
        let statistics = &self.state.statistics;
        tensors.insert("densify.gradient".into(), StateTensor::F32(statistics.gradient.clone()));
        tensors.insert("densify.count".into(), StateTensor::U32(statistics.count.clone()));
        tensors.insert("densify.radius".into(), StateTensor::F32(statistics.radius.clone()));
        let unseen = self.state.unseen.iter().map(|unseen| u32::from(*unseen)).collect();
        tensors.insert("identity.unseen".into(), StateTensor::U32(unseen));
        tensors.insert("identity.label_pixels".into(), StateTensor::F64(self.state.label_pixels.clone()));
        for (name, tensor) in self.state.guidance.tensors() {
            tensors.insert(name.to_owned(), tensor);
        }
        tensors.extend(self.state.head_tensors.saved());
        for (name, tensor) in self.state.pose_moments.saved() {
            tensors.insert(name.to_owned(), tensor);
        }
        let (objects, of_objects) = self.state.objects.saved();
        tensors.extend(of_objects);
        let state = SavedState {
            version: VERSION,
            config: self.state.config.clone(),
            progress: self.progress(),
            capture: Capture::of(self.state.capture(), &self.inputs),
            head: self.state.head.name().to_owned(),
            objects,
            travelling: self.state.guidance.travelling.clone(),
            adam_steps,
        };
        let json = serde_json::to_value(state).expect("the state holds only strings, numbers and lists");
        TrainingState { json, tensors }
    }

    /// A run where a checkpoint with state left it; settings come from the checkpoint.
    ///
    /// # Errors
    /// When the checkpoint has no training state, is damaged, or belongs to another capture; when a frame cannot
    /// be read; [`TrainError::Stopped`] when the stop of `start` was requested meanwhile.
    pub fn resume(start: impl Into<Start>, checkpoint: Checkpoint) -> Result<Self, TrainError> {
        let Start { mut dataset, phases } = start.into();
        let _run = phases.enter(Phase::Other, 0);
        let TrainingState { json, mut tensors } = checkpoint.training.ok_or(TrainError::NoState)?;
        let state = SavedState::parse(json)?;
        state.config.validate()?;
        let measured_frames = MeasuredFrames::withhold(&mut dataset, &state.config);
        state.capture.check(&Capture::of(&dataset, &inputs_of(&dataset)), &dataset)?;
        let start = Start { dataset, phases: phases.clone() };
        let mut trainer =
            Self::assemble(start, measured_frames, state.config, checkpoint.field, Some(state.progress))?;

        let n = trainer.state.field.gaussians.len();
        restore(&mut trainer.state.optimiser, &mut tensors, &state.adam_steps)?;
        trainer.state.statistics = DensifyStatistics {
            gradient: floats(&mut tensors, "densify.gradient", n)?,
            count: counters(&mut tensors, "densify.count", n)?,
            radius: floats(&mut tensors, "densify.radius", n)?,
        };
        trainer.restore_guidance(&mut tensors)?;
        trainer.restore_poses(&mut tensors)?;
        if let Some(objects) = state.objects {
            let State { field, dataset, .. } = &trainer.state;
            let (instances, times) = (field.instances.len(), dataset.times.len());
            trainer.state.objects = KnownObjects::restored(objects, &mut tensors, instances, times)
                .ok_or_else(|| unusable("the fitted objects do not fit the capture"))?;
        }
        if ![0, trainer.state.field.instances.len() + 1].contains(&state.travelling.len()) {
            return Err(unusable("the travelling objects do not fit the capture"));
        }
        trainer.state.guidance.travelling = state.travelling;
        let has_rows = trainer.state.field.identities.is_some();
        let unseen = counters(&mut tensors, "identity.unseen", if has_rows { n } else { 0 })?;
        trainer.state.unseen = unseen.into_iter().map(|flag| flag != 0).collect();
        let instances = if has_rows { trainer.state.field.instances.len() } else { 0 };
        trainer.state.label_pixels = match tensors.remove("identity.label_pixels") {
            Some(StateTensor::F64(values)) if values.len() == instances => values,
            _ => return Err(unusable("tensor identity.label_pixels is missing or has the wrong shape")),
        };
        if state.head != Cif.name() {
            tensors.retain(|name, _| name.starts_with("head."));
            trainer.saved_head = Some(SavedHead { name: state.head, tensors });
            if trainer.saved_head.as_ref().is_some_and(|saved| saved.name == trainer.state.head.name()) {
                trainer.restore_head()?;
            }
        }
        Ok(trainer)
    }

    /// Takes up the tensors of a saved head, once the run has it.
    pub(super) fn restore_head(&mut self) -> Result<(), TrainError> {
        let Some(mut saved) = self.saved_head.take() else { return Ok(()) };
        if saved.name != self.state.head.name() {
            return Err(unusable(format!("its head is {}, not {}", saved.name, self.state.head.name())));
        }
        let head = Arc::clone(&self.state.head);
        let Some(head) = value_head(&head, &self.state.config) else { return Ok(()) };
        if self.state.progress.stage == Stage::Instance {
            let State { field, config, head_tensors, .. } = &mut self.state;
            *head_tensors = tensors_at_start(head, field, config.seed);
            let restored = head_tensors.restore(&mut saved.tensors);
            restored.ok_or_else(|| unusable(format!("the tensors of the head {} do not fit", saved.name)))?;
        }
        Ok(())
    }
}

fn name_of_cif() -> String {
    Cif.name().to_owned()
}

fn is_cif(name: &String) -> bool {
    *name == name_of_cif()
}

/// Moments and step counts of all parameter groups.
pub(super) fn restore(
    optimiser: &mut Optimiser,
    tensors: &mut BTreeMap<String, StateTensor>,
    steps: &BTreeMap<String, u32>,
) -> Result<(), TrainError> {
    for (parameter, moments) in optimiser.groups_mut() {
        let name = parameter.rate;
        let len = moments.first.len();
        moments.first = floats(tensors, &format!("adam.{name}.first"), len)?;
        moments.second = floats(tensors, &format!("adam.{name}.second"), len)?;
        moments.steps =
            *steps.get(name).ok_or_else(|| unusable(format!("the step count of {name} is missing")))?;
    }
    Ok(())
}

fn floats(
    tensors: &mut BTreeMap<String, StateTensor>,
    name: &str,
    len: usize,
) -> Result<Vec<f32>, TrainError> {
    match tensors.remove(name) {
        Some(StateTensor::F32(values)) if values.len() == len => Ok(values),
        _ => Err(unusable(format!("tensor {name} is missing or does not hold {len} floats"))),
    }
}

fn counters(
    tensors: &mut BTreeMap<String, StateTensor>,
    name: &str,
    len: usize,
) -> Result<Vec<u32>, TrainError> {
    match tensors.remove(name) {
        Some(StateTensor::U32(values)) if values.len() == len => Ok(values),
        _ => Err(unusable(format!("tensor {name} is missing or does not hold {len} counters"))),
    }
}
