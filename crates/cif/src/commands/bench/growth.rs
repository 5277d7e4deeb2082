//! `cif bench growth`: how the cost of a training step grows with Gaussians and with pixels.

use std::path::PathBuf;
use std::time::Duration;

use cif_geometry::stats::median;
use cif_train::fit::{Grown, filled, grown};
use cif_train::metrics::training_config;
use cif_train::{Preset, TrainConfig};
use clap::Args;
use serde::Serialize;

use crate::commands::shared::{CaptureOptions, print_warnings, scene};
use crate::error::Error;
use crate::output::Outputs;
use crate::report::{JsonReport, Report as ReportOption};

/// Longest time that steps of one number of Gaussians and pixels are measured, three steps aside.
const LIMIT: Duration = Duration::from_secs(3);

/// Show how the cost of a training step grows with Gaussians and with pixels
#[derive(Debug, Args)]
#[command(after_help = "\
Steps of the fine stage are measured with the Gaussians of the capture's points, or of a trained
scene, thinned out or split until there are so many, and with images reduced as stated. Cells are
medians, milliseconds per step; exponents are slopes of their logarithms, by least squares: 1 is
proportional, 0 is no growth. Nothing is kept. On a GPU nothing counts pairs: evaluated_pairs is 0.

  cif bench growth captures/table --scene table.cif
  cif bench growth captures/table --gaussians 5000,50000,500000 --reductions 1,4 --json growth.json")]
pub(super) struct BenchGrowth {
    /// Folder of the capture
    capture: PathBuf,
    /// Trained scene whose Gaussians are taken, with its settings [default: the points and `standard`]
    #[arg(long, value_name = "SCENE.cif")]
    scene: Option<PathBuf>,
    /// Numbers of Gaussians
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "2000,10000,50000,200000",
          value_parser = clap::value_parser!(u32).range(100..=10_000_000))]
    gaussians: Vec<u32>,
    /// Reductions of the images
    #[arg(long, value_name = "K,...", value_delimiter = ',', default_value = "1,2,4",
          value_parser = clap::value_parser!(u32).range(1..=64))]
    reductions: Vec<u32>,
    /// Share of the Gaussians that moves, percent
    #[arg(long, value_name = "PERCENT", default_value_t = 40, value_parser = clap::value_parser!(u8).range(0..=100))]
    moving: u8,
    /// Backend that runs the steps
    #[cfg(feature = "wgpu")]
    #[arg(long, value_name = "BACKEND", default_value = "cpu")]
    backend: crate::commands::backend::Backend,
    #[command(flatten)]
    report: ReportOption,
    /// Replace existing output
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

/// Cost of a step by Gaussians and pixels.
#[derive(Debug, Serialize)]
struct Growth<'a> {
    /// `processor`, or the name of the GPU.
    engine: &'a str,
    /// Threads.
    threads: usize,
    /// All that was measured.
    cells: &'a [Cell],
    /// For every size of the images, the slope of the logarithm of the time by that of Gaussians.
    by_gaussians: Vec<Slope>,
    /// For every number of Gaussians, the slope by pixels.
    by_pixels: Vec<Slope>,
}

/// Steps with some number of Gaussians and pixels.
#[derive(Clone, Debug, Serialize)]
struct Cell {
    /// Gaussians.
    gaussians: usize,
    /// Width and height of the images.
    image_size: [u32; 2],
    /// Steps measured.
    steps: usize,
    /// Median, milliseconds per step.
    ms: f64,
    /// Mean number of pairs of a pixel and a Gaussian that are evaluated.
    evaluated_pairs: f64,
}

/// Growth along one of both.
#[derive(Debug, Serialize)]
struct Slope {
    /// Pixels, or Gaussians, that stay the same.
    of: u64,
    /// Exponent; null where there is one cell alone.
    exponent: Option<f64>,
}

impl JsonReport for Growth<'_> {
    const COMMANDS: &'static [&'static str] = &["cif bench growth"];
}

impl Cell {
    fn of(measured: &Grown) -> Self {
        let mut ms: Vec<f64> = measured.steps.iter().map(|step| 1e3 * step.total.as_secs_f64()).collect();
        let pairs: u64 = measured.steps.iter().map(|step| step.evaluated_pairs).sum();
        Self {
            gaussians: measured.gaussians,
            image_size: measured.image_size,
            steps: ms.len(),
            evaluated_pairs: pairs as f64 / ms.len().max(1) as f64,
            ms: median(&mut ms).unwrap_or(0.0),
        }
    }

    fn pixels(&self) -> u64 {
        u64::from(self.image_size[0]) * u64::from(self.image_size[1])
    }
}

/// Slope of the line through the logarithms of points, by least squares.
fn exponent(points: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let logs: Vec<[f64; 2]> = points.map(|(x, y)| [x.ln(), y.ln()]).collect();
    let mean = |k: usize| logs.iter().map(|log| log[k]).sum::<f64>() / logs.len() as f64;
    let (x, y) = (mean(0), mean(1));
    let variance: f64 = logs.iter().map(|log| (log[0] - x).powi(2)).sum();
    let covariance: f64 = logs.iter().map(|log| (log[0] - x) * (log[1] - y)).sum();
    (variance > 0.0).then(|| covariance / variance)
}

