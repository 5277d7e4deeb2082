//! The low-pass filter of the renderer as part of the splats, for viewers without one.
//!
//! The renderer widens every footprint by [`LOW_PASS`] px^2, so that what is thinner than a pixel stays visible. Ray
//! tracers and viewers that draw splats as they are do not, and thin parts vanish there. A splat that is as much wider
//! in all directions as this is at its distance has the same footprint from the cameras of the capture, and the filter
//! leaves its opacity alone, so that it keeps it; where the scene was trained with antialiasing, which lowers opacities
//! in turn, so are those of the splats.

use cif_geometry::{RigidTransform, quaternion};
use cif_render::constants::LOW_PASS;
use glam::{DMat3, DVec2, DVec3};

use crate::graph::{CameraSample, CameraTrack, Motion, Node, Part};
use crate::shape::extent;

/// Views at most that sizes of pixels are taken from, spread over all recorded ones.
const VIEWS: usize = 32;

/// Views of a scene by which blur is baked.
pub(crate) struct Blur {
    views: Vec<CameraSample>,
    antialiased: bool,
}

/// Sums over the views that see a splat.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    /// Of logarithms of the size of a pixel, world units.
    log_pixel: f64,
    /// Of factors of the opacity.
    opacity: f64,
    views: f64,
}

impl Blur {
    /// Views of recorded cameras; `antialiased` says how the scene was trained. `None` without any.
    pub(crate) fn of(cameras: &[CameraTrack], antialiased: bool) -> Option<Self> {
        let all: Vec<CameraSample> = cameras.iter().flat_map(|track| &track.samples).copied().collect();
        let step = all.len().div_ceil(VIEWS).max(1);
        let views: Vec<CameraSample> = all.into_iter().step_by(step).collect();
        (!views.is_empty()).then_some(Self { views, antialiased })
    }

    /// Widens the splats of a node by the size of a pixel at them: the geometric mean over the views that see a splat,
    /// else over those that it lies before.
    pub(crate) fn bake(&self, node: &mut Node) {
        let mut seen = vec![Seen::default(); node.splats.len()];
        let mut before = seen.clone();
        for view in &self.views {
            let (camera, placed) = (&view.camera, node.splats_at(view.time_code));
            let focal = (camera.focal_px.x * camera.focal_px.y).sqrt();
            for (index, mean) in placed.means.iter().enumerate() {
                let Some((pixel, depth)) = camera.project(*mean) else { continue };
                let size = depth / focal;
                let turn = DMat3::from_cols_array_2d(&quaternion::to_rotation(placed.orientations[index]));
                // Rows of a rotation as columns are its inverse: the direction in the frame of the splat.
                let direction = turn * (*mean - camera.centre()).normalize_or_zero();
                let opacity = lowered(placed.scales[index], direction, size);
                let shown = pixel.cmpge(DVec2::ZERO).all()
                    && pixel.x <= f64::from(camera.width)
                    && pixel.y <= f64::from(camera.height);
                let sums = [Some(&mut before[index]), shown.then_some(&mut seen[index])];
                for sum in sums.into_iter().flatten() {
                    sum.log_pixel += size.ln();
                    sum.opacity += opacity;
                    sum.views += 1.0;
                }
            }
        }
        let sums: Vec<Seen> = seen
            .into_iter()
            .zip(before)
            .map(|(seen, before)| if seen.views > 0.0 { seen } else { before })
            .collect();
        let variances: Vec<f64> = sums
            .iter()
            .map(|sum| if sum.views > 0.0 { variance((sum.log_pixel / sum.views).exp()) } else { 0.0 })
            .collect();
        widen(&mut node.splats.scales, &variances);
        if let Motion::Dense(dense) = &mut node.motion {
            dense
                .samples
                .iter_mut()
                .filter_map(|sample| sample.scales.as_mut())
                .for_each(|scales| widen(scales, &variances));
        }
        if self.antialiased {
            let factors: Vec<f32> = sums
                .iter()
                .map(|sum| if sum.views > 0.0 { (sum.opacity / sum.views) as f32 } else { 1.0 })
                .collect();
            let lower = |opacities: &mut Vec<f32>| {
                opacities.iter_mut().zip(&factors).for_each(|(opacity, factor)| *opacity *= factor);
            };
            lower(&mut node.splats.opacities);
            node.appearance.opacities.iter_mut().for_each(|sample| lower(&mut sample.values));
        }
        bounds(node);
    }
}

