//! Measures one rung.

use std::path::Path;

use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::quality::Quality;
use cif_render::{Channels, RenderSettings, RenderedImage, reference};
use cif_scene::{ExportOptions, SceneFormat, SceneOptions, Tolerance};
use cif_train::metrics::image::psnr;
use cif_train::metrics::{EvaluationError, EvaluationOptions, FrameView, Scores, evaluate, trained_settings};
use cif_train::{Clock, Seconds, Start, Stop, SystemClock, TrainConfig, Trainer};
use half::f16;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::record::Record;
use crate::error::{Error, write_file};
use crate::records::Records;
use crate::training::Run;

/// An error that evaluation can pass on.
struct Failure(Error);

impl From<EvaluationError> for Failure {
    fn from(error: EvaluationError) -> Self {
        Self(Error::plain(error))
    }
}

/// A training run under its identifier.
pub struct Training<'a> {
    /// File name.
    pub id: &'a str,
    /// Capture as the rung trains on it.
    pub dataset: Dataset,
    /// Settings.
    pub config: TrainConfig,
}

/// An 8-bit display-referred picture.
type Picture = PixelGrid<[u8; 3]>;

/// Draws a view as pictures, each with what is put behind the identifier of the rung to name it.
pub type Draw<'a> = &'a dyn Fn(&FrameView<'_>) -> Vec<(&'static str, Picture)>;

/// Trains a rung, going on where it was interrupted. The scene and its time; none when `stop` says so.
///
/// # Errors
/// When a setting cannot work, or training fails.
pub fn train(
    folder: &Records<Record>,
    training: Training<'_>,
    stop: &Stop,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Option<(Field, Record)>, Error> {
    let run = Run {
        partial: &folder.file(&format!("{}.partial.cif", training.id)),
        dataset: &training.dataset,
        config: &training.config,
        until: None,
    };
    let begin = |start: Start| Trainer::new(start, training.config.clone());
    let Some(trainer) = run.train(&begin, stop, progress)? else { return Ok(None) };
    let (curve, spent) = (trainer.curve().clone(), trainer.time_of_training());
    let field = trainer.into_field();
    let run = field.record.run.clone().unwrap_or_default();
    let record = Record {
        cpu_s: spent.cpu_s,
        wall_s: spent.wall_s,
        gaussians: Some(field.len()),
        bytes: Some(parameter_bytes(&field, 4, 4, 4)),
        peak_rss_mb: run.peak_rss_mb,
        curve: Some(curve),
        ..Record::default()
    };
    Ok(Some((field, record)))
}

/// Scores a field on the held-out frames of `dataset` and keeps pictures of the frame that all rungs show.
///
/// # Errors
/// When a frame cannot be read or a picture not be written.
pub fn score(
    field: &Field,
    settings: &RenderSettings,
    dataset: &Dataset,
    id: &str,
    folder: &Records<Record>,
    draw: Draw<'_>,
    record: &mut Record,
) -> Result<(), Error> {
    let shown = shown_frame(dataset).map(|index| dataset.frames[index].name.clone());
    let options = EvaluationOptions { settings: *settings, ..EvaluationOptions::held_out(field) };
    let evaluation = evaluate::<Failure>(field, dataset, &options, |view| {
        if Some(&view.frame.name) != shown.as_ref() {
            return Ok(());
        }
        for (suffix, picture) in draw(&view) {
            let name = format!("{id}{suffix}.png");
            save(&folder.file(&name), &picture).map_err(Failure)?;
            record.pictures.push(name);
        }
        Ok(())
    })
    .map_err(|Failure(error)| error)?;
    let Scores { psnr, ssim, instance, panoptic, .. } = &evaluation.overall;
    (record.psnr, record.ssim, record.miou) = (*psnr, *ssim, instance.miou);
    (record.panoptic, record.iou) = (panoptic.quality, panoptic.iou);
    record.render_ms = Some(evaluation.render_ms_per_frame);
    Ok(())
}

/// The frame that all rungs show: the middle of the held-out ones.
#[must_use]
pub fn shown_frame(dataset: &Dataset) -> Option<usize> {
    let frames = dataset.frames.iter().enumerate();
    let held_out: Vec<usize> =
        frames.filter(|(_, f)| f.split == Split::Val).map(|(index, _)| index).collect();
    held_out.get(held_out.len() / 2).copied()
}

/// Writes a picture as PNG.
///
/// # Errors
/// When the file cannot be written.
pub fn save(path: &Path, picture: &Picture) -> Result<(), Error> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(picture.pixels.as_flattened(), picture.width, picture.height, ExtendedColorType::Rgb8)
        .map_err(|error| Error::plain(format!("cannot encode {}: {error}", path.display())))?;
    write_file(path, &bytes)
}

