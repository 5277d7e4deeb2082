//! `cif render`: pictures of a scene from captured or new views.

mod files;
mod film;
mod flight;
mod layers;
mod painter;
mod shot;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_dataset::cryptomatte::BACKGROUND;
use cif_exr::ColorEncoding;
use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_output::Workplace;
use cif_render::constants::MIN_COVERAGE;
use cif_render::cpu::{BandRequest, Renderer};
use cif_render::quality::{self, Quality};
use cif_render::{Channels, RenderSettings, RenderedImage, screen_motion};
use cif_scene::files::folder_of;
use cif_scene::naming::instance_name;
use cif_system::memory::Need;
use cif_train::metrics::image::psnr;
use cif_train::{Clock, SystemClock};
use clap::{ArgGroup, Args, ValueEnum};
use serde::Serialize;

use super::shared::scene;
use super::shared::simd::Simd;
use super::shared::split::SplitName;
use super::shared::trajectories::Trajectories;
use crate::camera_file::{self, FORMAT_HELP, View};
use crate::commands::shared::{CaptureOptions, print_misfits, print_warnings};
use crate::error::Error;
use crate::messages::outcome;
use crate::moment::Moment;
use crate::output::Outputs;
use crate::report::{JsonReport, Report};
use crate::{endings, interrupt, output};
use files::ViewFiles;
use film::FilmFile;
use flight::{Film, Flight, Size};
use layers::What;
use painter::Painter;
#[cfg(feature = "wgpu")]
use painter::Sample;
use shot::Shot;

/// Render a scene from captured or new views
#[derive(Debug, Args)]
#[command(
    group = ArgGroup::new("views").required(true).args(["capture", "camera", "path"]),
    after_help = after_help(),
)]
pub(super) struct Render {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    /// Render the views of a capture
    #[arg(long, value_name = "CAPTURE")]
    capture: Option<PathBuf>,
    /// Frames of the capture
    #[arg(long, default_value = "val", value_name = "SPLIT", conflicts_with_all = ["camera", "path"])]
    split: SplitName,
    /// Render the views of a camera file
    #[arg(long, value_name = "FILE.json")]
    camera: Option<PathBuf>,
    /// Fly along a path, one view per captured time: orbit (around the objects, where cameras have been), cameras
    /// (through the recorded ones) or follow:LABEL (along with an object)
    #[arg(long, value_name = "PATH")]
    path: Option<Flight>,
    /// Size of the views of a path, as in 1280x720 [default: that of the recorded cameras]
    #[arg(long, value_name = "WxH", requires = "path")]
    size: Option<Size>,
    /// Pictures per second of a film [default: those of the scene]
    #[arg(long, value_name = "RATE", value_parser = rate)]
    fps: Option<f64>,
    /// Time of all views instead of their own: a frame (36), seconds (1.5s) or a share (50%)
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    time: Option<Moment>,
    /// Folder to write into: DIR/WHAT/VIEW.png; or a film of one layer, made by ffmpeg: out.mp4, .mov, .mkv, .webm,
    /// .avi or .gif
    #[arg(short, long, value_name = "DIR|FILM", value_parser = endings::folder_or_film())]
    output: PathBuf,
    /// Layers to write, comma separated [default: rgb, or none with --exr]
    #[arg(long, value_delimiter = ',', value_name = "WHAT")]
    what: Vec<What>,
    /// Write DIR/exr/VIEW.exr: beauty, depth, motion, instances and Cryptomatte in one file per view
    #[arg(long)]
    exr: bool,
    /// Quality of the pictures; the loss of a draft is measured on some of the views and printed
    #[arg(long, value_name = "QUALITY", default_value = "final")]
    quality: QualityName,
    /// Colours as the scene has them, or as the cameras of the capture record them where training learnt their exposures
    #[arg(long, value_name = "LOOK", default_value = "mean")]
    look: Look,
    /// Colours of the EXR files
    #[arg(long, value_name = "COLOR", default_value = "linear", requires = "exr")]
    exr_color: ExrColor,
    /// Write into a folder that holds files already
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    report: Report,
    #[command(flatten)]
    capture_options: CaptureOptions,
    /// Vector instructions: `auto` takes the widest that the processor has
    #[arg(long, value_name = "LEVEL", default_value = "auto", value_parser = Simd::parser())]
    simd: Simd,
    /// Backend that renders: `auto` measures the first view where there is a GPU, and uses the faster one. EXR files
    /// need the processor
    #[cfg(feature = "wgpu")]
    #[arg(long, value_name = "BACKEND", default_value = "auto")]
    backend: super::backend::Backend,
}

