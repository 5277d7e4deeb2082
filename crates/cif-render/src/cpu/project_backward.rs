//! Carries gradients of splats to the raw parameters of their Gaussians, sixteen at a time. Source: methods reference
//! 3.2, steps 1 to 9.

use cif_field::gaussians::SH_FLOATS;
use cif_geometry::spherical_harmonics::COEFFICIENTS;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::gaussian_lanes::{cross, dot, load_lanes, scaled, splat_matrix, store_lanes, transform_back};
use super::harmonics::{basis, basis_backward};
use super::pixels::{LANES, Lanes, splat};
use super::posed::PosedView;
use super::project::{Footprint, Posed, SH_BLOCK, Splat, ViewConstants, load_sh, sh_blocks};
use crate::OccupancySource;
use crate::constants::MAX_POSITION_GRADIENT;

/// Gradient of the loss by what the raster loops read of a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SplatGradient {
    pub(super) mean: [f32; 2],
    /// Sums M of `v_sigma u u^T` with `u = L d`, entries 00, 01, 11: the gradient by C is `-L^T M L / 2`.
    pub(super) moments: [f32; 3],
    pub(super) color: [f32; 3],
    pub(super) opacity: f32,
    /// Sum of weighted q_i (methods reference 4.2), so that `dL/dh = -(1 - pi) q`.
    pub(super) responsibility: f32,
}

impl SplatGradient {
    pub(super) fn add(&mut self, other: &Self) {
        for axis in 0..2 {
            self.mean[axis] += other.mean[axis];
        }
        for k in 0..3 {
            self.moments[k] += other.moments[k];
            self.color[k] += other.color[k];
        }
        self.opacity += other.opacity;
        self.responsibility += other.responsibility;
    }

    /// With what the gradients of the raw parameters depend on of the splat itself.
    fn with(&self, splat: &Splat) -> Lanes {
        let ([x, y], [m00, m01, m11], [red, green, blue]) = (self.mean, self.moments, self.color);
        let [of_red, of_green, of_blue] = splat.color;
        let (opacity, occupancy) = (splat.opacity, splat.occupancy);
        let (v_opacity, q) = (self.opacity, self.responsibility);
        [
            x, y, m00, m01, m11, red, green, blue, v_opacity, q, of_red, of_green, of_blue, opacity,
            occupancy, 0.0,
        ]
    }
}

/// Sixteen Gaussians with what is known of the loss by their splats.
pub(super) struct DrawnGaussians<'a> {
    /// Raw parameters in the order of [`PosedView::row`].
    pub(super) posed: [Lanes; LANES],
    pub(super) sh: [&'a [f32; SH_FLOATS]; LANES],
    pub(super) gradients: [Lanes; LANES],
}

impl<'a> DrawnGaussians<'a> {
    /// Lanes that nothing is known of, all with these coefficients.
    pub(super) fn new(sh: &'a [f32; SH_FLOATS]) -> Self {
        Self { posed: [[0.0; LANES]; LANES], sh: [sh; LANES], gradients: [[0.0; LANES]; LANES] }
    }

    /// Sets a lane to the Gaussian of a splat.
    pub(super) fn set(
        &mut self,
        lane: usize,
        posed: &PosedView<'a>,
        splat: &Splat,
        gradient: &SplatGradient,
    ) {
        let gaussian = splat.gaussian as usize;
        self.posed[lane] = posed.row(gaussian);
        self.sh[lane] = posed.sh(gaussian);
        self.gradients[lane] = gradient.with(splat);
    }
}

/// Gradient of the loss by the raw parameters of a posed Gaussian.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PosedGradient {
    pub(super) mean: [f32; 3],
    pub(super) log_scale: [f32; 3],
    pub(super) quaternion: [f32; 4],
    pub(super) opacity_logit: f32,
    pub(super) occupancy_logit: f32,
}

/// Gradients by lane, and those of the coefficients of spherical harmonics, block by block.
pub(super) struct PosedGradients {
    lanes: [Lanes; LANES],
    sh: [[Lanes; LANES]; SH_FLOATS / SH_BLOCK],
    blocks: usize,
}

