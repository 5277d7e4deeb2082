//! The runs of a comparison, one after the other: what is kept is not done again.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cif_bench::comparison::Contender;
use cif_bench::comparison::record::Record;
use cif_bench::comparison::run::{HeadRun, Subject, settings};
use cif_bench::comparison::tables::Missing;
use cif_bench::records::{Kept, Records};
use cif_dataset::MadeFrom;
use cif_geometry::PixelGrid;
use cif_train::metrics::FrameView;
use cif_train::{HeadName, Stop, TrainConfig};

use super::capture::Capture;
use super::options::Iterations;
use crate::commands::shared::table::number;
use crate::error::Error;
use crate::interrupt;
use crate::pictures::{Picture, instance_picture, rgb_picture};

/// Why no new run begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ended {
    Interrupted,
    OutOfTime,
}

/// A comparison under way.
pub(super) struct Bench {
    iterations: Iterations,
    pub(super) runs: Records<Record>,
    /// Folders of feature maps, by capture.
    maps: BTreeMap<String, PathBuf>,
    /// Runs that are done, in the order of tables.
    pub(super) records: Vec<Record>,
    /// Runs that are not.
    pub(super) missing: Vec<Missing>,
    pub(super) ended: Option<Ended>,
    /// Time after which no run begins; `None` without a budget.
    deadline: Option<Instant>,
    is_terminal: bool,
    /// The only part that is done.
    pub(super) only: Option<String>,
}

impl Bench {
    pub(super) fn new(
        runs: Records<Record>,
        iterations: Iterations,
        budget: Option<Duration>,
        maps: BTreeMap<String, PathBuf>,
    ) -> Self {
        Self {
            iterations,
            maps,
            runs,
            records: Vec::new(),
            missing: Vec::new(),
            ended: None,
            deadline: budget.and_then(|budget| Instant::now().checked_add(budget)),
            is_terminal: std::io::stderr().is_terminal(),
            only: None,
        }
    }

    /// Runs everything on all captures and seeds.
    pub(super) fn compare_all(
        &mut self,
        captures: &[Capture],
        seeds: u32,
        contenders: &[Contender],
    ) -> Result<(), Error> {
        for capture in captures {
            for seed in 0..u64::from(seeds) {
                let mut config = capture.config.clone();
                config.seed += seed;
                let subject = Subject {
                    capture: &capture.name,
                    dataset: &capture.dataset,
                    scored: capture.scored(),
                    config: &config,
                };
                self.compare(&subject, contenders)?;
            }
        }
        Ok(())
    }

    /// True where a part is to be done.
    fn is_requested(&self, id: &str) -> bool {
        self.only.as_ref().is_none_or(|only| only == id)
    }

    /// Runs everything on a capture with a seed. Once the comparison has ended, what is kept is taken and the rest
    /// noted as missing.
    pub(super) fn compare(&mut self, subject: &Subject<'_>, contenders: &[Contender]) -> Result<(), Error> {
        let stop = Stop::when(interrupt::requested);
        let heading = format!("{}, seed {}", subject.capture, subject.config.seed);
        let mut base = None;
        if self.only.as_ref() == Some(&subject.id()) {
            base = self.reconstruct(subject, &heading, &stop)?;
        }
        let inputs = self.inputs(subject, contenders);
        for contender in contenders {
            if !self.is_requested(&id(subject.capture, subject.config.seed, contender.name())) {
                continue;
            }
            let Some(config) = self.settings(subject, *contender) else { continue };
            let id = id(subject.capture, config.seed, contender.name());
            let mut fingerprint = inputs.clone();
            fingerprint.value("base", subject.config).value("settings", &config);
            if config.head.name == HeadName::LangSplat {
                let known = self.runs.known(&id);
                fingerprint.folder("feature map", Path::new(&config.head.maps), known.as_ref());
            }
            match self.runs.find(&id, &fingerprint) {
                Kept::Good(record) => {
                    self.show(&format!("{heading}: {}: kept, {}", contender.name(), summary(&record)), true);
                    self.records.push(record);
                    continue;
                }
                Kept::Void(why) => {
                    self.show(&format!("{heading}: {}: measured again: {why}", contender.name()), true);
                }
                Kept::Missing => {}
            }
            if base.is_none() && self.begins() {
                base = self.reconstruct(subject, &heading, &stop)?;
            }
            let trained = match base.as_ref().filter(|_| self.begins()) {
                Some(base) => {
                    let progress: &mut dyn FnMut(u64, u64) =
                        &mut |done, whole| self.show_share(&heading, contender.name(), done, whole);
                    let head = HeadRun { id: &id, config: &config };
                    let trained = subject.train(&self.runs, &head, base, &stop, progress, &draw)?;
                    if trained.is_none() {
                        self.ended = Some(Ended::Interrupted);
                    }
                    trained
                }
                None => None,
            };
            let Some(mut record) = trained else {
                self.missing.push(Missing {
                    capture: subject.capture.to_owned(),
                    head: contender.name().to_owned(),
                    seed: config.seed,
                });
                continue;
            };
            record.fingerprint = fingerprint;
            record.row.head = contender.name().to_owned();
            self.runs.keep(&id, &record)?;
            self.show(&format!("{heading}: {}: {}", contender.name(), summary(&record)), true);
            self.records.push(record);
        }
        Ok(())
    }

