//! Projects posed Gaussians to the image, sixteen at a time; [`super::project_backward`] is the backward pass. Source:
//! methods reference 3.1, steps 1 to 9.
//!
//! Everything of a Gaussian that a pixel needs is one [`Splat`]; the backward pass recomputes the
//! intermediate values instead of keeping them.

use std::ops::Range;

use cif_field::SortMetric;
use cif_field::gaussians::SH_FLOATS;
use cif_geometry::PinholeCamera;
use cif_geometry::spherical_harmonics::coefficient_count;
use fearless_simd::prelude::*;
use fearless_simd::{f32x16, mask32x16};
use fearless_simd_macros::simd;

use super::functions::{exp, ln, sigmoid};
use super::gaussian_lanes::{Matrix, Vector, cross, dot, load_lanes, splat_matrix, splat_vector, transform};
use super::harmonics::basis;
use super::pixels::{LANES, Lanes, splat};
use super::posed::PosedView;
use super::rotation::Rotation;
use crate::constants::{JACOBIAN_MARGIN, LOG_SCALE_RANGE, MAX_COVARIANCE, MIN_ALPHA, MIN_ANTIALIASING};
use crate::{Blending, OccupancySource, RenderSettings};

/// A camera and the settings of a render, in the form that projection reads.
#[derive(Clone, Copy, Debug)]
pub(super) struct ViewConstants {
    pub(super) rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    centre: [f32; 3],
    pub(super) focal: [f32; 2],
    principal: [f32; 2],
    /// Limits of x / z and y / z inside the Jacobian.
    ratio_limits: [(f32, f32); 2],
    pub(super) width: u32,
    pub(super) height: u32,
    near: f32,
    pub(super) low_pass: f32,
    pub(super) sh_degree: u8,
    antialiased: bool,
    sort_metric: SortMetric,
    /// Source of the occupancy; `None` where instances are not drawn.
    pub(super) occupancy: Option<OccupancySource>,
}

impl ViewConstants {
    pub(super) fn new(camera: &PinholeCamera, settings: &RenderSettings) -> Self {
        let rows = [0, 1, 2].map(|row| camera.camera_from_world.rotation.row(row).as_vec3().to_array());
        let focal = camera.focal_px.as_vec2().to_array();
        let principal = camera.principal_px.as_vec2().to_array();
        let size = [camera.width as f32, camera.height as f32];
        let ratio_limits = [0, 1].map(|axis| {
            let margin = JACOBIAN_MARGIN * 0.5 * size[axis] / focal[axis];
            (-(principal[axis] / focal[axis] + margin), (size[axis] - principal[axis]) / focal[axis] + margin)
        });
        Self {
            rotation: rows,
            translation: camera.camera_from_world.translation.as_vec3().to_array(),
            centre: camera.centre().as_vec3().to_array(),
            focal,
            principal,
            ratio_limits,
            width: camera.width,
            height: camera.height,
            near: settings.near,
            low_pass: settings.low_pass,
            sh_degree: settings.sh_degree,
            antialiased: settings.antialiased,
            sort_metric: settings.sort_metric,
            occupancy: settings.instances.map(|instances| instances.occupancy),
        }
    }
}

/// Raw parameters of sixteen Gaussians at the time of the view.
#[derive(Clone, Copy)]
pub(super) struct Posed<S: Simd> {
    mean: Vector<S>,
    log_scale: Vector<S>,
    quaternion: [f32x16<S>; 4],
    opacity_logit: f32x16<S>,
    occupancy_logit: f32x16<S>,
}

impl<S: Simd> Posed<S> {
    /// Gaussians in the order of [`PosedView::row`].
    #[inline(always)]
    pub(super) fn load(simd: S, rows: &[Lanes; LANES]) -> Self {
        let v = load_lanes(simd, rows);
        Self {
            mean: [v[0], v[1], v[2]],
            log_scale: [v[3], v[4], v[5]],
            quaternion: [v[6], v[7], v[8], v[9]],
            opacity_logit: v[10],
            occupancy_logit: v[11],
        }
    }
}

/// A Gaussian as the raster loops see it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Splat {
    /// Projected centre, pixels.
    pub(super) mean: [f32; 2],
    /// L00, L01, L11 of the conic `L^T L`, px^-1: sigma is half the squared norm of `L d`.
    pub(super) factor: [f32; 3],
    /// Blended colour.
    pub(super) color: [f32; 3],
    /// Opacity o after antialiasing.
    pub(super) opacity: f32,
    /// Occupancy pi, or the opacity when instances blend with it.
    pub(super) occupancy: f32,
    /// Camera z.
    pub(super) depth: f32,
    /// Sort key.
    pub(super) order: f32,
    /// Largest sigma that the colour and the instance pass draw: `ln(255 o)`, `ln(255 pi)`; negative where a
    /// pass draws nothing.
    pub(super) reach: [f32; 2],
    /// Half-widths of the drawn ellipse, pixels.
    pub(super) extent: [f32; 2],
    /// 3 standard deviations of the larger axis, pixels.
    pub(super) radius: f32,
    /// Index of the Gaussian.
    pub(super) gaussian: u32,
}