/// Care of a render.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum QualityName {
    /// Without Gaussians whose opacity and occupancy are both below 0.3; on a GPU, view-dependent colour is kept in
    /// 16-bit floats where it does not change with time, for less than half a level
    Draft,
    /// Everything that the scene holds
    Final,
}

/// Colours of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Look {
    /// As the scene has them, which files show too: the mean of what cameras record
    Mean,
    /// With the exposure of the camera, between those of the training images before and after
    Recorded,
}

/// Colours of EXR files.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum ExrColor {
    /// Linear light, as compositors expect of EXR files: the sRGB curve of the captured colours is undone
    Linear,
    /// As captured and trained, display-referred
    Display,
}

impl From<ExrColor> for ColorEncoding {
    fn from(color: ExrColor) -> Self {
        match color {
            ExrColor::Linear => Self::Linear,
            ExrColor::Display => Self::Display,
        }
    }
}

/// Folder of the EXR files inside the output.
const EXR_FOLDER: &str = "exr";

fn after_help() -> String {
    format!(
        "Values beyond what 16 bits hold are written as 65535.\n\n\
         Views are drawn and written in bands of rows, so that large views need little memory; only\n\
         depth-color keeps 4 bytes per pixel.\n\n\
         EXR files hold 32-bit floats: colour multiplied by alpha without the background colour, Z (1e10\n\
         where nothing is), forward.u and .v (pixels to the next view of the same camera, u to the right,\n\
         v up; 0 in the last), the instance layers, and the Cryptomatte uCryptoObject, whose names are the\n\
         labels (unique names where labels repeat, `background` for the rest).\n\n  \
         cif render table.cif --capture captures/table -o out --exr\n  \
         cif render table.cif --capture captures/table --split val -o out --what rgb,instance,depth\n  \
         cif render table.cif --capture captures/table -o look --quality draft\n  \
         cif render table.cif --capture captures/table -o paths --what tracks\n  \
         cif render table.cif --camera views.json --time 50% -o out\n  \
         cif render table.cif --path orbit -o orbit.mp4\n  \
         cif render table.cif --path 'follow:red mug' --what instance-color --size 1280x720 -o mug.mp4\n\n{FORMAT_HELP}"
    )
}

/// Pictures per second, above 0.
fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse::<f64>().ok().filter(|rate| rate.is_finite() && *rate > 0.0);
    rate.ok_or_else(|| "a number of pictures per second above 0 is expected".to_owned())
}

