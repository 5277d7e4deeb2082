//! `cif export --check`: written files, read back and compared with the scene that they came from.

use std::path::{Path, PathBuf};
use std::time::Instant;

use cif_dataset::{Dataset, Split};
use cif_field::{Field, RecordedCamera};
use cif_render::cpu::SimdLevel;
use cif_scene::motion::loose::LOOSE_SPLATS;
use cif_scene::{ExportOptions, ReadOptions, SceneGraph, time_in_field};
use cif_train::metrics::Scores;
use cif_train::metrics::round_trip::{
    HeldOutLoss, Likeness, ObjectLikeness, ObjectLoss, SharedView, held_out_loss, likeness,
};
use clap::Args;
use serde::Serialize;

use super::preset::Preferred;
use super::targets::{Target, Targets, Writing};
use crate::commands::shared::scene::code_at;
use crate::commands::shared::table::number;
use crate::commands::shared::{CaptureOptions, print_misfits, print_warnings};
use crate::error::Error;
use crate::output::Outputs;
use crate::{formats, interrupt};

/// Loss of a file, against images that were held out, that an export by default should stay below, dB.
const MUCH_DB: f64 = 0.2;

/// Options of the check.
#[derive(Debug, Args)]
#[command(next_help_heading = "Check")]
pub(super) struct Check {
    /// Read every file back as `cif import` does, render it next to the scene, and report the loss
    #[arg(long)]
    pub(super) check: bool,
    /// Views of the scene's own cameras that are compared, spread over its times
    #[arg(
        long,
        value_name = "N",
        default_value_t = 12,
        value_parser = clap::value_parser!(u32).range(1..),
        requires = "check"
    )]
    check_views: u32,
    /// Compare with the held-out images of a capture too
    #[arg(long, value_name = "CAPTURE", requires = "check")]
    capture: Option<PathBuf>,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

/// A scene whose files are checked.
pub(super) struct Checker<'a> {
    field: &'a Field,
    views: Vec<&'a RecordedCamera>,
    dataset: Option<Dataset>,
}

/// Likeness of a file to its scene.
pub(super) struct Finding {
    path: PathBuf,
    format: &'static str,
    /// Seconds for reading the file.
    read_s: f64,
    /// Seconds for reading and comparing.
    seconds: f64,
    /// Time code of the file, where it holds one moment.
    moment: Option<f64>,
    likeness: Option<Likeness>,
    /// `None` where none was asked for, inside where no image shows a time that the file holds.
    held_out: Option<Option<HeldOutLoss>>,
}

/// A file that was read back.
#[derive(Debug, Serialize)]
pub(super) struct FileCheck<'a> {
    /// The file.
    file: &'a Path,
    /// Name of its format.
    format: &'static str,
    /// Time code that it holds, where that is one moment only; null otherwise.
    time_code: Option<f64>,
    /// Wall time of reading the file, seconds.
    read_s: f64,
    /// Wall time of reading and comparing, seconds.
    seconds: f64,
    /// Views of the scene against the same views of the file; null where no camera of the scene sees a time of the
    /// file.
    against_scene: Option<LikenessReport>,
    /// Loss against held-out images of a capture; null where none was named, or none shows a time of the file.
    held_out: Option<HeldOutReport>,
}

/// Views of a scene against the same views of a file.
#[derive(Debug, Serialize)]
struct LikenessReport {
    /// Views.
    views: usize,
    /// PSNR, dB; null where no pixel differs.
    psnr: Option<f64>,
    /// Mean intersection over union of the labels, percent.
    miou: Option<f64>,
    /// The same of every object.
    objects: Vec<LikenessObject>,
}

/// An object in views of a scene and of a file.
#[derive(Debug, Serialize)]
struct LikenessObject {
    /// Mask id.
    id: u16,
    /// Label.
    label: String,
    /// PSNR over its pixels, dB; null where none differs.
    psnr: Option<f64>,
    /// Intersection over union of its labels, percent.
    iou: Option<f64>,
}

