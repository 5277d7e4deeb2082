//! `cif bench step`: what a training step costs, and where.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

#[cfg(feature = "wgpu")]
use cif_bench::device::{DeviceReport, OnDevice, StageTimes};
use cif_dataset::{Dataset, Layout};
use cif_field::Field;
use cif_geometry::stats::{median, median_of_sorted};
#[cfg(feature = "wgpu")]
use cif_render::Speed;
#[cfg(feature = "wgpu")]
use cif_render::wgpu::Gpu;
#[cfg(feature = "wgpu")]
use cif_train::floors::{Floor, StepShape};
use cif_train::metrics::training_config;
use cif_train::{InstancePass, Stage, StepTimes, Stop, TrainConfig, Trainer};
use clap::{Args, ValueEnum};
use serde::Serialize;

use crate::commands::shared::named::preset;
use crate::commands::shared::scene;
use crate::commands::shared::simd::Simd;
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::output::Outputs;
use crate::report::{JsonReport, Report as ReportOption};
use crate::settings::Layers;
use crate::{interrupt, starting_points};

/// Show where the time of a training step goes
#[derive(Debug, Args)]
#[command(after_help = "\
Times are milliseconds per step, mean and median over the measured steps; shares are of the mean.
Without --scene the Gaussians are the capture's points, with few of the properties of a trained
scene: give a scene to measure the cost of late training steps.

  cif bench step captures/table --preset draft
  cif bench step captures/table --scene table.cif --threads 1 --json cost.json
  cif bench step captures/table --scene table.cif --instances 8,256

In the instance stage every view is measured twice, with the instance pass and without, which gives
what the pass adds to colour. --instances repeats that from the same start with a longer table of
instances, with the labels spread over it. The trained steps are not saved.

On a GPU (--backend wgpu) every stage is also timed there, next to its floor: the bytes that it has to
move and the operations that it has to do at the least, at the speeds that a copy and a loop of
multiplications and additions reach on the same device. The same steps are then done on the processor.")]
pub(super) struct BenchStep {
    /// Folder of the capture
    capture: PathBuf,
    /// Trained scene to measure; settings come from it unless --preset is given
    #[arg(long, value_name = "SCENE.cif")]
    scene: Option<PathBuf>,
    /// Stage whose steps are measured [default: instance with a scene that has identities, else fine]
    #[arg(long)]
    stage: Option<StageName>,
    /// Steps to measure
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: u32,
    /// Steps before, not measured
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    warm_up: u32,
    /// Repeat the instance stage with so many instances
    #[arg(long, value_name = "K,...", value_delimiter = ',', value_parser = clap::value_parser!(u16).range(1..=60_000))]
    instances: Vec<u16>,
    #[command(flatten)]
    report: ReportOption,
    /// Replace existing output
    #[arg(long)]
    force: bool,
    /// Named settings: draft, standard, best or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Any setting by its key in SCENE.train.toml, e.g. --set stages.batch=2
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    capture_options: CaptureOptions,
    /// Vector instructions: `auto` takes the widest that the processor has
    #[arg(long, value_name = "LEVEL", default_value = "auto", value_parser = Simd::parser())]
    simd: Simd,
    /// Backend that runs the steps. On a GPU that has timestamps the parts are timed there, one step at a time;
    /// counts of what it does not count are 0
    #[cfg(feature = "wgpu")]
    #[arg(long, value_name = "BACKEND", default_value = "cpu")]
    backend: crate::commands::backend::Backend,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum StageName {
    Coarse,
    Fine,
    Instance,
}

impl From<StageName> for Stage {
    fn from(name: StageName) -> Self {
        match name {
            StageName::Coarse => Self::Coarse,
            StageName::Fine => Self::Fine,
            StageName::Instance => Self::Instance,
        }
    }
}

pub(super) fn run(command: &BenchStep) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    command.scene.as_deref().map_or(Ok(()), |scene| outputs.reads(scene))?;
    command.report.check(&mut outputs)?;
    if !command.instances.is_empty() && command.stage.is_some_and(|stage| stage != StageName::Instance) {
        return Err(no_instances());
    }
    let check = |layout| resolve(command, None, layout).map(drop);
    let layout = command.capture_options.layout_after(&command.capture, check)?;
    let field = command.scene.as_deref().map(scene::load).transpose()?;
    let stage: Stage = match command.stage {
        Some(stage) => stage.into(),
        None if field.as_ref().is_some_and(|field| field.identities.is_some()) => Stage::Instance,
        None => Stage::Fine,
    };
    if !command.instances.is_empty() && stage != Stage::Instance {
        return Err(no_instances());
    }
    let mut capture = match &field {
        Some(field) => command.capture_options.as_trained(field),
        None => command.capture_options.clone(),
    };
    capture.downscale = capture.downscale.or(resolve(command, field.as_ref(), layout)?.downscale);
    let mut dataset = capture.open(&command.capture)?;
    let config = resolve(command, field.as_ref(), dataset.layout)?;
    if field.is_none() && config.model.triangulate {
        starting_points::find(&mut dataset, &Stop::when(interrupt::requested).into())?;
    }
    print_warnings(&dataset);
    let report = measure(command, &dataset, &config, field, stage)?;
    command.report.give(|| report.report(), || report.print())
}

