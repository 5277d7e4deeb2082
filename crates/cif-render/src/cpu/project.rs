//! Projects posed Gaussians to the image, and back. Source: methods reference 3.1 and 3.2, steps 1 to 9.
//!
//! Everything of a Gaussian that a pixel needs is one [`Splat`]; the backward pass recomputes the
//! intermediate values instead of keeping them.

use cif_field::SortMetric;
use cif_field::gaussians::SH_FLOATS;
use cif_geometry::scalar::sigmoid;
use cif_geometry::{PinholeCamera, quaternion, spherical_harmonics};

use crate::constants::{
    JACOBIAN_MARGIN, LOG_SCALE_RANGE, MAX_COVARIANCE, MAX_POSITION_GRADIENT, MIN_ALPHA, MIN_ANTIALIASING,
};
use crate::{Blending, OccupancySource, RenderSettings};

type Vector = [f32; 3];
type Matrix = [[f32; 3]; 3];

/// A camera and the settings of a render, in the form that projection reads.
#[derive(Clone, Copy, Debug)]
pub(super) struct ViewConstants {
    rotation: Matrix,
    translation: Vector,
    centre: Vector,
    focal: [f32; 2],
    principal: [f32; 2],
    /// Limits of x / z and y / z inside the Jacobian.
    ratio_limits: [(f32, f32); 2],
    pub(super) width: u32,
    pub(super) height: u32,
    near: f32,
    low_pass: f32,
    sh_degree: u8,
    antialiased: bool,
    sort_metric: SortMetric,
    /// Source of the occupancy; `None` where instances are not drawn.
    occupancy: Option<OccupancySource>,
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

/// Raw parameters of one Gaussian at the time of the view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Posed<'a> {
    pub(super) mean: Vector,
    pub(super) log_scale: Vector,
    pub(super) quaternion: [f32; 4],
    pub(super) opacity_logit: f32,
    pub(super) occupancy_logit: f32,
    pub(super) sh: &'a [f32; SH_FLOATS],
}

/// A Gaussian as the raster loops see it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Splat {
    /// Projected centre, pixels.
    pub(super) mean: [f32; 2],
    /// L00, L01, L11 of the conic `L^T L`, px^-1: sigma is half the squared norm of `L d`.
    pub(super) factor: [f32; 3],
    /// Blended colour.
    pub(super) color: Vector,
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

    /// sigma at an offset from the mean.
    #[inline(always)]
    pub(super) fn sigma(&self, x: f32, y: f32) -> f32 {
        let [l00, l01, l11] = self.factor;
        let (u0, u1) = (l00 * x + l01 * y, l11 * y);
        0.5 * (u0 * u0 + u1 * u1)
    }
}

/// Intermediate values shared by both directions.
struct Footprint {
    in_camera: Vector,
    scales: Vector,
    clamped_scale: [bool; 3],
    /// R_v R diag(exp s).
    spread_in_camera: Matrix,
    jacobian: [[f32; 3]; 2],
    ratio_clamped: [bool; 2],
    /// Clamped x and y of the Jacobian.
    clamped_xy: [f32; 2],
    /// Rows of T = J R_v R diag(exp s), and their cross product.
    image_spread: [Vector; 2],
    normal: Vector,
    /// Determinant of C0 = T T^T.
    sharp_determinant: f32,
    /// After the low pass: C 00, 01, 11.
    blurred: [f32; 3],
    factor: [f32; 3],
    /// Antialiasing factor rho, and whether it sits on its floor.
    compensation: f32,
    compensation_floored: bool,
}

#[inline(always)]
fn dot(a: Vector, b: Vector) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn transform(m: &Matrix, v: Vector) -> Vector {
    [0, 1, 2].map(|r| m[r][0] * v[0] + m[r][1] * v[1] + m[r][2] * v[2])
}

#[inline(always)]
fn multiply(a: &Matrix, b: &Matrix) -> Matrix {
    let mut product = [[0.0; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            product[r][c] = a[r][0] * b[0][c] + a[r][1] * b[1][c] + a[r][2] * b[2][c];
        }
    }
    product
}