/// Scores of a scene and of a file on held-out images. Losses are positive where the file is worse.
#[derive(Debug, Serialize)]
struct HeldOutReport {
    /// Images.
    frames: usize,
    /// Scores of the scene.
    scene: ImageScores,
    /// Scores of the file.
    file: ImageScores,
    /// Loss of PSNR, dB.
    psnr_lost: Option<f64>,
    /// Loss of mIoU, percentage points.
    miou_lost: Option<f64>,
    /// The same of every object.
    objects: Vec<HeldOutObject>,
}

/// Scores on held-out images.
#[derive(Debug, Serialize)]
struct ImageScores {
    /// Mean PSNR, dB.
    psnr: Option<f64>,
    /// Mean SSIM.
    ssim: Option<f64>,
    /// mIoU over labelled pixels, percent.
    miou: Option<f64>,
}

/// Scores of an object: of the scene, then of the file.
#[derive(Debug, Serialize)]
struct HeldOutObject {
    /// Mask id.
    id: u16,
    /// Label.
    label: String,
    /// PSNR over its pixels, dB.
    psnr: [Option<f64>; 2],
    /// Loss of PSNR, dB.
    psnr_lost: Option<f64>,
    /// Intersection over union, percent.
    iou: [Option<f64>; 2],
    /// Loss of it, percentage points.
    iou_lost: Option<f64>,
}

impl ImageScores {
    fn of(scores: &Scores) -> Self {
        Self { psnr: scores.psnr, ssim: scores.ssim, miou: scores.instance.miou }
    }
}

impl Check {
    /// True with --check.
    pub(super) fn is_asked(&self) -> bool {
        self.check
    }

    /// Checks that there is something to compare before the work starts.
    pub(super) fn refuse(
        &self,
        targets: &Targets,
        writing: &Writing,
        preferred: &Preferred,
        bakes_blur: bool,
    ) -> Result<(), Error> {
        if !self.check {
            return Ok(());
        }
        if targets.iter().next().is_none() {
            return Err(Error::usage(
                "--check reads what was written",
                if cfg!(feature = "usd") {
                    "name a file to write as well, for example OUT.usda (or --usd, --gltf)"
                } else {
                    "name a file to write as well, for example OUT.glb (or --gltf)"
                },
            ));
        }
        if let Some(target) = targets.iter().find(|target| !target.format.about().is_read) {
            return Err(Error::usage(
                format!("{target:?}: --check reads what was written, and this is not read back"),
                "leave --check or this file out; a USD stage holds the same scene",
            ));
        }
        if bakes_blur {
            return Err(Error::usage(
                "--check draws with the filter of the renderer, which would be there twice with the blur baked",
                "leave --check out, or check with --bake-blur=false",
            ));
        }
        let options = writing.without_moment(preferred, false);
        match targets.iter().find(|target| target.format.fills_folder(&options)) {
            None => Ok(()),
            Some(target) => Err(Error::usage(
                format!("{target:?}: --check reads single files, and this is a folder of several"),
                "leave --check out, or --ply-split and --ply-sequence",
            )),
        }
    }

    /// Opens the capture; `None` without --check.
    ///
    /// # Errors
    /// When the capture cannot be read, or the scene has neither cameras nor a capture to be seen from.
    pub(super) fn open<'a>(
        &self,
        field: &'a Field,
        outputs: &mut Outputs,
    ) -> Result<Option<Checker<'a>>, Error> {
        if !self.check {
            return Ok(None);
        }
        let dataset = match &self.capture {
            None => None,
            Some(path) => {
                let dataset = self.capture_options.as_trained(field).open(path)?;
                outputs.reads_capture(&dataset)?;
                print_warnings(&dataset);
                print_misfits(field, &dataset, Split::Val);
                Some(dataset)
            }
        };
        let views = spread(&field.cameras, self.check_views as usize);
        if views.is_empty() && dataset.is_none() {
            return Err(Error::failed(
                "the scene records no cameras, from which --check could look at it",
                "give the capture: --check --capture CAPTURE",
            ));
        }
        Ok(Some(Checker { field, views, dataset }))
    }
}