fn no_instances() -> Error {
    Error::usage(
        "--instances measures the instance stage",
        "give --stage instance, or a --scene that was trained with masks",
    )
}

/// Settings of the scene or the preset, then what was typed.
fn resolve(command: &BenchStep, field: Option<&Field>, layout: Layout) -> Result<TrainConfig, Error> {
    let base = match (&command.preset, field.and_then(training_config)) {
        (Some(name), _) => TrainConfig::preset(preset(name, "--preset")?, layout),
        (None, Some(trained)) => trained,
        (None, None) => TrainConfig::preset(Default::default(), layout),
    };
    let mut layers = Layers::new(base);
    for assignment in &command.set {
        layers.assignment(assignment)?;
    }
    layers.validated()
}

fn measure(
    command: &BenchStep,
    dataset: &Dataset,
    config: &TrainConfig,
    field: Option<Field>,
    stage: Stage,
) -> Result<Report, Error> {
    // Refused before any step is done.
    let present = match (&field, stage) {
        (Some(field), Stage::Instance) if field.identities.is_some() => field.instances.len(),
        _ => dataset.instances.len(),
    };
    let mut tables = command.instances.clone();
    tables.sort_unstable();
    tables.dedup();
    if let Some(short) = tables.iter().find(|count| usize::from(**count) < present) {
        return Err(Error::failed(
            format!("--instances {short}: the masks have {present} instances already"),
            format!("give {present} or more"),
        ));
    }
    // Every series starts from the same state, because training changes what a step costs.
    let mut series = Vec::new();
    let mut simd = String::new();
    #[cfg(feature = "wgpu")]
    let (gpu, mut device, mut floors) = (command.backend.open()?, None, None);
    for table in std::iter::once(None).chain(tables.into_iter().map(Some)) {
        let start = || {
            let (dataset, config, field) = (dataset.clone(), config.clone(), field.clone());
            let mut trainer = Trainer::for_measuring(dataset, config, field, stage, command.warm_up)
                .map_err(Error::plain)?;
            trainer.set_simd(command.simd.into());
            Ok::<_, Error>(trainer)
        };
        let mut trainer = start()?;
        if let Some(count) = table {
            trainer.spread_instances(usize::from(count));
        }
        simd = trainer.simd_name();
        #[cfg(feature = "wgpu")]
        {
            command.backend.apply(gpu.as_ref(), &mut trainer)?;
            trainer.time_gpu_stages();
            simd = trainer.gpu_name().map_or(simd, str::to_owned);
        }
        let measured = Series::measure(&mut trainer, command)?;
        #[cfg(feature = "wgpu")]
        match (&gpu, table, trainer.gpu_name()) {
            (Some(gpu), None, Some(_)) => {
                device = Some(beside_processor(command, gpu, &trainer, &measured, start)?);
            }
            (_, None, None) => floors = Some(Floors::new(command, &trainer.step_shape(&measured.steps))),
            _ => {}
        }
        series.push(measured);
    }
    Ok(Report {
        stage,
        warm_up: command.warm_up,
        simd,
        series,
        #[cfg(feature = "wgpu")]
        device,
        #[cfg(feature = "wgpu")]
        floors,
    })
}

/// Least times of the parts of a step on this processor.
#[cfg(feature = "wgpu")]
struct Floors {
    shape: StepShape,
    speed: Speed,
}