#[inline(always)]
fn footprint(view: &ViewConstants, posed: &Posed<'_>) -> Option<Footprint> {
    let rotated = transform(&view.rotation, posed.mean);
    let in_camera = [0, 1, 2].map(|k| rotated[k] + view.translation[k]);
    let z = in_camera[2];
    if !in_camera.iter().all(|v| v.is_finite()) || z < view.near {
        return None;
    }
    let unit = quaternion::try_normalize(posed.quaternion)?;
    let unit_rotation = quaternion::to_rotation(unit);
    let (low, high) = LOG_SCALE_RANGE;
    if posed.log_scale.iter().any(|s| s.is_nan()) {
        return None;
    }
    let clamped_scale = posed.log_scale.map(|s| s < low || s > high);
    let scales = posed.log_scale.map(|s| s.clamp(low, high).exp());
    let mut spread = unit_rotation;
    for row in &mut spread {
        for (entry, scale) in row.iter_mut().zip(scales) {
            *entry *= scale;
        }
    }
    let m = multiply(&view.rotation, &spread);
    let mut ratio_clamped = [false; 2];
    let clamped_xy = [0, 1].map(|axis| {
        let ratio = in_camera[axis] / z;
        let (low, high) = view.ratio_limits[axis];
        ratio_clamped[axis] = ratio < low || ratio > high;
        z * ratio.clamp(low, high)
    });
    let r = 1.0 / z;
    let [fx, fy] = view.focal;
    let jacobian = [[fx * r, 0.0, -fx * clamped_xy[0] * r * r], [0.0, fy * r, -fy * clamped_xy[1] * r * r]];
    // Rows of T = J R_v B, so that C0 = T T^T and det C0 = |t0 x t1|^2: a sum of squares has nothing to
    // cancel, however thin the Gaussian. J has two non-zero entries a row.
    let [j0, j1] = &jacobian;
    let mut image_spread = [
        [0, 1, 2].map(|c| j0[0] * m[0][c] + j0[2] * m[2][c]),
        [0, 1, 2].map(|c| j1[1] * m[1][c] + j1[2] * m[2][c]),
    ];
    let largest = dot(image_spread[0], image_spread[0]).max(dot(image_spread[1], image_spread[1]));
    if largest > MAX_COVARIANCE {
        let factor = (MAX_COVARIANCE / largest).sqrt();
        image_spread = image_spread.map(|row| row.map(|entry| entry * factor));
    }
    let [t0, t1] = image_spread;
    let sharp = [dot(t0, t0), dot(t0, t1), dot(t1, t1)];
    let blurred = [sharp[0] + view.low_pass, sharp[1], sharp[2] + view.low_pass];
    let normal = cross(t0, t1);
    let sharp_determinant = dot(normal, normal);
    let det = sharp_determinant + view.low_pass * (sharp[0] + sharp[2]) + view.low_pass * view.low_pass;
    if !det.is_finite() {
        return None;
    }
    let l00 = (blurred[2] / det).sqrt();
    let factor = [l00, -l00 * blurred[1] / blurred[2], 1.0 / blurred[2].sqrt()];
    let (compensation, compensation_floored) = if view.antialiased {
        let squared = sharp_determinant / det;
        let floor = MIN_ANTIALIASING * MIN_ANTIALIASING;
        (squared.max(floor).sqrt(), squared <= floor)
    } else {
        (1.0, true)
    };
    Some(Footprint {
        in_camera,
        scales,
        clamped_scale,
        spread_in_camera: m,
        jacobian,
        ratio_clamped,
        clamped_xy,
        image_spread,
        normal,
        sharp_determinant,
        blurred,
        factor,
        compensation,
        compensation_floored,
    })
}

/// Unit direction from the camera to a point, and its distance.
#[inline(always)]
fn view_direction(view: &ViewConstants, mean: Vector) -> (Vector, f32) {
    let offset = [0, 1, 2].map(|k| mean[k] - view.centre[k]);
    let distance = (offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]).sqrt().max(1e-8);
    (offset.map(|v| v / distance), distance)
}

/// Colour before the clamp at 0.
#[inline(always)]
fn color_unclamped(view: &ViewConstants, direction: Vector, sh: &[f32; SH_FLOATS]) -> Vector {
    let basis = spherical_harmonics::basis(direction, view.sh_degree);
    let mut color = [0.5; 3];
    for (m, value) in basis.iter().enumerate().take(spherical_harmonics::coefficient_count(view.sh_degree)) {
        for channel in 0..3 {
            color[channel] += value * sh[m * 3 + channel];
        }
    }
    color
}

