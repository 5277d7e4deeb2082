//! Refuses settings that cannot work, naming the key.

use thiserror::Error;

use super::{Ablation, TrainConfig};

/// Largest `stages.reduction`.
pub const MAX_REDUCTION: u32 = 16;

/// Most views per step: a step holds the images of all of its views in memory.
const MAX_BATCH: u32 = 1024;

/// A setting that cannot work.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("setting `{key}` is {value}: {expected}")]
pub struct ConfigError {
    /// Dotted key, e.g. `resample.rate`.
    pub key: &'static str,
    /// The given value.
    pub value: String,
    /// Values that would be accepted.
    pub expected: &'static str,
}

impl TrainConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// The first setting that cannot work, by key, with what it takes.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.validate_run()?;
        self.validate_model()?;
        self.validate_rates()?;
        self.validate_effects()?;
        self.validate_gaussians()?;
        self.validate_instances()?;
        self.validate_relocation()?;
        at_least("report.step_every", self.report.step_every, 1, "expected at least 1")?;
        at_least("report.evaluate_frames", self.report.evaluate_frames, 1, "expected at least 1")
    }

    /// What is trained on, and for how long.
    fn validate_run(&self) -> Result<(), ConfigError> {
        let stages = &self.stages;
        for (channel, value) in self.background.iter().flatten().enumerate() {
            let key = ["background[0]", "background[1]", "background[2]"][channel];
            within(key, *value, 0.0..=1.0, "expected a number in [0, 1]")?;
        }
        non_negative("near", self.near)?;
        if let Some(downscale) = self.downscale {
            at_least("downscale", downscale, 1, "expected 1, 2, 4, ...")?;
        }
        check(
            (1..=MAX_BATCH).contains(&stages.batch),
            "stages.batch",
            stages.batch,
            "expected 1 to 1024 views per step",
        )?;
        within(
            "stages.half_size",
            stages.half_size,
            0.0..=1.0,
            "expected a share of the fine steps, 0 to 1",
        )?;
        check(
            stages.reduction <= MAX_REDUCTION,
            "stages.reduction",
            stages.reduction,
            "expected 1 to 16, or 0 (automatic)",
        )?;
        within(
            "stages.whole_size",
            stages.whole_size,
            0.0..=1.0,
            "expected a share of the fine steps, 0 to 1",
        )?;
        check(
            stages.fine > 0 || stages.coarse > 0,
            "stages.fine",
            stages.fine,
            "expected at least 1 step here or in stages.coarse",
        )?;
        check(
            !stages.fine_includes_coarse || stages.fine >= stages.coarse,
            "stages.fine_includes_coarse",
            true,
            "expected false, or stages.fine of at least stages.coarse",
        )?;

        check(
            self.head.name != super::HeadName::LangSplat || !self.head.maps.is_empty(),
            "head.maps",
            "empty",
            "expected the folder of feature maps that 4d-langsplat learns: --set head.maps=DIR",
        )?;
        Ok(())
    }

    /// Gaussians and deformation at their start.
    fn validate_model(&self) -> Result<(), ConfigError> {
        let model = &self.model;
        at_least("model.max_initial_points", model.max_initial_points, 1, "expected at least 1")?;
        open_unit("model.initial_opacity", model.initial_opacity)?;
        for (axis, nodes) in model.spatial_resolution.iter().enumerate() {
            let key =
                ["model.spatial_resolution[0]", "model.spatial_resolution[1]", "model.spatial_resolution[2]"]
                    [axis];
            check((2..=1024).contains(nodes), key, nodes, "expected 2 to 1024 nodes")?;
        }
        check(
            model.time_resolution == 0 || (3..=4096).contains(&model.time_resolution),
            "model.time_resolution",
            model.time_resolution,
            "expected 0 (automatic) or 3 to 4096 nodes",
        )?;
        check(
            !model.multipliers.is_empty()
                && model.multipliers.len() <= 8
                && model.multipliers.iter().all(|m| (1..=64).contains(m)),
            "model.multipliers",
            format!("{:?}", model.multipliers),
            "expected 1 to 8 factors, each 1 to 64",
        )?;
        check((1..=128).contains(&model.channels), "model.channels", model.channels, "expected 1 to 128")?;
        check((1..=1024).contains(&model.width), "model.width", model.width, "expected 1 to 1024")?;
        check(model.sh_degree <= 3, "model.sh_degree", model.sh_degree, "expected 0 to 3")?;
        Ok(())
    }

    /// Rates, weights and limits that are at least 0.
    fn validate_rates(&self) -> Result<(), ConfigError> {
        let (rates, densify) = (&self.rates, &self.densify);
        let (identity, resample) = (&self.identity, &self.resample);
        let scheduled =
            [("rates.means", rates.means), ("rates.planes", rates.planes), ("rates.mlp", rates.mlp)];
        for (key, pair) in scheduled {
            check(
                pair.iter().all(|rate| rate.is_finite() && *rate > 0.0) || pair == [0.0; 2],
                key,
                format!("{pair:?}"),
                "expected two positive rates, first and last, or [0, 0] to freeze",
            )?;
        }
        for (key, rate) in [
            ("rates.log_scales", rates.log_scales),
            ("rates.quaternions", rates.quaternions),
            ("rates.opacity", rates.opacity),
            ("rates.sh_base", rates.sh_base),
            ("rates.sh_rest", rates.sh_rest),
            ("rates.occupancy", rates.occupancy),
            ("rates.calibration", rates.calibration),
            ("loss.lambda_instance", self.loss.lambda_instance),
            ("loss.plane_smoothness", self.loss.plane_smoothness),
            ("loss.time_smoothness", self.loss.time_smoothness),
            ("loss.time_sparsity", self.loss.time_sparsity),
            ("motion.guidance", self.motion.guidance),
            ("motion.stillness", self.motion.stillness),
            ("motion.misfit", self.motion.misfit),
            ("densify.gradient_threshold", densify.gradient_threshold),
            ("densify.split_scale", densify.split_scale),
            ("densify.prune_radius_px", densify.prune_radius_px),
            ("densify.prune_scale", densify.prune_scale),
            ("identity.min_mass", identity.min_mass),
            ("identity.neighbour_distance", identity.neighbour_distance),
            ("resample.offset", resample.offset),
            ("effects.still_displacement", self.effects.still_displacement),
            ("effects.still_shape", self.effects.still_shape),
            ("effects.still_loss", self.effects.still_loss),
            ("effects.sh_gain", self.effects.sh_gain),
            ("effects.head_gain", self.effects.head_gain),
        ] {
            check(rate.is_finite() && rate >= 0.0, key, rate, "expected a finite number of at least 0")?;
        }
        Ok(())
    }

    /// Losses, motion and effects.
    fn validate_effects(&self) -> Result<(), ConfigError> {
        within("loss.lambda_dssim", self.loss.lambda_dssim, 0.0..=1.0, "expected a number in [0, 1]")?;

        within("motion.guidance_end", self.motion.guidance_end, 0.0..=1.0, "expected a number in [0, 1]")?;
        at_least("motion.gaussians", self.motion.gaussians, 4, "expected at least 4")?;

        within("effects.still_from", self.effects.still_from, 0.0..=1.0, "expected a number in [0, 1]")?;
        within("effects.still_awake", self.effects.still_awake, 0.0..=1.0, "expected a number in [0, 1]")?;
        Ok(())
    }

    /// The set of Gaussians, and whose they are.
    fn validate_gaussians(&self) -> Result<(), ConfigError> {
        let (densify, identity) = (&self.densify, &self.identity);
        at_least("densify.every", densify.every, 1, "expected at least 1")?;
        at_least("densify.max_gaussians", densify.max_gaussians, 1, "expected at least 1")?;
        at_least("densify.views", densify.views, 1, "expected at least 1")?;
        within("densify.detail", densify.detail, 0.0..=1e6, "expected a number of pixels, or 0")?;
        within("densify.full_at", densify.full_at, 0.0..=1.0, "expected a number in [0, 1]")?;
        within("densify.turnover", densify.turnover, 0.0..=0.5, "expected a number in [0, 0.5]")?;
        within("densify.prune_opacity", densify.prune_opacity, 0.0..=0.99, "expected a number in [0, 0.99]")?;
        open_unit("densify.opacity_reset_to", densify.opacity_reset_to)?;

        at_least("identity.stride", identity.stride, 1, "expected at least 1")?;
        within("identity.truncation", identity.truncation, 0.0..=0.5, "expected a number in [0, 0.5]")?;
        at_least("identity.neighbours", identity.neighbours, 1, "expected at least 1")?;
        open_unit("identity.unseen_occupancy", identity.unseen_occupancy)?;
        Ok(())
    }

    /// Occupancy and calibration.
    fn validate_instances(&self) -> Result<(), ConfigError> {
        let instance = &self.instance;
        open_unit("instance.occupancy", instance.occupancy)?;
        let [low, high] = instance.occupancy_limits;
        check(
            low > 0.0 && low < high && high < 1.0,
            "instance.occupancy_limits",
            format!("{:?}", instance.occupancy_limits),
            "expected a lower and a higher number inside (0, 1)",
        )?;
        positive("instance.calibration_limit", instance.calibration_limit)?;
        check(
            !(self.ablates(Ablation::ConstantOccupancy) && self.ablates(Ablation::OpacityOccupancy)),
            "instance.ablate",
            "constant-occupancy with opacity-occupancy",
            "expected at most one of the two",
        )?;
        Ok(())
    }

    /// Relocation of Gaussians.
    fn validate_relocation(&self) -> Result<(), ConfigError> {
        let resample = &self.resample;
        at_least("resample.every", resample.every, 1, "expected at least 1")?;
        within("resample.rate", resample.rate, 0.0..=0.5, "expected a number in [0, 0.5]")?;
        check(
            resample.gamma_floor > 0.0 && resample.gamma_floor <= 1.0,
            "resample.gamma_floor",
            resample.gamma_floor,
            "expected a number in (0, 1]",
        )?;
        check(
            resample.weak_share > 0.0 && resample.weak_share <= 1.0,
            "resample.weak_share",
            resample.weak_share,
            "expected a number in (0, 1]",
        )?;
        Ok(())
    }
}

fn check(
    accepted: bool,
    key: &'static str,
    value: impl std::fmt::Display,
    expected: &'static str,
) -> Result<(), ConfigError> {
    if accepted { Ok(()) } else { Err(ConfigError { key, value: value.to_string(), expected }) }
}

fn at_least(key: &'static str, value: u32, least: u32, expected: &'static str) -> Result<(), ConfigError> {
    check(value >= least, key, value, expected)
}

fn within(
    key: &'static str,
    value: f32,
    range: std::ops::RangeInclusive<f32>,
    expected: &'static str,
) -> Result<(), ConfigError> {
    check(range.contains(&value), key, value, expected)
}

fn open_unit(key: &'static str, value: f32) -> Result<(), ConfigError> {
    check(value > 0.0 && value < 1.0, key, value, "expected a number inside (0, 1)")
}

fn non_negative(key: &'static str, value: f32) -> Result<(), ConfigError> {
    check(value.is_finite() && value >= 0.0, key, value, "expected a positive number, or 0")
}

fn positive(key: &'static str, value: f32) -> Result<(), ConfigError> {
    check(value.is_finite() && value > 0.0, key, value, "expected a positive number")
}