#[cfg(feature = "wgpu")]
impl Floors {
    /// Measures the processor by arrays as large as those of the optimiser.
    fn new(command: &BenchStep, shape: &StepShape) -> Self {
        let planes = shape.deformation.map_or(0.0, |deformation| deformation.planes);
        let bytes = BYTES_OF_GAUSSIAN * shape.gaussians + 16.0 * planes;
        Self { shape: *shape, speed: Speed::of_processor(command.simd.into(), bytes as usize) }
    }

    /// Of a part by its name; `None` where it has none.
    fn of(&self, part: &str) -> Option<LeastTime> {
        let floor = Floor::of_part(part, &self.shape)?;
        let by = if floor.is_by_memory(&self.speed) { "memory" } else { "arithmetic" };
        Some(LeastTime { ms: 1e3 * floor.seconds(&self.speed), by })
    }
}

/// Least time of a part of a step.
#[derive(Clone, Copy, Serialize)]
struct LeastTime {
    /// Milliseconds.
    ms: f64,
    /// Bound that decides: `memory` or `arithmetic`.
    by: &'static str,
}

/// Stages on the device next to their floors, and the same steps on the processor.
#[cfg(feature = "wgpu")]
fn beside_processor(
    command: &BenchStep,
    gpu: &Gpu,
    trainer: &Trainer,
    measured: &Series,
    start: impl FnOnce() -> Result<Trainer, Error>,
) -> Result<OnDevice, Error> {
    let mut processor = start()?;
    let on_processor = Series::measure(&mut processor, command)?;
    // Pairs are evaluated in the same views there, and counted.
    let shape = StepShape {
        evaluated_pairs: processor.step_shape(&on_processor.steps).evaluated_pairs,
        ..trainer.step_shape(&measured.steps)
    };
    let wall = |series: &Series| cost(&series.steps, |step| step.total).mean;
    Ok(OnDevice::new(gpu, &measured.device, &shape, [wall(measured), wall(&on_processor)])?)
}

/// Bytes of a Gaussian in training: 60 values, their gradients and two moments.
#[cfg(feature = "wgpu")]
const BYTES_OF_GAUSSIAN: f64 = 4.0 * 4.0 * 60.0;

/// Measured steps with one table of instances.
struct Series {
    instances: usize,
    steps: Vec<StepTimes>,
    /// The same views without the instance pass; empty in other stages.
    without: Vec<StepTimes>,
    /// Times of the stages on a GPU, step by step.
    #[cfg(feature = "wgpu")]
    device: Vec<StageTimes>,
}

impl Series {
    fn measure(trainer: &mut Trainer, command: &BenchStep) -> Result<Self, Error> {
        let compares = trainer.stage() == Stage::Instance;
        let instances = trainer.field().instances.len();
        let mut series = Self {
            instances,
            steps: Vec::new(),
            without: Vec::new(),
            #[cfg(feature = "wgpu")]
            device: Vec::new(),
        };
        for step in 0..command.warm_up + command.steps {
            let with = trainer.measure_step(InstancePass::On).map_err(Error::plain)?;
            #[cfg(feature = "wgpu")]
            let on_device = trainer.take_gpu_stages();
            let without = match compares {
                true => {
                    // In turns, so that whatever else the machine does falls on both.
                    trainer.repeat_views();
                    Some(trainer.measure_step(InstancePass::Off).map_err(Error::plain)?)
                }
                false => None,
            };
            #[cfg(feature = "wgpu")]
            drop(trainer.take_gpu_stages());
            if step >= command.warm_up {
                #[cfg(feature = "wgpu")]
                series.device.push(on_device);
                series.steps.push(with);
                series.without.extend(without);
            }
        }
        Ok(series)
    }

    /// Overhead of the instance pass over colour; `None` in other stages.
    fn overhead(&self) -> Option<Overhead> {
        if self.without.is_empty() {
            return None;
        }
        let raster = |times: &StepTimes| times.render.rasterize + times.render.rasterize_backward;
        let added = |of: &dyn Fn(&StepTimes) -> Duration| {
            let pairs = self.without.iter().zip(&self.steps);
            Added {
                without: cost(&self.without, of).median,
                with: cost(&self.steps, of).median,
                percent: added_percent(pairs.map(|(without, with)| (of(without), of(with)))),
            }
        };
        Some(Overhead { raster: added(&raster), total: added(&|times| times.total) })
    }
}