pub(super) fn run(command: &Render) -> Result<(), Error> {
    let field = scene::load(&command.scene)?;
    let place = command.scene.display().to_string();
    let time_of_all = command.time.map(|moment| scene::time(&field, &place, "--time", moment)).transpose()?;
    let what = requested_layers(command, &field)?;
    check_look(command, &field)?;
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.report.check(&mut outputs)?;
    let Film { shots: views, per_second } = views(command, &field, &mut outputs)?;
    let is_film = endings::is_film(&command.output);
    check_film(command, is_film, what.len())?;
    if what.contains(&What::DepthColor) {
        check_memory(&views)?;
    }
    // Pictures of a film go through a folder that is gone afterwards.
    let passing = if is_film { Some(Workplace::create("cif-film-").map_err(Error::plain)?) } else { None };
    let folder = passing.as_ref().map_or(command.output.as_path(), Workplace::path);
    if is_film {
        outputs.file(&command.output)?;
    } else {
        check_pictures(command, &mut outputs, &views, &what)?;
    }
    let depth = command.exr || what.contains(&What::Depth) || what.contains(&What::DepthColor);
    let of_instances = what.iter().any(|what| what.of_instances());
    let instances = of_instances || (command.exr && field.identities.is_some());
    let settings = scene::render_settings(&field);
    let quality = match command.quality {
        QualityName::Draft => quality::DRAFT,
        QualityName::Final => quality::FINAL,
    };
    if command.quality == QualityName::Draft {
        let mut renderer = Renderer::new(command.simd.into());
        print_draft_loss(&mut renderer, &field, &views, &settings, time_of_all);
    }
    let field = quality.thin(&field);
    let channels = Channels { depth, instances };
    let mut painter = painter(command, &field, &views, &settings, channels, time_of_all)?;
    let trajectories = what.contains(&What::Tracks).then(|| Trajectories::new(&field, command.simd.into()));
    interrupt::watch();
    let settings = quality.settings(&settings);
    let mut film = is_film.then(|| FilmFile::create(&command.output, per_second)).transpose()?;
    if command.look == Look::Recorded {
        note_mean_looks(&field, &views, time_of_all);
    }
    let clock = SystemClock::start();
    let start = clock.now();
    for (index, Shot { view, .. }) in views.iter().enumerate() {
        let place = Place { field: &field, views: &views, index, time: time_of_all };
        let paths = trajectories.as_ref();
        let lines = paths.map(|paths| paths.lines(&view.camera, place.time_of(view))).unwrap_or_default();
        let mut files = ViewFiles::create(&what, &field, folder, view, lines)?;
        write_view(&mut painter, channels, &settings, &place, command, &mut files)?;
        files.finish()?;
        if let (Some(film), Some(what)) = (&mut film, what.first()) {
            let picture = output::inside(&folder.join(what.folder()), &view.name, "png")?;
            film.add(&std::fs::read(&picture).map_err(Error::io("read", &picture))?)?;
            std::fs::remove_file(&picture).map_err(Error::io("remove", &picture))?;
        }
    }
    film.map_or(Ok(()), FilmFile::finish)?;
    let seconds = (clock.now() - start).wall_s;
    outcome!("rendered {} views into {}", views.len(), command.output.display());
    // A film is one file of all views.
    let layers: Vec<String> = match is_film {
        true => Vec::new(),
        false => {
            what.iter().map(|what| what.folder()).chain(command.exr.then(|| EXR_FOLDER.to_owned())).collect()
        }
    };
    let report = report(&layers, &views, time_of_all, command, seconds)?;
    command.report.give(|| report, || {})
}

/// The layers that are asked for, which the scene has.
fn requested_layers(command: &Render, field: &Field) -> Result<BTreeSet<What>, Error> {
    let mut what: BTreeSet<What> = command.what.iter().copied().collect();
    if what.is_empty() && !command.exr {
        what.insert(What::Rgb);
    }
    let of_instances = what.iter().any(|what| what.of_instances() || *what == What::Tracks);
    if of_instances && field.identities.is_none() {
        return Err(Error::failed(
            format!("{} was trained without masks, so it has no instances to show", command.scene.display()),
            "leave tracks, instance, foreground, coverage, probability and entropy out of --what, or train with masks",
        ));
    }
    if command.exr && command.quality == QualityName::Draft {
        return Err(Error::usage(
            "--exr writes what compositors measure in, which a draft is not",
            "leave --quality draft or --exr away",
        ));
    }
    Ok(what)
}

