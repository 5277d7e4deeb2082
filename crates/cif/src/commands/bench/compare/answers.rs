//! Questions in words, asked of the scenes of a comparison.

use std::collections::BTreeSet;
use std::path::Path;

use cif_bench::comparison::queries::{Answer, Answers, Queries, Rule};
use cif_bench::comparison::record::{Record, Row};
use cif_bench::comparison::tables::Missing;
use cif_bench::records::{Kept, Records};
use cif_dataset::MadeFrom;
use cif_field::{Checkpoint, Field};
use cif_render::InstanceImage;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_train::HeadName;
use cif_train::heads::Decoder;
use cif_train::metrics::{EvaluationOptions, evaluate, mask_ids};
use cif_vision::grounding::Thresholds;
use cif_vision::{Models, Prompter};

use super::capture::Capture;
use super::questions::{OfOneCapture, Question};
use super::runs::{Bench, Ended, id};
use crate::commands::shared::asked::{self, AskedScene};
use crate::commands::shared::scene;
use crate::detector::Detector;
use crate::error::Error;
use crate::interrupt;
use crate::mask_query::{Agreement, Found, FrameAgreement, GATE, Selection, agreement};
use crate::words;

/// Refuses models that cannot answer, before anything is trained.
pub(super) fn check(models: &Path) -> Result<(), Error> {
    let models = Models::open(models)?;
    Ok(Prompter::new(&models, &crate::pythons(), Thresholds::default()).open()?)
}

/// Asks the scene of every head that is done; those that answered before are not asked again.
pub(super) fn ask(
    bench: &mut Bench,
    captures: &[Capture],
    questions: &[OfOneCapture],
    heads: &[HeadName],
    folder: &Path,
    models: Option<&Path>,
) -> Result<Queries, Error> {
    let kept: Records<Answers> = Records::inside(folder)?;
    let mut queries = Queries {
        questions: questions.iter().map(OfOneCapture::titles).collect(),
        heads: heads.iter().map(|head| head.name().to_owned()).collect(),
        camera: captures.first().map(|capture| capture.config.head.camera.clone()).unwrap_or_default(),
        has_models: models.is_some(),
        without_maps: without_maps(questions, heads),
        ..Queries::default()
    };
    let stamp = models.map(|folder| Models::open(folder)?.stamp()).transpose()?;
    for of in questions {
        let Some(capture) = captures.iter().find(|capture| capture.name == of.capture) else { continue };
        let detector = models.map(|models| asked::models(models, &capture.dataset.root, None)).transpose()?;
        let is_of = |name: &str, head: &str| name == of.capture && queries.heads.iter().any(|h| h == head);
        let runs: Vec<Record> =
            bench.records.iter().filter(|run| is_of(&run.row.capture, &run.row.head)).cloned().collect();
        let untrained = bench.missing.iter().filter(|run| is_of(&run.capture, &run.head)).cloned();
        let untrained: Vec<Missing> = untrained.collect();
        queries.missing.extend(untrained);
        for run in runs {
            let row = &run.row;
            let name = id(&row.capture, row.seed, &row.head);
            let fingerprint = fingerprint(&run, of, stamp);
            let heading = format!("{}, seed {}: {}", row.capture, row.seed, row.head);
            match kept.find(&name, &fingerprint) {
                Kept::Good(known) => {
                    bench.show(&format!("{heading}: questions: kept, {}", summary(&known.answers)), true);
                    queries.answers.extend(known.answers);
                    continue;
                }
                Kept::Void(why) => bench.show(&format!("{heading}: questions: asked again: {why}"), true),
                Kept::Missing => {}
            }
            let answers = match bench.begins() {
                true => {
                    let asked = Asked { capture, row, questions: &of.questions, detector: detector.as_ref() };
                    let progress =
                        &|done: u64| bench.show_share(&heading, "questions", done, of.questions.len() as u64);
                    match asked.answers(&bench.runs.file(&format!("{name}.cif")), progress) {
                        Err(Error::Interrupted { .. }) => None,
                        answers => Some(answers?),
                    }
                }
                false => None,
            };
            let Some(answers) = answers else {
                bench.ended = bench.ended.or(Some(Ended::Interrupted));
                let (capture, head) = (row.capture.clone(), row.head.clone());
                queries.missing.push(Missing { capture, head, seed: row.seed });
                continue;
            };
            bench.show(&format!("{heading}: questions: {}", summary(&answers)), true);
            let answers = Answers { fingerprint, answers };
            kept.keep(&name, &answers)?;
            queries.answers.extend(answers.answers);
        }
    }
    Ok(queries)
}