/// Overhead of the instance pass.
struct Overhead {
    /// Raster forward and backward.
    raster: Added,
    /// Whole step.
    total: Added,
}

/// Median milliseconds per step without and with the pass, and the median of what it adds to a view, percent.
struct Added {
    without: f64,
    with: f64,
    percent: Option<f64>,
}

/// Median of the growth of pairs of times, percent; `None` where no first time is measurable.
fn added_percent(pairs: impl Iterator<Item = (Duration, Duration)>) -> Option<f64> {
    let growth = |(without, with): (Duration, Duration)| {
        let without = without.as_secs_f64();
        (without > 0.0).then(|| 100.0 * (with.as_secs_f64() / without - 1.0))
    };
    let mut grown: Vec<f64> = pairs.filter_map(growth).collect();
    median(&mut grown)
}

/// Milliseconds per step.
struct Cost {
    mean: f64,
    median: f64,
}

fn cost(steps: &[StepTimes], of: impl Fn(&StepTimes) -> Duration) -> Cost {
    let mut ms: Vec<f64> = steps.iter().map(|step| 1e3 * of(step).as_secs_f64()).collect();
    ms.sort_by(f64::total_cmp);
    Cost {
        mean: ms.iter().sum::<f64>() / ms.len().max(1) as f64,
        median: median_of_sorted(&ms).unwrap_or(0.0),
    }
}

struct Report {
    stage: Stage,
    warm_up: u32,
    simd: String,
    /// The capture's own table of instances first.
    series: Vec<Series>,
    /// Stages on a GPU.
    #[cfg(feature = "wgpu")]
    device: Option<OnDevice>,
    /// Least times on the processor; none of steps on a GPU.
    #[cfg(feature = "wgpu")]
    floors: Option<Floors>,
}

/// A count per step, and the time that one of them takes.
struct Unit {
    name: &'static str,
    per_step: f64,
    /// Wall time of the stage over the count, nanoseconds.
    stage: &'static str,
    ns_each: Option<f64>,
}

/// Cost of the parts of a training step.
#[derive(Serialize)]
struct StepReport<'a> {
    /// Stage of the training.
    stage: Stage,
    /// Steps that were measured.
    steps: usize,
    /// Steps before them that were not.
    warm_up: u32,
    /// Threads.
    threads: usize,
    /// Vector instructions.
    simd: &'a str,
    /// Instances.
    instances: usize,
    /// Parts of a step on the processor, by name, and `total`.
    stages: BTreeMap<&'static str, PartReport>,
    /// Counts of the work of a step, by name.
    units: BTreeMap<&'static str, UnitReport>,
    /// Pairs of a pixel and a Gaussian that a thread evaluates in the forward raster pass, per second.
    evaluated_pairs_per_second_and_thread: Option<f64>,
    /// Cost of the instance pass on top of colour, for every number of instances; empty in other stages.
    instance_pass: Vec<PassReport>,
    /// The same steps on a GPU; null without one.
    #[cfg(feature = "wgpu")]
    device: Option<DeviceReport<'a>>,
    #[cfg(not(feature = "wgpu"))]
    device: Option<()>,
}

/// Wall time of a part of a step.
#[derive(Serialize)]
struct PartReport {
    /// Mean, milliseconds.
    mean_ms: f64,
    /// Median, milliseconds.
    median_ms: f64,
    /// Share of the mean of the whole step, in [0, 1].
    share: Option<f64>,
    /// Least time that its bytes and operations could take here; null where that is not known.
    floor: Option<LeastTime>,
}

/// A count of the work of a step.
#[derive(Serialize)]
struct UnitReport {
    /// Mean count of a step.
    per_step: f64,
    /// Part of the step whose time it is related to.
    of: &'static str,
    /// Time of that part over the count, nanoseconds.
    ns_each: Option<f64>,
}