/// Checks the files of all views.
fn check_pictures(
    command: &Render,
    outputs: &mut Outputs,
    views: &[Shot],
    what: &BTreeSet<What>,
) -> Result<(), Error> {
    let folder = &command.output;
    output::check_folder(folder, command.force)?;
    for Shot { view, .. } in views {
        for what in what {
            outputs.picture(&folder.join(what.folder()), &view.name, "png")?;
        }
        if command.exr {
            outputs.picture(&folder.join(EXR_FOLDER), &view.name, "exr")?;
        }
    }
    Ok(())
}

/// Refuses a recorded look that nothing is known of, or that files for compositors do not have.
fn check_look(command: &Render, field: &Field) -> Result<(), Error> {
    if command.look == Look::Mean {
        return Ok(());
    }
    if command.exr || command.capture.is_none() {
        return Err(Error::usage(
            "--look recorded is that of a camera of a capture, in pictures; EXR files hold the mean look",
            "give --capture, and leave --exr out",
        ));
    }
    if !field.record.drawing.has_exposures() {
        return Err(Error::failed(
            format!(
                "{}: training learnt no exposures, so that all cameras record the mean look",
                command.scene.display()
            ),
            "leave --look recorded out; cif plan says what a capture calls for",
        ));
    }
    Ok(())
}

/// Notes how many views have the mean look although the recorded one is requested.
fn note_mean_looks(field: &Field, views: &[Shot], time_of_all: Option<f64>) {
    let is_mean = |shot: &&Shot| {
        let time = time_of_all.or(shot.view.time).unwrap_or(0.0);
        field.record.drawing.exposure(&shot.camera, time).is_none()
    };
    let count = views.iter().filter(is_mean).count();
    if count > 0 {
        crate::messages::note!(
            "{count} of {} views have the mean look: training saw no image of their camera, whose exposure is not known",
            views.len()
        );
    }
}

/// Refuses films of several layers, and rates of what is no film.
fn check_film(command: &Render, is_film: bool, layers: usize) -> Result<(), Error> {
    if is_film && (command.exr || layers != 1) {
        return Err(Error::usage(
            "a film shows one layer",
            "name one with --what, or a folder of pictures instead of the film: -o views",
        ));
    }
    if !is_film && command.fps.is_some() {
        return Err(Error::usage(
            "--fps is about a film, and a folder of pictures is written",
            "name a film: -o out.mp4",
        ));
    }
    Ok(())
}

fn pixels(camera: &PinholeCamera) -> u64 {
    u64::from(camera.width) * u64::from(camera.height)
}

/// Refuses views whose depths memory does not hold.
fn check_memory(views: &[Shot]) -> Result<(), Error> {
    let cameras = views.iter().map(|shot| &shot.view.camera);
    let Some(camera) = cameras.max_by_key(|camera| pixels(camera)) else { return Ok(()) };
    let PinholeCamera { width, height, .. } = camera;
    let need = Need { bytes: 4 * pixels(camera), arithmetic: format!("{width} x {height} depths x 4 bytes") };
    need.check().map_err(|error| {
        let fix = "take smaller views, or depth, which needs no memory";
        Error::failed(format!("depth-color: {error}"), fix)
    })
}

/// Views that were rendered.
#[derive(Serialize)]
struct RenderReport<'a> {
    /// Folder of the files, or the film.
    output: &'a Path,
    /// Wall time of rendering and writing, seconds.
    seconds: f64,
    /// The views.
    views: Vec<ViewReport<'a>>,
}

/// A view that was rendered.
#[derive(Serialize)]
struct ViewReport<'a> {
    /// Name, which the files have too.
    name: &'a str,
    /// Camera; null where it has no name.
    camera: Option<&'a str>,
    /// Time, in [0, 1].
    time: f64,
    /// Width, pixels.
    width: u32,
    /// Height, pixels.
    height: u32,
    /// Files, by the layer that they hold: a value of `--what`, or `exr`; none of a film.
    files: BTreeMap<String, String>,
}

