//! Rare events of a run on the device. Most run on the host, which is brought up to date first; what they change is
//! sent before the next step. Changes of the set of Gaussians alone leave the rows where they are.

use std::time::Instant;

use super::super::Trainer;
use super::FETCH_EVERY;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::schedule::falls_on;

impl Trainer {
    /// Judgements that fall before the step to come: the host is brought up to date, as the degree of spherical
    /// harmonics depends on them.
    pub(super) fn judge_before_step(&mut self, events: &mut Vec<TrainEvent>) -> Result<(), TrainError> {
        let (stage, iteration) = (self.progress.stage, self.progress.iteration + 1);
        if !self.judges_sh(stage, iteration) {
            return Ok(());
        }
        self.fetch_from_device()?;
        self.judge_sh(stage, iteration, events)
    }

    /// Events that fall on the step just done.
    pub(super) fn rare_events(&mut self, events: &mut Vec<TrainEvent>) -> Result<(), TrainError> {
        let (stage, iteration) = (self.progress.stage, self.progress.iteration);
        let rearranges = match stage {
            Stage::Instance => {
                let resample = &self.config.resample;
                falls_on(iteration, self.config.identity.refresh_every)
                    || falls_on(iteration, resample.every)
                        && (resample.from..=resample.until).contains(&iteration)
            }
            _ => {
                let densify = &self.config.densify;
                iteration < densify.until
                    && (iteration > densify.from
                        && (falls_on(iteration, densify.prune_every) || falls_on(iteration, densify.every))
                        || falls_on(iteration, densify.opacity_reset_every))
            }
        };
        let judges = self.judges_heads(stage, iteration) || self.settles(stage, iteration);
        let is_late = self.device.as_ref().is_some_and(|device| device.since_fetch >= FETCH_EVERY);
        if !(rearranges || is_late || judges) {
            return Ok(());
        }
        let start = Instant::now();
        // New estimates of identities begin with everything that is known.
        let refreshes = stage == Stage::Instance && falls_on(iteration, self.config.identity.refresh_every);
        if rearranges && !refreshes && !is_late && !judges {
            self.rearrange_on_device(stage, iteration, events)?;
        } else {
            self.fetch_from_device()?;
            if rearranges && stage == Stage::Instance {
                self.instance_events(iteration, events)?;
                self.identities_changed();
            } else if rearranges {
                self.densify(stage, iteration, events)?;
                self.gaussians_changed();
            }
            self.judge_heads(stage, iteration, events)?;
            self.settle(stage, iteration, events)?;
        }
        self.times.rearrange += start.elapsed();
        self.times.total += start.elapsed();
        Ok(())
    }
}
