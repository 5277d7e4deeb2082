//! `cif masks import`: masks of other tools as masks of a capture.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::masks::{Import as Source, MaskWriter, SourceKind};
use cif_dataset::{Dataset, InstanceLabel, OpenOptions};
use clap::{Args, ValueEnum};
use serde::Serialize;

use crate::commands::shared::{LayoutName, command_line, table};
use crate::error::Error;
use crate::interrupt;
use crate::progress::FrameProgress;
use crate::report::{JsonReport, OnlyReport};

/// Import masks of other tools
#[derive(Debug, Args)]
#[command(after_help = "\
Recognised by their files, or named with --from:

  tracker         a PNG per frame: ids (grey or palette), or a colour per object (DEVA with Annotations/ and
                  pred.json, XMem, Cutie ...); black is unlabelled, other colours get ids in one table for all frames
  frame-folders   FRAME/OBJECT.png, a mask per object (SAM 2, SAM 3)
  object-folders  OBJECT/FRAME.png, or OBJECT.FRAME.exr and OBJECT_FRAME.png without folders; PNG or EXR (Nuke)
  mattes          FRAME.exr with a channel per object
  arrays          NumPy ids: FRAME.npy or .npz with [height, width], or one file with [frames, height, width]
  coco            COCO JSON: run-length codes or polygons, objects by track_id
  youtube-vis     JSON of YouTube-VIS: objects of a video with a run-length code or polygons per frame
  label-studio    JSON export of Label Studio: brushes and polygons, objects by label
  cvat            XML 1.1 of CVAT, for images (polygons, masks; objects by track_id, else label) or video (tracks)

  cif masks import deva-output -o table-masks --capture captures/table
  cif masks import annotations.xml -o table-masks --capture captures/table
  cif train captures/table --masks table-masks -o table.cif

Frames are found by their names, else by the numbers at the ends of the names: of frames of the video, where the capture
was made of one (a mask for each frame of it, counted from 0 or 1, or --first-number), else of frames of the capture. Masks
of another size than the images, such as that of the video, are brought to it by nearest neighbour. A mask of one object covers a pixel from one half on. Where objects overlap, the higher layer (z_order of CVAT) has the pixel, on
one layer the object with fewer pixels in that frame, of equal ones the later. Numbers from 1 to 65535 that name all
objects stay their ids; else objects are numbered from 1. Cryptomatte EXR files need no import: cif train CAPTURE
--masks DIR reads them.")]
pub(super) struct Import {
    /// File or folder with the masks
    source: PathBuf,
    /// New folder for the masks
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    /// Folder of the capture whose frames they show
    #[arg(long, value_name = "CAPTURE")]
    capture: PathBuf,
    /// Kind of the source [default: recognised by its files]
    #[arg(long, value_name = "TOOL")]
    from: Option<From>,
    /// Names of the masks end in numbers of frames of the video, and its first frame has this one [default: what the
    /// numbers show]
    #[arg(long, value_name = "NUMBER")]
    first_number: Option<u64>,
    /// The masks were made on images reduced by 1, 2, 4, ... [default: the largest images stored]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    downscale: Option<u32>,
    /// Read the capture as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    layout: Option<LayoutName>,
    #[command(flatten)]
    report: OnlyReport,
    #[arg(from_global)]
    quiet: bool,
}

/// Sources of masks.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum From {
    Tracker,
    FrameFolders,
    ObjectFolders,
    Mattes,
    Arrays,
    Coco,
    YoutubeVis,
    LabelStudio,
    Cvat,
}

impl From {
    fn kind(self) -> SourceKind {
        match self {
            Self::Tracker => SourceKind::Tracker,
            Self::FrameFolders => SourceKind::FrameFolders,
            Self::ObjectFolders => SourceKind::ObjectFolders,
            Self::Mattes => SourceKind::Mattes,
            Self::Arrays => SourceKind::Arrays,
            Self::Coco => SourceKind::Coco,
            Self::YoutubeVis => SourceKind::YoutubeVis,
            Self::LabelStudio => SourceKind::LabelStudio,
            Self::Cvat => SourceKind::Cvat,
        }
    }
}

/// Pixels of objects over all masks.
#[derive(Default)]
struct Found {
    /// Frames and pixels by id.
    objects: BTreeMap<u16, (usize, u64)>,
    masks: usize,
    pixels: u64,
    labelled: u64,
    disputed: u64,
    resized: Option<Resized>,
}

/// Masks of another size than their images.
struct Resized {
    count: usize,
    /// Width and height of the first of them, pixels.
    from: (u32, u32),
    /// Those of its image.
    to: (u32, u32),
}