/// Saves the captured picture of the frame that all rungs show.
///
/// # Errors
/// When it cannot be read or written.
pub fn save_truth(dataset: &Dataset, background: [f32; 3], path: &Path) -> Result<(), Error> {
    let Some(index) = shown_frame(dataset) else { return Ok(()) };
    save(path, &dataset.load_image(index, background).map_err(Error::plain)?)
}

/// Bytes of parameters with so many per value of planes and network, of splats, and of their centres.
fn parameter_bytes(field: &Field, planes: u64, splats: u64, centres: u64) -> u64 {
    let deformation = field.deformation.as_ref().map_or(0, |d| d.planes.len() + d.mlp.len()) as u64;
    let coefficients = 3 * (u64::from(field.sh_degree) + 1).pow(2);
    let rows = field.len() as u64;
    let entries = field.identities.as_ref().map_or(0, |rows| rows.labels.len()) as u64;
    // Log-scales, quaternion, opacity, occupancy, colour; identities keep a label of 16 bits per entry.
    deformation * planes + rows * (3 * centres + (9 + coefficients) * splats) + entries * (2 + 2 * splats)
}

/// Rounds parts of a field to 16-bit floats; the field, and the bytes of its parameters.
#[must_use]
pub fn store(field: &Field, planes: bool, splats: bool, centres: bool) -> (Field, u64) {
    let round = |values: &mut [f32]| {
        for value in values {
            *value = f16::from_f32(*value).to_f32();
        }
    };
    let mut stored = field.clone();
    if let (Some(deformation), true) = (&mut stored.deformation, planes) {
        round(&mut deformation.planes);
        round(&mut deformation.mlp);
    }
    if splats {
        let gaussians = &mut stored.gaussians;
        round(gaussians.log_scales.as_flattened_mut());
        round(gaussians.quaternions.as_flattened_mut());
        round(&mut gaussians.opacity_logits);
        round(&mut gaussians.occupancy_logits);
        round(gaussians.sh_coefficients.as_flattened_mut());
        if let Some(rows) = &mut stored.identities {
            round(&mut rows.log_estimates);
            round(&mut rows.log_calibrations);
        }
    }
    if centres {
        round(stored.gaussians.means.as_flattened_mut());
    }
    let width = |half: bool| if half { 2 } else { 4 };
    let bytes = parameter_bytes(field, width(planes), width(splats), width(centres));
    (stored, bytes)
}

/// Largest difference of a colour between two pictures.
fn largest_difference(a: &PixelGrid<[f32; 3]>, b: &PixelGrid<[f32; 3]>) -> f64 {
    let pairs = a.pixels.as_flattened().iter().zip(b.pixels.as_flattened());
    pairs.map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max)
}

fn compare(image: &PixelGrid<[f32; 3]>, exact: &PixelGrid<[f32; 3]>, record: &mut Record) {
    record.residual = Some(largest_difference(image, exact));
    record.psnr_to_exact =
        Some(psnr(image, &exact.map(|p| p.map(|v| v.clamp(0.0, 1.0))))).filter(|value| value.is_finite());
}

/// Renders the shown frame with the reference, in 64 bits when `double`; none without held-out frames.
#[must_use]
pub fn with_reference(field: &Field, dataset: &Dataset, double: bool) -> Option<(RenderedImage, Seconds)> {
    let frame = &dataset.frames[shown_frame(dataset)?];
    let settings = RenderSettings { instances: None, ..trained_settings(field) };
    let clock = SystemClock::start();
    let start = clock.now();
    let channels = Channels::default();
    let image = if double {
        reference::render::<f64>(field, &frame.camera, frame.time, &settings, channels)
    } else {
        reference::render::<f32>(field, &frame.camera, frame.time, &settings, channels)
    };
    Some((image, clock.now() - start))
}

/// Compares a picture of the shown frame with the exact one and with what was captured.
///
/// # Errors
/// When the frame cannot be read.
pub fn against_exact(
    image: &RenderedImage,
    exact: &RenderedImage,
    dataset: &Dataset,
    record: &mut Record,
) -> Result<(), Error> {
    compare(&image.color, &exact.color, record);
    if let Some(index) = shown_frame(dataset) {
        let truth = dataset.load_image(index, [1.0; 3]).map_err(Error::plain)?;
        record.psnr = Some(psnr(&image.color, &cif_train::metrics::image::unit_color(&truth)));
    }
    Ok(())
}

