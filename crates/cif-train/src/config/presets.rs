//! Values of the presets. Source of `paper`: methods reference 1.1 and 1.2.

use std::collections::BTreeMap;

use cif_dataset::Layout;
use cif_field::{Heads, SortMetric, TimeEncoding};

use super::{
    AdamConfig, DensifyConfig, EffectsConfig, HeadConfig, IdentityConfig, InstanceConfig, LossConfig,
    ModelConfig, MotionConfig, Preset, RatesConfig, ReportConfig, ResampleConfig, StagesConfig, TrainConfig,
};

impl TrainConfig {
    /// The settings of a preset, which differ by the layout of the capture.
    #[must_use]
    pub fn preset(preset: Preset, layout: Layout) -> Self {
        let mut config = match preset {
            Preset::Standard => Self::default(),
            Preset::Draft => draft(),
            Preset::Best => best(),
            Preset::Paper => paper(layout),
        };
        if let (Layout::DNerf, Some(coarse)) = (layout, without_points(preset)) {
            config.stages.coarse = coarse;
        }
        if matches!(layout, Layout::Neu3d | Layout::DynamicGaussians) {
            config.loss.time_smoothness = 1e-3;
        }
        config
    }
}

/// Coarse steps of captures that have no points: what objects stand on is then looked for in what these reconstruct.
fn without_points(preset: Preset) -> Option<u32> {
    match preset {
        Preset::Standard | Preset::Best => Some(2_000),
        Preset::Draft => Some(1_000),
        Preset::Paper => None,
    }
}

fn draft() -> TrainConfig {
    let mut config = TrainConfig { preset: Preset::Draft, ..TrainConfig::default() };
    config.stages = StagesConfig { coarse: 150, fine: 2_000, instance: 500, ..config.stages };
    config.model.max_initial_points = 5_000;
    config.model.sh_interval = 150;
    config.densify = DensifyConfig {
        from: 150,
        until: 1_200,
        every: 75,
        max_gaussians: 12_000,
        detail: 4.0,
        ..config.densify
    };
    config.resample = ResampleConfig { from: 50, until: 400, every: 50, ..config.resample };
    // They take as long as all steps together.
    config.motion.parts = false;
    config
}

fn best() -> TrainConfig {
    let mut config = TrainConfig { preset: Preset::Best, ..TrainConfig::default() };
    config.stages.fine = 16_000;
    config.model.channels = 32;
    config.densify = DensifyConfig { until: 9_000, max_gaussians: 30_000, ..config.densify };
    config
}

fn paper(layout: Layout) -> TrainConfig {
    let mut config = TrainConfig { preset: Preset::Paper, ..TrainConfig::default() };
    config.background = Some([1.0; 3]);
    config.near = 0.2;
    config.stages = StagesConfig {
        coarse: 3_000,
        fine: 10_000,
        fine_includes_coarse: false,
        instance: 3_000,
        half_size: 0.0,
        reduction: 1,
        whole_size: 0.0,
        batch: 1,
    };
    config.model = ModelConfig {
        max_initial_points: 40_000,
        spatial_resolution: [64; 3],
        time_resolution: 25,
        multipliers: vec![1, 2, 4, 8],
        channels: 32,
        width: 64,
        sh_interval: 1_000,
        ..config.model
    };
    config.rates = RatesConfig {
        schedule_steps: 20_000,
        planes: [1.6e-3, 1.6e-4],
        mlp: [1.6e-4, 1.6e-5],
        network_follows_extent: true,
        ..config.rates
    };
    config.loss = LossConfig {
        lambda_dssim: 0.0,
        plane_smoothness: 1e-4,
        time_smoothness: 1e-2,
        time_sparsity: 1e-4,
        ..config.loss
    };
    config.densify = DensifyConfig {
        rule: super::DensifyRule::Gradient,
        from: 500,
        until: 15_000,
        every: 100,
        max_gaussians: 360_000,
        detail: 0.0,
        prune_every: 100,
        prune_min_n: 200_000,
        opacity_reset_every: 3_000,
        ..config.densify
    };
    config.instance.geometry = super::InstanceGeometry::Full;
    config.identity.share_rounds = 0;
    config.resample = ResampleConfig {
        from: 100,
        until: 2_500,
        every: 100,
        weakness: super::Weakness::Occupancy,
        weak_share: 1.0,
        excess: super::Excess::Share,
        ..config.resample
    };
    // The published method has no such losses.
    config.motion = MotionConfig {
        guidance: 0.0,
        stillness: 0.0,
        misfit: 0.0,
        switches: false,
        edges: false,
        parts: false,
        ..config.motion
    };
    match layout {
        Layout::DNerf => {
            config.model.triangulate = false;
            config.model.multipliers = vec![1, 2];
            config.rates.planes[1] = 1.6e-5;
            config.rates.mlp[1] = 1.6e-6;
            config.densify.prune_every = 8_000;
        }
        // The publication has no LLFF sequences; they are of one moving camera, too.
        Layout::HyperNerf | Layout::Llff => {
            config.downscale = (layout == Layout::HyperNerf).then_some(2);
            config.stages.batch = 2;
            config.model.time_resolution = 150;
            config.model.multipliers = vec![1, 2, 4];
            config.model.channels = 16;
            config.model.width = 128;
            config.loss.plane_smoothness = 2e-4;
            config.loss.time_smoothness = 1e-3;
            config.densify.until = 10_000;
            config.densify.opacity_reset_every = 300_000;
        }
        // Nor captures of Dynamic 3D Gaussians, which are of fixed cameras, too.
        Layout::Neu3d | Layout::DynamicGaussians => {
            config.downscale = (layout == Layout::Neu3d).then_some(2);
            config.stages.batch = 4;
            config.model.time_resolution = 150;
            config.model.multipliers = vec![1, 2];
            config.model.channels = 16;
            config.model.width = 128;
            config.model.heads.opacity = true;
            config.model.heads.sh = true;
            config.loss.plane_smoothness = 2e-4;
            config.loss.time_smoothness = 1e-3;
            config.loss.lambda_instance = 0.005;
            config.densify.until = 10_000;
            config.densify.opacity_reset_every = 60_000;
            config.resample.rate = 0.05;
        }
        Layout::Nerfstudio | Layout::Colmap => {}
    }
    config
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            preset: Preset::Standard,
            seed: 0,
            downscale: None,
            background: None,
            near: 0.0,
            antialiased: false,
            sort_metric: SortMetric::Z,
            frame_memory_mib: 1_024,
            stages: StagesConfig::default(),
            model: ModelConfig::default(),
            rates: RatesConfig::default(),
            adam: AdamConfig::default(),
            loss: LossConfig::default(),
            motion: MotionConfig::default(),
            densify: DensifyConfig::default(),
            identity: IdentityConfig::default(),
            instance: InstanceConfig::default(),
            head: HeadConfig::default(),
            resample: ResampleConfig::default(),
            effects: EffectsConfig::default(),
            report: ReportConfig::default(),
        }
    }
}