/// Median cost of the instance pass, of views that were measured with and without it in turns.
#[derive(Serialize)]
struct PassReport {
    /// Instances.
    instances: usize,
    /// Raster forward and backward without the pass, milliseconds.
    raster_ms_without: f64,
    /// The same with it, milliseconds.
    raster_ms: f64,
    /// Median of the growth, percent.
    raster_overhead_percent: Option<f64>,
    /// Whole step without the pass, milliseconds.
    total_ms_without: f64,
    /// The same with it, milliseconds.
    total_ms: f64,
    /// Median of the growth, percent.
    total_overhead_percent: Option<f64>,
}

impl JsonReport for StepReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif bench step"];
}

impl Report {
    fn steps(&self) -> &[StepTimes] {
        &self.series[0].steps
    }

    /// Parts of a step in their order, and the whole.
    fn costs(&self) -> Vec<(&'static str, Cost)> {
        let steps = self.steps();
        let names: Vec<&'static str> = steps[0].rows().into_iter().map(|(name, _)| name).collect();
        let part = |index: usize| move |step: &StepTimes| step.rows()[index].1;
        let parts = names.into_iter().enumerate().map(|(index, name)| (name, cost(steps, part(index))));
        parts.chain([("total", cost(steps, |step| step.total))]).collect()
    }

    fn units(&self) -> Vec<Unit> {
        let steps = self.steps();
        let unit = |name, count: fn(&StepTimes) -> u64, stage, time: fn(&StepTimes) -> Duration| {
            let total: u64 = steps.iter().map(count).sum();
            let ns: f64 = steps.iter().map(|step| 1e9 * time(step).as_secs_f64()).sum();
            let per_step = total as f64 / steps.len() as f64;
            Unit { name, per_step, stage, ns_each: (total > 0).then(|| ns / total as f64) }
        };
        vec![
            unit("Gaussians", |step| step.gaussians, "deform", |step| step.render.deform),
            unit(
                "visible Gaussians",
                |step| step.visible,
                "project backward",
                |step| step.render.project_backward,
            ),
            unit("tile pairs", |step| step.tile_pairs, "bin and sort", |step| step.render.bin),
            unit("evaluated pairs", |step| step.evaluated_pairs, "rasterize", |step| step.render.rasterize),
            unit(
                "Gaussians deformed backward",
                |step| step.deformed_backward,
                "deform backward",
                |step| step.render.deform_backward,
            ),
        ]
    }

    /// Evaluated pairs per second and thread in the forward raster pass.
    fn pair_rate(&self) -> Option<f64> {
        let seconds: f64 = self.steps().iter().map(|step| step.render.rasterize.as_secs_f64()).sum();
        let pairs: u64 = self.steps().iter().map(|step| step.evaluated_pairs).sum();
        (seconds > 0.0).then(|| pairs as f64 / seconds / rayon::current_num_threads() as f64)
    }

    /// Least time of a part on the processor.
    #[cfg(feature = "wgpu")]
    fn floor(&self, part: &str) -> Option<LeastTime> {
        self.floors.as_ref()?.of(part)
    }

    #[cfg(not(feature = "wgpu"))]
    fn floor(&self, _: &str) -> Option<LeastTime> {
        None
    }

