//! Where the time of a step goes, and what it is spent on.

use std::time::{Duration, Instant};

use cif_field::parameters::{MLP, PLANES, Parameter};
use cif_render::cpu::{StageTimes, ViewStatistics};
use serde::{Deserialize, Serialize};

/// Wall time of training steps by part, and counts of their work, summed over steps and views since
/// [`Trainer::reset_times`](crate::Trainer::reset_times).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StepTimes {
    /// Steps summed.
    pub steps: u64,
    /// Views rendered.
    pub views: u64,
    /// The renderer's stages, forward and backward.
    pub render: StageTimes,
    /// Colour loss and its gradient; the instance loss is part of the raster passes.
    pub losses: Duration,
    /// Optimiser: everything that has a row per Gaussian, with occupancy and calibration.
    pub optimiser_gaussians: Duration,
    /// Optimiser: hexplanes, with their regularisers.
    pub optimiser_planes: Duration,
    /// Optimiser: network of the deformation.
    pub optimiser_mlp: Duration,
    /// Densification, resampling and refreshed identities.
    pub rearrange: Duration,
    /// Whole steps.
    pub total: Duration,
    /// Gaussians, visible or not, per view.
    pub gaussians: u64,
    /// Gaussians with a footprint in the view.
    pub visible: u64,
    /// (tile, Gaussian) pairs.
    pub tile_pairs: u64,
    /// (pixel, Gaussian) pairs evaluated in the forward pass.
    pub evaluated_pairs: u64,
    /// Gaussians that went through the deformation network.
    pub deformed: u64,
    /// Gaussians whose deformation was differentiated.
    pub deformed_backward: u64,
    /// Tiles that blended identities.
    pub labelled_tiles: u64,
    /// Gaussians whose identity row was evaluated.
    pub identity_rows: u64,
    /// (pixel, Gaussian) pairs evaluated for identities in the forward pass.
    pub instance_pairs: u64,
}

/// Work done by the steps of a run, summed over their views: zeros prove what did not run. Steps on a GPU are not
/// counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Work {
    /// Views rendered forward and backward.
    pub views: u64,
    /// Gaussians, visible or not.
    pub gaussians: u64,
    /// Gaussians that went through the deformation network.
    pub deformed: u64,
    /// Gaussians whose deformation was differentiated.
    pub deformed_backward: u64,
    /// Tiles that blended identities.
    pub labelled_tiles: u64,
    /// Gaussians whose identity row was evaluated.
    pub identity_rows: u64,
    /// (pixel, Gaussian) pairs evaluated for identities.
    pub instance_pairs: u64,
}

impl Work {
    pub(crate) fn add_view(&mut self, gaussians: usize, view: &ViewStatistics) {
        self.views += 1;
        self.gaussians += gaussians as u64;
        self.deformed += view.deformed as u64;
        self.deformed_backward += view.deformed_backward as u64;
        self.labelled_tiles += view.labelled_tiles as u64;
        self.identity_rows += view.identity_rows as u64;
        self.instance_pairs += view.instance_pairs;
    }
}

/// Exponents by which rasterising and losses grow with pixels and with Gaussians: footprints on larger images have more
/// pixels, but as many tiles and edges, and of more Gaussians each is smaller. 0.51 to 0.68 and 0.43 to 0.67 on four captures
/// of 256 x 192 to 400 x 400 pixels.
const RASTER: [f64; 2] = [0.6, 0.5];

/// Cost of rasterising and losses with so many times the pixels and Gaussians.
pub(crate) fn raster_cost(pixels: f64, gaussians: f64) -> f64 {
    pixels.powf(RASTER[0]) * gaussians.powf(RASTER[1])
}

/// Shares of a step that grow with pixels, with Gaussians that move, and with neither pixels nor Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepShares {
    /// Rasterising and losses.
    pub pixels: f64,
    /// Deformation.
    pub moving: f64,
    /// Planes and network of the deformation in the optimiser.
    pub fixed: f64,
}

impl StepShares {
    /// From [`StepTimes::seconds_by_growth`]; `None` where there were no steps, or their parts were not timed.
    #[must_use]
    pub fn of([pixels, moving, fixed, total]: [f64; 4]) -> Option<Self> {
        let share = |seconds: f64| (seconds / total).min(1.0);
        (total > 0.0 && pixels > 0.0).then(|| Self {
            pixels: share(pixels),
            moving: share(moving),
            fixed: share(fixed),
        })
    }

