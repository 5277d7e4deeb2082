use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{Gradients, InstanceSettings, RenderSettings};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::losses::{SsimScratch, color_loss_of_tiles};

/// 3 x 2 tiles, of which those at the right and at the bottom are cut.
fn scene() -> (SyntheticScene, PixelGrid<[u8; 3]>) {
    let config = SyntheticConfig {
        gaussians: 40,
        width: 44,
        height: 29,
        heads: Some(ALL_HEADS),
        screen_size: (0.05, 0.4),
        ..SyntheticConfig::default()
    };
    let mut rng = Pcg64::seed_from_u64(5);
    let mut target = PixelGrid::filled(44, 29, [0_u8; 3]);
    target.pixels.iter_mut().for_each(|pixel| *pixel = std::array::from_fn(|_| rng.random()));
    (generate(&config), target)
}

/// What a step sums up: colour loss, instance loss, mean squared error, and all gradients.
fn learn(
    scene: &SyntheticScene,
    target: &PixelGrid<[u8; 3]>,
    lambda_dssim: f32,
    tiles: Option<&TileSample>,
) -> ([f64; 3], Gradients) {
    let field: &Field = &scene.field;
    let settings =
        RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() };
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let choice = tiles.map(TileSample::choice);
    let pass =
        renderer.forward_tiles(field, &scene.camera, scene.time, &settings, Some(&scene.labels), choice);
    let mut v_color = PixelGrid::filled(0, 0, [0.0; 3]);
    let mut scratch = SsimScratch::default();
    let color =
        color_loss_of_tiles(&pass.color, target, lambda_dssim, 1.0, tiles, &mut v_color, &mut scratch);
    let weight = tiles.map_or(1.0, TileSample::weight);
    let mut gradients = Gradients::zeros(field);
    renderer.backward(field, &v_color, weight as f32, &mut gradients);
    ([color.loss, weight * pass.instance_loss, color.mean_squared_error], gradients)
}

fn groups(g: &Gradients) -> [&[f32]; 10] {
    [
        g.gaussians.means.as_flattened(),
        g.gaussians.log_scales.as_flattened(),
        g.gaussians.quaternions.as_flattened(),
        &g.gaussians.opacity_logits,
        &g.gaussians.occupancy_logits,
        g.gaussians.sh_coefficients.as_flattened(),
        &g.log_calibrations,
        &g.planes,
        &g.mlp,
        g.screen.as_flattened(),
    ]
}

/// Largest difference of the mean over all choices of one tile from all tiles: of losses, and of gradients relative
/// to the largest of their group.
fn bias(lambda_dssim: f32, windows: bool) -> (f64, f64) {
    let (scene, target) = scene();
    let (losses, gradients) = learn(&scene, &target, lambda_dssim, None);
    let mut mean_losses = [0.0; 3];
    let mut means: Vec<Vec<f64>> = groups(&gradients).iter().map(|group| vec![0.0; group.len()]).collect();
    for tile in 0..6 {
        let sample = TileSample::of(3, (0..6).map(|k| k == tile).collect(), windows);
        let (losses, gradients) = learn(&scene, &target, lambda_dssim, Some(&sample));
        for (mean, loss) in mean_losses.iter_mut().zip(losses) {
            *mean += loss / 6.0;
        }
        for (means, group) in means.iter_mut().zip(groups(&gradients)) {
            for (mean, value) in means.iter_mut().zip(group) {
                *mean += f64::from(*value) / 6.0;
            }
        }
    }
    let off = losses.iter().zip(mean_losses).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let mut worst = 0.0_f64;
    for (group, means) in groups(&gradients).iter().zip(&means) {
        let largest = group.iter().map(|v| f64::from(v.abs())).fold(0.0, f64::max);
        assert!(largest > 0.0, "every group learns here");
        let differences = group.iter().zip(means).map(|(a, b)| (f64::from(*a) - b).abs());
        worst = worst.max(differences.fold(0.0, f64::max) / largest);
    }
    (off, worst)
}

#[test]
fn one_tile_tells_on_average_what_all_tell() {
    for lambda_dssim in [0.0, 0.3] {
        let (losses, gradients) = bias(lambda_dssim, lambda_dssim > 0.0);
        assert!(losses < 1e-6 && gradients < 1e-4, "{lambda_dssim}: {losses:e} {gradients:e}");
    }
    // Windows see the background where the tiles beside are not drawn: the test would notice.
    let (losses, gradients) = bias(0.3, false);
    assert!(losses > 1e-4 && gradients > 1e-3, "{losses:e} {gradients:e}");
}

#[test]
fn all_tiles_are_the_view_bit_for_bit() {
    let (scene, target) = scene();
    let mut rng = Pcg64::seed_from_u64(1);
    assert_eq!(TileSample::draw(44, 29, 1.0, false, &mut rng), None);
    assert_eq!(TileSample::draw(44, 29, 0.95, false, &mut rng), None, "6 of 6");
    assert_eq!(TileSample::draw(9, 9, 0.1, false, &mut rng), None, "a single tile");
    for windows in [false, true] {
        let all = TileSample::of(3, vec![true; 6], windows);
        assert!(learn(&scene, &target, 0.3, Some(&all)) == learn(&scene, &target, 0.3, None));
    }
}

#[test]
fn every_tile_is_drawn_equally_often() {
    let mut counts = [0_u32; 20];
    let draws = 4_000;
    for seed in 0..draws {
        let mut rng = Pcg64::seed_from_u64(seed);
        let sample = TileSample::draw(80, 64, 0.25, true, &mut rng).unwrap();
        assert_eq!((sample.weight(), sample.counted.iter().filter(|tile| **tile).count()), (4.0, 5));
        for (tile, counted) in sample.counted.iter().enumerate() {
            counts[tile] += u32::from(*counted);
            assert!(!counted || sample.drawn[tile]);
        }
    }
    // A quarter of the draws each, with a standard deviation of 27.
    assert!(counts.iter().all(|count| count.abs_diff(1_000) < 5 * 27), "{counts:?}");
}

#[test]
fn neighbours_are_drawn_for_windows_alone() {
    let mut counted = vec![false; 12];
    counted[0] = true;
    let alone = TileSample::of(4, counted.clone(), false);
    assert_eq!(alone.drawn, counted);
    let drawn = TileSample::of(4, counted, true).drawn;
    let numbers: Vec<usize> = (0..12).filter(|tile| drawn[*tile]).collect();
    assert_eq!(numbers, [0, 1, 4, 5]);
    assert!(alone.counts(15, 15) && !alone.counts(16, 0) && !alone.counts(0, 16));
}