/// Views spread over the times of a scene, taking turns among the cameras of each time.
fn spread(cameras: &[RecordedCamera], count: usize) -> Vec<&RecordedCamera> {
    let mut sorted: Vec<&RecordedCamera> = cameras.iter().collect();
    sorted.sort_by_key(|camera| camera.time_index);
    if sorted.len() <= count {
        return sorted;
    }
    let mut by_time: Vec<Vec<&RecordedCamera>> =
        sorted.chunk_by(|a, b| a.time_index == b.time_index).map(<[_]>::to_vec).collect();
    for (place, cameras) in by_time.iter_mut().enumerate() {
        let first = place % cameras.len();
        cameras.rotate_left(first);
    }
    let mut chosen = Vec::with_capacity(count);
    for turn in 0..sorted.len() {
        // One view of every time that has another, or of times between which others are left out.
        let round: Vec<&RecordedCamera> = by_time.iter().filter_map(|of| of.get(turn).copied()).collect();
        let taken = (count - chosen.len()).min(round.len());
        chosen.extend((0..taken).map(|k| round[(2 * k + 1) * round.len() / (2 * taken)]));
    }
    chosen.sort_by_key(|camera| camera.time_index);
    chosen
}

impl Checker<'_> {
    /// Reads the file back that `graph` was written to, and compares it.
    pub(super) fn check(
        &self,
        target: &Target,
        graph: &SceneGraph,
        writing: &ExportOptions,
    ) -> Result<Finding, Error> {
        let start = Instant::now();
        let read = formats::read(&target.path, ReadOptions::default(), None)?;
        let mut copy = formats::field_of(&read, &target.path)?;
        let read_s = start.elapsed().as_secs_f64();
        // Of the capture rather than of the scene: no format holds exposures, and viewers choose a background.
        let drawing = &self.field.record.drawing;
        copy.record.drawing.exposures.clone_from(&drawing.exposures);
        copy.record.drawing.exposures_in_time.clone_from(&drawing.exposures_in_time);
        copy.background = self.field.background;
        let codes = &graph.time_codes;
        // Formats of one moment hold no objects either: all of it came back as one.
        let moment = match target.format.about().most_expensive_motion {
            Some(_) => None,
            None => Some(writing.time_code.unwrap_or(codes.start())),
        };
        if moment.is_some() {
            copy.identities = None;
        }
        let clock = Clock {
            field: self.field,
            read: &read,
            held: moment.map_or((codes.start(), codes.end()), |code| (code, code)),
        };
        let likeness = self.likeness(&copy, &clock, moment)?;
        let held_out =
            self.dataset.as_ref().map(|dataset| self.held_out(dataset, &copy, &clock)).transpose()?;
        let seconds = start.elapsed().as_secs_f64();
        Ok(Finding {
            path: target.path.clone(),
            format: target.format.about().key,
            read_s,
            seconds,
            moment,
            likeness,
            held_out,
        })
    }

    /// Compares with pictures of the scene. A file of one moment is seen at that moment from everywhere.
    fn likeness(
        &self,
        copy: &Field,
        clock: &Clock<'_>,
        moment: Option<f64>,
    ) -> Result<Option<Likeness>, Error> {
        let codes = self.field.time_codes();
        let code = |view: &RecordedCamera| moment.unwrap_or(codes[view.time_index]);
        let held = self.views.iter().filter(|view| clock.holds(code(view)));
        let views = held.map(|view| {
            let RecordedCamera { name, time_index, camera, .. } = view;
            let times = [clock.in_field(code(view)), clock.in_copy(code(view))?];
            Ok(SharedView { name, time_index: *time_index, camera, times })
        });
        let views = views.collect::<Result<Vec<SharedView<'_>>, Error>>()?;
        if views.is_empty() {
            return Ok(None);
        }
        likeness(self.field, copy, &views, SimdLevel::Auto, interrupt::go_on).map(Some)
    }

    /// Compares with the held-out images of the times that the file holds.
    fn held_out(
        &self,
        dataset: &Dataset,
        copy: &Field,
        clock: &Clock<'_>,
    ) -> Result<Option<HeldOutLoss>, Error> {
        let mut dataset = dataset.clone();
        dataset.frames.retain(|frame| frame.split == Split::Val && clock.holds(clock.code(frame.time)));
        if dataset.frames.is_empty() {
            return Ok(None);
        }
        let mut in_copy = dataset.clone();
        for frame in &mut in_copy.frames {
            frame.time = clock.in_copy(clock.code(frame.time))?;
        }
        held_out_loss([self.field, copy], [&dataset, &in_copy], SimdLevel::Auto, interrupt::go_on).map(Some)
    }
}

