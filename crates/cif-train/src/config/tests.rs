use cif_dataset::Layout;

use super::*;

#[test]
fn every_preset_is_valid_and_survives_a_round_trip() {
    for preset in Preset::ALL {
        for layout in Layout::ALL {
            let config = TrainConfig::preset(preset, layout);
            assert_eq!(config.preset, preset);
            config.validate().unwrap();
            let text = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<TrainConfig>(&text).unwrap(), config);
        }
    }
}

#[test]
fn the_paper_preset_follows_the_dataset_type() {
    let hyper = TrainConfig::preset(Preset::Paper, Layout::HyperNerf);
    assert_eq!((hyper.stages.batch, hyper.model.width, hyper.model.channels), (2, 128, 16));
    assert_eq!(hyper.model.multipliers, [1, 2, 4]);
    assert_eq!(hyper.densify.prune_min_n, 200_000);
    let neu = TrainConfig::preset(Preset::Paper, Layout::Neu3d);
    assert!(neu.model.heads.opacity && neu.model.heads.sh);
    assert_eq!((neu.loss.lambda_instance, neu.resample.rate), (0.005, 0.05));
    assert_eq!(hyper.resample.rate, 0.01);
    assert_eq!((hyper.resample.weak_share, hyper.resample.excess), (1.0, Excess::Share));
    let reductions = Layout::ALL.map(|layout| TrainConfig::preset(Preset::Paper, layout).downscale);
    assert_eq!(reductions, [Some(2), None, Some(2), None, None, None, None]);
    let sequence = TrainConfig::preset(Preset::Paper, Layout::Llff);
    assert_eq!(TrainConfig { downscale: Some(2), ..sequence }, hyper);
    let dnerf = TrainConfig::preset(Preset::Paper, Layout::DNerf);
    assert_eq!(dnerf.rates.mlp, [1.6e-4, 1.6e-6]);
    assert_eq!(dnerf.densify.prune_every, 8_000);
    let library = TrainConfig::preset(Preset::Paper, Layout::Colmap);
    assert_eq!(library.model.multipliers, [1, 2, 4, 8]);
}

#[test]
fn captures_without_points_are_reconstructed_longer_before_objects_are_looked_for() {
    let coarse = |preset: Preset, layout: Layout| TrainConfig::preset(preset, layout).stages.coarse;
    for preset in [Preset::Draft, Preset::Standard, Preset::Best] {
        assert!(coarse(preset, Layout::DNerf) > 3 * coarse(preset, Layout::HyperNerf));
    }
    assert_eq!(coarse(Preset::Paper, Layout::DNerf), coarse(Preset::Paper, Layout::HyperNerf));
}

#[test]
fn absent_keys_take_defaults_and_unknown_keys_are_refused() {
    let partial: TrainConfig = serde_json::from_str(r#"{"stages": {"fine": 7}}"#).unwrap();
    assert_eq!(partial.stages, StagesConfig { fine: 7, ..StagesConfig::default() });
    let error = serde_json::from_str::<TrainConfig>(r#"{"stages": {"fien": 7}}"#).unwrap_err();
    assert!(error.to_string().contains("fien"), "{error}");
    let error =
        serde_json::from_str::<TrainConfig>(r#"{"instance": {"ablate": ["no-colour"]}}"#).unwrap_err();
    assert!(error.to_string().contains("no-resampling"), "{error}");
}

#[test]
fn impossible_settings_are_refused_by_key() {
    type Change = fn(&mut TrainConfig);
    let changes: [(&str, Change); 13] = [
        ("stages.batch", |c| c.stages.batch = 0),
        ("stages.batch", |c| c.stages.batch = u32::MAX),
        ("near", |c| c.near = f32::NAN),
        ("background[1]", |c| c.background = Some([0.0, 1.5, 0.0])),
        ("model.multipliers", |c| c.model.multipliers.clear()),
        ("model.time_resolution", |c| c.model.time_resolution = 1),
        ("rates.means", |c| c.rates.means = [1e-4, 0.0]),
        ("rates.opacity", |c| c.rates.opacity = f32::INFINITY),
        ("resample.gamma_floor", |c| c.resample.gamma_floor = 0.0),
        ("resample.weak_share", |c| c.resample.weak_share = 0.0),
        ("resample.weak_share", |c| c.resample.weak_share = 1.01),
        ("instance.occupancy_limits", |c| c.instance.occupancy_limits = [0.5, 0.1]),
        ("instance.ablate", |c| {
            c.instance.ablate.extend([Ablation::ConstantOccupancy, Ablation::OpacityOccupancy]);
        }),
    ];
    for (key, change) in changes {
        let mut config = TrainConfig::default();
        change(&mut config);
        let error = config.validate().unwrap_err();
        assert_eq!(error.key, key);
        assert!(error.to_string().contains("expected"), "{error}");
    }
}

#[test]
fn the_strict_budget_shortens_the_fine_stage() {
    let mut config = TrainConfig::preset(Preset::Paper, Layout::HyperNerf);
    assert_eq!(config.fine_iterations(), 10_000);
    config.stages.fine_includes_coarse = true;
    assert_eq!(config.fine_iterations(), 7_000);
}