    fn report(&self) -> StepReport<'_> {
        let costs = self.costs();
        let whole = costs.last().map_or(0.0, |(_, cost)| cost.mean);
        let part = |(name, cost): &(&'static str, Cost)| {
            let share = (whole > 0.0).then(|| cost.mean / whole);
            let floor = self.floor(name);
            (*name, PartReport { mean_ms: cost.mean, median_ms: cost.median, share, floor })
        };
        let unit = |unit: Unit| {
            (unit.name, UnitReport { per_step: unit.per_step, of: unit.stage, ns_each: unit.ns_each })
        };
        let pass = |series: &Series| {
            let Overhead { raster, total } = series.overhead()?;
            Some(PassReport {
                instances: series.instances,
                raster_ms_without: raster.without,
                raster_ms: raster.with,
                raster_overhead_percent: raster.percent,
                total_ms_without: total.without,
                total_ms: total.with,
                total_overhead_percent: total.percent,
            })
        };
        StepReport {
            stage: self.stage,
            steps: self.steps().len(),
            warm_up: self.warm_up,
            threads: rayon::current_num_threads(),
            simd: &self.simd,
            instances: self.series[0].instances,
            stages: costs.iter().map(part).collect(),
            units: self.units().into_iter().map(unit).collect(),
            evaluated_pairs_per_second_and_thread: self.pair_rate(),
            instance_pass: self.series.iter().filter_map(pass).collect(),
            #[cfg(feature = "wgpu")]
            device: self.device.as_ref().map(OnDevice::report),
            #[cfg(not(feature = "wgpu"))]
            device: None::<()>,
        }
    }

    fn print(&self) {
        println!(
            "{} stage, {} steps after {}, {} threads, {}\n",
            self.stage,
            self.steps().len(),
            self.warm_up,
            rayon::current_num_threads(),
            self.simd
        );
        let costs = self.costs();
        let whole = costs.last().map_or(0.0, |(_, cost)| cost.mean);
        let heads = ["part of a step", "ms", "median ms", "share", "least ms", "times as long", "by"];
        let mut table = crate::commands::shared::table(heads);
        for (name, cost) in &costs {
            let share = if whole > 0.0 { 100.0 * cost.mean / whole } else { 0.0 };
            let floor = self.floor(name);
            table.add_row([
                (*name).to_owned(),
                format!("{:.3}", cost.mean),
                format!("{:.3}", cost.median),
                format!("{share:.1} %"),
                floor.map_or(String::new(), |floor| format!("{:.3}", floor.ms)),
                floor.map_or(String::new(), |floor| format!("{:.1}", cost.mean / floor.ms.max(1e-9))),
                floor.map_or(String::new(), |floor| floor.by.to_owned()),
            ]);
        }
        println!("{table}\n");
        #[cfg(feature = "wgpu")]
        if let Some(Floors { speed, .. }) = &self.floors {
            println!(
                "least: every array once at {:.1} GB/s, or every operation at {:.0} GFLOP/s, as measured here\n",
                speed.bytes_per_second / 1e9,
                speed.flops_per_second / 1e9
            );
        }
        let mut table = crate::commands::shared::table(["work", "per step", "ns each", "of"]);
        // What was not counted, or not done, has no line.
        for unit in self.units().into_iter().filter(|unit| unit.ns_each.is_some()) {
            table.add_row([
                unit.name.to_owned(),
                format!("{:.0}", unit.per_step),
                number(unit.ns_each, 2),
                unit.stage.to_owned(),
            ]);
        }
        println!("{table}\n");
        // A GPU does not count the pairs that it evaluates.
        if let Some(rate) = self.pair_rate().filter(|rate| *rate > 0.0) {
            println!("{:.1} million evaluated pairs per second and thread (rasterize)", rate / 1e6);
        }
        #[cfg(feature = "wgpu")]
        if let Some(device) = &self.device {
            println!("{}", device.table());
        }
        if self.series.iter().all(|series| series.without.is_empty()) {
            return;
        }
        let mut table = crate::commands::shared::table([
            "instances",
            "raster ms without",
            "with instance pass",
            "overhead",
            "total ms without",
            "with",
            "overhead",
        ]);
        for series in &self.series {
            let Some(Overhead { raster, total }) = series.overhead() else { continue };
            table.add_row([
                series.instances.to_string(),
                format!("{:.3}", raster.without),
                format!("{:.3}", raster.with),
                format!("{} %", number(raster.percent, 1)),
                format!("{:.3}", total.without),
                format!("{:.3}", total.with),
                format!("{} %", number(total.percent, 1)),
            ]);
        }
        println!(
            "\nInstance pass on top of colour, medians over views measured in turns; raster is forward and backward:\n{table}"
        );
    }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("n/a".to_owned(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_are_mean_and_median() {
        let steps =
            [1, 2, 3, 10].map(|ms| StepTimes { total: Duration::from_millis(ms), ..Default::default() });
        let all = cost(&steps, |step| step.total);
        assert!((all.mean - 4.0).abs() < 1e-9 && (all.median - 2.5).abs() < 1e-9);
        assert!((cost(&steps[..3], |step| step.total).median - 2.0).abs() < 1e-9);
        let pairs = [(2, 3), (100, 110), (0, 5), (10, 12)];
        let pairs = pairs.map(|(without, with)| (Duration::from_secs(without), Duration::from_secs(with)));
        assert!((added_percent(pairs.into_iter()).unwrap() - 20.0).abs() < 1e-9);
        assert_eq!(added_percent(pairs[2..3].iter().copied()), None);
    }
}
