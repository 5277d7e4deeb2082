//! Colours fitted to the truth before they are compared, so that what a camera makes of colours does not count.

use cif_geometry::PixelGrid;
use nalgebra::{Matrix4, SMatrix, Vector4};

/// Weight of no change, in pixels, so that an image of one colour has a fit.
const RIDGE: f64 = 1e-3;

/// The rendered colours, moved by the affine map (3 x 4) that brings them nearest to the true ones by least squares, in
/// [0, 1].
pub(super) fn fitted(rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) -> PixelGrid<[f32; 3]> {
    let homogeneous = |color: &[f32; 3]| {
        let [red, green, blue] = color.map(f64::from);
        Vector4::new(red, green, blue, 1.0)
    };
    let mut normal = Matrix4::identity() * RIDGE;
    let mut right = SMatrix::<f64, 4, 3>::identity() * RIDGE;
    for (color, truth) in rendered.pixels.iter().zip(&truth.pixels) {
        let color = homogeneous(color);
        normal += color * color.transpose();
        for channel in 0..3 {
            let mut column = right.column_mut(channel);
            column += color * f64::from(truth[channel]);
        }
    }
    let Some(map) = normal.cholesky().map(|of| of.solve(&right)) else { return rendered.clone() };
    rendered.map(|color| {
        let moved = map.transpose() * homogeneous(color);
        [0, 1, 2].map(|channel| moved[channel].clamp(0.0, 1.0) as f32)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_camera_makes_of_colours_is_taken_back() {
        let mut truth = PixelGrid::filled(8, 8, [0.0_f32; 3]);
        for (k, color) in truth.pixels.iter_mut().enumerate() {
            *color = [k as f32 / 64.0, (k * 7 % 64) as f32 / 64.0, (k * 29 % 64) as f32 / 64.0];
        }
        let seen = truth.map(|[r, g, b]| [0.7 * r + 0.1, 0.6 * g + 0.2 * r, 0.9 * b]);
        let worst = |a: &PixelGrid<[f32; 3]>| {
            let pairs = a.pixels.iter().flatten().zip(truth.pixels.iter().flatten());
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(
            worst(&seen) > 0.2 && worst(&fitted(&seen, &truth)) < 1e-3,
            "{}",
            worst(&fitted(&seen, &truth))
        );
        // An image of one colour, and one of no pixel.
        let plain = PixelGrid::filled(4, 4, [0.5_f32; 3]);
        assert!(fitted(&plain, &plain).pixels.iter().flatten().all(|value| (value - 0.5).abs() < 1e-3));
        assert_eq!(
            fitted(&PixelGrid::filled(0, 0, [0.0; 3]), &PixelGrid::filled(0, 0, [0.0; 3])).pixels.len(),
            0
        );
    }
}
