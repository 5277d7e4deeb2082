//! `cif masks propagate`: masks of all frames from a few painted ones.

mod points;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_dataset::masks::MaskWriter;
use cif_dataset::{Dataset, InstanceLabel, OpenOptions, Split};
use cif_geometry::PixelGrid;
use cif_masks::rig::{self, View};
use cif_masks::suggest::{Camera, Propagated, doubt, next_frame};
use cif_masks::{Clip, Keyframe, Mask};
use clap::Args;
use serde::Serialize;

use self::points::Points;
use crate::commands::shared::{FrameOptions, LayoutName, command_line};
use crate::error::Error;
use crate::interrupt;
use crate::pictures::{ContactSheet, save_jpeg};
use crate::progress::FrameProgress;
use crate::report::JsonReport;

/// Name of the picture of frames next to their masks, in the folder of masks. Not PNG, so that it is no mask.
const SHEET: &str = "contact_sheet.jpg";

/// Every so many frames one is on the picture.
const SHEET_EVERY: usize = 10;

/// Background behind images with alpha.
const BACKGROUND: [f32; 3] = [1.0; 3];

/// Make the masks of all frames from a few painted ones
#[derive(Debug, Args)]
#[command(after_help = "\
Keyframes are PNG files of ids, 0 for unlabelled, named as the frames that they show (000012.png, cam03/0007.png).
Paint every object in the first and the last frame and in a few between, at best one frame after every change: an
object that enters, a hand that leaves. Ids are propagated by optical flow from the keyframes before and after, and
checked by appearance. Cameras without a keyframe get their ids from the others through points in the world: those
of the capture, or of a first scene (--scene), which also has their motion.

  cif masks propagate captures/table --keyframes painted -o table-masks
  cif train captures/table --masks table-masks -o table.cif

The output folder holds a PNG of ids per frame, instances.json, confidence/FRAME.png (8-bit grey: probability that
the id is right, 255 for certain; training takes pixels below 192 as unlabelled) and contact_sheet.jpg, every tenth
frame next to its mask. Results do not depend on the number of threads.")]
pub(super) struct Propagate {
    /// Folder of the capture
    capture: PathBuf,
    /// Folder of painted masks, named as the frames that they show
    #[arg(long, value_name = "DIR")]
    keyframes: PathBuf,
    /// New folder for the masks
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    /// Scene of this capture, trained with or without masks, whose Gaussians bring ids to cameras without keyframes
    #[arg(long, value_name = "SCENE.cif")]
    scene: Option<PathBuf>,
    /// Reduce images by 1, 2, 4, ... [default: the largest images stored]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    downscale: Option<u32>,
    /// Read the folder as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    layout: Option<LayoutName>,
    #[command(flatten)]
    frames: FrameOptions,
    #[command(flatten)]
    report: crate::report::OnlyReport,
    #[arg(from_global)]
    quiet: bool,
    /// A step of `cif make`, which prints the next step itself
    #[arg(long, hide = true)]
    step: bool,
}

impl From<cif_masks::Error> for Error {
    fn from(error: cif_masks::Error) -> Self {
        match error {
            cif_masks::Error::Stopped => Self::Interrupted { message: "interrupted".to_owned(), help: None },
            other => Self::plain(other),
        }
    }
}

