use super::decide::objects;
use super::evidence::Exposures;
use super::*;
use crate::config::ObjectMotion;

fn found() -> Evidence {
    Evidence {
        times: 60,
        frames: 60,
        fixed_cameras: 0,
        moving_cameras: 1,
        change: None,
        masked: 60,
        instances: 5,
        travelling: vec!["ball".to_owned()],
        appearing: Vec::new(),
        exposures: None,
        footprint_ratio: 1.3,
        view_angle: 50.0,
        places: 60,
        image_size: [256, 192],
        lenses: 0,
        has_alpha: false,
    }
}

#[expect(clippy::unnecessary_wraps, reason = "as evidence has it")]
fn exposed(cameras: usize, between_cameras: f64, in_time: Option<f64>) -> Option<Exposures> {
    Some(Exposures { cameras, between_cameras, in_time })
}

fn of(effects: Vec<Effect>) -> EffectPlan {
    EffectPlan { effects, travelling: Vec::new(), determined_degree: 3 }
}

fn plan(found: &Evidence, choice: &str) -> (EffectPlan, TrainConfig) {
    let mut config = TrainConfig::default();
    let effects = decide(found, &config, &choice.parse().unwrap());
    let plan = EffectPlan { determined_degree: determined_degree(found.places), ..of(effects) };
    plan.apply(&mut config);
    config.validate().unwrap();
    (plan, config)
}

#[test]
fn all_leaves_the_settings_as_they_are() {
    assert_eq!(plan(&found(), "all").1, TrainConfig::default());
}

#[test]
fn auto_goes_as_far_as_the_evidence() {
    let (plan, config) = plan(&found(), "auto");
    assert_eq!(plan.decision(EffectKind::Motion), Some(&Decision::Value("where it is".to_owned())));
    assert!(config.effects.motion && config.effects.instances);
    assert!(config.effects.still_every > 0 && config.effects.sh_gain > 0.0 && config.effects.head_gain > 0.0);
    assert_eq!(config.motion, TrainConfig::default().motion);
    assert!(!config.antialiased);
    assert!(plan.effects[0].evidence.contains("ball"), "{}", plan.effects[0].evidence);
}

#[test]
fn a_static_capture_without_masks_needs_plain_splats() {
    for choice in ["auto", "all", "auto,+motion,+instances"] {
        let still = Evidence { times: 1, masked: 0, instances: 0, travelling: Vec::new(), ..found() };
        let (plan, config) = plan(&still, choice);
        assert_eq!(plan.decision(EffectKind::Motion), Some(&Decision::Off), "{choice}");
        assert_eq!(plan.decision(EffectKind::Instances), Some(&Decision::Off), "{choice}");
        assert!(
            plan.decision(EffectKind::Shape).is_none() && plan.decision(EffectKind::TimePlanes).is_none()
        );
        assert!(!config.effects.motion && !config.effects.instances);
        assert!(plan.effects[0].flag.is_empty(), "no flag gives a capture more times");
    }
    let still = Evidence { times: 1, ..found() };
    assert!(!plan(&still, "+motion").1.effects.motion);
}

#[test]
fn fixed_cameras_that_see_no_change_need_no_motion() {
    let fixed = |change| Evidence { moving_cameras: 0, fixed_cameras: 3, change: Some(change), ..found() };
    assert!(!plan(&fixed(1e-4), "auto").1.effects.motion);
    assert!(plan(&fixed(1e-4), "all").1.effects.motion, "all takes no evidence");
    assert!(plan(&fixed(0.01), "auto").1.effects.motion);
}

#[test]
fn switches_win_over_the_evidence() {
    let (plan, config) = plan(&found(), "auto,+motion,-instances,-guidance,-view-dependence,-shape");
    assert_eq!(plan.decision(EffectKind::Motion), Some(&Decision::On));
    assert_eq!((config.effects.still_every, config.effects.instances), (0, false));
    assert_eq!((config.motion.guidance, config.model.sh_degree), (0.0, 0));
    assert!(!config.model.heads.scale && config.model.heads.position);
    let mut paper = TrainConfig::preset(crate::Preset::Paper, cif_dataset::Layout::HyperNerf);
    of(decide(&found(), &paper, &"all,+guidance".parse().unwrap())).apply(&mut paper);
    assert_eq!((paper.motion.guidance, paper.motion.stillness), (GUIDANCE, STILLNESS));
    let none = self::plan(&found(), "none").1;
    assert!(!none.effects.motion && !none.effects.instances && none.model.sh_degree == 0);
}

#[test]
fn few_directions_and_many_footprints_count() {
    let flat = Evidence { view_angle: 1.0, footprint_ratio: 6.0, ..found() };
    let (_, config) = plan(&flat, "auto");
    assert_eq!(config.model.sh_degree, 0);
    assert!(config.antialiased);
    let (_, config) = plan(&flat, "all");
    assert_eq!((config.model.sh_degree, config.antialiased), (3, false));
}

#[test]
fn few_places_determine_few_coefficients() {
    assert_eq!([1, 3, 4, 8, 9, 15, 16, 200].map(determined_degree), [0, 0, 1, 1, 2, 2, 3, 3]);
    let rig = Evidence { places: 5, ..found() };
    let (rig_plan, config) = plan(&rig, "auto");
    assert_eq!(config.model.sh_degree, 1);
    let said = Decision::Value("up to degree 1 while it helps".to_owned());
    assert_eq!(rig_plan.decision(EffectKind::ViewDependence), Some(&said));
    assert_eq!(plan(&rig, "all").1.model.sh_degree, 3);
    assert_eq!(plan(&Evidence { places: 3, ..found() }, "auto").1.model.sh_degree, 0);
}

