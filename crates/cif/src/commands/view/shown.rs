//! What is looked at: any scene, file or capture, as a page.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::{Dataset, Frame, PointSource, Split};
use cif_field::Field;
use cif_geometry::UpAxis;
use cif_scene::{LabelQuery, ReadOptions, SceneFormat, SceneGraph, SceneOptions};
use cif_web::Page;
use cif_web::describe::{self, NEAR, describe};
use cif_web::document::{Camera, Document, Timeline, VERSION};

use super::images::Images;
use crate::commands::shared::scene::{self, code_at};
use crate::commands::shared::{CaptureOptions, print_misfits, print_warnings};
use crate::error::Error;
use crate::formats::{self, Content};
use crate::messages::warning;
use crate::pictures::instance_color;

/// Frames per second of captures that do not say.
const FRAMES_PER_SECOND: f64 = 24.0;

/// A page, and the images that it asks for.
pub(in crate::commands) struct Shown {
    page: Page,
    images: Option<Images>,
}

impl Shown {
    /// A page, with the images of a capture.
    pub(in crate::commands) fn of(page: Page, dataset: Option<Dataset>) -> Self {
        Self { page, images: dataset.map(Images::of) }
    }

    /// The page, and what answers for its images.
    pub(super) fn into_parts(self) -> (Page, Option<Images>) {
        (self.page, self.images)
    }
}

/// Opens whatever a path names.
///
/// # Errors
/// When it cannot be read, or a capture is given in addition to a capture.
pub(super) fn open(path: &Path, capture: Option<&Path>, options: &CaptureOptions) -> Result<Shown, Error> {
    if path.is_dir() {
        if capture.is_some() {
            return Err(Error::usage(
                format!("--capture compares with a scene, and {} is a folder", path.display()),
                "leave --capture out, or name a scene to look at",
            ));
        }
        let dataset = options.open(path)?;
        print_warnings(&dataset);
        return Ok(of_capture(dataset, &formats::name_of(path)));
    }
    let (graph, field, paths) = match Content::of(path)? {
        Content::Field => {
            let field = scene::load(path)?;
            let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
            (cif_scene::build(&field, &options).map_err(Error::plain)?, Some(field), BTreeMap::new())
        }
        Content::Graph(format) => {
            let graph = formats::read(path, ReadOptions::default(), options.frames.window)?;
            (graph, None, paths(format, path))
        }
    };
    for warning in &graph.warnings {
        warning!("{warning}");
    }
    let mut page = describe(&graph, &formats::name_of(path), &paths, instance_color);
    page.document.stage = stage(path, &graph);
    let Some(capture) = capture else { return Ok(Shown { page, images: None }) };
    let dataset = of_scene(capture, options, &graph, field.as_ref())?;
    let codes = &graph.time_codes;
    page.document.views = views(&dataset, |frame| match &dataset.window {
        // A stage of several windows has fewer times of each than the window sees.
        Some(window) => (window.first + frame.time_index) as f64,
        None => code_at(&codes.times, &codes.samples, frame.time),
    });
    Ok(Shown { page, images: Some(Images::of(dataset)) })
}

/// The stage that edits of a page are a layer over: the one that is shown, or the one that a scene is exported as. Other
/// files hold no prims, and of stages of others nobody knows how their prims are placed.
fn stage(path: &Path, graph: &SceneGraph) -> Option<String> {
    if formats::is_field(path) {
        return Some(formats::name_of(&path.with_extension("usda")));
    }
    let is_usd = formats::format_of(path).is_ok_and(|format| format.about().key == "usd");
    (is_usd && graph.origin.field_fingerprint.is_some()).then(|| formats::name_of(path))
}

/// Paths of prims as the file has them, by the names of its nodes; formats that call them otherwise are asked, and none
/// where a file has no labels.
fn paths(format: &dyn SceneFormat, path: &Path) -> BTreeMap<String, String> {
    let all = LabelQuery { pattern: "*".into(), time_code: None };
    let found = format.query(path, &all, ReadOptions::default()).unwrap_or_default();
    found.into_iter().map(|object| (object.instance, object.path)).collect()
}

/// The capture that a scene is compared with.
fn of_scene(
    capture: &Path,
    options: &CaptureOptions,
    graph: &SceneGraph,
    field: Option<&Field>,
) -> Result<Dataset, Error> {
    let options = field.map_or_else(|| options.clone(), |field| options.as_trained(field));
    let dataset = options.open(capture)?;
    print_warnings(&dataset);
    if let Some(field) = field {
        print_misfits(field, &dataset, Split::Val);
    }
    if dataset.frame != graph.frame {
        return Err(Error::failed(
            format!("{}: its cameras lie in another frame than the scene", capture.display()),
            "name the capture that the scene was trained on, or leave --capture out",
        ));
    }
    Ok(dataset)
}

/// A capture that nothing was trained on: points, cameras and images.
fn of_capture(dataset: Dataset, title: &str) -> Shown {
    let codes: Vec<f64> = (0..dataset.times.len()).map(|index| index as f64).collect();
    let mut cameras: BTreeMap<&str, Vec<&Frame>> = BTreeMap::new();
    for frame in &dataset.frames {
        cameras.entry(&frame.camera_name).or_default().push(frame);
    }
    let camera = |(name, frames): (&str, Vec<&Frame>)| {
        let shots = frames.iter().map(|frame| describe::shot(frame.time_index as f64, &frame.camera));
        let mut samples: Vec<_> = shots.collect();
        samples.sort_by(|a, b| a.code.total_cmp(&b.code));
        samples.dedup_by(|a, b| a.code == b.code);
        Camera { name: name.to_owned(), samples }
    };
    let measured = dataset.points.source != PointSource::Random;
    let count = if measured { dataset.points.positions.len() } else { 0 };
    let width = dataset.extent() as f32 / 1_000.0;
    let (node, bytes) =
        describe::points(&dataset.points.positions[..count], &dataset.points.colors[..count], width);
    let document = Document {
        version: VERSION,
        title: title.to_owned(),
        up: describe::up(UpAxis::Z, dataset.frames.iter().map(|frame| &frame.camera)),
        meters_per_unit: None,
        background: [0.1; 3],
        sort: "z",
        antialiased: false,
        near: NEAR.min(width),
        timeline: Timeline {
            start: 0.0,
            end: codes.last().copied().unwrap_or(0.0),
            per_second: dataset.frames_per_second.unwrap_or(FRAMES_PER_SECOND),
            samples: codes,
        },
        nodes: vec![node],
        cameras: cameras.into_iter().map(camera).collect(),
        views: views(&dataset, |frame| frame.time_index as f64),
        stage: None,
        bytes: 0,
        live: false,
    };
    Shown { page: Page::of(document, bytes), images: Some(Images::of(dataset)) }
}

/// Images of a capture, with the time codes at which they were taken.
fn views(dataset: &Dataset, code: impl Fn(&Frame) -> f64) -> Vec<cif_web::document::View> {
    let view = |(index, frame): (usize, &Frame)| cif_web::document::View {
        name: frame.name.clone(),
        camera: frame.camera_name.clone(),
        split: match frame.split {
            Split::Train => "train",
            Split::Val => "val",
        },
        shot: describe::shot(code(frame), &frame.camera),
        image: format!("images/{index}.png"),
        mask: frame.mask.is_some().then(|| format!("masks/{index}.png")),
    };
    dataset.frames.iter().enumerate().map(view).collect()
}
