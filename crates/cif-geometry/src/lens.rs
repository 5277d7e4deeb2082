//! Brown-Conrady lens distortion and skew, and their inverse.

use glam::DVec2;
use serde::{Deserialize, Serialize};

/// Distortion of normalised image coordinates (x / z, y / z), and pixel skew.
///
/// `radial` are k1, k2, k3 (and k4 where given) of `1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8`;
/// `tangential` are p1, p2 in the order of OpenCV.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LensDistortion {
    /// k1 to k4.
    pub radial: [f64; 4],
    /// p1, p2.
    pub tangential: [f64; 2],
    /// Pixels of x shift per unit of normalised y.
    pub skew_px: f64,
}

impl LensDistortion {
    /// True when the lens is ideal, so that images need no resampling.
    #[must_use]
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// Distorted normalised coordinates of ideal ones (skew excluded).
    #[must_use]
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        let (x, y) = (ideal.x, ideal.y);
        let r2 = ideal.length_squared();
        let [k1, k2, k3, k4] = self.radial;
        let [p1, p2] = self.tangential;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        DVec2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Ideal coordinates of distorted ones, by fixed-point iteration; `None` when it does not converge
    /// (outside the lens model's monotonic range).
    #[must_use]
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        let mut ideal = distorted;
        for _ in 0..100 {
            let error = self.distort(ideal) - distorted;
            if error.length() < 1e-12 {
                return Some(ideal);
            }
            ideal -= error;
            if !ideal.is_finite() {
                return None;
            }
        }
        (self.distort(ideal) - distorted).length().lt(&1e-6).then_some(ideal)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistort_inverts_distort() {
        let lens =
            LensDistortion { radial: [-0.1, 0.02, 0.001, 0.0], tangential: [1e-3, -2e-3], skew_px: 0.0 };
        for p in [DVec2::new(0.0, 0.0), DVec2::new(0.3, -0.4), DVec2::new(-0.6, 0.5)] {
            let back = lens.undistort(lens.distort(p)).unwrap();
            assert!((back - p).length() < 1e-9, "{p} {back}");
        }
    }
}
