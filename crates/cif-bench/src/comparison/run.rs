//! A run of a comparison: the reconstruction of a capture with a seed, or a head on it.

use cif_dataset::{Dataset, MadeFrom};
use cif_field::Checkpoint;
use cif_train::metrics::{EvaluationError, EvaluationOptions, FrameView, evaluate, mask_ids};
use cif_train::{HeadName, Stage, Start, Stop, TrainConfig, Trainer};

use super::record::{Record, Row};
use crate::accuracy::measure::{Draw, save, shown_frame};
use crate::error::Error;
use crate::records::Records;
use crate::training::Run;

/// An error that evaluation can pass on.
struct Failure(Error);

impl From<EvaluationError> for Failure {
    fn from(error: EvaluationError) -> Self {
        Self(Error::plain(error))
    }
}

/// A capture with a seed.
#[derive(Clone, Copy)]
pub struct Subject<'a> {
    /// Name of the capture.
    pub capture: &'a str,
    /// The capture.
    pub dataset: &'a Dataset,
    /// The capture with the masks that scores are taken on.
    pub scored: &'a Dataset,
    /// Settings of the reconstruction; their seed is the seed.
    pub config: &'a TrainConfig,
}

/// A head that is trained on a reconstruction.
#[derive(Clone, Copy)]
pub struct HeadRun<'a> {
    /// Names of its files begin with it.
    pub id: &'a str,
    /// Settings, among them the head.
    pub config: &'a TrainConfig,
}

/// Settings of the run of a head on a reconstruction: `steps` of the instance stage, with learning rates placed as
/// the reconstruction has them.
#[must_use]
pub fn settings(base: &TrainConfig, head: HeadName, steps: u32) -> TrainConfig {
    let mut config = base.clone();
    config.rates.schedule_steps = match base.rates.schedule_steps {
        0 => base.fine_iterations() + base.stages.instance,
        steps => steps,
    };
    config.head.name = head;
    config.stages.instance = steps;
    config
}

impl Subject<'_> {
    /// File name of its reconstruction.
    #[must_use]
    pub fn id(&self) -> String {
        format!("{}.seed{}.base", self.capture, self.config.seed)
    }

    /// Reconstructs the capture up to its instances, going on where that was interrupted; `None` when `stop` says so.
    ///
    /// # Errors
    /// When a setting cannot work, or training fails.
    pub fn reconstruct(
        &self,
        runs: &Records<Record>,
        stop: &Stop,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Option<Checkpoint>, Error> {
        let path = runs.file(&format!("{}.cif", self.id()));
        let known = runs.file(&format!("{}.settings.json", self.id()));
        let kept = std::fs::read(&known).ok().and_then(|text| serde_json::from_slice::<MadeFrom>(&text).ok());
        let mut made_from = MadeFrom::new();
        made_from.value("version", env!("CARGO_PKG_VERSION")).value("settings", self.config);
        made_from.capture(self.dataset, kept.as_ref());
        if path.is_file() && kept.as_ref() == Some(&made_from) {
            return Checkpoint::load(&path).map(Some).map_err(Error::plain);
        }
        let run = Run {
            partial: &runs.file(&format!("{}.partial.cif", self.id())),
            dataset: self.dataset,
            config: self.config,
            until: Some(Stage::Identity),
        };
        let begin = |start: Start| Trainer::new(start, self.config.clone());
        let Some(trainer) = run.train(&begin, stop, progress)? else { return Ok(None) };
        if trainer.stage() != Stage::Identity {
            return Err(Error::plain(format!(
                "{}: no training frame has a labelled pixel, so there is nothing to compare",
                self.dataset.root.display()
            )));
        }
        let checkpoint = trainer.checkpoint(true);
        checkpoint.save(&path).map_err(Error::plain)?;
        let text = serde_json::to_vec(&made_from).expect("plain data");
        crate::error::write_file(&known, &text)?;
        Ok(Some(checkpoint))
    }

    /// Trains a head on a reconstruction, going on where that was interrupted, and scores it; its scene is kept as
    /// `ID.cif`. `None` when `stop` says so.
    ///
    /// # Errors
    /// When a setting cannot work, training fails, or a file cannot be read or written.
    pub fn train(
        &self,
        runs: &Records<Record>,
        head: &HeadRun<'_>,
        reconstruction: &Checkpoint,
        stop: &Stop,
        progress: &mut dyn FnMut(u64, u64),
        draw: Draw<'_>,
    ) -> Result<Option<Record>, Error> {
        let HeadRun { id, config } = *head;
        let run = Run {
            partial: &runs.file(&format!("{id}.partial.cif")),
            dataset: self.dataset,
            config,
            until: None,
        };
        let base = format!("{}.cif", self.id());
        let begin = |start: Start| Trainer::from_scene(start, config.clone(), reconstruction.clone(), &base);
        let Some(trainer) = run.train(&begin, stop, progress)? else { return Ok(None) };
        let scene = trainer.checkpoint(false);
        scene.save(runs.file(&format!("{id}.cif"))).map_err(Error::plain)?;
        let (field, decoder) = (&scene.field, trainer.decoder());
        let options = EvaluationOptions { decoder: decoder.as_ref(), ..EvaluationOptions::held_out(field) };
        let shown = shown_frame(self.dataset).map(|index| self.dataset.frames[index].name.clone());
        let mut pictures = Vec::new();
        let evaluation = evaluate::<Failure>(field, self.scored, &options, |view| {
            if Some(&view.frame.name) != shown.as_ref() {
                return Ok(());
            }
            // Pixels that are mostly background have no label in pictures; decoders of pixels decide that themselves.
            let rendered = view.rendered.instances.as_ref().filter(|_| decoder.is_none());
            let shown = rendered.map(|instances| mask_ids(field, &instances.foreground_label()));
            let view = FrameView { predicted: shown.as_ref().or(view.predicted), ..view };
            for (suffix, picture) in draw(&view) {
                let name = format!("{id}{suffix}.png");
                save(&runs.file(&name), &picture).map_err(Failure)?;
                pictures.push(name);
            }
            Ok(())
        })
        .map_err(|Failure(error)| error)?;
        let scores = &evaluation.overall;
        let notes = field.record.run.as_ref().map(|run| &run.notes);
        let of_stage = |name: &str, stage: Stage| {
            notes.and_then(|notes| notes.get(name)?.get(stage.name())?.as_f64()).unwrap_or(0.0)
        };
        // Rows are estimated for the method alone; other heads have no use for them.
        let is_cif = config.head.name == HeadName::Cif;
        let identities = if is_cif { of_stage("cpu_s_by_phase", Stage::Identity) } else { 0.0 };
        Ok(Some(Record {
            row: Row {
                capture: self.capture.to_owned(),
                head: String::new(),
                seed: config.seed,
                panoptic: scores.panoptic.quality,
                iou: scores.panoptic.iou,
                macc_pix: scores.instance.macc_pix,
                macc_inst: scores.instance.macc_inst,
                miou: scores.instance.miou,
                psnr: scores.psnr,
                ssim: scores.ssim,
                gaussians: field.len(),
                seconds: identities + of_stage("cpu_s_by_phase", Stage::Instance),
            },
            steps: of_stage("iterations_by_stage", Stage::Instance) as u64,
            pictures,
            ..Record::default()
        }))
    }
}
