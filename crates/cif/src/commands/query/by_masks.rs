//! `cif query --masks` and `--prompt`: the objects that a 2D detector shows.

mod report;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::masks::found_masks;
use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use cif_vision::Models;
use cif_vision::grounding::FoundBox;
use clap::{Args, ValueEnum};

use super::Query;
use crate::commands::{CaptureOptions, FrameOptions, LayoutName, print_misfits, print_warnings, scene};
use crate::detector::{Asked, Detector};
use crate::error::Error;
use crate::formats;
use crate::mask_query::{self, Agreement, Found, FoundMasks, GATE, Selection, agreement, grouping};
use crate::pictures::{rgb_picture, save_grey};
use crate::{interrupt, output};

/// Folder inside a capture that keeps masks of models. Readers of captures pass over hidden folders.
const CACHE: &str = ".cif-cache";

/// Masks that a detector found, and their use.
#[derive(Debug, Args)]
#[command(next_help_heading = "By masks")]
pub(super) struct ByMasks {
    /// Folder of what a detector found on frames of the capture
    #[arg(
        long,
        value_name = "DIR",
        requires = "capture",
        conflicts_with_all = ["label", "taxonomy", "point", "region", "time", "interval", "prompt"]
    )]
    masks: Option<PathBuf>,
    /// Words for the detector
    #[arg(
        long,
        value_name = "TEXT",
        requires = "capture",
        conflicts_with_all = ["label", "taxonomy", "point", "region", "time", "interval", "text"]
    )]
    prompt: Option<String>,
    /// Command that reads the frames in {frames} and writes the masks of {prompt} into {masks}; without
    /// these words the folder of frames, the folder of masks and the prompt are its last arguments
    #[arg(long, value_name = "CMD", requires = "prompt", conflicts_with = "models")]
    detector: Option<String>,
    /// Keep the masks that models make in this folder, for the next time [default: .cif-cache in the capture]
    #[arg(long, value_name = "DIR", requires = "prompt", requires = "models")]
    cache: Option<PathBuf>,
    /// Rule by which instances are chosen
    #[arg(long, value_name = "RULE", default_value = "reproject")]
    protocol: Protocol,
    /// Capture that the masks belong to
    #[arg(long, value_name = "CAPTURE")]
    capture: Option<PathBuf>,
    /// Gaussians that make up the result
    #[arg(long, value_name = "SET", default_value = "instance")]
    select: Select,
    /// Least foreground of a pixel of the rendered masks, 0 to 1: below it a pixel is background. The paper has no
    /// such gate (0) [default: 0.5]
    #[arg(long, value_name = "SHARE", value_parser = share, requires = "eval")]
    foreground: Option<f32>,
    /// Render the result from held-out frames and compare it with the masks there
    #[arg(long, requires = "capture")]
    eval: bool,
    /// Write the rendered masks of --eval into this folder
    #[arg(short, long, value_name = "DIR", requires = "eval")]
    output: Option<PathBuf>,
    /// Reduce images by 1, 2, 4, ... [default: as the scene was trained]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    downscale: Option<u32>,
    /// Read the capture as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    layout: Option<LayoutName>,
    #[command(flatten)]
    frames: FrameOptions,
}

/// Which Gaussians make up the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Select {
    /// Those of the chosen instances
    Instance,
    /// Those inside the masks themselves
    Gaussian,
    /// Those that are both: a part of an instance
    Both,
}

/// Rule by which instances are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Protocol {
    /// Those that lie mostly inside the masks of the training frames
    Reproject,
    /// Those with more than 0.7 of their pixels inside the mask of the first held-out view as it is rendered; their
    /// answer in a view are the pixels with a probability above 0.2, as in Gaussian Grouping
    Grouping,
}

impl Protocol {
    /// As it is typed.
    fn name(self) -> &'static str {
        match self {
            Self::Reproject => "reproject",
            Self::Grouping => "grouping",
        }
    }
}

impl From<Select> for Selection {
    fn from(select: Select) -> Self {
        match select {
            Select::Instance => Self::Instance,
            Select::Gaussian => Self::Gaussian,
            Select::Both => Self::Both,
        }
    }
}

impl ByMasks {
    /// True when the question is asked by masks.
    pub(super) fn is_asked(&self) -> bool {
        self.masks.is_some() || self.prompt.is_some()
    }
}

/// A number in [0, 1].
fn share(text: &str) -> Result<f32, String> {
    let share: f32 = text.parse().map_err(|_| "expected a number".to_owned())?;
    if (0.0..=1.0).contains(&share) { Ok(share) } else { Err("expected 0 to 1".to_owned()) }
}

