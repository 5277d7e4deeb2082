//! Which job is next on a machine: those whose needs are done, the latest step first, within threads and memory.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use crate::job::Batch;
use crate::steps::COLLECT;

/// How a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// It waits for others.
    Waits,
    /// It may begin.
    Ready,
    /// It runs.
    Runs,
    /// It is done.
    Done,
    /// It failed.
    Failed,
    /// It will not run, because one that it needs failed.
    LeftOut,
}

/// Resources of a machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Jobs at once.
    pub jobs: usize,
    /// Threads.
    pub threads: u32,
    /// Bytes of memory; `None` where that is not known.
    pub memory: Option<u64>,
}

/// A job that may begin now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Next {
    /// The job.
    pub job: usize,
    /// Threads for it.
    pub threads: u32,
}

/// Jobs of a batch under way on one machine.
#[derive(Debug)]
pub struct Schedule<'a> {
    batch: &'a Batch,
    limits: Limits,
    standing: Vec<Standing>,
    /// Jobs that need a job.
    needed_by: Vec<Vec<usize>>,
    /// Jobs that a job still waits for.
    left: Vec<usize>,
    ready: BTreeSet<(Reverse<usize>, usize)>,
    /// Threads and bytes of the jobs that run.
    running: BTreeMap<usize, (u32, u64)>,
    /// Largest memory that jobs of a step took, bytes; 0 where none has run.
    seen: Vec<u64>,
}

/// Memory of a job of which nothing is known, bytes: what a capture of 100 images of 640 x 360 takes in training, rounded up.
const UNKNOWN: u64 = 2 << 30;

impl<'a> Schedule<'a> {
    /// All jobs, none begun; `chosen` are to be done.
    #[must_use]
    pub fn new(batch: &'a Batch, limits: Limits, chosen: impl Fn(usize) -> bool) -> Self {
        let count = batch.jobs.len();
        let mut needed_by = vec![Vec::new(); count];
        for (k, job) in batch.jobs.iter().enumerate() {
            job.needs.iter().for_each(|need| needed_by[*need].push(k));
        }
        let mut schedule = Self {
            batch,
            limits: Limits { jobs: limits.jobs.max(1), threads: limits.threads.max(1), ..limits },
            standing: vec![Standing::Waits; count],
            needed_by,
            left: batch.jobs.iter().map(|job| job.needs.len()).collect(),
            ready: BTreeSet::new(),
            running: BTreeMap::new(),
            seen: vec![0; batch.steps.len()],
        };
        for job in 0..count {
            if chosen(job) && schedule.left[job] == 0 {
                schedule.make_ready(job);
            }
        }
        schedule
    }

    fn make_ready(&mut self, job: usize) {
        self.standing[job] = Standing::Ready;
        self.ready.insert((Reverse(self.batch.jobs[job].step), job));
    }

    /// How a job stands.
    #[must_use]
    pub fn standing(&self, job: usize) -> Standing {
        self.standing[job]
    }

    /// Jobs that run.
    #[must_use]
    pub fn running(&self) -> usize {
        self.running.len()
    }

    /// A job that is ready and of which it is not known yet whether it is done already.
    pub fn ready(&self) -> impl Iterator<Item = usize> {
        self.ready.iter().map(|(_, job)| *job)
    }

    /// Memory that a job is expected to take, bytes: the most that jobs of its step took, else what the plan says.
    fn memory(&self, job: usize) -> u64 {
        let step = self.batch.jobs[job].step;
        let declared =
            self.batch.steps[step].resources.memory_gib.map(|gib| (gib * f64::from(1 << 30)) as u64);
        match (self.seen[step], declared) {
            (0, None) => UNKNOWN,
            // Others of the step may take a little more.
            (seen, declared) => (seen + seen / 8).max(declared.unwrap_or(0)),
        }
    }

    /// A job of a step took so much memory, bytes.
    pub fn saw(&mut self, job: usize, bytes: u64) {
        let seen = &mut self.seen[self.batch.jobs[job].step];
        *seen = (*seen).max(bytes);
    }

    /// Begins the next job, where one fits. One alone always fits.
    pub fn begin_next(&mut self) -> Option<Next> {
        if self.running.len() >= self.limits.jobs {
            return None;
        }
        let used: u64 = self.running.values().map(|(_, bytes)| bytes).sum();
        let fits = |job: usize| {
            let free = self.limits.memory.map(|memory| memory.saturating_sub(used));
            self.running.is_empty() || free.is_none_or(|free| self.memory(job) <= free)
        };
        let key = *self.ready.iter().find(|(_, job)| fits(*job))?;
        let job = key.1;
        let busy: u32 = self.running.values().map(|(threads, _)| threads).sum();
        let free = self.limits.threads.saturating_sub(busy).max(1);
        // What is free is shared among those that may begin along with it.
        let others = self.ready.len().min(self.limits.jobs - self.running.len());
        let threads = self.batch.steps[self.batch.jobs[job].step].resources.threads;
        let threads = threads.unwrap_or((free / others.max(1) as u32).max(1)).min(self.limits.threads);
        self.ready.remove(&key);
        self.running.insert(job, (threads, self.memory(job)));
        self.standing[job] = Standing::Runs;
        Some(Next { job, threads })
    }

