//! Training with a callback.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use cif::Error;
use cif::backend::Backend;
use cif::destination::{Destination, Existing};
use cif::settings::Layers;
use cif_dataset::{Layout, OpenOptions};
use cif_field::Checkpoint;
use cif_train::plan::Basis;
use cif_train::{
    Control, EffectChoice, EffectPlan, Phase, Phases, Preset, Start, Stop, TrainConfig, TrainEvent, Trainer,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};
use serde_json::Value;

use crate::dataset::Dataset;
use crate::error::cif_error;
use crate::field::Field;
use crate::{arrays, beside};

/// A capture, opened or by its folder.
#[derive(FromPyObject)]
pub(crate) enum Capture<'py> {
    /// Opened.
    Opened(PyRef<'py, Dataset>),
    /// Its folder.
    Folder(PathBuf),
}

/// Settings as they were typed.
struct Typed {
    preset: Preset,
    effects: Option<EffectChoice>,
    /// Dotted keys and values.
    settings: Vec<(String, toml::Value)>,
}

impl Typed {
    /// The settings over a base.
    fn over(&self, base: TrainConfig) -> Result<TrainConfig, Error> {
        let mut layers = Layers::new(base);
        for (key, value) in &self.settings {
            layers.typed("settings", key, value.clone())?;
        }
        layers.validated()
    }

    /// The settings before anything is known of the capture.
    fn alone(&self, layout: Layout) -> Result<TrainConfig, Error> {
        self.over(TrainConfig::preset(self.preset, layout))
    }

    /// The settings on a capture, and what it calls for.
    fn on(
        &self,
        dataset: &cif_dataset::Dataset,
        phases: &Phases,
    ) -> Result<(TrainConfig, EffectPlan), Error> {
        let basis = if self.preset == Preset::Paper { Basis::All } else { Basis::Auto };
        let choice = self.effects.clone().unwrap_or(EffectChoice { basis, ..EffectChoice::default() });
        let config = self.alone(dataset.layout)?;
        let plan = EffectPlan::watched(dataset, &config, &choice, phases).map_err(Error::plain)?;
        let mut base = TrainConfig::preset(self.preset, dataset.layout);
        plan.apply(&mut base);
        Ok((self.over(base)?, plan))
    }
}

/// Dotted keys of dictionaries in dictionaries.
fn flatten(prefix: &str, value: Value, found: &mut Vec<(String, toml::Value)>) -> PyResult<()> {
    match value {
        Value::Object(entries) => {
            for (key, value) in entries {
                let key = if prefix.is_empty() { key } else { format!("{prefix}.{key}") };
                flatten(&key, value, found)?;
            }
            Ok(())
        }
        Value::Null => Err(PyValueError::new_err(format!("settings: {prefix} is None; leave it away"))),
        value => {
            let value = toml::Value::try_from(value).map_err(cif_error)?;
            found.push((prefix.to_owned(), value));
            Ok(())
        }
    }
}

fn named<T: serde::de::DeserializeOwned>(what: &str, name: &str, known: &str) -> PyResult<T> {
    serde_json::from_value(Value::String(name.to_owned()))
        .map_err(|_| PyValueError::new_err(format!("{what} '{name}': choose {known}")))
}

fn backend_named(name: &str) -> PyResult<Backend> {
    [Backend::Auto, Backend::Cpu, Backend::Wgpu]
        .into_iter()
        .find(|backend| backend.name() == name)
        .ok_or_else(|| PyValueError::new_err(format!("backend '{name}': choose auto, cpu or wgpu")))
}

/// A state to go on with.
fn load_state(path: &Path) -> Result<Checkpoint, Error> {
    let checkpoint = Checkpoint::load(path).map_err(Error::plain)?;
    if checkpoint.training.is_none() {
        return Err(Error::plain(format!("{} is finished: there is nothing to resume", path.display())));
    }
    Ok(checkpoint)
}