/// A scene and the capture whose frames are asked.
struct Scene<'a> {
    field: &'a Field,
    dataset: &'a Dataset,
    settings: RenderSettings,
    renderer: Renderer,
}

/// Answer to a question by masks.
struct Answer {
    found: Found,
    /// Boxes of the prompt in the pictures that chose, by frame.
    boxes: BTreeMap<String, Vec<FoundBox>>,
    scores: Option<Agreement>,
}

/// Origin of the masks.
enum Source<'a> {
    /// A folder that somebody filled.
    Folder(&'a Path),
    /// A prompt for a detector.
    Prompt(&'a str, Detector),
}

pub(super) fn run(command: &Query) -> Result<(), Error> {
    let options = &command.by_masks;
    let Some(capture) = &options.capture else {
        return Err(Error::usage("masks belong to frames", "name their capture with --capture"));
    };
    let source = source(command, capture)?;
    if !formats::is_field(&command.path) {
        return Err(Error::usage(
            format!(
                "masks are compared with renders of a trained scene (.cif), and {} is none",
                command.path.display()
            ),
            "give the .cif; its labels are those of the stages exported from it",
        ));
    }
    let field = scene::load(&command.path)?;
    if field.identities.is_none() {
        return Err(Error::failed(
            format!("{} was trained without masks, so it has no instances to find", command.path.display()),
            "train it with instance masks",
        ));
    }
    let pictures = CaptureOptions::pictures_of(&field, options.downscale, options.layout, &options.frames);
    let dataset = pictures.open(capture)?;
    print_warnings(&dataset);
    print_misfits(&field, &dataset, Split::Train);
    if let Some(folder) = &options.output {
        output::check_folder(folder, false)?;
    }
    let settings = scene::render_settings(&field);
    interrupt::watch();
    let mut scene =
        Scene { field: &field, dataset: &dataset, settings, renderer: Renderer::new(SimdLevel::Auto) };
    let answer = match options.protocol {
        Protocol::Reproject => by_reprojection(&mut scene, &source, options)?,
        Protocol::Grouping => by_grouping(&mut scene, &source, options)?,
    };
    report::print(command, &answer);
    Ok(())
}

/// Where masks come from, as far as the command line goes together.
fn source<'a>(command: &'a Query, capture: &Path) -> Result<Source<'a>, Error> {
    let options = &command.by_masks;
    let is_grouping = options.protocol == Protocol::Grouping;
    if is_grouping && (options.select != Select::Instance || options.foreground.is_some()) {
        return Err(Error::usage(
            "--protocol grouping answers by instances and their probabilities",
            "leave --select and --foreground out, or take --protocol reproject",
        ));
    }
    match (&options.prompt, &options.masks) {
        (Some(prompt), _) if prompt.trim().is_empty() => {
            Err(Error::usage("--prompt names nothing", "for example --prompt 'steel jug'"))
        }
        (Some(prompt), _) => {
            let detector = match (&options.detector, &command.models) {
                (Some(detector), _) => Detector::Command(detector.clone()),
                (None, Some(folder)) => {
                    let cache = options.cache.clone().unwrap_or_else(|| capture.join(CACHE));
                    Detector::Models(Box::new(Models::open(folder)?), cache)
                }
                (None, None) => {
                    return Err(Error::usage(
                        "--prompt is answered by models or by a command of your own",
                        "give --models DIR, a folder of ONNX models, or --detector CMD",
                    ));
                }
            };
            Ok(Source::Prompt(prompt, detector))
        }
        (None, Some(_)) if is_grouping => Err(Error::usage(
            "--protocol grouping asks a detector about a rendered view, for which a folder has no mask",
            "give --prompt with --models or --detector",
        )),
        (None, Some(folder)) => Ok(Source::Folder(folder)),
        (None, None) => {
            Err(Error::usage("no masks", "give --masks, or --prompt with --models or --detector"))
        }
    }
}

impl From<cif_dataset::Error> for Error {
    fn from(error: cif_dataset::Error) -> Self {
        Self::plain(error)
    }
}