pub(super) fn run(command: &Propagate) -> Result<(), Error> {
    command.report.check([command.capture.as_path(), command.keyframes.as_path()])?;
    crate::output::check_new_folder(&command.output)?;
    let dataset = open(command)?;
    check_ids(&dataset, &command.keyframes)?;
    let mut painted = BTreeMap::new();
    for (index, frame) in dataset.frames.iter().enumerate() {
        if let Some(ids) = dataset.load_distorted_mask(index).map_err(Error::plain)? {
            if ids.pixels.iter().all(|id| *id == 0) {
                crate::messages::note!("the keyframe of frame {} shows no object", frame.name);
            }
            painted.insert(index, Keyframe::painted(ids));
        }
    }
    if painted.values().all(|keyframe| keyframe.ids.pixels.iter().all(|id| *id == 0)) {
        return Err(Error::failed(
            format!("{}: no keyframe shows an object: every pixel is 0", command.keyframes.display()),
            "paint each object with an id of its own, 1 to 65535; 0 is unlabelled",
        ));
    }
    let cameras = cameras(&dataset);
    interrupt::watch();
    let points = Points::new(command.scene.as_deref(), &dataset, &cameras, &painted)?;
    let writer = MaskWriter::create(&command.output).map_err(Error::plain)?;
    let mut work = Work {
        dataset: &dataset,
        painted: &painted,
        writer,
        progress: FrameProgress::new(command.quiet, dataset.frames.len()),
        doubts: vec![0.0; dataset.frames.len()],
        sheet: ContactSheet::new(),
        unmasked: Vec::new(),
    };
    let (with, without): (Vec<_>, Vec<_>) =
        cameras.values().partition(|frames| frames.iter().any(|frame| painted.contains_key(frame)));
    for frames in with {
        work.propagate(frames, &keyframes_of(frames, &painted))?;
    }
    for frames in without {
        let keyframes = work.carried(frames, &points)?;
        if keyframes.is_empty() {
            work.unmasked.extend(frames.iter().copied());
        } else {
            work.propagate(frames, &keyframes)?;
        }
    }
    work.finish(command, &cameras)
}

/// Opens the capture with the keyframes as its masks, and reports what is wrong with them.
fn open(command: &Propagate) -> Result<Dataset, Error> {
    let folder = &command.keyframes;
    if !folder.is_dir() {
        return Err(Error::failed(
            format!("{}: there is no such folder of keyframes", folder.display()),
            "give the folder that holds the painted masks, PNG files of ids named as the frames",
        ));
    }
    let options = OpenOptions {
        // A path from here, also where the capture has a folder of that name.
        masks: Some(std::path::absolute(folder).map_err(Error::io("find", folder))?),
        keyframes: true,
        downscale: command.downscale,
        layout: command.layout.map(Into::into),
        without_cameras: command.frames.without_camera.clone(),
        video_frames: command.frames.video_frames,
        window: command.frames.window,
        ..OpenOptions::default()
    };
    let dataset = Dataset::open(&command.capture, &options).map_err(Error::plain)?;
    for warning in &dataset.warnings {
        crate::messages::warning!("{warning}");
    }
    Ok(dataset)
}

/// Refuses ids that the list of instances does not name, where there is a list.
fn check_ids(dataset: &Dataset, keyframes: &Path) -> Result<(), Error> {
    let Some((file, named)) = dataset.named_instances(keyframes).map_err(Error::plain)? else {
        return Ok(());
    };
    let unnamed: Vec<String> = dataset
        .instances
        .iter()
        .filter(|instance| !named.contains(&instance.id))
        .map(|instance| instance.id.to_string())
        .collect();
    if unnamed.is_empty() {
        return Ok(());
    }
    Err(Error::failed(
        format!("{}: the keyframes hold ids that it does not name: {}", file.display(), unnamed.join(", ")),
        "add them there with their labels, or paint those pixels with an id that is listed",
    ))
}

/// Frames of every camera, in order of time.
fn cameras(dataset: &Dataset) -> BTreeMap<&str, Vec<usize>> {
    let mut cameras: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (index, frame) in dataset.frames.iter().enumerate() {
        cameras.entry(&frame.camera_name).or_default().push(index);
    }
    cameras
}

/// Keyframes of a camera by their place among its frames.
fn keyframes_of(frames: &[usize], painted: &BTreeMap<usize, Keyframe>) -> BTreeMap<usize, Keyframe> {
    let known = frames.iter().enumerate().filter_map(|(k, frame)| Some((k, painted.get(frame)?.clone())));
    known.collect()
}