pub(super) fn run(command: &BenchGrowth) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    command.scene.as_deref().map_or(Ok(()), |scene| outputs.reads(scene))?;
    command.report.check(&mut outputs)?;
    let field = command.scene.as_deref().map(scene::load).transpose()?;
    let mut options = match &field {
        Some(field) => command.capture_options.as_trained(field),
        None => command.capture_options.clone(),
    };
    #[cfg(feature = "wgpu")]
    let gpu = command.backend.open()?;
    let (whole, mut cells, mut engine) = (options.downscale, Vec::new(), String::new());
    for reduction in &command.reductions {
        options.downscale = match whole {
            None if *reduction == 1 => None,
            whole => Some(whole.unwrap_or(1) * reduction),
        };
        let dataset = options.open(&command.capture)?;
        if cells.is_empty() {
            print_warnings(&dataset);
        }
        let trained = field.as_ref().and_then(training_config);
        let config = trained.unwrap_or_else(|| TrainConfig::preset(Preset::default(), dataset.layout));
        for gaussians in &command.gaussians {
            let moving = f64::from(command.moving) / 100.0;
            let count = *gaussians as usize;
            let mut trainer =
                filled(&dataset, &config, field.clone(), count, moving).map_err(Error::plain)?;
            #[cfg(feature = "wgpu")]
            command.backend.apply(gpu.as_ref(), &mut trainer)?;
            engine = trainer.gpu_name().unwrap_or("processor").to_owned();
            cells.push(Cell::of(&grown(&mut trainer, LIMIT).map_err(Error::plain)?));
        }
    }
    command.report.give(|| Growth::of(&cells, &engine), || Growth::of(&cells, &engine).print())
}

impl<'a> Growth<'a> {
    fn of(cells: &'a [Cell], engine: &'a str) -> Self {
        let slopes = |same: &dyn Fn(&Cell) -> u64, other: &dyn Fn(&Cell) -> u64| {
            let mut all: Vec<u64> = cells.iter().map(same).collect();
            all.sort_unstable();
            all.dedup();
            let slope = |of: u64| {
                let points = cells.iter().filter(|cell| same(cell) == of);
                Slope { of, exponent: exponent(points.map(|cell| (other(cell) as f64, cell.ms))) }
            };
            all.into_iter().map(slope).collect()
        };
        let gaussians = |cell: &Cell| cell.gaussians as u64;
        Self {
            engine,
            threads: rayon::current_num_threads(),
            by_gaussians: slopes(&Cell::pixels, &gaussians),
            by_pixels: slopes(&gaussians, &Cell::pixels),
            cells,
        }
    }

    fn print(&self) {
        let shown =
            |exponent: Option<f64>| exponent.map_or(String::new(), |exponent| format!("{exponent:.2}"));
        let mut heads = vec!["images".to_owned()];
        heads.extend(self.by_pixels.iter().map(|slope| format!("{} Gaussians", slope.of)));
        heads.push("exponent".to_owned());
        let mut table = crate::commands::shared::table(heads.iter().map(String::as_str));
        for row in self.by_gaussians.iter().rev() {
            let cells: Vec<&Cell> = self.cells.iter().filter(|cell| cell.pixels() == row.of).collect();
            let [width, height] = cells[0].image_size;
            let mut line = vec![format!("{width} x {height}")];
            line.extend(self.by_pixels.iter().map(|column| {
                let cell = cells.iter().find(|cell| cell.gaussians as u64 == column.of);
                cell.map_or(String::new(), |cell| format!("{:.1} ms", cell.ms))
            }));
            line.push(shown(row.exponent));
            table.add_row(line);
        }
        let mut last = vec!["exponent".to_owned()];
        last.extend(self.by_pixels.iter().map(|slope| shown(slope.exponent)));
        last.push(String::new());
        table.add_row(last);
        println!("fine stage, {}, {} threads, medians per step\n\n{table}", self.engine, self.threads);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_are_slopes() {
        let cell = |gaussians: usize, width: u32| Cell {
            gaussians,
            image_size: [width, 100],
            steps: 3,
            ms: 0.1 * (gaussians as f64).sqrt() * f64::from(width).powi(2),
            evaluated_pairs: 0.0,
        };
        let numbers = [100, 1_000, 10_000].into_iter();
        let cells: Vec<Cell> = numbers.flat_map(|n| [10, 20, 40].map(|width| cell(n, width))).collect();
        let growth = Growth::of(&cells, "processor");
        let all = |slopes: &[Slope], expected: f64| {
            slopes.len() == 3 && slopes.iter().all(|slope| (slope.exponent.unwrap() - expected).abs() < 1e-9)
        };
        assert!(all(&growth.by_gaussians, 0.5) && all(&growth.by_pixels, 2.0));
        assert!(Growth::of(&cells[..1], "processor").by_pixels[0].exponent.is_none());
    }
}