/// Everything that a run needs, so that it can go to another thread.
struct Run {
    dataset: Result<(cif_dataset::Dataset, Option<u32>), PathBuf>,
    output: Option<PathBuf>,
    typed: Typed,
    backend: Backend,
    resume: bool,
    force: bool,
}

impl Run {
    fn run(
        self,
        phases: &Phases,
        observe: &mut dyn FnMut(&TrainEvent) -> Control,
    ) -> Result<cif_field::Field, Error> {
        let _run = phases.enter(Phase::Other, 0);
        let existing = if self.force || self.resume { Existing::Replace } else { Existing::Keep };
        let mut destination =
            self.output.as_deref().map(|path| Destination::open(path, existing)).transpose()?;
        let state = match (&self.output, self.resume) {
            (Some(path), true) => Some(load_state(path)?),
            _ => None,
        };
        let gpu = self.backend.open()?;
        let (mut dataset, downscale) = match self.dataset {
            Ok(opened) => opened,
            Err(folder) => {
                let downscale = match &state {
                    Some(state) => {
                        let config = cif_train::metrics::training_config(&state.field);
                        config.and_then(|config| config.downscale)
                    }
                    None => {
                        let layout = OpenOptions::default().layout_of(&folder).map_err(Error::plain)?;
                        self.typed.alone(layout)?.downscale
                    }
                };
                let window = state.as_ref().and_then(|state| state.field.record.window);
                let options = OpenOptions { downscale, window, ..OpenOptions::default() };
                let _phase = phases.enter(Phase::Open, 0);
                (cif_dataset::Dataset::open(&folder, &options).map_err(Error::plain)?, downscale)
            }
        };
        let begun = |dataset| Start { dataset, phases: phases.clone() };
        let mut trainer = match state {
            Some(state) => {
                if cif_train::metrics::training_config(&state.field)
                    .is_some_and(|config| config.model.triangulate)
                {
                    cif::starting_points::find(&mut dataset, phases)?;
                }
                let trainer = Trainer::resume(begun(dataset), state).map_err(Error::plain)?;
                if let Some(destination) = &mut destination {
                    destination.resumes(trainer.config());
                }
                trainer
            }
            None => {
                let is_requested = self.typed.alone(dataset.layout)?.model.triangulate;
                let is_found = !is_requested || cif::starting_points::find(&mut dataset, phases)?;
                let (mut config, plan) = self.typed.on(&dataset, phases)?;
                config.downscale = downscale;
                config.model.triangulate &= is_found;
                if let Some(destination) = &destination {
                    destination.check_settings(&config)?;
                }
                let mut trainer = Trainer::new(begun(dataset), config).map_err(Error::plain)?;
                trainer.record_effects(serde_json::json!(plan));
                trainer
            }
        };
        self.backend.apply(gpu.as_ref(), &mut trainer)?;
        cif::training::run(&mut trainer, destination.as_mut(), &mut |event, _| observe(event))?;
        Ok(trainer.into_field())
    }
}