pub(super) fn run(command: &Import) -> Result<(), Error> {
    let options = OpenOptions {
        without_masks: true,
        downscale: command.downscale,
        layout: command.layout.map(Into::into),
        ..OpenOptions::default()
    };
    command.report.check([command.source.as_path(), command.capture.as_path()])?;
    let dataset = Dataset::open(&command.capture, &options).map_err(Error::plain)?;
    let source = Source::open(&command.source, command.from.map(From::kind), command.first_number, &dataset)
        .map_err(Error::plain)?;
    if !command.report.to_stdout() {
        println!("read as {}", source.kind.described());
    }
    let writer = MaskWriter::create(&command.output).map_err(Error::plain)?;
    interrupt::watch();
    let mut progress = FrameProgress::new(command.quiet, dataset.frames.len());
    let mut found = Found::default();
    let mut without = Vec::new();
    for (index, frame) in dataset.frames.iter().enumerate() {
        interrupt::go_on()?;
        progress.step();
        let Some(drawn) = source.draw(&dataset, index).map_err(Error::plain)? else {
            without.push(frame.name.as_str());
            continue;
        };
        writer.add(&frame.name, &drawn.ids, None).map_err(Error::plain)?;
        found.disputed += drawn.disputed;
        let size = (drawn.ids.width, drawn.ids.height);
        if drawn.size != size {
            found.resized.get_or_insert(Resized { count: 0, from: drawn.size, to: size }).count += 1;
        }
        found.count(&drawn.ids.pixels);
    }
    drop(progress);
    if found.objects.is_empty() {
        return Err(Error::failed(
            format!(
                "{}: none of its masks shows an object: every pixel is unlabelled",
                command.source.display()
            ),
            "export the masks again, or name another source with --from",
        ));
    }
    let (seen, empty): (Vec<_>, Vec<_>) =
        source.instances.iter().cloned().partition(|instance| found.objects.contains_key(&instance.id));
    writer.finish(&seen).map_err(Error::plain)?;

    let report = || {
        let objects = seen.iter().map(|instance| {
            let (frames, pixels) = found.objects[&instance.id];
            ImportedObject {
                id: instance.id,
                label: &instance.label,
                category: &instance.category,
                frames,
                pixels,
            }
        });
        MaskImportReport {
            read_as: source.kind.described(),
            masks_in: &command.output,
            frames: dataset.frames.len(),
            masks: found.masks,
            frames_without_mask: &without,
            pixels: found.pixels,
            labelled_pixels: found.labelled,
            disputed_pixels: found.disputed,
            objects: objects.collect(),
            objects_without_pixels: &empty,
        }
    };
    command.report.give(report, || print(command, &dataset, &found, &seen))?;
    for note in &source.notes {
        crate::messages::note!("{note}");
    }
    if let Some(Resized { count, from, to }) = found.resized {
        crate::messages::note!(
            "{count} masks of {} x {} pixels were brought to {} x {} by nearest neighbour",
            from.0,
            from.1,
            to.0,
            to.1
        );
    }
    if found.disputed > 0 {
        crate::messages::note!("{} pixels were claimed by several objects", found.disputed);
    }
    if let Some(first) = without.first() {
        crate::messages::warning!("{} frames have no mask, the first is {first}", without.len());
    }
    if !empty.is_empty() {
        let names: Vec<&str> = empty.iter().map(|instance| instance.label.as_str()).collect();
        crate::messages::warning!("no pixel shows {}; left out of instances.json", names.join(", "));
    }
    Ok(())
}

/// Masks of another tool that were imported.
#[derive(Serialize)]
struct MaskImportReport<'a> {
    /// Kind of the source.
    read_as: &'static str,
    /// Folder of the masks.
    masks_in: &'a Path,
    /// Frames of the capture.
    frames: usize,
    /// Masks.
    masks: usize,
    /// Names of the frames that got no mask.
    frames_without_mask: &'a [&'a str],
    /// Pixels of all masks.
    pixels: u64,
    /// Pixels that belong to an object.
    labelled_pixels: u64,
    /// Pixels that several objects of the source claim.
    disputed_pixels: u64,
    /// Objects that a pixel shows.
    objects: Vec<ImportedObject<'a>>,
    /// Objects of the source that no pixel shows.
    objects_without_pixels: &'a [InstanceLabel],
}

/// An object of imported masks.
#[derive(Serialize)]
struct ImportedObject<'a> {
    /// Mask id.
    id: u16,
    /// Label.
    label: &'a str,
    /// Class.
    category: &'a str,
    /// Frames that show it.
    frames: usize,
    /// Pixels, over all frames.
    pixels: u64,
}

impl JsonReport for MaskImportReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif masks import"];
}

fn print(command: &Import, dataset: &Dataset, found: &Found, seen: &[InstanceLabel]) {
    let mut rows = table(["id", "label", "category", "frames", "pixels"]);
    for instance in seen {
        let (frames, pixels) = found.objects[&instance.id];
        rows.add_row([
            instance.id.to_string(),
            instance.label.clone(),
            instance.category.clone(),
            frames.to_string(),
            pixels.to_string(),
        ]);
    }
    println!("{rows}");
    println!(
        "{} objects in {} masks of {} frames, {:.1} % of their pixels labelled, in {}",
        seen.len(),
        found.masks,
        dataset.frames.len(),
        100.0 * found.labelled as f64 / found.pixels.max(1) as f64,
        command.output.display()
    );
    let masks = std::path::absolute(&command.output).unwrap_or_else(|_| command.output.clone());
    let words = ["train", &command.capture.display().to_string(), "--masks", &masks.display().to_string()];
    println!("next: {} -o scene.cif", command_line(&words));
}

impl Found {
    fn count(&mut self, ids: &[u16]) {
        let mut here: BTreeMap<u16, u64> = BTreeMap::new();
        for run in ids.chunk_by(|a, b| a == b).filter(|run| run[0] != 0) {
            *here.entry(run[0]).or_default() += run.len() as u64;
        }
        self.masks += 1;
        self.pixels += ids.len() as u64;
        for (id, pixels) in here {
            self.labelled += pixels;
            let object = self.objects.entry(id).or_default();
            object.0 += 1;
            object.1 += pixels;
        }
    }
}