    /// Cost of a step with so many times the pixels and Gaussians, and the share of these that moves, relative to those
    /// that were timed.
    #[must_use]
    pub fn cost(&self, pixels: f64, gaussians: f64, moving: f64) -> f64 {
        let rows = (1.0 - self.pixels - self.moving - self.fixed).max(0.0);
        self.pixels * raster_cost(pixels, gaussians) + self.fixed + (rows + self.moving * moving) * gaussians
    }
}

impl StepTimes {
    /// Seconds of what grows with pixels, with Gaussians that move, and with neither pixels nor Gaussians, and of all.
    #[must_use]
    pub fn seconds_by_growth(&self) -> [f64; 4] {
        let render = &self.render;
        let pixels = render.rasterize + render.rasterize_backward + self.losses;
        let moving = render.deform + render.deform_backward;
        let fixed = self.optimiser_planes + self.optimiser_mlp;
        [pixels, moving, fixed, self.total].map(|time| time.as_secs_f64())
    }

    /// Part names and times in the order of a step; they sum to [`Self::total`].
    #[must_use]
    pub fn rows(&self) -> Vec<(&'static str, Duration)> {
        let (forward, backward) = (self.render.rows(), self.render.rows());
        let mut rows: Vec<_> = forward.into_iter().take(4).collect();
        rows.push(("losses", self.losses));
        rows.extend(backward.into_iter().skip(4));
        rows.extend([
            ("optimiser: Gaussians", self.optimiser_gaussians),
            ("optimiser: planes", self.optimiser_planes),
            ("optimiser: network", self.optimiser_mlp),
            ("densify, resample", self.rearrange),
        ]);
        let known: Duration = rows.iter().map(|(_, time)| *time).sum();
        rows.push(("other", self.total.saturating_sub(known)));
        rows
    }

    /// Time of the optimiser's step of a parameter.
    pub(crate) fn optimiser(&mut self, parameter: &Parameter) -> &mut Duration {
        match *parameter {
            PLANES => &mut self.optimiser_planes,
            MLP => &mut self.optimiser_mlp,
            _ => &mut self.optimiser_gaussians,
        }
    }

    /// Adds the renderer's times of a step.
    pub(crate) fn add_render(&mut self, times: &StageTimes) {
        let render = &mut self.render;
        render.deform += times.deform;
        render.project += times.project;
        render.bin += times.bin;
        render.rasterize += times.rasterize;
        render.rasterize_backward += times.rasterize_backward;
        render.project_backward += times.project_backward;
        render.deform_backward += times.deform_backward;
    }

    /// Adds the counts of a view that was rendered forward and backward.
    pub(crate) fn add_view(&mut self, gaussians: usize, view: &ViewStatistics) {
        self.views += 1;
        self.gaussians += gaussians as u64;
        self.visible += view.visible as u64;
        self.tile_pairs += view.tile_pairs as u64;
        self.evaluated_pairs += view.evaluated_pairs;
        self.deformed += view.deformed as u64;
        self.deformed_backward += view.deformed_backward as u64;
        self.labelled_tiles += view.labelled_tiles as u64;
        self.identity_rows += view.identity_rows as u64;
        self.instance_pairs += view.instance_pairs;
    }
}

/// Adds the time since `since` to `total`, and starts anew.
pub(crate) fn lap(total: &mut Duration, since: &mut Instant) {
    let now = Instant::now();
    *total += now - *since;
    *since = now;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_in_the_order_of_a_step_and_sum_to_the_total() {
        let ms = Duration::from_millis;
        let mut times =
            StepTimes { losses: ms(2), optimiser_planes: ms(5), total: ms(20), ..StepTimes::default() };
        // The renderer's times add up over steps.
        times.add_render(&StageTimes { deform: ms(1), rasterize_backward: ms(7), ..StageTimes::default() });
        times.add_render(&StageTimes { deform: ms(2), ..StageTimes::default() });
        let rows = times.rows();
        assert_eq!(rows.iter().map(|(_, time)| *time).sum::<Duration>(), times.total);
        assert_eq!(rows.last(), Some(&("other", ms(3))));
        let at = |name| rows.iter().position(|(row, _)| *row == name).unwrap();
        assert!(at("rasterize") < at("losses") && at("losses") < at("rasterize backward"));
        assert!(at("deform backward") < at("optimiser: Gaussians"));
    }
}
