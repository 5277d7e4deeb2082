//! Views drawn in bands take the memory that they are given. On its own: it measures the process that it runs in.
#![cfg(target_os = "linux")]

use cif_field::Gaussians;
use cif_field::gaussians::SH_FLOATS;
use cif_geometry::PinholeCamera;
use cif_render::RenderSettings;
use cif_render::cpu::{BandRequest, Renderer, SimdLevel};
use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
use glam::DVec2;

/// Gaussians that each cover the whole of a square image, barely visible, so that none hides another.
fn veils(count: usize, size: u32) -> SyntheticScene {
    let config = SyntheticConfig { width: size, height: size, instances: 0, ..SyntheticConfig::default() };
    let mut scene = generate(&config);
    let camera = PinholeCamera {
        focal_px: DVec2::splat(f64::from(size)),
        principal_px: DVec2::splat(f64::from(size) / 2.0),
        ..scene.camera
    };
    let (centre, forward) = (camera.centre(), camera.camera_from_world.rotation.row(2));
    let mean = |k: usize| (centre + forward * (2.0 + 0.001 * k as f64)).as_vec3().to_array();
    scene.field.gaussians = Gaussians {
        means: (0..count).map(mean).collect(),
        log_scales: vec![[3.0; 3]; count],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![-4.6; count],
        occupancy_logits: vec![-4.6; count],
        sh_coefficients: vec![[0.1; SH_FLOATS]; count],
    };
    scene.camera = camera;
    scene
}

/// Peak of resident memory since the last reset, bytes.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("this holds in the test");
    let line = status.lines().find(|line| line.starts_with("VmHWM")).expect("this holds in the test");
    line.split_whitespace()
        .nth(1)
        .expect("this holds in the test")
        .parse::<u64>()
        .expect("this holds in the test")
        * 1024
}

/// Bytes that a view takes, (tile, Gaussian) pairs, and covered pixels.
fn draw(scene: &SyntheticScene, band_memory: u64) -> (u64, usize, usize) {
    std::fs::write("/proc/self/clear_refs", "5").expect("this holds in the test");
    let before = peak();
    let mut renderer = Renderer::new(SimdLevel::Auto);
    renderer.set_band_memory(band_memory);
    let settings = RenderSettings::of_field(&scene.field);
    let mut covered = 0;
    let request = BandRequest::default();
    let drawn = renderer.render_bands(&scene.field, &scene.camera, 0.0, &settings, &request, |band| {
        covered += band.image.alpha.pixels.iter().filter(|alpha| **alpha > 0.9).count();
        Ok::<(), String>(())
    });
    drawn.expect("this holds in the test");
    (peak() - before, renderer.statistics().tile_pairs, covered)
}

#[test]
fn large_splats_take_the_memory_of_a_band() {
    const BAND: u64 = 8 << 20;
    // A first view takes what threads and code take.
    draw(&veils(20, 64), BAND);
    let scene = veils(2000, 512);
    let (taken, pairs, covered) = draw(&scene, BAND);
    assert_eq!((pairs, covered), (2000 * 32 * 32, 512 * 512));
    // Beside the band: the splats, twice while they are put in order, and what the allocator keeps.
    let splats = 2 * 2000 * 100;
    assert!(taken < BAND + splats + (4 << 20), "{taken} bytes for bands of {BAND}");
    // At once, 8 bytes of every pair are there together, before the lists are.
    let (taken, ..) = draw(&scene, u64::MAX);
    assert!(taken > 8 * pairs as u64, "{taken} bytes at once");
}
