//! Videos of a comparison: what its runs show, side by side, along the held-out frames of a camera.

use std::ffi::OsStr;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use cif_bench::comparison::page::Video;
use cif_bench::comparison::record::{Record, Row};
use cif_bench::comparison::title;
use cif_dataset::{Dataset, Frame, Split};
use cif_field::Field;
use cif_geometry::PinholeCamera;
use cif_output::Scratch;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use cif_train::HeadName;
use cif_train::heads::Decoder;
use cif_train::metrics::mask_ids;

use super::capture::Capture;
use super::runs::{Bench, id, labels};
use crate::commands::shared::scene;
use crate::error::Error;
use crate::interrupt;
use crate::pictures::{Picture, rgb_picture, side_by_side};

/// Pictures of a video, at least, where there are held-out frames to go between.
const LEAST_PICTURES: usize = 60;
/// Pictures per second.
const RATE: &str = "15";
/// Largest width of a part, pixels.
const PART_WIDTH: u32 = 320;

const ENCODER: &str = "ffmpeg";

/// Refuses to begin without the encoder, which is needed at the end of all runs.
pub(super) fn check() -> Result<(), Error> {
    let asked = Command::new(ENCODER).args(["-hide_banner", "-encoders"]).stdin(Stdio::null()).output();
    match asked {
        Ok(answer) if String::from_utf8_lossy(&answer.stdout).contains("libx264") => Ok(()),
        Ok(_) => Err(failed("it has no encoder libx264")),
        Err(error) => Err(failed(&error.to_string())),
    }
}

fn failed(problem: &str) -> Error {
    Error::failed(
        format!("--video: {ENCODER}: {problem}"),
        "install an ffmpeg with libx264, or leave --video out",
    )
}

/// Writes a video per capture whose runs of the first seed are there.
pub(super) fn write_all(folder: &Path, bench: &Bench, captures: &[Capture]) -> Result<Vec<Video>, Error> {
    let mut videos = Vec::new();
    for capture in captures {
        let of_seed = |record: &&Record| {
            let Row { capture: of, head, seed, .. } = &record.row;
            *of == capture.name && *seed == capture.config.seed && head != HeadName::LangSplat.name()
        };
        let records: Vec<&Record> = bench.records.iter().filter(of_seed).collect();
        let path = path(&capture.dataset);
        if records.is_empty() || path.is_empty() {
            continue;
        }
        let shown = records
            .iter()
            .map(|record| {
                let id = id(&record.row.capture, record.row.seed, &record.row.head);
                let (field, decoder) = scene::load_with_head(&bench.runs.file(&format!("{id}.cif")))?;
                let settings = scene::render_settings(&field);
                Ok(Shown { field, decoder, settings })
            })
            .collect::<Result<Vec<_>, Error>>()?;
        let file = folder.join(format!("{}.mp4", capture.name));
        let progress = |done: usize| {
            let percent = 100 * done / path.len();
            bench.show(&format!("{}: video: {percent} %", capture.name), false);
        };
        encode(OsStr::new(ENCODER), &file, &shown, &path, progress)?;
        bench.show(&format!("{}: wrote {}", capture.name, file.display()), true);
        let titles = records.iter().map(|record| title(&record.row.head, &capture.config.head.camera));
        videos.push(Video {
            capture: capture.name.clone(),
            file,
            parts: std::iter::once("colours".to_owned()).chain(titles).collect(),
        });
    }
    Ok(videos)
}

/// A run as it is drawn.
struct Shown {
    field: Field,
    decoder: Option<Decoder>,
    settings: RenderSettings,
}

