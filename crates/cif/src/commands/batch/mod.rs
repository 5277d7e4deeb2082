//! `cif batch`: the jobs of a plan, here or on a farm.

mod board;
mod collect;
mod here;
mod inputs;
mod one;
mod parts;
mod report;

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::thread::available_parallelism;

use cif_batch::engines::{hyperqueue, openjd, slurm};
use cif_batch::record::{Record, State};
use cif_batch::schedule::Limits;
use cif_batch::simulate::{Farm, Forecast, forecast};
use cif_batch::steps::COLLECT;
use cif_batch::{Batch, Plan, expand};
use clap::{Args, ValueEnum};

use self::inputs::Inputs;
use self::one::{Job, Outcome};
use crate::commands::shared::table;
use crate::error::Error;
use crate::output::Outputs;
use crate::{interrupt, output};

const HELP: &str = "\
A plan names captures and what to do with them. It becomes jobs, each one cif command with the files that it makes and the
jobs that it needs. Paths are relative to the plan. The whole of it, where every line but `captures` may be left out:

  output = \"results\"                     # scenes/CAPTURE/SETTINGS/, jobs/, index.html
  captures = [\"captures/*\"]              # folders
  capture_options = \"--masks tracked\"    # of every command that reads a capture

  [train]                                # every combination is a scene
  preset = [\"draft\", \"standard\"]
  head = [\"cif\", \"sa4d\"]
  seed = [0, 1, 2]
  windows = 4                            # of time, for long captures: trained one by one, exported as one stage
  options = \"--max-gaussians 20000\"
  needs = [\"masks\"]                      # steps that come first

  [variants]                             # named options of cif train, one more list to combine
  plain = []
  smooth = \"--set loss.time_smoothness=0.05\"

  [eval]                                 # `eval = false` for none
  pictures = true
  options = []

  [export]
  files = [\"scene.usda\", \"scene.html\"]
  options = \"--check\"

  [[step]]                               # commands of your own
  name = \"film\"
  each = \"run\"                           # every scene; or \"whole\" for all its windows, \"capture\", \"batch\" for once
  command = \"render {scene} --path orbit -o {folder}/orbit.mp4\"
  makes = [\"{folder}/orbit.mp4\"]
  needs = [\"eval\"]

  [[bench]]                              # benches, a job for each part
  name = \"heads\"
  command = \"compare captures/a captures/b -o {output}/compare --seeds 3\"

  [resources]                            # of a job; also in a [[step]]
  threads = 4
  memory_gib = 6
  time = \"4h\"

  [engines]
  command = \"/shared/cif/bin/cif\"        # on the workers
  slurm = \"--partition=cpu\"

Placeholders: {capture}, {name}, {folder}, {scene}, {output}; the word {scenes} is the files of all windows of a scene.

  cif batch plan.toml --list                     which jobs there are, and which are done
  cif batch plan.toml                            run them here; the same command goes on after a stop
  cif batch plan.toml --forecast 100             how long with 1, 10 and 100 workers, from the jobs that ran
  cif batch plan.toml --for openjd -o job.json   for AWS Deadline Cloud, or: openjd run job.json --step collect --run-dependencies
  cif batch plan.toml --for slurm -o job.sh      then: sh job.sh
  cif batch plan.toml --for hyperqueue -o job.toml   then: hq job submit-file job.toml

Here, jobs share the processors and the memory: each has as many threads as are free for it, and begins when what jobs of its
step took before still fits. Several machines may run the same plan in a shared folder: a job is locked while it runs. A
training goes on from its last saved state, on whichever machine. A job is done again only if its command, its capture, the
version of cif or what it needs has changed. One that fails stops those that need it, and no others. In the end, index.html
has all scenes: quality, seconds by phase, memory, failures and pictures; scores.csv and costs.csv hold the numbers.";

/// Run many captures, settings and seeds as jobs, here or on a farm
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct BatchCommand {
    /// The plan
    #[arg(value_name = "PLAN.toml")]
    plan: PathBuf,
    /// List the jobs and how far they are
    #[arg(long, group = "what")]
    list: bool,
    /// Write the jobs for an engine: openjd, slurm or hyperqueue
    #[arg(long = "for", value_name = "ENGINE", group = "what", requires = "output")]
    engine: Option<Engine>,
    /// File of --for
    #[arg(short, long, value_name = "FILE", requires = "engine")]
    output: Option<PathBuf>,
    /// Replace an existing file of --for or of --json
    #[arg(long)]
    force: bool,
    /// Run these jobs alone, in their order: ids of --list, or by number as in train:0-9; may be repeated
    #[arg(long, value_name = "JOB", group = "what")]
    job: Vec<String>,
    /// Record jobs of --job that fail and end well, so that an engine goes on with others; `collect` fails all the same
    #[arg(long, requires = "job")]
    keep_going: bool,
    /// Write the page over all from what is there
    #[arg(long, group = "what")]
    collect: bool,
    /// Forecast the time with 1, 10, ... and N workers, from the jobs that ran
    #[arg(long, value_name = "N", group = "what", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    forecast: Option<u32>,
    /// Megabytes per second that a shared folder serves, for --forecast
    #[arg(long, value_name = "MB/S", default_value_t = 1_000.0, requires = "forecast")]
    folder_speed: f64,
    /// Jobs at once [default: as many as there are processors]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    jobs: Option<u32>,
    #[command(flatten)]
    report: crate::report::Report,
    #[arg(from_global)]
    threads: Option<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Engine {
    Openjd,
    Slurm,
    Hyperqueue,
}

pub(super) fn run(command: &BatchCommand) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.plan)?;
    command.report.check(&mut outputs)?;
    if let Some(file) = &command.output {
        outputs.file(file)?;
    }
    let plan = Plan::read(&command.plan)?;
    let batch = expand(&plan, &parts::Commands)?;
    if let (Some(engine), Some(file)) = (command.engine, &command.output) {
        return write_for(engine, &batch, file);
    }
    if command.list {
        return list(command, &batch);
    }
    if command.collect {
        return collect::collect(&batch);
    }
    if let Some(workers) = command.forecast {
        return show_forecast(&batch, workers, 1e6 * command.folder_speed);
    }
    match command.job.is_empty() {
        true => here::run(&batch, limits(command), &command.report),
        false => named(command, &batch),
    }
}

/// Resources of this machine for jobs.
fn limits(command: &BatchCommand) -> Limits {
    let threads =
        command.threads.unwrap_or_else(|| available_parallelism().map_or(1, NonZeroUsize::get) as u32);
    Limits {
        jobs: command.jobs.unwrap_or(threads) as usize,
        threads,
        memory: cif_system::memory::available(),
    }
}

fn write_for(engine: Engine, batch: &Batch, file: &std::path::Path) -> Result<(), Error> {
    let (text, next) = match engine {
        Engine::Openjd => (format!("{:#}\n", openjd::template(batch, file)), "openjd check"),
        Engine::Slurm => (slurm::script(batch), "sh"),
        Engine::Hyperqueue => (hyperqueue::job_file(batch), "hq job submit-file"),
    };
    output::write_file(file, text.as_bytes())?;
    let (jobs, steps) = (batch.jobs.len(), batch.steps.len());
    crate::messages::outcome!("wrote {jobs} jobs in {steps} steps; next: {next} {}", file.display());
    Ok(())
}

/// Runs jobs that are named, one after the other.
fn named(command: &BatchCommand, batch: &Batch) -> Result<(), Error> {
    interrupt::watch_and_save();
    let jobs = command.job.iter().map(|text| batch.named(text)).collect::<Result<Vec<_>, _>>()?;
    let inputs = Inputs::new(batch);
    let mut failed = Vec::new();
    for index in jobs.into_iter().flatten() {
        let of_plan = batch.steps[batch.jobs[index].step].resources.threads;
        let job = Job { batch, index, threads: command.threads.or(of_plan), wait: true };
        let id = &batch.jobs[index].id;
        match one::run(&job, &inputs)? {
            Outcome::Kept => crate::messages::outcome!("{id}: kept"),
            Outcome::Done(spent) => crate::messages::outcome!("{id}: done in {}", board::shown(&spent)),
            Outcome::Failed(why) => {
                crate::messages::warning!(
                    "{id}: failed: {why}; see {}",
                    batch.file_of(&batch.jobs[index], "log").display()
                );
                failed.push(id.as_str());
            }
            Outcome::Elsewhere => crate::messages::outcome!("{id}: another process has it"),
            Outcome::Interrupted => {
                return Err(Error::Interrupted {
                    message: format!("interrupted in {id}"),
                    help: Some("the same command goes on".to_owned()),
                });
            }
        }
    }
    if command.job.iter().any(|text| text.starts_with(COLLECT)) {
        return here::verdict(batch);
    }
    match failed.as_slice() {
        [] => Ok(()),
        _ if command.keep_going => Ok(()),
        failed => Err(Error::failed(format!("failed: {}", failed.join(", ")), "their logs say why")),
    }
}

fn list(command: &BatchCommand, batch: &Batch) -> Result<(), Error> {
    let inputs = Inputs::new(batch);
    let rows = report::JobState::of_all(batch, &inputs);
    let print = || {
        let mut table = table(["job", "state", "processor s", "memory MB", "command"]);
        for (row, job) in rows.iter().zip(&batch.jobs) {
            let number = |value: f64, digits: usize| {
                if value > 0.0 { format!("{value:.digits$}") } else { String::new() }
            };
            table.add_row([
                row.id.clone(),
                row.state.clone(),
                number(row.spent.cpu_s, 1),
                number(row.spent.peak_bytes as f64 / 1e6, 0),
                crate::commands::shared::command_line(&job.words),
            ]);
        }
        println!("{table}");
    };
    command.report.give(|| report::BatchReport::new(batch, rows.clone()), print)
}

fn show_forecast(batch: &Batch, workers: u32, bytes_per_s: f64) -> Result<(), Error> {
    let records = batch.jobs.iter().enumerate().filter_map(|(index, job)| {
        let record = Record::read(batch, job).filter(|record| record.state == State::Done)?;
        Some((index, record.spent))
    });
    let spent = records.collect();
    let missing = || {
        Error::failed(
            "a forecast needs a job of each step that has run",
            "run one of each first, as in: cif batch PLAN.toml --job train:0 --job eval:0",
        )
    };
    let mut table = table(["workers", "time", "workers busy %", "folder at its limit %", "GB moved"]);
    let powers =
        std::iter::successors(Some(1), |count| Some(count * 10)).take_while(|count| *count < workers);
    for workers in powers.chain([workers]) {
        let farm = Farm { workers: workers as usize, bytes_per_s };
        let Forecast { wall_s, busy, folder_busy, bytes } =
            forecast(batch, &spent, farm).ok_or_else(missing)?;
        table.add_row([
            workers.to_string(),
            board::duration(wall_s),
            format!("{:.0}", 100.0 * busy),
            format!("{:.0}", 100.0 * folder_busy),
            format!("{:.1}", bytes / 1e9),
        ]);
    }
    println!("{table}");
    Ok(())
}