impl Splat {
    /// Peak of the blending weight.
    #[inline(always)]
    pub(super) fn strength(&self, blending: Blending) -> f32 {
        match blending {
            Blending::Color => self.opacity,
            Blending::Own => self.occupancy,
        }
    }

    /// The factor scaled so that the footprint is `2^-|u|^2` with `u` its product with an offset.
    #[inline(always)]
    pub(super) fn binary_factor(&self) -> [f32; 3] {
        let scale = (0.5 * std::f32::consts::LOG2_E).sqrt();
        self.factor.map(|entry| scale * entry)
    }
}

/// Intermediate values shared by both directions, a Gaussian per lane.
pub(super) struct Footprint<S: Simd> {
    /// Lanes with a footprint at all: the others hold anything.
    some: mask32x16<S>,
    pub(super) in_camera: Vector<S>,
    pub(super) rotation: Rotation<S>,
    pub(super) scales: Vector<S>,
    pub(super) clamped_scale: [mask32x16<S>; 3],
    /// R_v R diag(exp s).
    pub(super) spread_in_camera: Matrix<S>,
    /// The entries of the Jacobian that are not zero: 00, 02, 11, 12.
    pub(super) jacobian: [f32x16<S>; 4],
    pub(super) ratio_clamped: [mask32x16<S>; 2],
    /// Clamped x and y of the Jacobian.
    pub(super) clamped_xy: [f32x16<S>; 2],
    /// 1 / z.
    pub(super) inverse_depth: f32x16<S>,
    /// Rows of T = J R_v R diag(exp s), and their cross product.
    pub(super) image_spread: [Vector<S>; 2],
    pub(super) normal: Vector<S>,
    /// Determinant of C0 = T T^T.
    pub(super) sharp_determinant: f32x16<S>,
    /// After the low pass: C 00, 01, 11.
    pub(super) blurred: [f32x16<S>; 3],
    pub(super) factor: [f32x16<S>; 3],
    /// Antialiasing factor rho, and where it sits on its floor.
    pub(super) compensation: f32x16<S>,
    pub(super) compensation_floored: mask32x16<S>,
    /// sigmoid(opacity logit).
    pub(super) base_opacity: f32x16<S>,
    /// Unit direction from the camera, and the distance.
    pub(super) direction: Vector<S>,
    pub(super) distance: f32x16<S>,
}

