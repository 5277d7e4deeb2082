//! `cif query --masks` and `--prompt`: the objects that a 2D detector shows.

mod report;

use std::path::Path;

use cif_dataset::masks::found_masks;
use cif_dataset::{Dataset, Split};
use cif_geometry::PixelGrid;

use self::report::Answer;
use super::mask_options::{ByMasks, Protocol, Select};
use super::options::Query;
use crate::commands::shared::asked::{self, AskedScene};
use crate::commands::shared::scene;
use crate::commands::shared::{CaptureOptions, print_misfits, print_warnings};
use crate::detector::Detector;
use crate::error::Error;
use crate::formats;
use crate::mask_query::{Agreement, FoundMasks, FrameAgreement, GATE, agreement};
use crate::pictures::save_grey;
use crate::{interrupt, output};

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
    interrupt::watch();
    let mut scene = AskedScene::new(&field, &dataset);
    let answer = match options.protocol {
        Protocol::Reproject => by_reprojection(&mut scene, &dataset, &source, options)?,
        Protocol::Grouping => by_grouping(&mut scene, &dataset, &source, options)?,
    };
    report::give(command, &answer)
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
                (None, Some(folder)) => asked::models(folder, capture, options.cache.clone())?,
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
fn by_reprojection(
    scene: &mut AskedScene<'_>,
    dataset: &Dataset,
    source: &Source<'_>,
    options: &ByMasks,
) -> Result<Answer, Error> {
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
    let found = scene.reproject(masks, options.select.into())?;
    let gate = options.foreground.unwrap_or(GATE);
    let scores = options
        .eval
        .then(|| evaluate(dataset, masks, options, |index| scene.reprojected(&found, gate, index)));
    let scores = scores.transpose()?;
    let boxes = detected.map(|detected| detected.boxes).unwrap_or_default();
    Ok(Answer { found, boxes, scores })
}

/// Instances that lie inside the mask of the first view as it is rendered, and how well they agree on the held-out
/// frames.
fn by_grouping(
    scene: &mut AskedScene<'_>,
    dataset: &Dataset,
    source: &Source<'_>,
    options: &ByMasks,
) -> Result<Answer, Error> {
    let Source::Prompt(prompt, detector) = source else { unreachable!("refused with the arguments") };
    let (found, boxes) = scene.group(detector, prompt)?;
    if !options.eval {
        return Ok(Answer { found, boxes, scores: None });
    }
    let truth = scene.detect(detector, prompt, &dataset.val_frames())?;
    let scores = evaluate(dataset, &truth.masks, options, |index| scene.grouped(&found, index))?;
    Ok(Answer { found, boxes, scores: Some(scores) })
}

/// Compares on the held-out frames what `render` makes of them. Of a detector that was run here, no mask means that it
/// found nothing; of a folder, that it was not asked.
fn evaluate(
    dataset: &Dataset,
    masks: &FoundMasks,
    options: &ByMasks,
    mut render: impl FnMut(usize) -> PixelGrid<bool>,
) -> Result<Agreement, Error> {
    let mut frames = Vec::new();
    for index in dataset.val_frames() {
        let (frame, files) = (&dataset.frames[index], &masks.files[index]);
        if files.is_empty() && !masks.loaded {
            continue;
        }
        interrupt::go_on()?;
        let truth = dataset.load_found_mask(index, files, masks.loaded)?;
        let rendered = render(index);
        if let Some(folder) = &options.output {
            let picture: PixelGrid<u16> = rendered.map(|inside| if *inside { u16::MAX } else { 0 });
            save_grey(&output::inside(folder, &frame.name, "png")?, &picture)?;
        }
        frames.push(FrameAgreement::of(&frame.name, &rendered, &truth));
    }
    if frames.is_empty() {
        return Err(Error::failed(
            "no held-out frame has a mask, so there is nothing to compare with",
            "run the detector on held-out frames too, or leave --eval out",
        ));
    }
    Ok(agreement(frames))
}