/// Renders the shown frame with the fast path, at the quality given, several times.
#[must_use]
pub fn fast(field: &Field, dataset: &Dataset, quality: Quality) -> Option<(RenderedImage, Seconds)> {
    let frame = &dataset.frames[shown_frame(dataset)?];
    let settings = RenderSettings { instances: None, ..trained_settings(field) };
    let thinned = quality.thin(field);
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let mut render = || {
        let channels = Channels::default();
        quality.render(&mut renderer, &thinned, &frame.camera, frame.time, &settings, channels)
    };
    let image = render();
    let clock = SystemClock::start();
    let start = clock.now();
    const REPEATS: u32 = 8;
    for _ in 0..REPEATS {
        render();
    }
    let spent = clock.now() - start;
    let each = |seconds: f64| seconds / f64::from(REPEATS);
    Some((image, Seconds { wall_s: each(spent.wall_s), cpu_s: each(spent.cpu_s) }))
}

/// Renders all held-out frames at a quality, against the truth and against the final quality.
///
/// # Errors
/// When a frame cannot be read.
pub fn render(field: &Field, dataset: &Dataset, quality: Quality, record: &mut Record) -> Result<(), Error> {
    let settings = RenderSettings { instances: None, ..trained_settings(field) };
    let thinned = quality.thin(field);
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let clock = SystemClock::start();
    let (mut spent, mut frames, mut largest) = (Seconds::default(), 0u32, 0.0f64);
    let (mut to_truth, mut to_final) = (Vec::new(), Vec::new());
    for (index, frame) in dataset.frames.iter().enumerate().filter(|(_, frame)| frame.split == Split::Val) {
        let channels = Channels::default();
        let exact = renderer.render(field, &frame.camera, frame.time, &settings, channels);
        let start = clock.now();
        let image = quality.render(&mut renderer, &thinned, &frame.camera, frame.time, &settings, channels);
        spent += clock.now() - start;
        frames += 1;
        largest = largest.max(largest_difference(&image.color, &exact.color));
        let truth = dataset.load_image(index, settings.background).map_err(Error::plain)?;
        to_truth.push(psnr(&image.color, &cif_train::metrics::image::unit_color(&truth)));
        to_final.push(psnr(&image.color, &exact.color.map(|p| p.map(|v| v.clamp(0.0, 1.0)))));
    }
    let mean =
        |values: &[f64]| Some(values.iter().sum::<f64>() / values.len() as f64).filter(|v| v.is_finite());
    let each = |seconds: f64| seconds / f64::from(frames.max(1));
    (record.cpu_s, record.wall_s) = (each(spent.cpu_s), each(spent.wall_s));
    (record.psnr, record.psnr_to_exact) = (mean(&to_truth), mean(&to_final));
    record.residual = Some(largest);
    record.gaussians = Some(thinned.len());
    record.render_ms = Some(1e3 * record.wall_s);
    Ok(())
}

/// Exports a field inside a tolerance, to a temporary file.
///
/// # Errors
/// When the graph cannot be built or the file not be written.
pub fn export(field: &Field, tolerance: Tolerance, record: &mut Record) -> Result<(), Error> {
    let folder = tempfile::tempdir()
        .map_err(|error| Error::plain(format!("cannot make a temporary folder: {error}")))?;
    let format: &dyn SceneFormat = &cif_gltf::Gltf;
    let options = format.held(&SceneOptions { tolerance, ..SceneOptions::default() });
    let clock = SystemClock::start();
    let start = clock.now();
    let graph = cif_scene::build(field, &options).map_err(Error::plain)?;
    let path = folder.path().join("rung.glb");
    let written = format.write(&graph, &path, &ExportOptions::default()).map_err(Error::plain)?;
    let spent = clock.now() - start;
    (record.cpu_s, record.wall_s) = (spent.cpu_s, spent.wall_s);
    record.bytes = Some(written.bytes);
    let residual = graph.motion_table().iter().map(|row| row.motion.residual.decisive).fold(0.0, f64::max);
    record.residual = Some(residual);
    Ok(())
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic::{SyntheticConfig, generate};

    use super::*;

    #[test]
    fn half_precision_rounds_the_requested_fields() {
        let field = generate(&SyntheticConfig::default()).field;
        let (same, bytes) = store(&field, false, false, false);
        assert!(same == field);
        let (centres, fewer) = store(&field, false, false, true);
        assert_eq!(bytes - fewer, 6 * field.len() as u64);
        assert!(centres.gaussians.means != field.gaussians.means);
        assert_eq!(centres.gaussians.log_scales, field.gaussians.log_scales);
        let (all, least) = store(&field, true, true, true);
        assert!(least < fewer && all.gaussians.sh_coefficients != field.gaussians.sh_coefficients);
        assert_eq!(store(&all, true, true, true).0, all, "rounding twice changes nothing");
    }
}
