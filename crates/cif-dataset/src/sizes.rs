//! Sizes of images, reduced or compared.

use cif_geometry::PinholeCamera;
use glam::DVec2;

/// True when two sizes have one aspect, up to the rounding of either to whole pixels.
#[must_use]
pub fn same_aspect(a: (u32, u32), b: (u32, u32)) -> bool {
    let [aw, ah, bw, bh] = [a.0, a.1, b.0, b.1].map(f64::from);
    let slack = 1.0 / aw.min(ah).max(1.0) + 1.0 / bw.min(bh).max(1.0);
    ((aw * bh) / (ah * bw)).ln().abs() <= slack.min(0.1)
}

/// Size of an image after a reduction.
pub(crate) fn reduced_size(width: u32, height: u32, reduction: u32) -> (u32, u32) {
    let reduce = |size: u32| ((f64::from(size) / f64::from(reduction)).round() as u32).max(1);
    (reduce(width), reduce(height))
}

/// The principal point in the middle of the image.
pub(crate) fn centred(camera: PinholeCamera) -> PinholeCamera {
    PinholeCamera {
        principal_px: DVec2::new(f64::from(camera.width), f64::from(camera.height)) / 2.0,
        ..camera
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aspects_allow_for_rounding_only() {
        assert!(same_aspect((256, 192), (128, 96)));
        assert!(same_aspect((1352, 1014), (451, 338)));
        assert!(!same_aspect((256, 192), (192, 256)));
        assert!(!same_aspect((256, 192), (256, 180)));
    }
}