/// Masks being made.
struct Work<'a> {
    dataset: &'a Dataset,
    painted: &'a BTreeMap<usize, Keyframe>,
    writer: MaskWriter,
    progress: FrameProgress,
    /// Doubt about each frame.
    doubts: Vec<f64>,
    sheet: ContactSheet,
    /// Frames of cameras that no id reaches.
    unmasked: Vec<usize>,
}

impl Work<'_> {
    fn image(&self, frame: usize) -> Result<PixelGrid<[u8; 3]>, Error> {
        self.dataset.load_distorted_image(frame, BACKGROUND).map_err(Error::plain)
    }

    /// Masks of all frames of a camera.
    fn propagate(&mut self, frames: &[usize], keyframes: &BTreeMap<usize, Keyframe>) -> Result<(), Error> {
        let dataset = self.dataset;
        let image = |k: usize| Ok(dataset.load_distorted_image(frames[k], BACKGROUND)?);
        let clip = Clip { frames: frames.len(), image: &image, keyframes, stop: &interrupt::requested };
        let mut failure = None;
        let result = cif_masks::propagate(&clip, &mut |k, mask| {
            self.keep(frames[k], k, &mask).map_err(|error| {
                failure = Some(error);
                cif_masks::Error::Stopped
            })
        });
        match failure {
            Some(error) => Err(error),
            None => Ok(result?),
        }
    }

    fn keep(&mut self, frame: usize, place: usize, mask: &Mask) -> Result<(), Error> {
        let name = &self.dataset.frames[frame].name;
        self.writer.add(name, &mask.ids, Some(&mask.confidence)).map_err(Error::plain)?;
        self.doubts[frame] = doubt(mask);
        if place.is_multiple_of(SHEET_EVERY) {
            let image = self.image(frame)?;
            self.sheet.add(frame, &image, &mask.ids);
        }
        self.progress.step();
        Ok(())
    }

    /// Keyframes of a camera that has none, brought by points: at the moments of painted frames where it has those, else
    /// wherever another camera has a mask.
    fn carried(&self, frames: &[usize], points: &Points) -> Result<BTreeMap<usize, Keyframe>, Error> {
        let moment = |frame: usize| self.dataset.frames[frame].time_index;
        let painted: BTreeSet<usize> = self.painted.keys().map(|frame| moment(*frame)).collect();
        let at_painted: Vec<usize> =
            (0..frames.len()).filter(|k| painted.contains(&moment(frames[*k]))).collect();
        let chosen = if at_painted.is_empty() { (0..frames.len()).collect() } else { at_painted.clone() };
        let mut keyframes = BTreeMap::new();
        for k in chosen {
            interrupt::go_on()?;
            let frame = frames[k];
            let mut known = Vec::new();
            for other in (0..self.dataset.frames.len()).filter(|other| moment(*other) == moment(frame)) {
                if let Some(mask) = self.mask_of(other, !at_painted.is_empty())? {
                    known.push((other, self.image(other)?, mask));
                }
            }
            let image = self.image(frame)?;
            let views: Vec<(View<'_>, &Keyframe)> = known
                .iter()
                .map(|(other, image, mask)| (View { frame: &self.dataset.frames[*other], image }, mask))
                .collect();
            let view = View { frame: &self.dataset.frames[frame], image: &image };
            let points = points.at(self.dataset.frames[frame].time);
            if let Some(keyframe) = rig::carry(&views, &view, &points) {
                keyframes.insert(k, keyframe);
            }
        }
        Ok(keyframes)
    }

    /// The mask of a frame: painted, or, unless only painted ones count, written before.
    fn mask_of(&self, frame: usize, only_painted: bool) -> Result<Option<Keyframe>, Error> {
        if let Some(keyframe) = self.painted.get(&frame) {
            let (width, height) =
                (self.dataset.frames[frame].camera.width, self.dataset.frames[frame].camera.height);
            debug_assert_eq!((keyframe.ids.width, keyframe.ids.height), (width, height));
            return Ok(Some(keyframe.clone()));
        }
        let name = &self.dataset.frames[frame].name;
        let path = crate::output::inside(self.writer.path(), name, "png")?;
        if only_painted || !path.exists() {
            return Ok(None);
        }
        let confidence = crate::output::inside(&self.writer.path().join("confidence"), name, "png")?;
        let read = |path| self.dataset.load_distorted_mask_file(frame, path).map_err(Error::plain);
        Ok(Some(Keyframe {
            ids: read(&path)?,
            confidence: Some(read(&confidence)?.map(|value| f32::from(*value) / 255.0)),
        }))
    }

    fn finish(self, command: &Propagate, cameras: &BTreeMap<&str, Vec<usize>>) -> Result<(), Error> {
        let Self { dataset, painted, writer, progress, doubts, sheet, unmasked } = self;
        drop(progress);
        save_jpeg(&writer.path().join(SHEET), &sheet.finish())?;
        writer.finish(&dataset.instances).map_err(Error::plain)?;
        let masks = dataset.frames.len() - unmasked.len();
        if !unmasked.is_empty() {
            eprintln!(
                "warning: no point brings ids to {} frames, which have no mask: {} ...",
                unmasked.len(),
                dataset.frames[unmasked[0]].name
            );
        }
        let propagated = |frame: &usize| Propagated {
            frame: *frame,
            doubt: doubts[*frame],
            painted: painted.contains_key(frame),
            trained: dataset.frames[*frame].split == Split::Train,
        };
        let camera = |frames: &Vec<usize>| Camera { frames: frames.iter().map(propagated).collect() };
        let next = next_frame(&cameras.values().map(camera).collect::<Vec<_>>());
        let names = |frames: &[usize]| -> Vec<&str> {
            frames.iter().map(|frame| dataset.frames[*frame].name.as_str()).collect()
        };
        let report = || PropagateReport {
            masks_in: &command.output,
            masks,
            instances: &dataset.instances,
            keyframes: names(&painted.keys().copied().collect::<Vec<_>>()),
            frames_without_mask: names(&unmasked),
            label_next: next.map(|frame| dataset.frames[frame].name.as_str()),
            doubt_there: next.map(|frame| doubts[frame]),
        };
        command.report.give(report, || {
            self::print(command, dataset, masks, painted.len(), next.map(|frame| (frame, doubts[frame])))
        })
    }
}

