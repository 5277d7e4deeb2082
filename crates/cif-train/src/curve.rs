//! Curve of a run: quality against time, measured on a few frames while it trains.
//!
//! Measuring reads the field and nothing else, so that a run with its curve ends bit for bit where one without
//! it ends; its own time is kept apart from that of the run.

use serde::{Deserialize, Serialize};

use crate::clock::Seconds;
use crate::stage::Stage;

/// Fewest steps between two points of a stage.
pub const MIN_GAP: u32 = 100;

/// Growth of the step count from one point of a stage to the next.
const GROWTH: f64 = 1.4;

/// Growth while a target decides when to stop.
const WATCHFUL_GROWTH: f64 = 1.1;

/// Which frames the points are measured on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CurveFrames {
    /// Of the held-out split of the capture.
    #[default]
    HeldOut,
    /// Training frames that this run does not train on.
    Withheld,
    /// Training frames, because the capture holds none out.
    Training,
}

impl CurveFrames {
    /// In words.
    #[must_use]
    pub const fn describe(self) -> &'static str {
        match self {
            Self::HeldOut => "held-out frames",
            Self::Withheld => "training frames withheld from training",
            Self::Training => "training frames",
        }
    }
}

/// A moment of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// Stage.
    pub stage: Stage,
    /// Steps done in the stage.
    pub iteration: u32,
    /// Steps done in all stages.
    pub step: u64,
    /// Wall time of the run so far, from the opening of the capture on: everything but measuring, seconds.
    pub wall_s: f64,
    /// Processor time of the same, all threads together, seconds.
    pub cpu_s: f64,
    /// Gaussians.
    pub gaussians: usize,
    /// Mean PSNR, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM.
    pub ssim: Option<f64>,
    /// Mean IoU over the whole image, percent; none before identities exist or without masks, and in older scenes.
    #[serde(default)]
    pub iou: Option<f64>,
    /// mIoU over labelled pixels alone, percent; none before identities exist or without masks.
    pub miou: Option<f64>,
}

/// All moments of a run that were measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curve {
    /// Kind of the frames.
    pub frames: CurveFrames,
    /// Their names.
    pub frame_names: Vec<String>,
    /// Time that measuring took, which no point counts.
    pub measuring: Seconds,
    /// Points in the order of steps.
    pub points: Vec<CurvePoint>,
}

impl Curve {
    /// True when a point is due after `iteration` steps of `stage`; closer together when `watchful`.
    #[must_use]
    pub fn is_due(&self, stage: Stage, iteration: u32, watchful: bool) -> bool {
        let last = self.points.last().filter(|point| point.stage == stage).map_or(0, |point| point.iteration);
        let growth = if watchful { WATCHFUL_GROWTH } else { GROWTH };
        let next = (f64::from(last) * growth).ceil().max(f64::from(last.saturating_add(MIN_GAP)));
        f64::from(iteration) >= next
    }

    /// True when the state after `step` steps is measured already.
    #[must_use]
    pub fn holds(&self, stage: Stage, step: u64) -> bool {
        self.points.last().is_some_and(|point| (point.stage, point.step) == (stage, step))
    }

    /// The run's own description of a value to come: the trend of the last half of the points of this stage
    /// against the logarithm of steps, taken to `step`. None with less than three points.
    #[must_use]
    pub fn trend(&self, value: impl Fn(&CurvePoint) -> Option<f64>, step: u64) -> Option<f64> {
        let stage = self.points.last()?.stage;
        let of_stage: Vec<(f64, f64)> = self
            .points
            .iter()
            .filter(|point| point.stage == stage && point.step > 0)
            .filter_map(|point| Some(((point.step as f64).ln(), value(point)?)))
            .collect();
        let late = &of_stage[of_stage.len() / 2..];
        if late.len() < 3 {
            return None;
        }
        let n = late.len() as f64;
        let (mean_x, mean_y) = late.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
        let (xx, xy) = late.iter().fold((0.0, 0.0), |(xx, xy), (x, y)| {
            (xx + (x - mean_x).powi(2), xy + (x - mean_x) * (y - mean_y))
        });
        (xx > 0.0).then(|| mean_y + xy / xx * ((step as f64).max(1.0).ln() - mean_x))
    }
}

/// Target scores of a run on the frames of its curve; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Targets {
    /// PSNR, dB.
    pub psnr: Option<f64>,
    /// mIoU, percent.
    pub miou: Option<f64>,
}

impl Targets {
    /// True when there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.psnr.is_none() && self.miou.is_none()
    }

    /// True when measured values reach all targets.
    #[must_use]
    pub fn reached_by(&self, psnr: Option<f64>, miou: Option<f64>) -> bool {
        let reached = |target: Option<f64>, value: Option<f64>| {
            target.is_none_or(|target| value.is_some_and(|value| value >= target))
        };
        reached(self.psnr, psnr) && reached(self.miou, miou)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(stage: Stage, iteration: u32, psnr: f64) -> CurvePoint {
        CurvePoint {
            stage,
            iteration,
            step: u64::from(iteration),
            wall_s: 0.0,
            cpu_s: 0.0,
            gaussians: 1,
            psnr: Some(psnr),
            ssim: None,
            iou: None,
            miou: None,
        }
    }

    #[test]
    fn points_thin_out_and_start_anew_with_each_stage() {
        let mut curve = Curve::default();
        let mut steps = Vec::new();
        for iteration in 1..=7_000 {
            if curve.is_due(Stage::Fine, iteration, false) {
                curve.points.push(point(Stage::Fine, iteration, 20.0));
                steps.push(iteration);
            }
        }
        assert_eq!(steps[..5], [100, 200, 300, 420, 588]);
        assert!(steps.len() < 16, "{steps:?}");
        assert!(!curve.is_due(Stage::Instance, 99, false) && curve.is_due(Stage::Instance, 100, false));
        assert!(curve.holds(Stage::Fine, u64::from(*steps.last().unwrap())));
        let last = *steps.last().unwrap();
        assert!(curve.is_due(Stage::Fine, last * 11 / 10 + 100, true));
    }

    #[test]
    fn trends_follow_the_logarithm_of_steps() {
        let mut curve = Curve::default();
        assert_eq!(curve.trend(|point| point.psnr, 1_000), None);
        for iteration in [100, 200, 400, 800, 1_600, 3_200] {
            curve.points.push(point(Stage::Fine, iteration, 20.0 + f64::from(iteration).log2()));
        }
        let to_come = curve.trend(|point| point.psnr, 6_400).unwrap();
        assert!((to_come - (20.0 + 6_400f64.log2())).abs() < 1e-9, "{to_come}");
        assert_eq!(curve.trend(|point| point.miou, 6_400), None);
    }
}
