//! `cif embed`: what objects look like, for questions in words.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::{Dataset, Split};
use cif_field::{Checkpoint, Embeddings, Field, Instance};
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use cif_vision::embedding::{PictureEmbedder, unit};
use cif_vision::{Models, library};
use clap::Args;
use serde::Serialize;

use super::shared::scene;
use crate::commands::shared::{CaptureOptions, FrameOptions, LayoutName, print_misfits, print_warnings};
use crate::error::Error;
use crate::formats;
use crate::instance_views::{Coverage, cut_out};
use crate::lock::Lock;
use crate::messages::is_quiet;
use crate::output::Outputs;
use crate::progress::FrameProgress;
use crate::report::{JsonReport, Report};
use crate::{endings, interrupt};

/// Store an embedding of every object, so that cif query --text finds objects by meaning
#[derive(Debug, Args)]
#[command(after_help = "\
Every object is cut out of the captured training views that show most of it, and a model such as CLIP
makes an embedding of each; their mean is kept in the scene, and in stages that are exported from it
afterwards, as cif:embedding. The file is written to a temporary file in the same folder, which then replaces it.

  cif embed table.cif --capture captures/table --models models
  cif export table.cif --usd table.usda
  cif query table.usda --text 'something to drink from' --models models

The folder of models is described in cif query --help; this takes its [embedder].")]
pub(super) struct Embed {
    /// Trained scene (.cif)
    #[arg(value_name = "SCENE")]
    path: PathBuf,
    /// Capture that it was trained on
    #[arg(long, value_name = "CAPTURE")]
    capture: PathBuf,
    /// Folder of ONNX models with a models.toml
    #[arg(long, value_name = "DIR")]
    models: PathBuf,
    /// Views per object, at most
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1000))]
    views: u32,
    /// Write to another file and leave this one as it is
    #[arg(short, long, value_name = "OUT.cif", value_parser = endings::scene())]
    output: Option<PathBuf>,
    /// Replace existing files of -o and --json
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    report: Report,
    /// Reduce images by 1, 2, 4, ... [default: as the scene was trained]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    downscale: Option<u32>,
    /// Read the capture as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    layout: Option<LayoutName>,
    #[command(flatten)]
    frames: FrameOptions,
}

pub(super) fn run(command: &Embed) -> Result<(), Error> {
    if !formats::is_field(&command.path) {
        return Err(Error::usage(
            "embeddings are made for a trained scene (.cif)",
            "give the .cif, and export the stage again afterwards",
        ));
    }
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.path)?;
    command.output.as_deref().map_or(Ok(()), |output| outputs.file(output))?;
    command.report.check(&mut outputs)?;
    let models = Models::open(&command.models)?;
    let name = models.embedder_name()?;
    let mut embedder = PictureEmbedder::open(&library::find(&crate::pythons())?, &models)?;
    // The whole file, so that a training state in it stays.
    // From before it is read, so that no other change is lost.
    let target = command.output.as_deref().unwrap_or(&command.path);
    let _lock = Lock::wait(target)?;
    let mut checkpoint = Checkpoint::load(&command.path).map_err(Error::plain)?;
    let field = &checkpoint.field;
    if field.identities.is_none() {
        return Err(Error::failed(
            format!("{} was trained without masks, so it has no objects to look at", command.path.display()),
            "train it with instance masks",
        ));
    }
    let options = CaptureOptions::pictures_of(field, command.downscale, command.layout, &command.frames);
    let dataset = options.open(&command.capture)?;
    print_warnings(&dataset);
    print_misfits(field, &dataset, Split::Train);
    interrupt::watch();
    let mut views = Views {
        field,
        dataset: &dataset,
        settings: scene::render_settings(field),
        renderer: Renderer::new(SimdLevel::Auto),
    };
    let shown = views.best(command.views as usize)?;
    let embeddings = views.embed(&mut embedder, &shown)?;
    let views: Vec<_> = field.instances.iter().cloned().zip(shown.iter().map(Vec::len)).collect();
    if embeddings.is_empty() {
        return Err(Error::failed(
            format!("no training view of {} shows an object", command.capture.display()),
            "give the capture that the scene was trained on",
        ));
    }
    checkpoint.field.record.embeddings = Some(Embeddings { model: name.to_owned(), of: embeddings });
    checkpoint.save(target).map_err(Error::plain)?;
    let seen = |(instance, views): &(Instance, usize)| SeenInstance {
        id: instance.id,
        label: instance.label.clone(),
        views: *views,
    };
    let report = || EmbedReport { scene: target, model: name, instances: views.iter().map(seen).collect() };
    command.report.give(report, || {
        let mut table = crate::commands::shared::table(["id", "label", "views"]);
        for (instance, views) in &views {
            table.add_row([instance.id.to_string(), instance.label.clone(), views.to_string()]);
        }
        println!("{table}");
        println!("{}: embeddings by {name}", target.display());
    })
}

