//! Label mass on the device against the double-precision reference. `CIF_TEST_GPU=off|auto|require`.

use cif_geometry::PixelGrid;
use cif_render::RenderSettings;
use cif_render::cpu::IdentityCounts;
use cif_render::reference::{self, Scene};
use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
use cif_render::wgpu::{
    Commands, Gpu, GpuGaussians, GpuIdentityCounts, GpuVec, Rasterizer, ViewInput, testing,
};

/// Relative to the largest mass of its kind; single precision over the pixels of a Gaussian.
const TOLERANCE: f64 = 2e-5;

fn scene(instances: usize) -> SyntheticScene {
    let mut scene = generate(&SyntheticConfig {
        seed: 21,
        gaussians: 300,
        instances,
        width: 71,
        height: 53,
        screen_size: (0.01, 0.1),
        ..SyntheticConfig::default()
    });
    // Labels that change at every pixel, many to a tile, and pixels without any.
    for (position, label) in scene.labels.pixels.iter_mut().enumerate() {
        *label = if position % 5 == 0 { 0 } else { (position * 7 % instances) as u16 + 1 };
    }
    scene
}

fn on_device(gpu: &Gpu, scene: &SyntheticScene, label_maps: &[&PixelGrid<u16>]) -> IdentityCounts {
    let (n, k) = (scene.field.gaussians.len(), scene.field.instances.len());
    let mut rasterizer = Rasterizer::new(gpu).unwrap();
    let gaussians = GpuGaussians::upload(gpu, &scene.field.gaussians).unwrap();
    let mut counts = GpuIdentityCounts::zeros(gpu, n, k).unwrap();
    let settings = RenderSettings::default();
    for labels in label_maps {
        let wide: Vec<u32> = labels.pixels.iter().map(|label| u32::from(*label)).collect();
        let wide = GpuVec::from_slice(gpu, "labels", &wide).unwrap();
        let mut present = labels.pixels.clone();
        present.sort_unstable();
        present.dedup();
        let input = ViewInput { camera: &scene.camera, settings: &settings, labels: None };
        let mut commands = Commands::new(gpu, None);
        rasterizer.project(gpu, &mut commands, (&gaussians).into(), None, &input).unwrap();
        rasterizer.measure(gpu, commands).unwrap();
        let mut commands = Commands::new(gpu, None);
        rasterizer.rasterize(gpu, &mut commands, None, None).unwrap();
        counts.add_view(gpu, &mut commands, &mut rasterizer, &wide, &present).unwrap();
        commands.submit();
    }
    counts.read(gpu).unwrap()
}

fn worst_error(found: &IdentityCounts, expected: &IdentityCounts) -> (f64, f64) {
    let (n, k) = (expected.gaussians(), expected.instances());
    let largest = (0..n).map(|row| expected.total_mass(row)).fold(0.0, f64::max);
    let (mut labels, mut totals) = (0.0_f64, 0.0_f64);
    for row in 0..n {
        totals = totals.max((found.total_mass(row) - expected.total_mass(row)).abs() / largest);
        for label in 0..k as u16 {
            let difference = found.label_mass(row, label) - expected.label_mass(row, label);
            labels = labels.max(difference.abs() / largest);
        }
    }
    (labels, totals)
}

#[test]
fn counts_agree_with_the_reference_over_views_and_repeat_to_the_bit() {
    let Some(gpu) = testing::gpu() else { return };
    // Fewer labels than a pass takes, just as many, several passes, one beyond the table.
    for instances in [1, 3, 11, 12, 40] {
        let scene = scene(instances);
        let mut other = scene.labels.clone();
        other.pixels.reverse();
        other.pixels[3] = instances as u16 + 1;
        let double = Scene::<f64>::from_field(&scene.field);
        let (n, settings) = (scene.field.gaussians.len(), RenderSettings::default());
        let mut expected = IdentityCounts::zeros(n, instances);
        for labels in [&scene.labels, &other] {
            reference::count_identities(&double, &scene.camera, 0.0, &settings, labels, &mut expected);
        }
        let found = on_device(&gpu, &scene, &[&scene.labels, &other]);
        let (labels, totals) = worst_error(&found, &expected);
        eprintln!("K = {instances}: label mass {labels:.1e}, mass {totals:.1e} of the largest");
        assert!(labels <= TOLERANCE && totals <= TOLERANCE, "K = {instances}: {labels:.1e} {totals:.1e}");
        assert!(found == on_device(&gpu, &scene, &[&scene.labels, &other]), "not to the bit");
        // A view less is another count, or this could not fail.
        let (labels, totals) = worst_error(&on_device(&gpu, &scene, &[&scene.labels]), &expected);
        assert!(labels > 100.0 * TOLERANCE && totals > 100.0 * TOLERANCE);
    }
}

#[test]
fn views_without_labels_count_mass_alone() {
    let Some(gpu) = testing::gpu() else { return };
    let mut scene = scene(3);
    scene.labels.pixels.fill(0);
    let found = on_device(&gpu, &scene, &[&scene.labels]);
    assert!((0..300).all(|row| found.row(row).is_empty()));
    assert!((0..300).any(|row| found.total_mass(row) > 1.0));
}

#[test]
fn tables_that_the_device_does_not_hold_are_known_before() {
    let Some(gpu) = testing::gpu() else { return };
    assert!(GpuIdentityCounts::fits(&gpu, 100_000, 40));
    assert!(!GpuIdentityCounts::fits(&gpu, 10_000_000, 65_534));
}