/// Projects one Gaussian; `None` where it draws nothing.
#[inline(always)]
pub(super) fn project(view: &ViewConstants, posed: &Posed<'_>, gaussian: u32) -> Option<Splat> {
    let footprint = footprint(view, posed)?;
    let base_opacity = sigmoid(posed.opacity_logit);
    let opacity = footprint.compensation * base_opacity;
    let (occupancy, strongest) = match view.occupancy {
        None => (0.0, opacity),
        Some(OccupancySource::Own) => {
            let occupancy = sigmoid(posed.occupancy_logit);
            if occupancy.is_nan() {
                return None;
            }
            (occupancy, opacity.max(occupancy))
        }
        Some(OccupancySource::Opacity) => (opacity, opacity),
    };
    if strongest.is_nan() || strongest < MIN_ALPHA {
        return None;
    }
    let reach = [opacity, occupancy].map(|weight| (weight / MIN_ALPHA).ln());
    let furthest = reach[0].max(reach[1]);
    let [x, y, z] = footprint.in_camera;
    let mean = [view.focal[0] * x / z + view.principal[0], view.focal[1] * y / z + view.principal[1]];
    let [c00, c01, c11] = footprint.blurred;
    let extent = [(2.0 * furthest * c00).sqrt(), (2.0 * furthest * c11).sqrt()];
    let inside = mean[0] + extent[0] > 0.0
        && mean[1] + extent[1] > 0.0
        && mean[0] - extent[0] < view.width as f32
        && mean[1] - extent[1] < view.height as f32;
    if !inside || !extent[0].is_finite() || !extent[1].is_finite() {
        return None;
    }
    let half_trace = 0.5 * (c00 + c11);
    let spread = (0.25 * (c00 - c11) * (c00 - c11) + c01 * c01).sqrt();
    let (direction, distance) = view_direction(view, posed.mean);
    let color = color_unclamped(view, direction, posed.sh);
    if !color.iter().all(|c| c.is_finite()) {
        return None;
    }
    let color = color.map(|c| c.max(0.0));
    Some(Splat {
        mean,
        factor: footprint.factor,
        color,
        opacity,
        occupancy,
        depth: z,
        order: match view.sort_metric {
            SortMetric::Z => z,
            SortMetric::Distance => distance,
        },
        reach,
        extent,
        radius: 3.0 * (half_trace + spread).sqrt(),
        gaussian,
    })
}

/// Gradient of the loss by what the raster loops read of a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SplatGradient {
    pub(super) mean: [f32; 2],
    /// Sums M of `v_sigma u u^T` with `u = L d`, entries 00, 01, 11: the gradient by C is `-L^T M L / 2`.
    pub(super) moments: [f32; 3],
    pub(super) color: Vector,
    pub(super) opacity: f32,
    /// Sum of weighted q_i (methods reference 4.2), so that `dL/dh = -(1 - pi) q`.
    pub(super) responsibility: f32,
}

/// Gradient of the loss by the raw parameters of a posed Gaussian.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PosedGradient {
    pub(super) mean: Vector,
    pub(super) log_scale: Vector,
    pub(super) quaternion: [f32; 4],
    pub(super) opacity_logit: f32,
    pub(super) occupancy_logit: f32,
}