impl JsonReport for RenderReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif render"];
}

/// Views with their times and files.
fn report<'a>(
    layers: &[String],
    views: &'a [Shot],
    time_of_all: Option<f64>,
    command: &'a Render,
    seconds: f64,
) -> Result<RenderReport<'a>, Error> {
    let view = |Shot { view, camera }: &'a Shot| {
        let file = |layer: &String| {
            let ending = if layer == EXR_FOLDER { "exr" } else { "png" };
            let path = output::inside(&command.output.join(layer), &view.name, ending)?;
            Ok((layer.clone(), path.display().to_string()))
        };
        Ok(ViewReport {
            name: &view.name,
            camera: (!camera.is_empty()).then_some(camera),
            time: time_of_all.or(view.time).unwrap_or(0.0),
            width: view.camera.width,
            height: view.camera.height,
            files: layers.iter().map(file).collect::<Result<_, Error>>()?,
        })
    };
    let views = views.iter().map(view).collect::<Result<Vec<_>, Error>>()?;
    Ok(RenderReport { output: &command.output, seconds, views })
}

/// Renders some of the views in both qualities and says what the draft loses and gains.
fn print_draft_loss(
    renderer: &mut Renderer,
    field: &Field,
    views: &[Shot],
    settings: &RenderSettings,
    time: Option<f64>,
) {
    const MEASURED: usize = 3;
    // Larger views are measured smaller: here whole images are kept and compared.
    const MOST_PIXELS: f64 = 4e6;
    let smaller = |camera: &PinholeCamera| {
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        let share = (MOST_PIXELS / pixels).sqrt().min(1.0);
        let side = |pixels: u32| ((f64::from(pixels) * share) as u32).max(1);
        if share < 1.0 { camera.resized(side(camera.width), side(camera.height)) } else { *camera }
    };
    let settings = RenderSettings { instances: None, ..*settings };
    let count = views.len().min(MEASURED);
    let thinned = quality::DRAFT.thin(field);
    let clock = SystemClock::start();
    let mut seconds = [0.0; 2];
    let (mut worst, mut mean) = (f64::INFINITY, 0.0);
    for k in 0..count {
        let view = &views[(2 * k + 1) * views.len() / (2 * count)].view;
        let (camera, time) = (smaller(&view.camera), time.or(view.time).unwrap_or(0.0));
        let mut render = |quality: Quality, field: &Field, seconds: &mut f64| {
            let channels = Channels::default();
            // Once before, so that memory is there for both.
            quality.render(renderer, field, &camera, time, &settings, channels);
            let start = clock.now();
            let image = quality.render(renderer, field, &camera, time, &settings, channels);
            *seconds += (clock.now() - start).cpu_s;
            image.color
        };
        let exact = render(quality::FINAL, field, &mut seconds[0]);
        let exact = exact.map(|pixel| pixel.map(|value| value.clamp(0.0, 1.0)));
        let draft = render(quality::DRAFT, &thinned, &mut seconds[1]);
        let psnr = psnr(&draft, &exact).min(100.0);
        worst = worst.min(psnr);
        mean += psnr / count as f64;
    }
    outcome!(
        "draft: PSNR {mean:.1} dB against final quality, {worst:.1} in the worst of {count} views measured; \
         {} of {} Gaussians, {:.2} times as fast by processor time",
        thinned.len(),
        field.len(),
        seconds[0] / seconds[1].max(1e-9)
    );
}