impl Default for StagesConfig {
    fn default() -> Self {
        Self {
            coarse: 300,
            fine: 7_000,
            fine_includes_coarse: false,
            instance: 1_000,
            half_size: 0.4,
            reduction: 0,
            whole_size: 0.05,
            batch: 1,
        }
    }
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            max_initial_points: 20_000,
            triangulate: true,
            initial_opacity: 0.1,
            spatial_resolution: [64; 3],
            time_resolution: 0,
            multipliers: vec![1, 2],
            channels: 16,
            width: 64,
            heads: Heads { position: true, scale: true, rotation: true, opacity: false, sh: false },
            time_encoding: TimeEncoding::Compact,
            zero_initial_heads: false,
            sh_degree: 3,
            sh_interval: 400,
        }
    }
}

impl Default for RatesConfig {
    fn default() -> Self {
        Self {
            schedule_steps: 0,
            restart_in_instance_stage: false,
            means: [1.6e-4, 1.6e-6],
            log_scales: 5e-3,
            quaternions: 1e-3,
            opacity: 5e-2,
            sh_base: 2.5e-3,
            sh_rest: 1.25e-4,
            planes: [1e-2, 5e-4],
            mlp: [2e-3, 1e-4],
            network_follows_extent: false,
            occupancy: 1e-2,
            calibration: 1e-2,
        }
    }
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            lambda_dssim: 0.1,
            lambda_instance: 0.01,
            plane_smoothness: 1e-4,
            time_smoothness: 1e-2,
            time_sparsity: 1e-4,
        }
    }
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self {
            guidance: 10.0,
            guidance_end: 0.1,
            rigid: true,
            parts: true,
            of: BTreeMap::new(),
            stillness: 1.0,
            rehearsal: 300,
            gaussians: 300,
            misfit: 20.0,
            switches: true,
            edges: true,
        }
    }
}

impl Default for DensifyConfig {
    fn default() -> Self {
        Self {
            rule: super::DensifyRule::Error,
            views: 8,
            full_at: 0.5,
            turnover: 0.1,
            from: 300,
            until: 4_000,
            every: 100,
            gradient_threshold: 2e-4,
            split_scale: 0.01,
            max_gaussians: 20_000,
            detail: 2.5,
            prune_every: 100,
            prune_min_n: 0,
            prune_opacity: 0.005,
            prune_radius_px: 20.0,
            prune_scale: 0.1,
            opacity_reset_every: 0,
            opacity_reset_to: 0.01,
        }
    }
}

impl Default for IdentityConfig {
    fn default() -> Self {
        Self {
            stride: 1,
            truncation: 1e-4,
            min_mass: 1e-3,
            neighbours: 8,
            neighbour_distance: 0.05,
            unseen_occupancy: 0.005,
            share_rounds: 4,
            refresh_every: 0,
        }
    }
}

impl Default for InstanceConfig {
    fn default() -> Self {
        Self {
            occupancy_start: super::OccupancyStart::Constant,
            occupancy: 0.02,
            occupancy_limits: [0.005, 0.999],
            calibration_limit: 10.0,
            normalisation: super::Normalisation::None,
            geometry: super::InstanceGeometry::Off,
            color_loss: true,
            ablate: std::collections::BTreeSet::new(),
        }
    }
}

impl Default for ResampleConfig {
    fn default() -> Self {
        Self {
            from: 100,
            until: 800,
            every: 100,
            rate: 0.01,
            gamma_floor: 1e-3,
            weak_set: super::WeakSet::Members,
            weakness: super::Weakness::Visibility,
            weak_share: 0.5,
            excess: super::Excess::Drop,
            scale_correction: super::ScaleCorrection::Off,
            label_shares: super::LabelShares::Equal,
            offset: 0.5,
        }
    }
}

impl Default for EffectsConfig {
    fn default() -> Self {
        Self {
            motion: true,
            instances: true,
            still_every: 0,
            still_from: 0.15,
            still_told: 350,
            still_displacement: 0.002,
            still_shape: 0.2,
            still_awake: 0.03,
            still_loss: 0.02,
            sh_gain: 0.0,
            head_gain: 0.0,
            physics: true,
            exposure: false,
            exposure_in_time: false,
        }
    }
}

impl Default for ReportConfig {
    fn default() -> Self {
        Self {
            step_every: 10,
            evaluate_every: 0,
            evaluate_frames: 8,
            curve_frames: 4,
            withhold: 0,
            checkpoint_every: 0,
            checkpoint_seconds: 300,
        }
    }
}