/// Carries a splat's gradient to the raw parameters; spherical harmonics are added to `v_sh`.
#[inline(always)]
pub(super) fn project_backward(
    view: &ViewConstants,
    posed: &Posed<'_>,
    splat: &Splat,
    v: &SplatGradient,
    v_sh: &mut [f32; SH_FLOATS],
) -> PosedGradient {
    let Some(f) = footprint(view, posed) else { return PosedGradient::default() };
    let base_opacity = sigmoid(posed.opacity_logit);

    // Step 1: v_T = -L^T M W with W = L T, whose first row is L00 (t0 - C01 / C11 t1): the difference is
    // (low_pass t0 + t1 x (t0 x t1)) / C11, in which nothing cancels for needles.
    let [l00, l01, l11] = f.factor;
    let [t0, t1] = f.image_spread;
    let turned = cross(t1, f.normal);
    let scale = l00 / f.blurred[2];
    let w0 = [0, 1, 2].map(|c| scale * (view.low_pass * t0[c] + turned[c]));
    let w1 = t1.map(|entry| l11 * entry);
    let mut m = v.moments;
    let mut v_image_spread = [[0.0; 3]; 2];
    // With opacity as occupancy, -q / o is the instance loss by the blended opacity (dl / d log pi = -q).
    let v_blended = match view.occupancy {
        Some(OccupancySource::Opacity) => v.opacity - v.responsibility / splat.opacity,
        _ => v.opacity,
    };
    let v_opacity = v_blended * f.compensation;
    // Step 2: d log rho / dT is C0^-1 T - C^-1 T, and C^-1 T = L^T W.
    if !f.compensation_floored {
        let slope = v_blended * base_opacity * f.compensation;
        m[0] += slope;
        m[2] += slope;
        let inverse = slope / f.sharp_determinant;
        v_image_spread = [turned, cross(f.normal, t0)].map(|row| row.map(|entry| inverse * entry));
    }

    // Step 6: the log-scale of column c gets T_c . v_T_c = -W_c^T M W_c, again without cancellation.
    let mut log_scale = [0.0; 3];
    for c in 0..3 {
        let moved = [m[0] * w0[c] + m[1] * w1[c], m[1] * w0[c] + m[2] * w1[c]];
        if !f.clamped_scale[c] {
            log_scale[c] = t0[c] * v_image_spread[0][c] + t1[c] * v_image_spread[1][c]
                - (w0[c] * moved[0] + w1[c] * moved[1]);
        }
        v_image_spread[0][c] -= l00 * moved[0];
        v_image_spread[1][c] -= l01 * moved[0] + l11 * moved[1];
    }

    // Step 3: T = J M gives v_J = v_T M^T and v_M = J^T v_T.
    let j = &f.jacobian;
    let v_j = v_image_spread.map(|row| [0, 1, 2].map(|c| dot(row, f.spread_in_camera[c])));

    // Step 4: camera-space point.
    let [x, y, z] = f.in_camera;
    let r = 1.0 / z;
    let (r2, r3) = (r * r, r * r * r);
    let [fx, fy] = view.focal;
    let mut v_point =
        [fx * r * v.mean[0], fy * r * v.mean[1], -(fx * x * v.mean[0] + fy * y * v.mean[1]) * r2];
    v_point[2] += -fx * r2 * v_j[0][0] - fy * r2 * v_j[1][1];
    for (axis, focal) in [fx, fy].into_iter().enumerate() {
        let slope = focal * f.clamped_xy[axis] * r3 * v_j[axis][2];
        if f.ratio_clamped[axis] {
            v_point[2] += slope;
        } else {
            v_point[axis] += -focal * r2 * v_j[axis][2];
            v_point[2] += 2.0 * slope;
        }
    }
    let norm = (v_point[0] * v_point[0] + v_point[1] * v_point[1] + v_point[2] * v_point[2]).sqrt();
    if norm > MAX_POSITION_GRADIENT {
        v_point = v_point.map(|value| value * (MAX_POSITION_GRADIENT / norm));
    }

    // Step 5: to the world, M = R_v B.
    let rv = &view.rotation;
    let mut v_mean = [0, 1, 2].map(|c| rv[0][c] * v_point[0] + rv[1][c] * v_point[1] + rv[2][c] * v_point[2]);
    let mut v_spread_in_camera = [[0.0; 3]; 3];
    for row in 0..3 {
        for c in 0..3 {
            v_spread_in_camera[row][c] = j[0][row] * v_image_spread[0][c] + j[1][row] * v_image_spread[1][c];
        }
    }
    let mut v_spread = [[0.0; 3]; 3];
    for row in 0..3 {
        for c in 0..3 {
            v_spread[row][c] = rv[0][row] * v_spread_in_camera[0][c]
                + rv[1][row] * v_spread_in_camera[1][c]
                + rv[2][row] * v_spread_in_camera[2][c];
        }
    }

    // Step 7: rotation.
    let mut v_rotation = v_spread;
    for row in &mut v_rotation {
        for (entry, scale) in row.iter_mut().zip(f.scales) {
            *entry *= scale;
        }
    }
    let quaternion = quaternion::to_rotation_backward(posed.quaternion, v_rotation);

    // Step 9: colour.
    let (direction, distance) = view_direction(view, posed.mean);
    let mut v_color = v.color;
    for channel in 0..3 {
        if splat.color[channel] <= 0.0 {
            v_color[channel] = 0.0;
        }
    }
    if v_color != [0.0; 3] {
        let degree = view.sh_degree;
        let basis = spherical_harmonics::basis(direction, degree);
        let count = spherical_harmonics::coefficient_count(degree);
        for m in 0..count {
            for channel in 0..3 {
                v_sh[m * 3 + channel] += basis[m] * v_color[channel];
            }
        }
        if degree > 0 {
            let gradient = spherical_harmonics::basis_gradient(direction, degree);
            let mut v_direction = [0.0; 3];
            for m in 1..count {
                let along = posed.sh[m * 3] * v_color[0]
                    + posed.sh[m * 3 + 1] * v_color[1]
                    + posed.sh[m * 3 + 2] * v_color[2];
                for axis in 0..3 {
                    v_direction[axis] += gradient[m][axis] * along;
                }
            }
            let radial =
                direction[0] * v_direction[0] + direction[1] * v_direction[1] + direction[2] * v_direction[2];
            for axis in 0..3 {
                v_mean[axis] += (v_direction[axis] - direction[axis] * radial) / distance;
            }
        }
    }

    // Step 8.
    let opacity_logit = base_opacity * (1.0 - base_opacity) * v_opacity;
    let occupancy_logit = match view.occupancy {
        Some(OccupancySource::Own) => -(1.0 - splat.occupancy) * v.responsibility,
        Some(OccupancySource::Opacity) | None => 0.0,
    };
    PosedGradient { mean: v_mean, log_scale, quaternion, opacity_logit, occupancy_logit }
}