impl<S: Simd> Footprint<S> {
    #[inline(always)]
    pub(super) fn new(simd: S, view: &ViewConstants, posed: &Posed<S>) -> Self {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let to_camera = splat_matrix(simd, view.rotation);
        let [x, y, z] = transform(&to_camera, posed.mean);
        let [tx, ty, tz] = splat_vector(simd, view.translation);
        let [x, y, z] = [x + tx, y + ty, z + tz];
        let (rotation, rotates) = Rotation::new(simd, posed.quaternion);
        let [sx, sy, sz] = posed.log_scale;
        let some = rotates
            & x.is_finite()
            & y.is_finite()
            & z.is_finite()
            & z.simd_ge(splat(simd, view.near))
            & !(sx.is_nan() | sy.is_nan() | sz.is_nan() | posed.opacity_logit.is_nan());
        let (low, high) = (splat(simd, LOG_SCALE_RANGE.0), splat(simd, LOG_SCALE_RANGE.1));
        let clamped_scale = [
            sx.simd_lt(low) | sx.simd_gt(high),
            sy.simd_lt(low) | sy.simd_gt(high),
            sz.simd_lt(low) | sz.simd_gt(high),
        ];
        let scales = [
            exp(simd, sx.max(low).min(high)),
            exp(simd, sy.max(low).min(high)),
            exp(simd, sz.max(low).min(high)),
        ];
        let [r0, r1, r2] = rotation.matrix(simd);
        let spread = [
            [r0[0] * scales[0], r0[1] * scales[1], r0[2] * scales[2]],
            [r1[0] * scales[0], r1[1] * scales[1], r1[2] * scales[2]],
            [r2[0] * scales[0], r2[1] * scales[1], r2[2] * scales[2]],
        ];
        let mut m = spread;
        for row in 0..3 {
            let [a, b, c] = to_camera[row];
            for k in 0..3 {
                m[row][k] = a.mul_add(spread[0][k], b.mul_add(spread[1][k], c * spread[2][k]));
            }
        }
        let inverse_depth = one / z;
        let mut clamped_xy = [x, y];
        let mut ratio_clamped = [clamped_scale[0]; 2];
        for axis in 0..2 {
            let ratio = clamped_xy[axis] * inverse_depth;
            let (low, high) = view.ratio_limits[axis];
            let (low, high) = (splat(simd, low), splat(simd, high));
            ratio_clamped[axis] = ratio.simd_lt(low) | ratio.simd_gt(high);
            clamped_xy[axis] = ratio_clamped[axis].select(z * ratio.max(low).min(high), clamped_xy[axis]);
        }
        let (fx, fy) = (inverse_depth * view.focal[0], inverse_depth * view.focal[1]);
        let jacobian = [fx, -(fx * clamped_xy[0] * inverse_depth), fy, -(fy * clamped_xy[1] * inverse_depth)];
        // Rows of T = J R_v B, so that C0 = T T^T and det C0 = |t0 x t1|^2: a sum of squares has nothing to
        // cancel, however thin the Gaussian. J has two non-zero entries a row.
        let [j00, j02, j11, j12] = jacobian;
        let mut t0 = m[0];
        let mut t1 = m[1];
        for k in 0..3 {
            t0[k] = j00.mul_add(m[0][k], j02 * m[2][k]);
            t1[k] = j11.mul_add(m[1][k], j12 * m[2][k]);
        }
        let largest = dot(t0, t0).max(dot(t1, t1));
        let too_large = largest.simd_gt(splat(simd, MAX_COVARIANCE));
        if too_large.to_bitmask() != 0 {
            let shrink = too_large.select((splat(simd, MAX_COVARIANCE) / largest).sqrt(), one);
            for k in 0..3 {
                t0[k] *= shrink;
                t1[k] *= shrink;
            }
        }
        let low_pass = splat(simd, view.low_pass);
        let sharp = [dot(t0, t0), dot(t0, t1), dot(t1, t1)];
        let blurred = [sharp[0] + low_pass, sharp[1], sharp[2] + low_pass];
        let normal = cross(t0, t1);
        let sharp_determinant = dot(normal, normal);
        let det = sharp_determinant + low_pass * (sharp[0] + sharp[2]) + low_pass * low_pass;
        let l00 = (blurred[2] / det).sqrt();
        let factor = [l00, -(l00 * blurred[1] / blurred[2]), one / blurred[2].sqrt()];
        let (compensation, compensation_floored) = if view.antialiased {
            let squared = sharp_determinant / det;
            let floor = splat(simd, MIN_ANTIALIASING * MIN_ANTIALIASING);
            (squared.max(floor).sqrt(), squared.simd_le(floor))
        } else {
            (one, zero.simd_eq(zero))
        };
        let [cx, cy, cz] = splat_vector(simd, view.centre);
        let offset = [posed.mean[0] - cx, posed.mean[1] - cy, posed.mean[2] - cz];
        let distance = dot(offset, offset).sqrt().max(splat(simd, 1e-8));
        Self {
            some: some & det.is_finite(),
            in_camera: [x, y, z],
            rotation,
            scales,
            clamped_scale,
            spread_in_camera: m,
            jacobian,
            ratio_clamped,
            clamped_xy,
            inverse_depth,
            image_spread: [t0, t1],
            normal,
            sharp_determinant,
            blurred,
            factor,
            compensation,
            compensation_floored,
            base_opacity: sigmoid(simd, posed.opacity_logit),
            direction: [offset[0] / distance, offset[1] / distance, offset[2] / distance],
            distance,
        }
    }
}

/// Coefficients of spherical harmonics that one transposition takes.
pub(super) const SH_BLOCK: usize = LANES;

/// Blocks of coefficients that a degree has.
pub(super) fn sh_blocks(degree: u8) -> usize {
    (3 * coefficient_count(degree)).div_ceil(SH_BLOCK)
}

/// A block of the coefficients of sixteen Gaussians, a lane each.
#[inline(always)]
pub(super) fn load_sh<S: Simd>(
    simd: S,
    sh: &[&[f32; SH_FLOATS]; LANES],
    block: usize,
) -> [f32x16<S>; SH_BLOCK] {
    let mut lanes = [[0.0; SH_BLOCK]; LANES];
    for lane in 0..LANES {
        lanes[lane].copy_from_slice(&sh[lane][block * SH_BLOCK..(block + 1) * SH_BLOCK]);
    }
    load_lanes(simd, &lanes)
}

/// Colours before the clamp at 0.
#[inline(always)]
fn color_unclamped<S: Simd>(
    simd: S,
    degree: u8,
    direction: Vector<S>,
    sh: &[&[f32; SH_FLOATS]; LANES],
) -> Vector<S> {
    let basis = basis(simd, direction, degree);
    let mut color = [splat(simd, 0.5); 3];
    for block in 0..sh_blocks(degree) {
        let sh = load_sh(simd, sh, block);
        for k in 0..SH_BLOCK {
            let at = block * SH_BLOCK + k;
            color[at % 3] = basis[at / 3].mul_add(sh[k], color[at % 3]);
        }
    }
    color
}

