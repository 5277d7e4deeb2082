use cif_geometry::PixelGrid;
use rand::{RngExt, SeedableRng};

use super::*;
use crate::losses::{SsimScratch, color_loss};

fn pictures() -> (PixelGrid<[f32; 3]>, PixelGrid<[u8; 3]>) {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
    let (mut rendered, mut target) =
        (PixelGrid::filled(23, 17, [0.0_f32; 3]), PixelGrid::filled(23, 17, [0_u8; 3]));
    for (color, truth) in rendered.pixels.iter_mut().zip(&mut target.pixels) {
        *color = std::array::from_fn(|_| rng.random::<f32>());
        // Far from the recorded colour, so that no difference changes its sign.
        *truth = std::array::from_fn(|_| if rng.random::<f32>() < 0.5 { 0 } else { 255 });
    }
    (rendered, target)
}

const EXPOSURE: Exposure = Exposure { gain: [0.9, 0.8, 0.7], offset: [0.05, 0.03, 0.08] };

fn from_floats(values: [f64; WIDTH]) -> Exposure {
    Exposure {
        gain: std::array::from_fn(|k| values[k].exp() as f32),
        offset: std::array::from_fn(|k| values[3 + k] as f32),
    }
}

#[test]
fn gradients_agree_with_differences() {
    let (rendered, target) = pictures();
    for lambda in [0.0, 0.3] {
        let loss = |exposure: &Exposure, rendered: &PixelGrid<[f32; 3]>| {
            let mut v_color = PixelGrid::filled(0, 0, [0.0; 3]);
            let scratch = &mut SsimScratch::default();
            let mut recorded = rendered.clone();
            exposure.apply(&mut recorded);
            let loss = color_loss(&recorded, &target, lambda, 1.0, &mut v_color, scratch);
            let v = exposure.pull_back(rendered, &mut v_color);
            (loss.loss, v, v_color)
        };
        let (_, v_exposure, v_color) = loss(&EXPOSURE, &rendered);
        let at: [f64; WIDTH] = std::array::from_fn(|k| {
            if k < 3 { f64::from(EXPOSURE.gain[k]).ln() } else { f64::from(EXPOSURE.offset[k - 3]) }
        });
        let step = 2e-3;
        for k in 0..WIDTH {
            let moved = |by: f64| {
                let mut values = at;
                values[k] += by;
                loss(&from_floats(values), &rendered).0
            };
            let numeric = (moved(step) - moved(-step)) / (2.0 * step);
            let error = (numeric - f64::from(v_exposure[k])).abs();
            assert!(error < 2e-3 * numeric.abs().max(1e-2), "{lambda} {k}: {numeric} {}", v_exposure[k]);
        }
        for (pixel, channel) in [(0, 0), (57, 1), (200, 2), (390, 0)] {
            let moved = |by: f32| {
                let mut rendered = rendered.clone();
                rendered.pixels[pixel][channel] += by;
                loss(&EXPOSURE, &rendered).0
            };
            let numeric = (moved(5e-3) - moved(-5e-3)) / 1e-2;
            let analytic = f64::from(v_color.pixels[pixel][channel]);
            assert!((numeric - analytic).abs() < 0.02 * analytic.abs() + 1e-6, "{numeric} {analytic}");
        }
    }
}

#[test]
fn a_neutral_exposure_changes_nothing() {
    let (rendered, target) = pictures();
    let mut recorded = rendered.clone();
    Exposure::NEUTRAL.apply(&mut recorded);
    assert_eq!(recorded, rendered);
    let mut v_color = PixelGrid::filled(0, 0, [0.0; 3]);
    color_loss(&rendered, &target, 0.2, 0.5, &mut v_color, &mut SsimScratch::default());
    let before = v_color.clone();
    Exposure::NEUTRAL.pull_back(&rendered, &mut v_color);
    assert_eq!(v_color, before);
}

#[test]
fn a_scene_begins_with_the_exposures_it_was_trained_with() {
    let exposures = BTreeMap::from([("b".to_owned(), EXPOSURE), ("gone".to_owned(), EXPOSURE)]);
    let known = Drawing { exposures, ..Drawing::default() };
    let exposures = two_cameras().start_with(&known);
    assert_eq!(exposures.at("a", 0.3), Exposure::NEUTRAL);
    let b = exposures.at("b", 0.3);
    assert!(b.gain.iter().zip(EXPOSURE.gain).all(|(a, b)| (a - b).abs() < 1e-6), "{b:?}");
    assert_eq!(b.offset, EXPOSURE.offset);
}