/// Captures without feature maps, where others have some.
fn without_maps(questions: &[OfOneCapture], heads: &[HeadName]) -> Vec<String> {
    if !heads.contains(&HeadName::LangSplat) {
        return Vec::new();
    }
    let lacking = questions.iter().filter(|of| of.maps.is_none());
    lacking.map(|of| format!("{} has no feature maps", of.capture)).collect()
}

/// Everything that the answers of a run depend on.
fn fingerprint(run: &Record, of: &OfOneCapture, models: Option<u128>) -> MadeFrom {
    let mut made_from = run.fingerprint.clone();
    made_from.value("questions", &of.questions).value("models", models.map(|stamp| format!("{stamp:032x}")));
    made_from
}

/// A scene and the questions about its capture.
struct Asked<'a> {
    capture: &'a Capture,
    row: &'a Row,
    questions: &'a [Question],
    detector: Option<&'a Detector>,
}

impl Asked<'_> {
    /// Answers to all questions, by labels and, with models, by both protocols of masks.
    fn answers(&self, scene: &Path, progress: &dyn Fn(u64)) -> Result<Vec<Answer>, Error> {
        if self.row.head == HeadName::LangSplat.name() {
            return self.by_relevance(scene);
        }
        let (field, decoder) = scene::load_with_head(scene)?;
        let mut answers = self.by_labels(&field, decoder.as_ref())?;
        if let Some(detector) = self.detector {
            let mut scene = AskedScene::new(&field, &self.capture.dataset);
            let trained = self.capture.dataset.train_frames();
            for (done, question) in self.questions.iter().enumerate() {
                progress(done as u64);
                let detected = scene.detect(detector, &question.text, &trained)?;
                let found = scene.reproject(&detected.masks, Selection::Instance)?;
                let scores = self.compare(question, |frame| scene.reprojected(&found, GATE, frame))?;
                answers.push(self.answer(question, Rule::Reproject, chosen(&found), &scores));
                let (found, _) = scene.group(detector, &question.text)?;
                let scores = self.compare(question, |frame| scene.grouped(&found, frame))?;
                answers.push(self.answer(question, Rule::Grouping, chosen(&found), &scores));
            }
        }
        let place = |answer: &Answer| self.questions.iter().position(|asked| asked.text == answer.question);
        answers.sort_by_key(|answer| (place(answer), answer.by));
        Ok(answers)
    }

    /// Pixels of the instances whose names have the most words of a question, as the scene shows them.
    fn by_labels(&self, field: &Field, decoder: Option<&Decoder>) -> Result<Vec<Answer>, Error> {
        let chosen: Vec<BTreeSet<u16>> =
            self.questions.iter().map(|question| named(field, &question.text)).collect();
        let mut frames: Vec<Vec<FrameAgreement>> = vec![Vec::new(); self.questions.len()];
        let options = EvaluationOptions { decoder, ..EvaluationOptions::held_out(field) };
        evaluate::<Error>(field, self.capture.scored(), &options, |view| {
            interrupt::go_on()?;
            // A pixel that is mostly background is nobody's: all pixels are counted.
            let labels = view.rendered.instances.as_ref().map(InstanceImage::foreground_label);
            let (Some(truth), Some(labels)) = (&view.truth.mask, labels) else { return Ok(()) };
            let predicted = mask_ids(field, &labels);
            for ((question, chosen), frames) in self.questions.iter().zip(&chosen).zip(&mut frames) {
                let rendered = predicted.map(|id| chosen.contains(id));
                let truth = truth.map(|id| question.answer.contains(id));
                frames.push(FrameAgreement::of(&view.frame.name, &rendered, &truth));
            }
            Ok(())
        })?;
        let answered = self.questions.iter().zip(chosen).zip(frames);
        let answer = |((question, chosen), frames): ((&Question, BTreeSet<u16>), _)| {
            self.answer(question, Rule::Labels, chosen, &agreement(frames))
        };
        Ok(answered.map(answer).collect())
    }

    /// Pixels whose features are relevant for a question.
    fn by_relevance(&self, scene: &Path) -> Result<Vec<Answer>, Error> {
        let Checkpoint { field, head, .. } = Checkpoint::load(scene).map_err(Error::plain)?;
        let head = head.ok_or_else(|| Error::plain(format!("{} has no head", scene.display())))?;
        let decoder = Decoder::of_scene(&field, &head).map_err(Error::plain)?;
        let (settings, dataset) = (scene::render_settings(&field), self.capture.scored());
        let mut renderer = Renderer::new(SimdLevel::Auto);
        let mut frames: Vec<Vec<FrameAgreement>> = vec![Vec::new(); self.questions.len()];
        for index in dataset.val_frames() {
            interrupt::go_on()?;
            let Some(mask) = dataset.load_mask(index)? else { continue };
            let frame = &dataset.frames[index];
            let features = decoder.blended(&mut renderer, &field, (&frame.camera, frame.time), &settings);
            for (question, frames) in self.questions.iter().zip(&mut frames) {
                let Some(codes) = &question.codes else { continue };
                let truth = mask.map(|id| question.answer.contains(id));
                frames.push(FrameAgreement::of(&frame.name, &codes.answer(&features), &truth));
            }
        }
        let answer =
            |(question, frames)| self.answer(question, Rule::Relevance, BTreeSet::new(), &agreement(frames));
        Ok(self.questions.iter().zip(frames).map(answer).collect())
    }

    /// Compares what `render` makes of the held-out frames that have a mask with the instances that are the answer.
    fn compare(
        &self,
        question: &Question,
        mut render: impl FnMut(usize) -> cif_geometry::PixelGrid<bool>,
    ) -> Result<Agreement, Error> {
        let dataset = self.capture.scored();
        let mut frames = Vec::new();
        for index in dataset.val_frames() {
            interrupt::go_on()?;
            let Some(mask) = dataset.load_mask(index)? else { continue };
            let truth = mask.map(|id| question.answer.contains(id));
            frames.push(FrameAgreement::of(&dataset.frames[index].name, &render(index), &truth));
        }
        Ok(agreement(frames))
    }

    fn answer(&self, question: &Question, by: Rule, chosen: BTreeSet<u16>, scores: &Agreement) -> Answer {
        Answer {
            capture: self.row.capture.clone(),
            head: self.row.head.clone(),
            seed: self.row.seed,
            question: question.text.clone(),
            by,
            macc: scores.macc,
            miou: scores.miou,
            frames: scores.frames,
            empty_frames: scores.empty_frames,
            chosen: chosen.into_iter().collect(),
        }
    }
}