    /// The reconstruction of a capture with a seed; `None` when interrupted.
    fn reconstruct(
        &mut self,
        subject: &Subject<'_>,
        heading: &str,
        stop: &Stop,
    ) -> Result<Option<cif_field::Checkpoint>, Error> {
        let progress = &mut |done, whole| self.show_share(heading, "reconstruction", done, whole);
        let base = subject.reconstruct(&self.runs, stop, progress)?;
        self.ended = base.is_none().then_some(Ended::Interrupted);
        Ok(base)
    }

    /// Inputs that all runs on a capture with a seed are made from.
    fn inputs(&self, subject: &Subject<'_>, contenders: &[Contender]) -> MadeFrom {
        let id = |contender: &Contender| id(subject.capture, subject.config.seed, contender.name());
        let known = contenders.iter().find_map(|contender| self.runs.known(&id(contender)));
        let mut inputs = MadeFrom::new();
        inputs.value("version", env!("CARGO_PKG_VERSION")).capture(subject.dataset, known.as_ref());
        let mut scored = MadeFrom::new();
        scored.capture(subject.scored, known.as_ref());
        inputs.extend(&scored, " in what is scored");
        inputs
    }

    /// Settings of a run; those of the steps of the method hold for the method. `None` where the capture has not what a
    /// head learns.
    fn settings(&self, subject: &Subject<'_>, contender: Contender) -> Option<TrainConfig> {
        let steps = match contender {
            Contender::Head(HeadName::Cif) | Contender::Without(_) => subject.config.stages.instance,
            Contender::Head(head) => self.iterations.of(head),
        };
        let mut config = settings(subject.config, contender.head(), steps);
        if let Contender::Without(ablation) = contender {
            config.instance.ablate.insert(ablation);
        }
        if config.head.name == HeadName::LangSplat {
            config.head.maps = self.maps.get(subject.capture)?.display().to_string();
        }
        Some(config)
    }

    /// True while new runs begin.
    pub(super) fn begins(&mut self) -> bool {
        if self.ended.is_none() && self.deadline.is_some_and(|deadline| Instant::now() >= deadline) {
            self.ended = Some(Ended::OutOfTime);
        }
        self.ended.is_none()
    }

    /// Tells how far a run is.
    pub(super) fn show_share(&self, heading: &str, what: &str, done: u64, whole: u64) {
        self.show(&format!("{heading}: {what}: {} %", 100 * done / whole.max(1)), false);
    }

    pub(super) fn show(&self, text: &str, ends: bool) {
        // Overwritten on terminals; elsewhere only what is finished.
        if self.is_terminal {
            eprint!("\r\x1b[K{text}{}", if ends { "\n" } else { "" });
            let _ = std::io::stderr().flush();
        } else if ends {
            crate::messages::outcome!("{text}");
        }
    }
}

/// Name of a run: that of its scene and of its record, without extension.
pub(super) fn id(capture: &str, seed: u64, contender: &str) -> String {
    format!("{capture}.seed{seed}.{contender}")
}

/// Colour of pixels without a label in pictures of labels.
pub(super) fn empty() -> [u8; 3] {
    labels(&PixelGrid::filled(1, 1, 0)).pixels[0]
}

/// Labels in full colour.
pub(super) fn labels(ids: &PixelGrid<u16>) -> Picture {
    instance_picture(ids, &PixelGrid::filled(ids.width, ids.height, 1.0))
}

/// Pictures of a view for the page.
fn draw(view: &FrameView<'_>) -> Vec<(&'static str, Picture)> {
    let mut pictures = vec![("", rgb_picture(&view.rendered.color)), (".truth", view.truth.image.clone())];
    pictures.extend(view.truth.mask.as_ref().map(|mask| (".mask", labels(mask))));
    pictures.extend(view.predicted.map(|ids| (".instances", labels(ids))));
    pictures
}

/// A record in a line.
fn summary(record: &Record) -> String {
    let row = &record.row;
    format!(
        "PQ {} %, IoU {} %, mAcc-pix {} %, mIoU {} %, {} dB, {} Gaussians, {:.1} s",
        number(row.panoptic, 2),
        number(row.iou, 2),
        number(row.macc_pix, 2),
        number(row.miou, 2),
        number(row.psnr, 2),
        row.gaussians,
        row.seconds
    )
}
