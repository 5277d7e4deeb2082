//! `cif query --masks` and `--prompt`: the objects that a 2D detector shows.

use std::path::PathBuf;

use cif_dataset::masks::found_masks;
use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::RenderSettings;
use cif_render::cpu::{Renderer, SimdLevel};
use clap::{Args, ValueEnum};
use serde_json::json;

use super::Query;
use crate::commands::{CaptureOptions, FrameOptions, LayoutName, print_misfits, print_warnings, scene};
use crate::detector::{Detected, detect};
use crate::error::Error;
use crate::formats;
use crate::mask_query::{Agreement, Found, FoundMasks, GATE, Selection, agreement, find, render};
use crate::pictures::save_grey;
use crate::{interrupt, output};

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
    /// Text for the detector
    #[arg(
        long,
        value_name = "TEXT",
        requires = "capture",
        requires = "detector",
        conflicts_with_all = ["label", "taxonomy", "point", "region", "time", "interval"]
    )]
    prompt: Option<String>,
    /// Command that reads the frames in {frames} and writes the masks of {prompt} into {masks}; without
    /// these words the folder of frames, the folder of masks and the prompt are its last arguments
    #[arg(long, value_name = "CMD", requires = "prompt")]
    detector: Option<String>,
    /// Capture that the masks belong to
    #[arg(long, value_name = "CAPTURE")]
    capture: Option<PathBuf>,
    /// Gaussians that make up the result
    #[arg(long, value_name = "SET", default_value = "instance")]
    select: Select,
    /// Least foreground of a pixel of the rendered masks, 0 to 1: below it a pixel is background. The paper has no
    /// such gate (0)
    #[arg(long, value_name = "SHARE", default_value_t = GATE, value_parser = share, requires = "eval")]
    foreground: f32,
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
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Select {
    /// Those of the chosen instances
    Instance,
    /// Those inside the masks themselves
    Gaussian,
    /// Those that are both: a part of an instance
    Both,
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

pub(super) fn run(command: &Query) -> Result<(), Error> {
    let options = &command.by_masks;
    let Some(capture) = &options.capture else {
        return Err(Error::usage("masks belong to frames", "name their capture with --capture"));
    };
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
    let dataset = CaptureOptions {
        masks: None,
        no_masks: true,
        downscale: options.downscale.or(scene::trained_downscale(&field)),
        center_principal_point: false,
        layout: options.layout,
        frames: options.frames.clone(),
    }
    .open(capture)?;
    print_warnings(&dataset);
    print_misfits(&field, &dataset, Split::Train);
    if let Some(folder) = &options.output {
        output::check_folder(folder, false)?;
    }
    let settings = scene::render_settings(&field);
    interrupt::watch();
    let detected: Option<Detected> = match (&options.prompt, &options.detector) {
        (Some(prompt), Some(detector)) => {
            let asked: Vec<usize> = (0..dataset.frames.len())
                .filter(|index| options.eval || dataset.frames[*index].split == Split::Train)
                .collect();
            Some(detect(&dataset, &asked, settings.background, detector, prompt)?)
        }
        _ => None,
    };
    let given = match (&detected, &options.masks) {
        (None, Some(folder)) => {
            Some(FoundMasks { files: found_masks(&dataset, folder).map_err(Error::plain)?, loaded: false })
        }
        _ => None,
    };
    let Some(masks) = detected.as_ref().map(|detected| &detected.masks).or(given.as_ref()) else {
        return Err(Error::usage("no masks", "give --masks, or --prompt with --detector"));
    };
    if !dataset.train_frames().iter().any(|index| !masks.files[*index].is_empty()) {
        return Err(Error::failed(
            "no training frame has a mask, so nobody can be asked",
            "run the detector on training frames; cif info CAPTURE lists them",
        ));
    }
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let found =
        find(&field, &dataset, masks, options.select.into(), &mut renderer, &settings, interrupt::go_on)?;
    let scores = if options.eval {
        Some(evaluate(&field, &dataset, masks, &found, &mut renderer, &settings, options)?)
    } else {
        None
    };
    report(command, &found, scores.as_ref());
    Ok(())
}

impl From<cif_dataset::Error> for Error {
    fn from(error: cif_dataset::Error) -> Self {
        Self::plain(error)
    }
}

/// Compares on the held-out frames. Of a detector that was run here, no mask means that it found nothing; of a
/// folder, that it was not asked.
fn evaluate(
    field: &Field,
    dataset: &Dataset,
    masks: &FoundMasks,
    found: &Found,
    renderer: &mut Renderer,
    settings: &RenderSettings,
    options: &ByMasks,
) -> Result<Agreement, Error> {
    let mut pairs = Vec::new();
    for index in dataset.val_frames() {
        let (frame, files) = (&dataset.frames[index], &masks.files[index]);
        if files.is_empty() && !masks.loaded {
            continue;
        }
        interrupt::go_on()?;
        let truth = dataset.load_found_mask(index, files, masks.loaded)?;
        let rendered =
            render(field, &found.rows, options.foreground, &frame.camera, frame.time, renderer, settings);
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

fn report(command: &Query, found: &Found, scores: Option<&Agreement>) {
    let options = &command.by_masks;
    if command.json {
        let mut report = json!({
            "instances": found.votes,
            "gaussians": found.rows.len(),
            "select": Selection::from(options.select),
            "frames": found.frames,
        });
        if let Some(prompt) = &options.prompt {
            report["prompt"] = json!(prompt);
        }
        if let Some(scores) = scores {
            report["eval"] = json!(scores);
        }
        println!("{report:#}");
        return;
    }
    if found.votes.iter().all(|vote| !vote.chosen) {
        println!("no instance lies inside the masks of {} frames", found.frames);
    }
    let mut table = crate::commands::table(["", "id", "label", "class", "inside"]);
    for vote in &found.votes {
        table.add_row([
            if vote.chosen { "*".to_owned() } else { String::new() },
            vote.id.to_string(),
            vote.label.clone(),
            vote.category.clone(),
            format!("{:.3}", vote.score),
        ]);
    }
    println!("{table}");
    println!("* chosen, by {} training frames; {} Gaussians", found.frames, found.rows.len());
    if let Some(scores) = scores {
        let number = |value: Option<f64>| value.map_or("n/a".to_owned(), |value| format!("{value:.2}"));
        println!(
            "held-out frames: mAcc {}, mIoU {} over {} ({} more where nothing was found)",
            number(scores.macc),
            number(scores.miou),
            scores.frames,
            scores.empty_frames
        );
    }
}