/// Ids of the instances that have the most words of a text in their names.
fn named(field: &Field, text: &str) -> BTreeSet<u16> {
    let asked = words::words(text);
    let shares: Vec<f64> = field
        .instances
        .iter()
        .map(|instance| {
            let names = [&instance.label, &instance.category].into_iter().chain(instance.taxonomies.values());
            words::share(&asked, names.map(String::as_str))
        })
        .collect();
    let best = field.instances.iter().zip(words::best(&shares));
    best.filter(|(_, is_best)| *is_best).map(|(instance, _)| instance.id).collect()
}

fn chosen(found: &Found) -> BTreeSet<u16> {
    found.votes.iter().filter(|vote| vote.chosen).map(|vote| vote.id).collect()
}

/// Answers in a line.
fn summary(answers: &[Answer]) -> String {
    let of_rule = |rule: Rule| {
        let scores: Vec<f64> =
            answers.iter().filter(|answer| answer.by == rule).filter_map(|answer| answer.miou).collect();
        let mean = scores.iter().sum::<f64>() / scores.len() as f64;
        (!scores.is_empty()).then(|| format!("mIoU {mean:.2} % by {}", rule.name()))
    };
    let rules: Vec<String> = Rule::ALL.into_iter().filter_map(of_rule).collect();
    if rules.is_empty() { "no held-out frame shows an answer".to_owned() } else { rules.join(", ") }
}
