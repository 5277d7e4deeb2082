//! Plans of many runs. A plan names captures and what to do with them; it is expanded into jobs, each one `cif` command with
//! the files that it makes and the jobs that it needs. An engine runs the jobs: this machine, or that of a farm.
//!
//! | module | answers |
//! |---|---|
//! | [`plan`] | what a plan may say |
//! | [`steps`] | which steps a plan has, each a command with placeholders |
//! | [`expand`] | which jobs the steps are on the captures and values of a plan |
//! | [`job`] | what a job is, and how jobs are named on a command line |
//! | [`process`] | how a job runs: a process of its own, stopped gently, and what it takes of the machine |
//! | [`record`] | what is kept of a job that ran, and whether its results still hold |
//! | [`schedule`] | which job is next, with how many threads, within the memory |
//! | [`engines`] | the same jobs for OpenJD, Slurm and HyperQueue |
//! | [`simulate`] | how long a plan takes on so many workers, from what its jobs took |

pub mod engines;
pub mod expand;
pub mod job;
pub mod plan;
pub mod process;
pub mod record;
pub mod schedule;
pub mod simulate;
pub mod steps;

pub use cif_system::Error;
pub use expand::{Benches, Part, WINDOW, expand};
pub use job::{Batch, Job, Step};
pub use plan::Plan;