/// Time codes of a file, in the scene that it came from and in the copy of it that was read back.
struct Clock<'a> {
    field: &'a Field,
    read: &'a SceneGraph,
    /// First and last time code of the file.
    held: (f64, f64),
}

impl Clock<'_> {
    fn holds(&self, code: f64) -> bool {
        (self.held.0..=self.held.1).contains(&code)
    }

    /// Time code of a time in the scene.
    fn code(&self, time: f64) -> f64 {
        code_at(&self.field.timeline.times, &self.field.time_codes(), time)
    }

    fn in_field(&self, code: f64) -> f64 {
        code_at(&self.field.time_codes(), &self.field.timeline.times, code)
    }

    fn in_copy(&self, code: f64) -> Result<f64, Error> {
        time_in_field(self.read, code).map_err(Error::plain)
    }
}

impl Finding {
    /// The finding for programs.
    pub(super) fn report(&self, field: &Field) -> FileCheck<'_> {
        let held_out = self.held_out.iter().flatten().next().map(|found| {
            let (before, after) = (&found.field, &found.copy);
            let object = |object: &ObjectLoss| HeldOutObject {
                id: object.id,
                label: label(field, object.id),
                psnr: object.psnr,
                psnr_lost: lost(object.psnr),
                iou: object.iou,
                iou_lost: lost(object.iou),
            };
            HeldOutReport {
                frames: before.frames,
                scene: ImageScores::of(before),
                file: ImageScores::of(after),
                psnr_lost: lost([before.psnr, after.psnr]),
                miou_lost: lost([before.instance.miou, after.instance.miou]),
                objects: found.objects.iter().map(object).collect(),
            }
        });
        let against_scene = self.likeness.as_ref().map(|found| {
            let object = |object: &ObjectLikeness| LikenessObject {
                id: object.id,
                label: label(field, object.id),
                psnr: object.psnr,
                iou: object.iou,
            };
            LikenessReport {
                views: found.views,
                psnr: found.psnr,
                miou: found.miou,
                objects: found.objects.iter().map(object).collect(),
            }
        });
        FileCheck {
            file: &self.path,
            format: self.format,
            time_code: self.moment,
            read_s: self.read_s,
            seconds: self.seconds,
            against_scene,
            held_out,
        }
    }

    /// Prints the tables.
    pub(super) fn print(&self, field: &Field) {
        let moment = self.moment.map_or(String::new(), |code| format!(" at time code {code}"));
        println!(
            "{} read back in {:.1} s and compared{moment} in {:.1} s",
            self.path.display(),
            self.read_s,
            self.seconds - self.read_s
        );
        match &self.likeness {
            None => println!("no camera of the scene sees a time that the file holds"),
            Some(found) => print_likeness(found, field),
        }
        match &self.held_out {
            None => {}
            Some(None) => println!("no held-out image of the capture shows a time that the file holds"),
            Some(Some(found)) => print_held_out(found, field),
        }
    }
}

fn print_likeness(found: &Likeness, field: &Field) {
    println!("against pictures of the scene, {} views of its cameras:", found.views);
    let mut table = crate::commands::shared::table(["object", "PSNR, dB", "IoU"]);
    table.add_row(["all, mean".to_owned(), decibels(found.psnr), number(found.miou, 2)]);
    for object in &found.objects {
        table.add_row([label(field, object.id), decibels(object.psnr), number(object.iou, 2)]);
    }
    println!("{table}");
}