    /// A job ended, or was done before; returns the jobs that will not run now.
    pub fn ended(&mut self, job: usize, well: bool) -> Vec<usize> {
        self.running.remove(&job);
        self.ready.remove(&(Reverse(self.batch.jobs[job].step), job));
        self.standing[job] = if well { Standing::Done } else { Standing::Failed };
        let mut left_out = Vec::new();
        let mut open = vec![(job, well)];
        while let Some((job, well)) = open.pop() {
            for dependent in self.needed_by[job].clone() {
                self.left[dependent] -= 1;
                let collects = self.batch.jobs[dependent].id == COLLECT;
                if well || collects {
                    if self.left[dependent] == 0 && self.standing[dependent] == Standing::Waits {
                        self.make_ready(dependent);
                    }
                } else if self.standing[dependent] == Standing::Waits {
                    self.standing[dependent] = Standing::LeftOut;
                    left_out.push(dependent);
                    open.push((dependent, false));
                }
            }
        }
        left_out
    }

    /// A job cannot run now, because another machine has it.
    pub fn put_aside(&mut self, job: usize) {
        self.running.remove(&job);
        self.standing[job] = Standing::Waits;
    }

    /// A job that was put aside may be tried again.
    pub fn give_back(&mut self, job: usize) {
        self.make_ready(job);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::expand::{Benches, Part, expand};
    use crate::plan::Plan;

    struct None_;

    impl Benches for None_ {
        fn parts(&self, _: &[String], _: &std::path::Path) -> Result<Vec<Part>, cif_system::Error> {
            Ok(Vec::new())
        }
    }

    fn batch(extra: &str) -> Batch {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a", "b", "c"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        let file = folder.path().join("plan.toml");
        std::fs::write(&file, format!("captures = ['a', 'b', 'c']\n[export]\nfiles = ['x.glb']\n{extra}"))
            .unwrap();
        expand(&Plan::read(&file).unwrap(), &None_).unwrap()
    }

    fn id(batch: &Batch, next: Option<Next>) -> (String, u32) {
        let next = next.unwrap();
        (batch.jobs[next.job].id.clone(), next.threads)
    }

    #[test]
    fn what_follows_a_job_comes_before_other_jobs_and_the_last_have_more_threads() {
        let batch = batch("");
        let limits = Limits { jobs: 2, threads: 4, memory: None };
        let mut schedule = Schedule::new(&batch, limits, |_| true);
        assert_eq!(id(&batch, schedule.begin_next()), ("train/a/run".to_owned(), 2));
        assert_eq!(id(&batch, schedule.begin_next()), ("train/b/run".to_owned(), 2));
        assert_eq!(schedule.begin_next(), None);
        schedule.ended(0, true);
        assert_eq!(id(&batch, schedule.begin_next()).0, "export/a/run");
        schedule.ended(6, true);
        assert_eq!(id(&batch, schedule.begin_next()).0, "eval/a/run");
        for job in [1, 3, 4, 7] {
            schedule.ended(job, true);
        }
        assert_eq!(id(&batch, schedule.begin_next()), ("train/c/run".to_owned(), 4), "it is alone");
    }

    #[test]
    fn a_failure_leaves_out_what_needs_it_and_nothing_else() {
        let batch = batch("");
        let mut schedule = Schedule::new(&batch, Limits { jobs: 9, threads: 9, memory: None }, |_| true);
        let left: BTreeSet<String> =
            schedule.ended(1, false).iter().map(|job| batch.jobs[*job].id.clone()).collect();
        assert_eq!(left, BTreeSet::from(["eval/b/run".to_owned(), "export/b/run".to_owned()]));
        for job in [0, 2, 3, 5, 6] {
            schedule.ended(job, true);
            assert_ne!(schedule.standing(9), Standing::Ready, "after {job}");
        }
        schedule.ended(8, true);
        assert_eq!(schedule.standing(9), Standing::Ready, "the collecting job runs all the same");
        assert_eq!(schedule.standing(4), Standing::LeftOut);
    }

    #[test]
    fn memory_is_shared_by_what_jobs_have_taken() {
        let batch = batch("[resources]\nmemory_gib = 4\n");
        let limits = Limits { jobs: 9, threads: 9, memory: Some(10 << 30) };
        let mut schedule = Schedule::new(&batch, limits, |_| true);
        assert!(schedule.begin_next().is_some() && schedule.begin_next().is_some());
        assert_eq!(schedule.begin_next(), None, "a third does not fit");
        schedule.saw(0, 8 << 30);
        schedule.ended(0, true);
        schedule.ended(1, true);
        let begun: Vec<String> = std::iter::from_fn(|| schedule.begin_next())
            .map(|next| batch.jobs[next.job].id.clone())
            .collect();
        assert_eq!(begun, ["export/a/run", "export/b/run"], "a training takes 9 GiB now, an export 4");
        schedule.ended(6, true);
        schedule.ended(7, true);
        schedule.ended(3, true);
        schedule.ended(4, true);
        assert_eq!(id(&batch, schedule.begin_next()).0, "train/c/run", "alone it runs");
    }

    #[test]
    fn a_job_that_another_machine_has_is_tried_again() {
        let batch = batch("");
        let mut schedule = Schedule::new(&batch, Limits { jobs: 2, threads: 2, memory: None }, |_| true);
        let first = schedule.begin_next().unwrap();
        schedule.put_aside(first.job);
        assert_ne!(schedule.begin_next(), Some(first));
        schedule.give_back(first.job);
        assert_eq!(schedule.begin_next(), Some(first));
    }
}