#[test]
fn every_effect_says_why_and_what_decides_otherwise() {
    let lens = Evidence { lenses: 3, has_alpha: true, exposures: exposed(3, 1.02, Some(1.0)), ..found() };
    let (plan, _) = plan(&lens, "auto");
    for effect in &plan.effects {
        assert!(!effect.evidence.is_empty() && !effect.cost.is_empty(), "{effect:?}");
        assert!(effect.flag.starts_with("--") || effect.effect == EffectKind::Lens, "{effect:?}");
    }
    let json = serde_json::to_value(&plan).unwrap();
    let names: Vec<&str> =
        json["effects"].as_array().unwrap().iter().map(|e| e["effect"].as_str().unwrap()).collect();
    assert_eq!(
        names,
        [
            "motion",
            "shape",
            "time-planes",
            "image-size",
            "view-dependence",
            "instances",
            "appearing",
            "guidance",
            "objects",
            "exposure",
            "exposure-in-time",
            "antialiasing",
            "lens",
            "background",
            "physics"
        ]
    );
    assert_eq!(json["effects"][5]["decision"], "on");
}

#[test]
fn the_motion_that_is_tried_is_listed_object_by_object() {
    let found = Evidence { travelling: vec!["ball".to_owned(), "scarf".to_owned()], ..found() };
    let mut declared = TrainConfig::default();
    declared.motion.of.insert("scarf".to_owned(), ObjectMotion::Free);
    let plan = of(decide(&found, &declared, &"auto".parse().unwrap()));
    let Some(Decision::Value(words)) = plan.decision(EffectKind::Objects) else { panic!("{plan:?}") };
    assert!(
        words.starts_with("rigid, if pixels left out agree, else free: ball; free: scarf (told);"),
        "{words}"
    );
    assert!(words.contains("static: the other 3, unless a joint"), "{words}");
    plan.apply(&mut declared);
    assert!(declared.motion.rigid && declared.motion.parts);
    // What is declared is not judged.
    declared.motion.of.insert("ball".to_owned(), ObjectMotion::Rigid);
    let (words, _) = objects(&found, &declared);
    assert!(words.starts_with("rigid: ball (told); free: scarf (told); static: the other 3"), "{words}");
    let (plan, config) = self::plan(&found, "auto,-objects");
    assert_eq!(plan.decision(EffectKind::Objects), Some(&Decision::Off));
    assert!(!config.motion.rigid && !config.motion.parts);
    // Without paths nothing is fitted.
    assert!(self::plan(&found, "auto,-guidance").0.decision(EffectKind::Objects).is_none());
}

#[test]
fn cameras_that_disagree_and_instances_that_appear_count() {
    let calm = Evidence { exposures: exposed(8, 1.04, None), ..found() };
    let (plan, config) = plan(&calm, "auto");
    assert_eq!(plan.decision(EffectKind::Exposure), Some(&Decision::Off));
    assert_eq!(plan.decision(EffectKind::Appearing), Some(&Decision::Off));
    assert!(!config.effects.exposure && !config.model.heads.opacity);
    let found = Evidence { exposures: exposed(8, 1.3, None), appearing: vec!["kite".to_owned()], ..found() };
    let (plan, config) = self::plan(&found, "auto");
    assert!(config.effects.exposure && config.model.heads.opacity);
    assert!(self::plan(&calm, "auto,+appearing").1.model.heads.opacity);
    let why = |kind| plan.effects.iter().find(|effect| effect.effect == kind).unwrap().evidence.clone();
    assert!(why(EffectKind::Exposure).contains("30 %") && why(EffectKind::Appearing).contains("kite"));
    assert_eq!(self::plan(&found, "all").1, TrainConfig::default(), "all takes no evidence");
    let (_, config) = self::plan(&found, "auto,-exposure,-appearing");
    assert!(!config.effects.exposure && !config.model.heads.opacity);
    assert!(self::plan(&calm, "all,+exposure").1.effects.exposure);
    assert!(self::plan(&self::found(), "+exposure").0.decision(EffectKind::Exposure).is_none(), "one camera");
}

#[test]
fn a_camera_that_adapts_while_it_films_has_an_exposure_per_image() {
    let of = |cameras, drift| Evidence { exposures: exposed(cameras, 1.02, drift), ..found() };
    for (found, in_time) in [(of(1, Some(1.18)), true), (of(1, Some(1.03)), false), (of(5, Some(1.18)), true)]
    {
        let (_, config) = plan(&found, "auto");
        assert_eq!((config.effects.exposure, config.effects.exposure_in_time), (false, in_time), "{found:?}");
    }
    assert!(!plan(&of(1, Some(1.18)), "auto,-exposure-in-time").1.effects.exposure_in_time);
    assert!(plan(&of(1, Some(1.03)), "auto,+exposure-in-time").1.effects.exposure_in_time);
    // Photographs of one moment.
    let (plan, _) = plan(&of(1, None), "auto,+exposure-in-time");
    assert!(plan.decision(EffectKind::ExposureInTime).is_none());
}

#[test]
fn hulls_are_for_what_moves() {
    assert!(plan(&found(), "auto").1.effects.physics);
    for (still, choice) in [
        (Evidence { times: 1, ..found() }, "auto"),
        (Evidence { moving_cameras: 0, fixed_cameras: 3, change: Some(0.0), ..found() }, "auto"),
        (found(), "auto,-physics"),
    ] {
        assert!(!plan(&still, choice).1.effects.physics, "{choice}");
    }
    assert!(plan(&Evidence { times: 1, ..found() }, "auto,+physics").1.effects.physics);
}
