//! Scores of a scene on the frames of a capture.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use cif::Error;
use cif::evaluation::{load_with_head, motion_of, report_of};
use cif_dataset::{OpenOptions, Split};
use cif_train::heads::Decoder;
use cif_train::metrics::fit::misfits;
use cif_train::metrics::{EvaluationOptions, training_config};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use serde_json::{Value, json};

use crate::error::cif_error;
use crate::field::Field;
use crate::train::Capture;
use crate::{arrays, beside, process};

/// A scene, loaded or by its file.
#[derive(FromPyObject)]
pub(crate) enum Scene<'py> {
    /// Loaded or made.
    Field(PyRef<'py, Field>),
    /// A .cif file.
    File(PathBuf),
}

/// A capture that is open, or how to open it.
enum Source<'a> {
    Opened(&'a cif_dataset::Dataset),
    Folder(PathBuf, OpenOptions),
}

/// All scores, and what is to be said of them.
fn scores(
    field: &cif_field::Field,
    decoder: Option<&Decoder>,
    source: Source<'_>,
    split: Split,
    go_on: &dyn Fn() -> Result<(), Error>,
) -> Result<Value, Error> {
    let start = Instant::now();
    let opened;
    let dataset = match source {
        Source::Opened(dataset) => dataset,
        Source::Folder(folder, options) => {
            opened = cif_dataset::Dataset::open(&folder, &options).map_err(Error::plain)?;
            &opened
        }
    };
    let mut warnings = dataset.warnings.clone();
    warnings.extend(misfits(field, dataset, split).into_iter().map(|misfit| misfit.message));
    // Read first: damaged files are reported before frames are rendered.
    let truth = dataset.motion_truth().map_err(Error::plain)?;
    let covisible = split == Split::Val;
    let options = EvaluationOptions { split, covisible, decoder, ..EvaluationOptions::held_out(field) };
    let evaluation = cif_train::metrics::evaluate(field, dataset, &options, |_| go_on())?;
    let motion = match truth.map(|truth| motion_of(field, dataset, &truth)).transpose()? {
        Some(Err(reason)) => {
            warnings.push(format!("motion is not measured: {reason}"));
            None
        }
        measured => measured.and_then(Result::ok),
    };
    let scores = report_of(&evaluation, motion.as_ref(), field, decoder.map(Decoder::name));
    let mut report = json!(scores);
    report["warnings"] = json!(warnings);
    report["seconds"] = json!(start.elapsed().as_secs_f64());
    Ok(report)
}

/// Score a scene on frames of a capture: the scores of `cif eval --json`, as a dictionary.
///
/// scene is a field or a .cif file; a file that another head was trained on is scored by what that head
/// decodes. capture is an opened capture or its folder, which masks (a folder) and downscale (by default as
/// the scene was trained) say how to open. split is "val", the held-out frames, or "train".
///
/// The answer has frames (their number), psnr, psnr_mean_look (without the exposures of cameras), psnr_color_fitted
/// (colours of each image fitted to its truth), psnr_covisible and covisible (percent of pixels), ssim,
/// panoptic (quality, segmentation, recognition and iou in percent, pixels without a label being background),
/// macc_pix, macc_inst and miou (percent, over labelled pixels), variants (other definitions in use),
/// instances (scores of each), groups, per_frame, motion (against known motion, where the capture has it), gaussians,
/// render_ms_per_frame, train (of its run: wall_s, iterations and more), warnings, and seconds, which scoring
/// took by the clock of the wall. None means that there is nothing to measure. Ctrl-C raises
/// KeyboardInterrupt between two frames.
#[pyfunction]
#[pyo3(signature = (scene, capture, *, split="val", masks=None, downscale=None))]
pub(crate) fn evaluate<'py>(
    py: Python<'py>,
    scene: Scene<'py>,
    capture: Capture<'py>,
    split: &str,
    masks: Option<PathBuf>,
    downscale: Option<u32>,
) -> PyResult<Bound<'py, PyAny>> {
    let split = match split {
        "val" => Split::Val,
        "train" => Split::Train,
        other => return Err(PyValueError::new_err(format!("split '{other}': choose val or train"))),
    };
    let loaded;
    let (field, decoder) = match &scene {
        Scene::Field(field) => (&field.inner, None),
        Scene::File(path) => {
            let load = || load_with_head(path).map_err(|error| error.with_help());
            loaded = process::detach(py, load)?.map_err(cif_error)?;
            (&loaded.0, loaded.1.as_ref())
        }
    };
    let source = match &capture {
        Capture::Opened(_) if masks.is_some() || downscale.is_some() => {
            return Err(PyValueError::new_err("masks and downscale are given where the capture is opened"));
        }
        Capture::Opened(dataset) => Source::Opened(&dataset.inner),
        Capture::Folder(folder) => {
            let downscale = downscale.or_else(|| training_config(field)?.downscale);
            let window = field.record.window;
            Source::Folder(folder.clone(), OpenOptions { masks, downscale, window, ..OpenOptions::default() })
        }
    };
    let stopped = Arc::new(AtomicBool::new(false));
    let go_on = {
        let stopped = Arc::clone(&stopped);
        move || if stopped.load(Ordering::Relaxed) { Err(Error::plain("interrupted")) } else { Ok(()) }
    };
    let report = beside::run(
        py,
        || stopped.store(true, Ordering::Relaxed),
        |()| Ok(()),
        |_questions: beside::Questions<(), ()>| {
            scores(field, decoder, source, split, &go_on).map_err(|error| error.with_help())
        },
    )?;
    arrays::to_python(py, &report.map_err(cif_error)?)
}
