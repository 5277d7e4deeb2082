//! How long a batch takes on so many workers that share a folder.
//!
//! A list schedule: a worker takes the next job whose needs are done, the latest step first. A job takes the processor time
//! that jobs of its step took in the mean, and the time that its bytes take through the shared folder, whose bandwidth is
//! divided equally among the jobs that run.

use std::collections::BTreeMap;

use crate::job::Batch;
use crate::record::Spent;
use crate::schedule::{Limits, Schedule};

/// Workers, and the folder that they share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Farm {
    /// Workers, each one job at a time.
    pub workers: usize,
    /// Bytes per second that the shared folder serves, all workers together.
    pub bytes_per_s: f64,
}

/// Outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Forecast {
    /// Time from the first job to the end of the last, seconds.
    pub wall_s: f64,
    /// Share of the time of the workers in which they compute.
    pub busy: f64,
    /// Share of the time in which the shared folder serves at its limit.
    pub folder_busy: f64,
    /// Bytes read and written.
    pub bytes: f64,
}

/// Cost of a job of a step: work on a processor in seconds, and bytes through the folder.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Cost {
    work_s: f64,
    bytes: f64,
}

/// Forecast for the jobs of a batch that need to be done, from the means of those that ran; `None` where none of a step ran.
#[must_use]
pub fn forecast(batch: &Batch, spent: &BTreeMap<usize, Spent>, farm: Farm) -> Option<Forecast> {
    let costs: Vec<Cost> = batch
        .steps
        .iter()
        .map(|step| mean(spent.range(step.jobs.clone()).map(|(_, spent)| spent)))
        .collect::<Option<_>>()?;
    let workers = farm.workers.max(1);
    let mut schedule =
        Schedule::new(batch, Limits { jobs: workers, threads: workers as u32, memory: None }, |_| true);
    // Work and bytes that are left of the jobs that run.
    let mut running: BTreeMap<usize, Cost> = BTreeMap::new();
    let (mut time, mut worked, mut saturated, mut bytes) = (0.0, 0.0, 0.0, 0.0);
    loop {
        while let Some(next) = schedule.begin_next() {
            let cost = costs[batch.jobs[next.job].step];
            bytes += cost.bytes;
            running.insert(next.job, cost);
        }
        if running.is_empty() {
            break;
        }
        // A job reads and works at the same time: it ends when both are done.
        let readers = running.values().filter(|cost| cost.bytes > 0.0).count();
        let rate = farm.bytes_per_s / readers.max(1) as f64;
        // The next moment at which a job has done its work or moved its bytes.
        let next_change = |cost: &Cost| match (cost.work_s > 0.0, cost.bytes > 0.0) {
            (true, true) => cost.work_s.min(cost.bytes / rate),
            (true, false) => cost.work_s,
            (false, _) => cost.bytes / rate,
        };
        let step = running.values().map(next_change).fold(f64::INFINITY, f64::min);
        let computing = running.values().filter(|cost| cost.work_s > 0.0).count();
        worked += running.values().map(|cost| cost.work_s.min(step)).sum::<f64>();
        if readers > 0 && computing < running.len() {
            saturated += step;
        }
        time += step;
        for cost in running.values_mut() {
            cost.work_s = (cost.work_s - step).max(0.0);
            cost.bytes = if cost.bytes > 0.0 { (cost.bytes - rate * step).max(0.0) } else { 0.0 };
            // What rounding leaves.
            if cost.bytes < 1.0 {
                cost.bytes = 0.0;
            }
        }
        let ended: Vec<usize> = running
            .iter()
            .filter(|(_, cost)| cost.work_s <= 1e-9 && cost.bytes <= 0.0)
            .map(|(job, _)| *job)
            .collect();
        for job in ended {
            running.remove(&job);
            schedule.ended(job, true);
        }
    }
    let capacity = time * workers as f64;
    let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
    Some(Forecast { wall_s: time, busy: share(worked, capacity), folder_busy: share(saturated, time), bytes })
}

fn mean<'a>(spent: impl Iterator<Item = &'a Spent>) -> Option<Cost> {
    let (mut count, mut sum) = (0.0, Cost::default());
    for one in spent {
        count += 1.0;
        sum.work_s += one.cpu_s.max(1e-3);
        sum.bytes += (one.read_bytes + one.written_bytes) as f64;
    }
    (count > 0.0).then(|| Cost { work_s: sum.work_s / count, bytes: sum.bytes / count })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::job::{Job, Step};
    use crate::plan::{EngineOptions, Resources};

    /// `count` jobs of 10 s that read 1 GB each, and one that needs them all.
    fn batch(count: usize) -> (Batch, BTreeMap<usize, Spent>) {
        let job = |id: String, step, needs| Job {
            id,
            step,
            words: Vec::new(),
            needs,
            makes: Vec::new(),
            capture: None,
            goes_on: false,
        };
        let step = |name: &str, jobs, needs| Step {
            name: name.to_owned(),
            jobs,
            needs,
            resources: Resources::default(),
        };
        let mut jobs: Vec<Job> = (0..count).map(|k| job(format!("train/{k}"), 0, Vec::new())).collect();
        jobs.push(job("sum".to_owned(), 1, (0..count).collect()));
        let batch = Batch {
            name: String::new(),
            plan: "plan.toml".into(),
            folder: ".".into(),
            output: "results".into(),
            steps: vec![step("train", 0..count, Vec::new()), step("sum", count..count + 1, vec![0])],
            jobs,
            engines: EngineOptions::default(),
        };
        let spent = Spent { cpu_s: 10.0, read_bytes: 1_000_000_000, ..Spent::default() };
        let last = Spent { cpu_s: 1.0, ..Spent::default() };
        (batch, BTreeMap::from([(0, spent), (count, last)]))
    }

    #[test]
    fn workers_divide_the_work_until_the_folder_is_the_limit() {
        let (batch, spent) = batch(100);
        let of = |workers, bytes_per_s| forecast(&batch, &spent, Farm { workers, bytes_per_s }).unwrap();
        let one = of(1, 1e12);
        assert!((one.wall_s - 1_001.0).abs() < 1.0 && one.busy > 0.99, "{one:?}");
        let ten = of(10, 1e12);
        assert!((ten.wall_s - 101.0).abs() < 1.0 && ten.folder_busy < 0.01, "{ten:?}");
        // 100 GB at 1 GB/s are 100 s, however many workers there are.
        let many = of(100, 1e9);
        assert!((many.wall_s - 101.0).abs() < 1.5 && many.folder_busy > 0.8 && many.busy < 0.2, "{many:?}");
        assert!((many.bytes - 1e11).abs() < 1.0);
    }

    #[test]
    fn nothing_is_forecast_of_steps_that_never_ran() {
        let (batch, mut spent) = batch(3);
        spent.remove(&3);
        assert_eq!(forecast(&batch, &spent, Farm { workers: 2, bytes_per_s: 1e9 }), None);
    }
}