/// The processor or a GPU, as asked.
#[cfg(feature = "wgpu")]
fn painter(
    command: &Render,
    field: &Field,
    views: &[Shot],
    settings: &RenderSettings,
    channels: Channels,
    time: Option<f64>,
) -> Result<Painter, Error> {
    use super::backend::Backend;
    if command.exr && command.backend == Backend::Wgpu {
        return Err(Error::usage(
            "EXR files hold several objects per pixel and motion, which only the processor renders",
            "leave --backend wgpu or --exr out",
        ));
    }
    let (false, Some(Shot { view, .. })) = (command.exr, views.first()) else {
        return Ok(Painter::cpu(command.simd.into()));
    };
    let time = time.or(view.time).unwrap_or(0.0);
    let compact = command.quality == QualityName::Draft;
    let sample = Sample { field, camera: &view.camera, time, settings, channels, compact };
    Painter::choose(command.backend, command.simd.into(), &sample)
}

/// The processor.
#[cfg(not(feature = "wgpu"))]
fn painter(
    command: &Render,
    _: &Field,
    _: &[Shot],
    _: &RenderSettings,
    _: Channels,
    _: Option<f64>,
) -> Result<Painter, Error> {
    Ok(Painter::cpu(command.simd.into()))
}

/// The views, and how many of them are shown per second.
fn views(command: &Render, field: &Field, outputs: &mut Outputs) -> Result<Film, Error> {
    let film = match &command.path {
        Some(path) => flight::film(field, path, command.size, &command.scene.display().to_string())?,
        None => Film {
            shots: given_views(command, field, outputs)?,
            per_second: field.timeline.frames_per_second,
        },
    };
    Ok(Film { per_second: command.fps.unwrap_or(film.per_second), ..film })
}

fn given_views(command: &Render, field: &Field, outputs: &mut Outputs) -> Result<Vec<Shot>, Error> {
    if let Some(path) = &command.camera {
        outputs.reads(path)?;
        let mut views = camera_file::read(path)?;
        // Cameras are given in the world of the capture.
        let frame = scene::frame(field)?;
        if !frame.is_identity() {
            views.iter_mut().for_each(|view| view.camera = frame.camera(&view.camera));
        }
        return Ok(views.into_iter().map(|view| Shot { view, camera: String::new() }).collect());
    }
    let Some(capture) = &command.capture else {
        return Err(Error::usage("no views", "give --capture, --camera or --path"));
    };
    let mut options = command.capture_options.as_trained(field);
    options.no_masks = options.masks.is_none();
    let dataset = options.open(capture)?;
    outputs.reads_capture(&dataset)?;
    print_warnings(&dataset);
    let split = command.split.into();
    print_misfits(field, &dataset, split);
    let views: Vec<Shot> = dataset
        .frames
        .iter()
        .filter(|frame| frame.split == split)
        .map(|frame| Shot {
            view: View { name: frame.name.clone(), time: Some(frame.time), camera: frame.camera },
            camera: frame.camera_name.clone(),
        })
        .collect();
    if views.is_empty() {
        return Err(Error::failed(
            format!("{}: the split has no frame", capture.display()),
            "try the other one: --split train or --split val",
        ));
    }
    Ok(views)
}

/// Which of the views is written.
struct Place<'a> {
    field: &'a Field,
    views: &'a [Shot],
    index: usize,
    /// Time of all views.
    time: Option<f64>,
}

impl Place<'_> {
    /// The next view of the same camera.
    fn next(&self) -> Option<&View> {
        let next = self.views.get(self.index + 1)?;
        (next.camera == self.views[self.index].camera).then_some(&next.view)
    }

    fn time_of(&self, view: &View) -> f64 {
        self.time.or(view.time).unwrap_or(0.0)
    }
}