/// Cameras and times of the pictures: through the held-out frames of the camera that has most of them, in the order of
/// their times, and straight from one to the next.
fn path(dataset: &Dataset) -> Vec<(PinholeCamera, f64)> {
    let held_out: Vec<&Frame> = dataset.frames.iter().filter(|frame| frame.split == Split::Val).collect();
    let of_camera = |name: &str| held_out.iter().filter(|frame| frame.camera_name == name).count();
    // Of equals the first.
    let most = held_out.iter().rev().max_by_key(|frame| of_camera(&frame.camera_name));
    let Some(camera) = most.map(|frame| frame.camera_name.as_str()) else { return Vec::new() };
    let mut frames: Vec<&Frame> =
        held_out.iter().copied().filter(|frame| frame.camera_name == camera).collect();
    frames.sort_by(|a, b| a.time.total_cmp(&b.time).then_with(|| a.name.cmp(&b.name)));
    let between = LEAST_PICTURES.div_ceil(frames.len().saturating_sub(1).max(1));
    let mut path = Vec::new();
    for pair in frames.windows(2) {
        for k in 0..between {
            let ratio = k as f64 / between as f64;
            let time = pair[0].time + (pair[1].time - pair[0].time) * ratio;
            path.push((pair[0].camera.toward(&pair[1].camera, ratio), time));
        }
    }
    path.extend(frames.last().map(|frame| (frame.camera, frame.time)));
    path
}

/// One picture: colours of the first run, then the labels of every one.
fn picture(renderer: &mut Renderer, shown: &[Shown], camera: &PinholeCamera, time: f64) -> Picture {
    let mut parts = Vec::new();
    for Shown { field, decoder, settings } in shown {
        let channels =
            Channels { depth: false, instances: decoder.is_none() && settings.instances.is_some() };
        let mut rendered = renderer.render(field, camera, time, settings, channels);
        if let Some(decoder) = decoder {
            let view = (camera, time);
            rendered.instances = Some(decoder.instances(renderer, field, view, settings, &rendered));
        }
        if parts.is_empty() {
            parts.push(rgb_picture(&rendered.color));
        }
        if let Some(instances) = &rendered.instances {
            // As in the pictures of the page.
            let shown =
                if decoder.is_none() { instances.foreground_label() } else { instances.label.clone() };
            parts.push(labels(&mask_ids(field, &shown)));
        }
    }
    side_by_side(&parts)
}

/// Renders the path and has it encoded; the file takes its place when it is whole.
fn encode(
    program: &OsStr,
    file: &Path,
    shown: &[Shown],
    path: &[(PinholeCamera, f64)],
    progress: impl Fn(usize),
) -> Result<(), Error> {
    let folder = file.parent().unwrap_or(Path::new("."));
    let scratch = Scratch::inside(folder).map_err(Error::io("write into", folder))?;
    let partial = scratch.file("mp4");
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let mut encoder: Option<Child> = None;
    for (done, (camera, time)) in path.iter().enumerate() {
        if let Err(interrupted) = interrupt::go_on() {
            if let Some(mut encoder) = encoder {
                let _ = encoder.kill();
                let _ = encoder.wait();
            }
            return Err(interrupted);
        }
        progress(done);
        let camera = camera.resized(
            camera.width.min(PART_WIDTH),
            (camera.height * camera.width.min(PART_WIDTH)).div_ceil(camera.width.max(1)),
        );
        let picture = picture(&mut renderer, shown, &camera, *time);
        let child = match &mut encoder {
            Some(child) => child,
            None => encoder.insert(start(program, &picture, &partial)?),
        };
        let bytes: Vec<u8> = picture.pixels.iter().flatten().copied().collect();
        // An encoder that has ended gives its reason when it is waited for.
        if child.stdin.as_mut().is_none_or(|input| input.write_all(&bytes).is_err()) {
            break;
        }
    }
    let Some(encoder) = encoder else { return Ok(()) };
    let ended = encoder.wait_with_output().map_err(|error| failed(&error.to_string()))?;
    if !ended.status.success() {
        let words = String::from_utf8_lossy(&ended.stderr);
        return Err(failed(words.lines().last().unwrap_or("it gave no reason")));
    }
    scratch.replace(&[(partial, file.to_owned())], &[]).map_err(Error::io("write", file))
}

/// An encoder that takes pictures of one size, rows of 8-bit colours, on its standard input.
fn start(program: &OsStr, first: &Picture, partial: &PathBuf) -> Result<Child, Error> {
    Command::new(program)
        .args(["-nostdin", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s"])
        .arg(format!("{}x{}", first.width, first.height))
        .args(["-r", RATE, "-i", "pipe:0", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264"])
        .args(["-pix_fmt", "yuv420p", "-crf", "20", "-threads", "1", "-movflags", "+faststart"])
        .arg(cif_input::for_ffmpeg(partial).map_err(Error::io("write", partial))?)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| failed(&error.to_string()))
}