fn two_cameras() -> Exposures {
    Exposures::neutral(vec!["a".into(), "b".into()], Vec::new())
}

#[test]
fn what_all_cameras_have_in_common_stays_with_the_field() {
    let mut exposures = two_cameras();
    for _ in 0..50 {
        exposures.add("a", 0.3, &[1.0; WIDTH]);
        exposures.add("b", 0.3, &[1.0; WIDTH]);
        exposures.add("unknown", 0.3, &[9.0; WIDTH]);
        exposures.step(RATES[0]);
    }
    assert!(exposures.values.iter().all(|value| value.abs() < 1e-6), "{:?}", exposures.values);
    exposures.add("a", 0.3, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    exposures.step(RATES[0]);
    assert!(exposures.at("a", 0.3).gain[0] < 1.0 && exposures.at("b", 0.3).gain[0] > 1.0);
    assert_eq!(exposures.at("c", 0.3), Exposure::NEUTRAL);
}

#[test]
fn gradients_that_are_not_finite_move_nothing() {
    let mut exposures = two_cameras();
    exposures.add("a", 0.3, &[0.5; WIDTH]);
    assert_eq!(exposures.gradient_beyond(1.0), None);
    assert_eq!(exposures.gradient_beyond(0.1), Some((0, 0.5)));
    exposures.add("b", 0.3, &[f32::NAN; WIDTH]);
    assert_eq!(exposures.gradient_beyond(1.0).map(|(index, _)| index), Some(WIDTH));
    exposures.step(RATES[0]);
    assert_eq!(exposures.values, two_cameras().values);
    exposures.add("b", 0.3, &[1.0; WIDTH]);
    exposures.step(RATES[0]);
    assert!(exposures.values.iter().all(|value| value.is_finite()));
}

#[test]
fn saved_exposures_come_back_bit_for_bit() {
    let mut exposures = two_cameras();
    for k in 0..7 {
        exposures.add(if k % 2 == 0 { "a" } else { "b" }, 0.3, &[0.1, -0.3, 0.7, 1e-5, -0.2, 0.05]);
        exposures.step(RATES[0]);
    }
    let text = serde_json::to_string(&exposures).unwrap();
    let mut back: Exposures = serde_json::from_str(&text).unwrap();
    back.gradients = exposures.gradients.clone();
    assert_eq!(back, exposures);
}

#[test]
fn images_of_a_camera_that_adapts_have_rows_of_their_own() {
    let mut exposures = Exposures::neutral(vec!["a".into(), "a".into(), "b".into()], vec![0.0, 0.5, 0.0]);
    assert!(exposures.are_whole());
    assert_eq!(exposures.position("a", 0.5), Some(1));
    assert_eq!((exposures.position("a", 0.25), exposures.position("b", 0.5)), (None, None));
    let gain = |exposures: &Exposures, camera: &str, time: f64| exposures.at(camera, time).gain[0];
    for _ in 0..50 {
        exposures.add("a", 0.5, &[-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        exposures.step(RATES[0]);
    }
    let [first, last] = [0.0, 0.5].map(|time| gain(&exposures, "a", time));
    assert!(first < 1.0 && last > 1.2, "{first} {last}");
    // Between two images it changes evenly; beyond them it stays.
    assert!((gain(&exposures, "a", 0.25) - (first * last).sqrt()).abs() < 1e-5);
    assert_eq!((gain(&exposures, "a", 1.0), gain(&exposures, "c", 0.0)), (last, 1.0));
    // Scenes hold them, and begin others with them.
    assert!(exposures.by_camera().is_empty());
    let drawing = Drawing { exposures_in_time: exposures.in_time(), ..Drawing::default() };
    let begun = Exposures::neutral(exposures.cameras.clone(), exposures.times.clone()).start_with(&drawing);
    assert!(begun.values.iter().zip(&exposures.values).all(|(a, b)| (a - b).abs() < 1e-6));
    let mut back: Exposures = serde_json::from_str(&serde_json::to_string(&exposures).unwrap()).unwrap();
    back.gradients = exposures.gradients.clone();
    assert_eq!(back, exposures);
    back.times[1] = 0.0;
    assert!(!back.are_whole(), "two rows of one image");
}
