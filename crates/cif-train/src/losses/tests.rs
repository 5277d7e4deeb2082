use cif_geometry::PixelGrid;

use super::rows::unit;
use super::*;

const WIDTH: usize = 19;
const HEIGHT: usize = 14;

fn images() -> (PixelGrid<[f32; 3]>, PixelGrid<[u8; 3]>) {
    let pixel = |k: usize, c: usize| ((k * 31 + c * 17) as f32 * 0.13).sin() * 0.4 + 0.5;
    let rendered = (0..WIDTH * HEIGHT).map(|k| [0, 1, 2].map(|c| pixel(k, c))).collect();
    let target = (0..WIDTH * HEIGHT).map(|k| [0, 1, 2].map(|c| (pixel(k + 3, c) * 255.0) as u8)).collect();
    let (w, h) = (WIDTH as u32, HEIGHT as u32);
    (PixelGrid::from_pixels(w, h, rendered), PixelGrid::from_pixels(w, h, target))
}

/// Plain double-precision similarity: full two-dimensional window, zero padding.
fn ssim_reference(x: &[[f64; 3]], y: &[[f64; 3]]) -> f64 {
    let tap = |k: i64| (-((k * k) as f64) / 4.5).exp();
    let norm: f64 = (-5..=5).map(tap).sum();
    let mut total = 0.0;
    for c in 0..3 {
        for row in 0..HEIGHT as i64 {
            for column in 0..WIDTH as i64 {
                let (mut m1, mut m2, mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
                for dy in -5..=5 {
                    for dx in -5..=5 {
                        let (r, q) = (row + dy, column + dx);
                        if (0..HEIGHT as i64).contains(&r) && (0..WIDTH as i64).contains(&q) {
                            let k = (r * WIDTH as i64 + q) as usize;
                            let w = tap(dx) * tap(dy) / (norm * norm);
                            m1 += w * x[k][c];
                            m2 += w * y[k][c];
                            xx += w * x[k][c] * x[k][c];
                            yy += w * y[k][c] * y[k][c];
                            xy += w * x[k][c] * y[k][c];
                        }
                    }
                }
                let (s1, s2, s12) = (xx - m1 * m1, yy - m2 * m2, xy - m1 * m2);
                total += (2.0 * m1 * m2 + 1e-4) * (2.0 * s12 + 9e-4)
                    / ((m1 * m1 + m2 * m2 + 1e-4) * (s1 + s2 + 9e-4));
            }
        }
    }
    total / (3 * WIDTH * HEIGHT) as f64
}

fn loss_reference(x: &[[f64; 3]], y: &[[f64; 3]], lambda: f64) -> f64 {
    let l1: f64 = x.iter().flatten().zip(y.iter().flatten()).map(|(a, b)| (a - b).abs()).sum();
    (1.0 - lambda) * l1 / (3 * WIDTH * HEIGHT) as f64 + lambda * (1.0 - ssim_reference(x, y))
}

#[test]
fn gradient_matches_central_differences() {
    let (rendered, target) = images();
    let y: Vec<[f64; 3]> = target.pixels.iter().map(|p| p.map(|v| f64::from(v) / 255.0)).collect();
    let x: Vec<[f64; 3]> = rendered.pixels.iter().map(|p| p.map(f64::from)).collect();
    for lambda in [0.0_f32, 0.2, 1.0] {
        let mut v_color = PixelGrid::filled(1, 1, [9.0; 3]);
        let result = color_loss(&rendered, &target, lambda, 0.5, &mut v_color, &mut SsimScratch::default());
        let expected = loss_reference(&x, &y, f64::from(lambda));
        assert!((result.loss - expected).abs() < 1e-5, "{} vs {expected}", result.loss);
        let mut moved = x.clone();
        for k in (0..x.len()).step_by(23).chain([0, x.len() - 1]) {
            for c in 0..3 {
                let h = 1e-5;
                moved[k][c] = x[k][c] + h;
                let upper = loss_reference(&moved, &y, f64::from(lambda));
                moved[k][c] = x[k][c] - h;
                let lower = loss_reference(&moved, &y, f64::from(lambda));
                moved[k][c] = x[k][c];
                let numerical = 0.5 * (upper - lower) / (2.0 * h);
                let analytic = f64::from(v_color.pixels[k][c]);
                let tolerance = 1e-3 * numerical.abs() + 2e-7;
                assert!((numerical - analytic).abs() < tolerance, "{lambda} {k} {c}: {numerical} {analytic}");
            }
        }
    }
}

#[test]
fn equal_images_have_no_loss_and_no_gradient() {
    let (_, target) = images();
    let rendered = target.map(|p| p.map(unit));
    let mut v_color = PixelGrid::filled(1, 1, [0.0; 3]);
    let result = color_loss(&rendered, &target, 0.0, 1.0, &mut v_color, &mut SsimScratch::default());
    assert_eq!(result.loss, 0.0);
    assert_eq!(result.psnr(), f64::INFINITY);
    assert!(v_color.pixels.iter().flatten().all(|v| *v == 0.0));
}

#[test]
fn scratch_may_be_shared_by_images_of_different_size() {
    let (rendered, target) = images();
    let mut scratch = SsimScratch::default();
    let mut v_color = PixelGrid::filled(1, 1, [0.0; 3]);
    let small = PixelGrid::filled(4, 3, [0.5; 3]);
    color_loss(&small, &PixelGrid::filled(4, 3, [9; 3]), 0.5, 1.0, &mut v_color, &mut scratch);
    let again = color_loss(&rendered, &target, 0.5, 1.0, &mut v_color, &mut scratch);
    let fresh = color_loss(&rendered, &target, 0.5, 1.0, &mut v_color, &mut SsimScratch::default());
    assert_eq!(again, fresh);
}