/// Masks that were made from keyframes.
#[derive(Serialize)]
struct PropagateReport<'a> {
    /// Folder of the masks.
    masks_in: &'a Path,
    /// Masks.
    masks: usize,
    /// Instances of the masks.
    instances: &'a [InstanceLabel],
    /// Names of the frames that were painted.
    keyframes: Vec<&'a str>,
    /// Names of the frames that got no mask.
    frames_without_mask: Vec<&'a str>,
    /// Name of the frame that is best painted next; null where none is in doubt.
    label_next: Option<&'a str>,
    /// Share of that frame whose labels are in doubt, in [0, 1].
    doubt_there: Option<f64>,
}

impl JsonReport for PropagateReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif masks propagate"];
}

/// Prints what was made, and what comes next.
fn print(command: &Propagate, dataset: &Dataset, masks: usize, keyframes: usize, next: Option<(usize, f64)>) {
    println!(
        "{masks} masks of {} instances from {keyframes} keyframes in {}; {SHEET} shows them",
        dataset.instances.len(),
        command.output.display()
    );
    if let Some((frame, doubt)) = next {
        println!(
            "label this frame next: {} ({:.0} % of its objects in doubt)",
            dataset.frames[frame].name,
            100.0 * doubt
        );
    }
    if command.step {
        return;
    }
    let words = [
        "train".to_owned(),
        command.capture.display().to_string(),
        "--masks".to_owned(),
        std::path::absolute(&command.output).unwrap_or_else(|_| command.output.clone()).display().to_string(),
        "-o".to_owned(),
        "scene.cif".to_owned(),
    ];
    println!("next: {}", command_line(&words));
}