impl PosedGradients {
    #[inline(always)]
    pub(super) fn of(&self, lane: usize) -> PosedGradient {
        let v = &self.lanes[lane];
        PosedGradient {
            mean: [v[0], v[1], v[2]],
            log_scale: [v[3], v[4], v[5]],
            quaternion: [v[6], v[7], v[8], v[9]],
            opacity_logit: v[10],
            occupancy_logit: v[11],
        }
    }

    /// Adds those of the coefficients of a lane.
    #[inline(always)]
    pub(super) fn add_sh(&self, lane: usize, total: &mut [f32; SH_FLOATS]) {
        for (total, block) in total.chunks_exact_mut(SH_BLOCK).zip(&self.sh[..self.blocks]) {
            for (total, v) in total.iter_mut().zip(&block[lane]) {
                *total += v;
            }
        }
    }
}

/// Carries gradients of splats to the raw parameters. All lanes must have been drawn, or be without gradient.
#[simd]
pub(super) fn project_backward<S: Simd>(
    simd: S,
    view: &ViewConstants,
    drawn: &DrawnGaussians<'_>,
) -> PosedGradients {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let f = Footprint::new(simd, view, &Posed::load(simd, &drawn.posed));
    let gradients = load_lanes(simd, &drawn.gradients);
    let [v_x, v_y, m00, m01, m11, v_red, v_green, v_blue, ..] = gradients;
    let [.., v_drawn_opacity, responsibility, red, green, blue, opacity, occupancy, _] = gradients;

    // Step 1: v_T = -L^T M W with W = L T, whose first row is L00 (t0 - C01 / C11 t1): the difference is
    // (low_pass t0 + t1 x (t0 x t1)) / C11, in which nothing cancels for needles.
    let [l00, l01, l11] = f.factor;
    let [t0, t1] = f.image_spread;
    let turned = cross(t1, f.normal);
    let scale = l00 / f.blurred[2];
    let low_pass = splat(simd, view.low_pass);
    let w0 = [
        scale * low_pass.mul_add(t0[0], turned[0]),
        scale * low_pass.mul_add(t0[1], turned[1]),
        scale * low_pass.mul_add(t0[2], turned[2]),
    ];
    let w1 = scaled(t1, l11);
    // With opacity as occupancy, -q / o is the instance loss by the blended opacity (dl / d log pi = -q).
    let v_blended = match view.occupancy {
        Some(OccupancySource::Opacity) => v_drawn_opacity - responsibility / opacity,
        _ => v_drawn_opacity,
    };
    let v_opacity = v_blended * f.compensation;
    // Step 2: d log rho / dT is C0^-1 T - C^-1 T, and C^-1 T = L^T W.
    let floored = f.compensation_floored;
    let slope = floored.select(zero, v_blended * f.base_opacity * f.compensation);
    let inverse = floored.select(zero, slope / f.sharp_determinant);
    let m = [m00 + slope, m01, m11 + slope];
    let mut v_t0 = scaled(turned, inverse);
    let mut v_t1 = scaled(cross(f.normal, t0), inverse);

    // Step 6: the log-scale of column c gets T_c . v_T_c = -W_c^T M W_c, again without cancellation.
    let mut v_log_scale = [zero; 3];
    for c in 0..3 {
        let moved = [m[0].mul_add(w0[c], m[1] * w1[c]), m[1].mul_add(w0[c], m[2] * w1[c])];
        let along = t0[c] * v_t0[c] + t1[c] * v_t1[c] - (w0[c] * moved[0] + w1[c] * moved[1]);
        v_log_scale[c] = f.clamped_scale[c].select(zero, along);
        v_t0[c] -= l00 * moved[0];
        v_t1[c] -= l01 * moved[0] + l11 * moved[1];
    }

    // Step 3: T = J M gives v_J = v_T M^T and v_M = J^T v_T.
    let spread = &f.spread_in_camera;
    let [j00, j02, j11, j12] = f.jacobian;

    // Step 4: camera-space point.
    let [x, y, _] = f.in_camera;
    let r = f.inverse_depth;
    let (fx, fy) = (r * view.focal[0], r * view.focal[1]);
    let mut v_point = [fx * v_x, fy * v_y, -((fx * x * v_x + fy * y * v_y) * r)];
    v_point[2] -= (fx * dot(v_t0, spread[0]) + fy * dot(v_t1, spread[1])) * r;
    let v_last = [dot(v_t0, spread[2]), dot(v_t1, spread[2])];
    for (axis, focal) in [fx, fy].into_iter().enumerate() {
        let slope = focal * f.clamped_xy[axis] * r * r * v_last[axis];
        let clamped = f.ratio_clamped[axis];
        v_point[axis] -= clamped.select(zero, focal * r * v_last[axis]);
        v_point[2] += clamped.select(slope, slope * 2.0);
    }
    let norm = dot(v_point, v_point).sqrt();
    let limit = splat(simd, MAX_POSITION_GRADIENT);
    let v_point = scaled(v_point, norm.simd_gt(limit).select(limit / norm, one));

    // Step 5: to the world, M = R_v B.
    let to_camera = splat_matrix(simd, view.rotation);
    let mut v_mean = transform_back(&to_camera, v_point);
    let mut v_rotation = [[zero; 3]; 3];
    for c in 0..3 {
        let v_column = [j00 * v_t0[c], j11 * v_t1[c], j02.mul_add(v_t0[c], j12 * v_t1[c])];
        let [a, b, d] = scaled(transform_back(&to_camera, v_column), f.scales[c]);
        (v_rotation[0][c], v_rotation[1][c], v_rotation[2][c]) = (a, b, d);
    }

    // Step 7: rotation.
    let v_quaternion = f.rotation.backward(simd, &v_rotation);

    // Step 9: colour.
    let v_color = [
        red.simd_gt(zero).select(v_red, zero),
        green.simd_gt(zero).select(v_green, zero),
        blue.simd_gt(zero).select(v_blue, zero),
    ];
    let degree = view.sh_degree;
    let values = basis(simd, f.direction, degree);
    let mut along = [zero; COEFFICIENTS];
    let blocks = sh_blocks(degree);
    let mut v_sh = [[[0.0; LANES]; LANES]; SH_FLOATS / SH_BLOCK];
    for block in 0..blocks {
        let sh = load_sh(simd, &drawn.sh, block);
        let mut v_block = [zero; SH_BLOCK];
        for k in 0..SH_BLOCK {
            let at = block * SH_BLOCK + k;
            let v_color = v_color[at % 3];
            along[at / 3] = sh[k].mul_add(v_color, along[at / 3]);
            v_block[k] = values[at / 3] * v_color;
        }
        v_sh[block] = store_lanes(simd, v_block);
    }
    if degree > 0 {
        let direction = f.direction;
        let v_direction = basis_backward(simd, direction, degree, &along);
        let radial = dot(direction, v_direction);
        let inverse = one / f.distance;
        for axis in 0..3 {
            v_mean[axis] += (v_direction[axis] - direction[axis] * radial) * inverse;
        }
    }

    // Step 8.
    let v_opacity_logit = f.base_opacity * (one - f.base_opacity) * v_opacity;
    let v_occupancy_logit = match view.occupancy {
        Some(OccupancySource::Own) => (occupancy - one) * responsibility,
        Some(OccupancySource::Opacity) | None => zero,
    };
    let lanes = store_lanes(
        simd,
        [
            v_mean[0],
            v_mean[1],
            v_mean[2],
            v_log_scale[0],
            v_log_scale[1],
            v_log_scale[2],
            v_quaternion[0],
            v_quaternion[1],
            v_quaternion[2],
            v_quaternion[3],
            v_opacity_logit,
            v_occupancy_logit,
            zero,
            zero,
            zero,
            zero,
        ],
    );
    PosedGradients { lanes, sh: v_sh, blocks }
}