/// Renders a view into its files.
fn write_view(
    painter: &mut Painter,
    channels: Channels,
    settings: &RenderSettings,
    place: &Place<'_>,
    command: &Render,
    files: &mut ViewFiles<'_>,
) -> Result<(), Error> {
    let (field, Shot { view, camera }) = (place.field, &place.views[place.index]);
    let time = place.time_of(view);
    let is_recorded = command.look == Look::Recorded;
    let exposure = is_recorded.then(|| field.record.drawing.exposure(camera, time)).flatten();
    let recorded = |mut image: RenderedImage| {
        if let Some(exposure) = exposure {
            exposure.apply(&mut image.color);
        }
        image
    };
    match painter {
        Painter::Cpu(renderer) if command.exr => {
            write_exr(renderer, channels, settings, place, command, files)
        }
        Painter::Cpu(renderer) => {
            let request = BandRequest { channels, ..BandRequest::default() };
            renderer.render_bands(field, &view.camera, time, settings, &request, |band| {
                interrupt::go_on()?;
                files.add(&recorded(band.image))
            })
        }
        #[cfg(feature = "wgpu")]
        Painter::Gpu(renderer) => {
            renderer.render_bands(field, &view.camera, time, settings, channels, |_, band| {
                interrupt::go_on()?;
                files.add(&recorded(band))
            })
        }
    }
}

/// Renders a view, and writes its EXR file next to the other `files`.
fn write_exr(
    renderer: &mut Renderer,
    channels: Channels,
    settings: &RenderSettings,
    place: &Place<'_>,
    command: &Render,
    files: &mut ViewFiles<'_>,
) -> Result<(), Error> {
    let (field, view) = (place.field, &place.views[place.index].view);
    let path = output::inside(&command.output.join(EXR_FOLDER), &view.name, "exr")?;
    let folder = folder_of(&path);
    std::fs::create_dir_all(&folder).map_err(Error::io("create the folder", &folder))?;
    let next = place.next();
    let moved = next.map(|next| {
        let means = renderer.deform(field, place.time_of(view)).means;
        let next_means = renderer.deform(field, place.time_of(next)).means;
        screen_motion(&view.camera, &means, &next.camera, &next_means)
    });
    let objects = field.identities.as_ref().map(|_| objects(field));
    let frame = cif_exr::Frame {
        name: &view.name,
        time: place.time_of(view),
        width: view.camera.width,
        height: view.camera.height,
        world_per_unit: 1.0 / scene::frame(field)?.scale,
        background: settings.background,
        objects: objects.as_deref(),
        next: next.map(|next| next.name.as_str()),
        encoding: command.exr_color.into(),
    };
    let request = BandRequest { channels, ranks: cif_exr::cryptomatte::RANKS, values: moved.as_deref() };
    cif_exr::write(&path, &frame, |file| {
        renderer.render_bands(field, &view.camera, frame.time, settings, &request, |band| {
            interrupt::go_on()?;
            let image = &band.image;
            let motion = motion(band.blended, image);
            let (first_row, ranks) = (band.first_row, band.ranks.as_ref());
            file.write(&cif_exr::Rows { first_row, image, ranks, motion: &motion })?;
            files.add(image)
        })
    })
}

/// Motion to the next view, where there is one: that of the Gaussians, weighted as their colours are.
fn motion(blended: Option<PixelGrid<[f32; 2]>>, image: &RenderedImage) -> PixelGrid<[f32; 2]> {
    let Some(mut vectors) = blended else {
        return PixelGrid::filled(image.alpha.width, image.alpha.height, [0.0; 2]);
    };
    for (vector, alpha) in vectors.pixels.iter_mut().zip(&image.alpha.pixels) {
        *vector = if *alpha > MIN_COVERAGE { vector.map(|sum| sum / alpha) } else { [0.0; 2] };
    }
    vectors
}

/// Instances with their names in a Cryptomatte: the label, or the name of the node where labels repeat.
fn objects(field: &Field) -> Vec<cif_exr::Object> {
    let repeated = |label: &str| {
        label == BACKGROUND || field.instances.iter().filter(|instance| instance.label == label).count() > 1
    };
    let named = field.instances.iter().map(|instance| cif_exr::Object {
        id: instance.id,
        name: if repeated(&instance.label) {
            instance_name(&instance.label, instance.id)
        } else {
            instance.label.clone()
        },
    });
    named.collect()
}