fn print_held_out(found: &HeldOutLoss, field: &Field) {
    println!("against {} held-out images:", found.field.frames);
    let mut table = crate::commands::shared::table([
        "object",
        "PSNR of scene",
        "of file",
        "lost, dB",
        "IoU of scene",
        "of file",
        "lost",
    ]);
    let mut row = |name: String, psnr: [Option<f64>; 2], iou: [Option<f64>; 2]| {
        let [psnr, iou] =
            [psnr, iou].map(|pair| [number(pair[0], 2), number(pair[1], 2), number(lost(pair), 2)]);
        table.add_row(std::iter::once(name).chain(psnr).chain(iou));
    };
    let (before, after) = (&found.field, &found.copy);
    row("all, mean".to_owned(), [before.psnr, after.psnr], [before.instance.miou, after.instance.miou]);
    for object in &found.objects {
        row(label(field, object.id), object.psnr, object.iou);
    }
    println!("{table}");
    if let Some(advice) = advice(lost([before.psnr, after.psnr])) {
        println!("{advice}");
    }
}

/// Advice about a file whose views lose so many decibels against its scene; `None` where the loss is small.
fn advice(lost: Option<f64>) -> Option<String> {
    let lost = lost.filter(|lost| *lost > MUCH_DB)?;
    Some(format!(
        "the file loses {lost:.2} dB: a smaller --tolerance keeps more of motion that is fitted, a smaller \
         --appearance-tolerance more of how they change; a .usda file holds a path for every splat, a .glb file those of \
         bodies and of the {LOOSE_SPLATS} splats that travel farthest, a .ply file one time"
    ))
}

/// Amount by which the second is worse.
fn lost([before, after]: [Option<f64>; 2]) -> Option<f64> {
    Some(before? - after?)
}

/// PSNR that is missing because nothing differs.
fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or("equal".to_owned(), |psnr| format!("{psnr:.2}"))
}

fn label(field: &Field, id: u16) -> String {
    let known = field.instances.iter().find(|instance| instance.id == id);
    known.map_or_else(|| "everything else".to_owned(), |instance| instance.label.clone())
}

#[cfg(test)]
mod tests {
    use cif_geometry::{PinholeCamera, RigidTransform};
    use glam::DVec2;

    use super::*;

    /// Cameras `a`, `b`, ... at each of some times.
    fn cameras(names: &str, times: usize) -> Vec<RecordedCamera> {
        let camera = PinholeCamera {
            width: 4,
            height: 4,
            focal_px: DVec2::splat(4.0),
            principal_px: DVec2::splat(2.0),
            camera_from_world: RigidTransform::IDENTITY,
        };
        let of = |name: char| {
            (0..times).map(move |time_index| RecordedCamera {
                name: name.into(),
                time_index,
                trained: true,
                camera,
            })
        };
        names.chars().flat_map(of).collect()
    }

    fn chosen(names: &str, times: usize, count: usize) -> Vec<String> {
        let cameras = cameras(names, times);
        spread(&cameras, count).iter().map(|view| format!("{}{}", view.name, view.time_index)).collect()
    }

    #[test]
    fn large_losses_come_with_advice() {
        assert!(advice(Some(0.31)).unwrap().contains("loses 0.31 dB: a smaller --tolerance"));
        assert!(advice(Some(0.1)).is_none() && advice(Some(-0.4)).is_none() && advice(None).is_none());
    }

    #[test]
    fn views_take_turns_among_times_and_cameras() {
        assert_eq!(chosen("a", 8, 4), ["a1", "a3", "a5", "a7"]);
        assert_eq!(chosen("abc", 6, 3), ["b1", "a3", "c5"]);
        assert_eq!(chosen("ab", 3, 4), ["a0", "b1", "a1", "a2"]);
        assert_eq!(chosen("ab", 2, 9), ["a0", "b0", "a1", "b1"]);
        assert!(chosen("", 3, 2).is_empty());
    }

    #[test]
    fn every_view_is_chosen_once() {
        for count in 1..30 {
            let mut views = chosen("abcde", 5, count);
            assert_eq!(views.len(), count.min(25));
            views.sort();
            views.dedup();
            assert_eq!(views.len(), count.min(25), "{count}: {views:?}");
        }
    }
}