/// Embeddings that were added to a scene.
#[derive(Serialize)]
struct EmbedReport<'a> {
    /// File that was written.
    scene: &'a Path,
    /// Model that made the embeddings.
    model: &'a str,
    /// Instances of the scene.
    instances: Vec<SeenInstance>,
}

/// An instance and the views that show it.
#[derive(Serialize)]
struct SeenInstance {
    /// Mask id.
    id: u16,
    /// Label.
    label: String,
    /// Views whose mean its embedding is; 0 where it has none.
    views: usize,
}

impl JsonReport for EmbedReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif embed"];
}

/// The training views of a scene.
struct Views<'a> {
    field: &'a Field,
    dataset: &'a Dataset,
    settings: RenderSettings,
    renderer: Renderer,
}

impl Views<'_> {
    /// Labels of a frame as the scene shows it.
    fn labels(&mut self, index: usize) -> PixelGrid<u16> {
        let frame = &self.dataset.frames[index];
        let channels = Channels { depth: false, instances: true };
        let image = self.renderer.render(self.field, &frame.camera, frame.time, &self.settings, channels);
        image.instances.expect("instances were asked for").foreground_label()
    }

    /// Frames that show an instance best, by instance.
    fn best(&mut self, most: usize) -> Result<Vec<Vec<usize>>, Error> {
        let frames = self.dataset.train_frames();
        let mut coverage = Coverage::new(self.field.instances.len());
        let mut progress = FrameProgress::new(is_quiet(), frames.len());
        for index in frames {
            interrupt::go_on()?;
            let labels = self.labels(index);
            coverage.add(index, &labels);
            progress.step();
        }
        Ok((0..self.field.instances.len()).map(|instance| coverage.best(instance, most)).collect())
    }

    /// Mean embedding of every instance over its frames, by id.
    fn embed(
        &mut self,
        embedder: &mut PictureEmbedder,
        shown: &[Vec<usize>],
    ) -> Result<BTreeMap<u16, Vec<f32>>, Error> {
        let mut of_frame: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (instance, frames) in shown.iter().enumerate() {
            for frame in frames {
                of_frame.entry(*frame).or_default().push(instance);
            }
        }
        let mut sums: Vec<Vec<f32>> = vec![Vec::new(); shown.len()];
        let mut progress = FrameProgress::new(is_quiet(), of_frame.len());
        for (index, instances) in of_frame {
            let labels = self.labels(index);
            let picture = self.dataset.load_image(index, self.settings.background)?;
            for instance in instances {
                interrupt::go_on()?;
                let Some(square) = cut_out(&picture, &labels, instance as u16 + 1) else { continue };
                let direction = embedder.embed(&square)?;
                let sum = &mut sums[instance];
                sum.resize(direction.len(), 0.0);
                for (sum, value) in sum.iter_mut().zip(direction) {
                    *sum += value;
                }
            }
            progress.step();
        }
        let ids = self.field.instances.iter().map(|instance| instance.id);
        Ok(ids.zip(sums).filter_map(|(id, sum)| Some((id, unit(&sum)?))).collect())
    }
}