/// Projects Gaussians; those that draw nothing are left out.
#[simd]
pub(super) fn project_rows<S: Simd>(
    simd: S,
    view: &ViewConstants,
    posed: &PosedView<'_>,
    rows: Range<usize>,
    splats: &mut Vec<Splat>,
) {
    for first in rows.clone().step_by(LANES) {
        let count = LANES.min(rows.end - first);
        let mut lanes = [[0.0; LANES]; LANES];
        for lane in 0..count {
            lanes[lane] = posed.row(first + lane);
        }
        project_lanes(simd, view, posed, &lanes, first, count, splats);
    }
}

/// Projects some Gaussians from `first` on, one per lane.
#[inline(always)]
fn project_lanes<S: Simd>(
    simd: S,
    view: &ViewConstants,
    posed: &PosedView<'_>,
    lanes: &[Lanes; LANES],
    first: usize,
    count: usize,
    splats: &mut Vec<Splat>,
) {
    let zero = splat(simd, 0.0);
    let raw = Posed::load(simd, lanes);
    let f = Footprint::new(simd, view, &raw);
    let opacity = f.compensation * f.base_opacity;
    let (occupancy, strongest, mut some) = match view.occupancy {
        None => (zero, opacity, f.some),
        Some(OccupancySource::Own) => {
            let occupancy = sigmoid(simd, raw.occupancy_logit);
            (occupancy, opacity.max(occupancy), f.some & !raw.occupancy_logit.is_nan())
        }
        Some(OccupancySource::Opacity) => (opacity, opacity, f.some),
    };
    some &= strongest.simd_ge(splat(simd, MIN_ALPHA));
    let reach = [ln(simd, opacity / splat(simd, MIN_ALPHA)), ln(simd, occupancy / splat(simd, MIN_ALPHA))];
    let twice = reach[0].max(reach[1]) * 2.0;
    let [x, y, z] = f.in_camera;
    let mean = [
        (x / z).mul_add(splat(simd, view.focal[0]), splat(simd, view.principal[0])),
        (y / z).mul_add(splat(simd, view.focal[1]), splat(simd, view.principal[1])),
    ];
    let [c00, c01, c11] = f.blurred;
    let extent = [(twice * c00).sqrt(), (twice * c11).sqrt()];
    some &= (mean[0] + extent[0]).simd_gt(zero)
        & (mean[1] + extent[1]).simd_gt(zero)
        & (mean[0] - extent[0]).simd_lt(splat(simd, view.width as f32))
        & (mean[1] - extent[1]).simd_lt(splat(simd, view.height as f32))
        & extent[0].is_finite()
        & extent[1].is_finite();
    let mut drawn = some.to_bitmask() as u32 & ((1_u32 << count) - 1);
    if drawn == 0 {
        return;
    }
    let mut sh = [posed.sh(first); LANES];
    for lane in 1..count {
        sh[lane] = posed.sh(first + lane);
    }
    let color = color_unclamped(simd, view.sh_degree, f.direction, &sh);
    drawn &= (color[0].is_finite() & color[1].is_finite() & color[2].is_finite()).to_bitmask() as u32;
    let half_difference = (c00 - c11) * 0.5;
    let spread = half_difference.mul_add(half_difference, c01 * c01).sqrt();
    let radius = ((c00 + c11) * 0.5 + spread).sqrt() * 3.0;
    let order = match view.sort_metric {
        SortMetric::Z => z,
        SortMetric::Distance => f.distance,
    };
    let values = [
        mean[0].to_array(),
        mean[1].to_array(),
        f.factor[0].to_array(),
        f.factor[1].to_array(),
        f.factor[2].to_array(),
        color[0].max(zero).to_array(),
        color[1].max(zero).to_array(),
        color[2].max(zero).to_array(),
        opacity.to_array(),
        occupancy.to_array(),
        z.to_array(),
        order.to_array(),
        reach[0].to_array(),
        reach[1].to_array(),
        extent[0].to_array(),
        extent[1].to_array(),
        radius.to_array(),
    ];
    while drawn != 0 {
        let lane = drawn.trailing_zeros() as usize;
        drawn &= drawn - 1;
        let at = |value: usize| values[value][lane];
        splats.push(Splat {
            mean: [at(0), at(1)],
            factor: [at(2), at(3), at(4)],
            color: [at(5), at(6), at(7)],
            opacity: at(8),
            occupancy: at(9),
            depth: at(10),
            order: at(11),
            reach: [at(12), at(13)],
            extent: [at(14), at(15)],
            radius: at(16),
            gaussian: (first + lane) as u32,
        });
    }
}