/// Train a field on a capture, and return it.
///
/// dataset is an opened capture or its folder. With output, a .cif file, the run is saved there every five minutes,
/// at the end of each stage and in the end, its settings next to it; without, it is only returned.
///
/// preset is "draft", "standard" (the default), "best" or "paper"; effects says which effects are trained, "auto" (as the
/// capture calls for), "all" or "none", then single ones on or off, as in "auto,-instances". settings are single
/// settings by their keys in the settings file, dotted or as dictionaries: {"stages.fine": 500} or {"stages":
/// {"fine": 500}}. seed makes runs repeatable: same seed and settings, same field. backend is "cpu", "wgpu" (a GPU)
/// or "auto".
///
/// callback is called in this thread with a dictionary for each event of the run; its "event" is "stage_started",
/// "stage_ended" (stage, wall_s), "step" (every report.step_every steps: stage, iteration, iterations, loss, psnr,
/// gaussians, eta_s), "evaluated", "note", "warning", "finished" and more. Work without steps is reported as
/// "phase_started", "phase_progress" (phase, done, total, elapsed_s, eta_s) and "phase_ended" (phase, wall_s, cpu_s),
/// from the opening of the capture on. When it returns False the run stops and the field as it is then is returned;
/// CifError is raised where it stops before the first step. An exception in it stops the run and is raised, as is
/// KeyboardInterrupt on Ctrl-C. In all three cases the run is saved to output first, and resume=True goes on with it,
/// with the settings of the file.
///
/// An output that exists is refused without force or resume. Raises CifError when the capture, a setting or the
/// output is not as it should be. Other Python threads run meanwhile.
#[pyfunction]
#[pyo3(signature = (dataset, output=None, *, preset=None, effects=None, settings=None, seed=None, backend="cpu",
                    callback=None, resume=false, force=false))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of a function")]
pub(crate) fn train(
    py: Python<'_>,
    dataset: Capture<'_>,
    output: Option<PathBuf>,
    preset: Option<&str>,
    effects: Option<&str>,
    settings: Option<Bound<'_, PyDict>>,
    seed: Option<u32>,
    backend: &str,
    callback: Option<Bound<'_, PyAny>>,
    resume: bool,
    force: bool,
) -> PyResult<Field> {
    if resume && (preset.is_some() || effects.is_some() || settings.is_some() || seed.is_some()) {
        return Err(PyValueError::new_err("resume: preset, effects, settings and seed come from the output"));
    }
    if resume && output.is_none() {
        return Err(PyValueError::new_err("resume: name the output of the run to continue"));
    }
    let mut flat = Vec::new();
    if let Some(settings) = settings {
        flatten("", arrays::from_python("settings", &settings)?, &mut flat)?;
    }
    if let Some(seed) = seed {
        flat.push(("seed".to_owned(), i64::from(seed).into()));
    }
    let dataset = match dataset {
        Capture::Opened(opened) => {
            if flat.iter().any(|(key, _)| key == "downscale") {
                return Err(PyValueError::new_err("downscale is given where the capture is opened"));
            }
            Ok((opened.inner.clone(), opened.downscale))
        }
        Capture::Folder(folder) => Err(folder),
    };
    let requested = Arc::new(AtomicBool::new(false));
    let run = Run {
        dataset,
        output,
        typed: Typed {
            preset: named("preset", preset.unwrap_or("standard"), "draft, standard, best or paper")?,
            effects: effects.map(str::parse).transpose().map_err(PyValueError::new_err)?,
            settings: flat,
        },
        backend: backend_named(backend)?,
        resume,
        force,
    };
    let stop = Stop::when({
        let requested = Arc::clone(&requested);
        move || requested.load(Ordering::Relaxed)
    });
    let answer = |event: TrainEvent| -> PyResult<Control> {
        let Some(callback) = &callback else { return Ok(Control::Continue) };
        let answer = callback.call1((arrays::to_python(py, &event)?,))?;
        let stops = answer.cast::<PyBool>().is_ok_and(|answer| !answer.is_true());
        Ok(if stops { Control::Stop } else { Control::Continue })
    };
    let is_watched = callback.is_some();
    let trained = beside::run(
        py,
        || requested.store(true, Ordering::Relaxed),
        answer,
        |questions| {
            let ask = move |event: &TrainEvent| {
                is_watched.then(|| questions.ask(event.clone())).flatten().unwrap_or_default()
            };
            let ask = Arc::new(ask);
            let phases = Phases::from(stop).reported_to({
                let ask = Arc::clone(&ask);
                move |event| ask(event)
            });
            run.run(&phases, &mut |event| ask(event)).map_err(|error| error.with_help())
        },
    )?;
    Ok(Field::new(trained.map_err(cif_error)?))
}