/// Instances that lie inside the masks of the training frames, and how well they agree on the held-out ones.
fn by_reprojection(scene: &mut Scene<'_>, source: &Source<'_>, options: &ByMasks) -> Result<Answer, Error> {
    let Scene { field, dataset, .. } = *scene;
    let mut detected = None;
    let given;
    let masks: &FoundMasks = match source {
        Source::Prompt(prompt, detector) => {
            let asked: Vec<usize> = (0..dataset.frames.len())
                .filter(|index| options.eval || dataset.frames[*index].split == Split::Train)
                .collect();
            &detected.insert(scene.detect(detector, prompt, &asked)?).masks
        }
        Source::Folder(folder) => {
            given = FoundMasks { files: found_masks(dataset, folder).map_err(Error::plain)?, loaded: false };
            &given
        }
    };
    if !dataset.train_frames().iter().any(|index| !masks.files[*index].is_empty()) {
        return Err(Error::failed(
            "no training frame has a mask, so nobody can be asked",
            "run the detector on training frames; cif info CAPTURE lists them",
        ));
    }
    let selection = options.select.into();
    let Scene { renderer, settings, .. } = scene;
    let found = mask_query::find(field, dataset, masks, selection, renderer, settings, interrupt::go_on)?;
    let gate = options.foreground.unwrap_or(GATE);
    let scores = options.eval.then(|| {
        evaluate(scene, masks, options, |scene, index| {
            let frame = &dataset.frames[index];
            let Scene { renderer, settings, .. } = scene;
            mask_query::render(field, &found.rows, gate, &frame.camera, frame.time, renderer, settings)
        })
    });
    let boxes = detected.map(|detected| detected.boxes).unwrap_or_default();
    Ok(Answer { found, boxes, scores: scores.transpose()? })
}

/// Instances that lie inside the mask of the first view as it is rendered, and how well they agree on the held-out
/// frames.
fn by_grouping(scene: &mut Scene<'_>, source: &Source<'_>, options: &ByMasks) -> Result<Answer, Error> {
    let Source::Prompt(prompt, detector) = source else { unreachable!("refused with the arguments") };
    let Scene { field, dataset, .. } = *scene;
    let held_out = dataset.val_frames();
    let first = held_out.first().copied().unwrap_or(0);
    let frame = &dataset.frames[first];
    let plain = Channels { depth: false, instances: false };
    let Scene { renderer, settings, .. } = &mut *scene;
    let view = rgb_picture(&renderer.render(field, &frame.camera, frame.time, settings, plain).color);
    let asked = Asked { dataset, frames: &[first], picture: &|_| Ok(view.clone()) };
    let detected = detector.detect(&asked, prompt)?;
    let mask = dataset.load_found_mask(first, &detected.masks.files[first], true)?;
    let found = grouping::find(field, &mask, &frame.camera, frame.time, renderer, settings);
    let boxes = detected.boxes;
    if !options.eval {
        return Ok(Answer { found, boxes, scores: None });
    }
    let truth = scene.detect(detector, prompt, &held_out)?;
    let scores = evaluate(scene, &truth.masks, options, |scene, index| {
        let frame = &dataset.frames[index];
        let Scene { renderer, settings, .. } = scene;
        grouping::render(field, &found.votes, &frame.camera, frame.time, renderer, settings)
    })?;
    Ok(Answer { found, boxes, scores: Some(scores) })
}

impl Scene<'_> {
    /// Asks a detector about captured frames.
    fn detect(
        &self,
        detector: &Detector,
        prompt: &str,
        frames: &[usize],
    ) -> Result<crate::detector::Detected, Error> {
        let picture = |index| self.dataset.load_image(index, self.settings.background).map_err(Error::plain);
        detector.detect(&Asked { dataset: self.dataset, frames, picture: &picture }, prompt)
    }
}

/// Compares on the held-out frames what `render` makes of them. Of a detector that was run here, no mask means that it
/// found nothing; of a folder, that it was not asked.
fn evaluate(
    scene: &mut Scene<'_>,
    masks: &FoundMasks,
    options: &ByMasks,
    mut render: impl FnMut(&mut Scene<'_>, usize) -> PixelGrid<bool>,
) -> Result<Agreement, Error> {
    let dataset = scene.dataset;
    let mut pairs = Vec::new();
    for index in dataset.val_frames() {
        let (frame, files) = (&dataset.frames[index], &masks.files[index]);
        if files.is_empty() && !masks.loaded {
            continue;
        }
        interrupt::go_on()?;
        let truth = dataset.load_found_mask(index, files, masks.loaded)?;
        let rendered = render(scene, index);
        if let Some(folder) = &options.output {
            let picture: PixelGrid<u16> = rendered.map(|inside| if *inside { u16::MAX } else { 0 });
            save_grey(&output::inside(folder, &frame.name, "png")?, &picture)?;
        }
        pairs.push((frame.name.as_str(), rendered, truth));
    }
    if pairs.is_empty() {
        return Err(Error::failed(
            "no held-out frame has a mask, so there is nothing to compare with",
            "run the detector on held-out frames too, or leave --eval out",
        ));
    }
    Ok(agreement(pairs))
}