/// Variance that the filter adds where a pixel has this size, square world units.
fn variance(pixel: f64) -> f64 {
    f64::from(LOW_PASS) * pixel * pixel
}

fn widen(scales: &mut [[f32; 3]], variances: &[f64]) {
    for (scale, variance) in scales.iter_mut().zip(variances) {
        *scale = scale.map(|sigma| (f64::from(sigma).powi(2) + variance).sqrt() as f32);
    }
}

/// Factor by which antialiasing lowers the opacity of a splat that is seen along a direction of its own frame.
fn lowered(scales: [f32; 3], direction: DVec3, pixel: f64) -> f64 {
    let area = |more: f64| {
        let [x, y, z] = scales.map(|sigma| f64::from(sigma).powi(2) + more);
        DVec3::new(y * z, x * z, x * y).dot(direction * direction)
    };
    let (sharp, dilated) = (area(0.0), area(variance(pixel)));
    if dilated > 0.0 { (sharp / dilated).sqrt() } else { 1.0 }
}

/// Boxes of a node whose splats have changed.
fn bounds(node: &mut Node) {
    let at_rest = &RigidTransform::IDENTITY;
    match &mut node.motion {
        Motion::Parts(motion) => {
            for part in &mut motion.parts {
                part.extent = extent::splat_bounds(at_rest, &node.splats, part.splats.clone());
            }
        }
        Motion::Dense(dense) => {
            for sample in &mut dense.samples {
                let scales = sample.scales.as_ref().unwrap_or(&node.splats.scales);
                sample.extent =
                    extent::ellipsoid_bounds(at_rest, &sample.means, &sample.orientations, scales);
            }
        }
        Motion::Static | Motion::Rigid(_) => {}
    }
    node.extent = extent::node_bounds(at_rest, &node.splats, &node.motion, Part::at_first);
}

#[cfg(test)]
mod tests {
    use cif_geometry::PinholeCamera;

    use super::*;
    use crate::testing::node_of;

    fn track(depth: f64) -> CameraTrack {
        let camera = PinholeCamera {
            width: 100,
            height: 80,
            focal_px: DVec2::splat(50.0),
            principal_px: DVec2::new(50.0, 40.0),
            camera_from_world: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::Z * depth },
        };
        CameraTrack {
            name: "a".into(),
            label: "a".into(),
            samples: vec![CameraSample { time_code: 0.0, camera, exposure: 0.0 }],
        }
    }

    #[test]
    fn splats_grow_by_the_filter_at_their_distance() {
        // At the origin a pixel is 2 / 50; the second lies behind the camera.
        let mut node = node_of(&[DVec3::ZERO, DVec3::Z * -5.0], [0.001, 0.03, 0.001]);
        Blur::of(&[track(2.0)], false).unwrap().bake(&mut node);
        let expected = |sigma: f64| (sigma * sigma + 0.3 * 0.04 * 0.04).sqrt();
        for (scale, sigma) in node.splats.scales[0].into_iter().zip([0.001, 0.03, 0.001]) {
            assert!((f64::from(scale) - expected(sigma)).abs() < 1e-7, "{scale}");
        }
        assert_eq!(node.splats.scales[1], [0.001, 0.03, 0.001]);
        assert_eq!(node.splats.opacities, [0.9, 0.9], "the filter leaves opacities alone");
        assert!((node.extent.high.x - 3.0 * expected(0.001)).abs() < 1e-6, "{:?}", node.extent);
        assert!(Blur::of(&[], false).is_none());
    }

    #[test]
    fn antialiasing_is_baked_too() {
        let mut node = node_of(&[DVec3::ZERO], [0.02, 0.02, 0.5]);
        Blur::of(&[track(2.0)], true).unwrap().bake(&mut node);
        // Seen along z: the same factor on both axes of the picture.
        let factor = 0.02_f64.powi(2) / (0.02_f64.powi(2) + 0.3 * 0.04 * 0.04);
        assert!(
            (f64::from(node.splats.opacities[0]) - 0.9 * factor).abs() < 1e-6,
            "{:?}",
            node.splats.opacities
        );
    }
}
