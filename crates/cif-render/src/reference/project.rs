//! Projects a Gaussian to the image, and carries gradients back. Source: methods reference 3.1 and 3.2, steps 1
//! to 9: EWA splatting by the local affine approximation, 0.3 px^2 dilation.

use cif_field::SortMetric;
use cif_geometry::scalar::sigmoid;
use cif_geometry::{PinholeCamera, Real, quaternion, spherical_harmonics};

use super::constant;
use super::matrix::{Matrix, apply, cross, dot, multiply, scale_columns, transpose};
use super::scene::Gaussian;
use crate::constants::{
    JACOBIAN_MARGIN, LOG_SCALE_RANGE, MAX_COVARIANCE, MAX_POSITION_GRADIENT, MIN_ALPHA, MIN_ANTIALIASING,
};
use crate::settings::{OccupancySource, RenderSettings};

/// A camera in the scalar of the evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct View<R> {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Focal lengths, pixels.
    pub focal: [R; 2],
    /// Principal point, pixels.
    pub principal: [R; 2],
    /// R_v of `camera_from_world`, `[row][column]`.
    pub rotation: [[R; 3]; 3],
    /// t_v of `camera_from_world`, metres.
    pub translation: [R; 3],
    /// Camera centre, world, metres.
    pub centre: [R; 3],
}

impl<R: Real> View<R> {
    /// Converts a camera.
    #[must_use]
    pub fn from_camera(camera: &PinholeCamera) -> Self {
        let pose = &camera.camera_from_world;
        Self {
            width: camera.width,
            height: camera.height,
            focal: camera.focal_px.to_array().map(R::of),
            principal: camera.principal_px.to_array().map(R::of),
            rotation: std::array::from_fn(|row| pose.rotation.row(row).to_array().map(R::of)),
            translation: pose.translation.to_array().map(R::of),
            centre: camera.centre().to_array().map(R::of),
        }
    }

    /// A world point in the camera frame.
    #[must_use]
    pub fn to_camera(&self, point: [R; 3]) -> [R; 3] {
        let rotated = apply(&self.rotation, point);
        std::array::from_fn(|k| rotated[k] + self.translation[k])
    }

    /// Limits of x / z (axis 0) or y / z (axis 1) inside the Jacobian.
    #[must_use]
    pub fn ratio_limits(&self, axis: usize) -> (R, R) {
        let size = R::of(f64::from([self.width, self.height][axis]));
        let (focal, principal) = (self.focal[axis], self.principal[axis]);
        let margin = constant::<R>(JACOBIAN_MARGIN) * R::of(0.5) * size / focal;
        (-(principal / focal + margin), (size - principal) / focal + margin)
    }
}

/// A Gaussian as a view sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct Splat2d<R> {
    /// Projected centre, pixels.
    pub mean2d: [R; 2],
    /// L00, L01, L11 of the upper triangular factor of the conic: `X = L^T L` is the inverse of the dilated
    /// covariance, so that sigma is half the squared norm of `L d`; px^-1.
    pub factor: [R; 3],
    /// Camera z, metres.
    pub depth: R,
    /// Sort key of the blending order: z, or the distance to the camera centre, metres.
    pub sort_key: R,
    /// Colour, clamped at 0.
    pub color: [R; 3],
    /// Channels at the clamp; they carry no gradient.
    pub color_clamped: [bool; 3],
    /// Opacity o that is blended: after the antialiasing factor.
    pub opacity: R,
    /// Occupancy pi that is blended: the opacity above under [`OccupancySource::Opacity`]; 0 without instances.
    pub occupancy: R,
    /// Three standard deviations of the larger axis, pixels.
    pub radius: R,
    /// Half-widths of the box in which a weight can reach 1/255, pixels.
    pub extents: [R; 2],
}

/// Gradient of the loss by the entries of a [`Splat2d`].
#[derive(Clone, Debug, PartialEq)]
pub struct SplatGradient<R> {
    /// By the projected centre.
    pub mean2d: [R; 2],
    /// Sums M of `v_sigma u u^T` with `u = L d`, entries 00, 01, 11. The gradient by the dilated covariance is
    /// `-L^T M L / 2`, which is never formed: along a needle it is smaller than across it by the square of how
    /// many times longer the needle is than wide.
    pub moments: [R; 3],
    /// By z (depth cotangents only).
    pub depth: R,
    /// By the clamped colour.
    pub color: [R; 3],
    /// By the blended opacity (colour pass only).
    pub opacity: R,
    /// By the logarithm of the blended occupancy: minus the sum of weighted q_i (4.2).
    pub log_occupancy: R,
}

impl<R: Real> SplatGradient<R> {
    /// All zero.
    #[must_use]
    pub fn zero() -> Self {
        let zero = R::zero();
        Self {
            mean2d: [zero; 2],
            moments: [zero; 3],
            depth: zero,
            color: [zero; 3],
            opacity: zero,
            log_occupancy: zero,
        }
    }
}

/// Intermediate values that both directions share.
struct Footprint<R> {
    /// Camera-space point t_c.
    point: [R; 3],
    /// exp of the clamped log-scales.
    scales: [R; 3],
    scale_clamped: [bool; 3],
    /// R_v B.
    spread_in_camera: Matrix<R>,
    /// J, with the clamped tx, ty.
    jacobian: [[R; 3]; 2],
    clamped_xy: [R; 2],
    ratio_clamped: [bool; 2],
    /// Rows of T = J R_v B, and their cross product.
    image_spread: [[R; 3]; 2],
    normal: [R; 3],
    /// det C0.
    sharp_determinant: R,
    /// Low-pass dilation, px^2; C as 00, 01, 11, and its determinant.
    low_pass: R,
    dilated: [R; 3],
    determinant: R,
    /// rho, and whether it sits on its floor.
    antialiasing: R,
    antialiasing_floored: bool,
}

impl<R: Real> Footprint<R> {
    /// L of `C^-1 = L^T L`: nothing is subtracted.
    fn factor(&self) -> [R; 3] {
        let [_, c01, c11] = self.dilated;
        let l00 = (c11 / self.determinant).sqrt();
        [l00, -l00 * c01 / c11, c11.sqrt().recip()]
    }

    /// Rows of `W = L T`, with entries in [-1, 1]. The first is `L00 (t0 - C01 / C11 t1)`, whose difference is
    /// `(low_pass t0 + t1 x (t0 x t1)) / C11`, without the cancellation for needles.
    fn whitened_spread(&self) -> [[R; 3]; 2] {
        let [l00, _, l11] = self.factor();
        let [t0, t1] = self.image_spread;
        let turned = cross(t1, self.normal);
        let scale = l00 / self.dilated[2];
        [std::array::from_fn(|c| scale * (self.low_pass * t0[c] + turned[c])), t1.map(|entry| l11 * entry)]
    }
}

/// `None` when the Gaussian is nearer than the near plane, not finite or without orientation.
fn measure<R: Real>(
    gaussian: &Gaussian<R>,
    view: &View<R>,
    settings: &RenderSettings,
) -> Option<Footprint<R>> {
    let finite = |values: &[R]| values.iter().all(|value| value.is_finite());
    let point = view.to_camera(gaussian.mean);
    let [x, y, z] = point;
    if !finite(&point) || !finite(&gaussian.log_scale) || z < constant(settings.near) {
        return None;
    }
    let rotation = quaternion::to_rotation(quaternion::try_normalize(gaussian.quaternion)?);
    let (low, high) = (constant::<R>(LOG_SCALE_RANGE.0), constant::<R>(LOG_SCALE_RANGE.1));
    let scale_clamped = gaussian.log_scale.map(|s| s < low || s > high);
    let scales = gaussian.log_scale.map(|s| s.max(low).min(high).exp());

    let spread_in_camera = multiply(&view.rotation, &scale_columns(&rotation, scales));

    let mut clamped_xy = [R::zero(); 2];
    let mut ratio_clamped = [false; 2];
    for (axis, coordinate) in [x, y].into_iter().enumerate() {
        let (low, high) = view.ratio_limits(axis);
        let ratio = coordinate / z;
        ratio_clamped[axis] = ratio < low || ratio > high;
        clamped_xy[axis] = if ratio_clamped[axis] { z * ratio.max(low).min(high) } else { coordinate };
    }
    let ([fx, fy], zero, r) = (view.focal, R::zero(), z.recip());
    let jacobian = [[fx * r, zero, -fx * clamped_xy[0] * r * r], [zero, fy * r, -fy * clamped_xy[1] * r * r]];

    // C0 = J V J^T = T T^T with T = J R_v B. Its determinant is the squared area of the parallelogram of the
    // rows of T (Lagrange's identity): needles neither cancel nor turn it negative.
    let columns = transpose(&spread_in_camera);
    let mut image_spread: [[R; 3]; 2] = jacobian.map(|row| std::array::from_fn(|c| dot(row, columns[c])));
    let largest = dot(image_spread[0], image_spread[0]).max(dot(image_spread[1], image_spread[1]));
    if largest > constant(MAX_COVARIANCE) {
        let factor = (constant::<R>(MAX_COVARIANCE) / largest).sqrt();
        image_spread = image_spread.map(|row| row.map(|value| value * factor));
    }
    let [t0, t1] = image_spread;
    let sharp = [dot(t0, t0), dot(t0, t1), dot(t1, t1)];
    let normal = cross(t0, t1);
    let sharp_determinant = dot(normal, normal);
    let low_pass = constant::<R>(settings.low_pass);
    let dilated = [sharp[0] + low_pass, sharp[1], sharp[2] + low_pass];
    let determinant = sharp_determinant + low_pass * (sharp[0] + sharp[2]) + low_pass * low_pass;
    if !determinant.is_finite() {
        return None;
    }
    let floor = constant::<R>(MIN_ANTIALIASING) * constant(MIN_ANTIALIASING);
    let squared = sharp_determinant / determinant;
    let antialiasing = if settings.antialiased { squared.max(floor).sqrt() } else { R::one() };
    Some(Footprint {
        point,
        scales,
        scale_clamped,
        spread_in_camera,
        jacobian,
        clamped_xy,
        ratio_clamped,
        image_spread,
        normal,
        sharp_determinant,
        low_pass,
        dilated,
        determinant,
        antialiasing,
        antialiasing_floored: squared <= floor,
    })
}

/// Unit vector from the camera centre to the Gaussian, and the distance; finite at the centre itself.
fn view_direction<R: Real>(mean: [R; 3], view: &View<R>) -> ([R; 3], R) {
    let offset: [R; 3] = std::array::from_fn(|k| mean[k] - view.centre[k]);
    let distance = dot(offset, offset).sqrt().max(R::of(1e-8));
    (offset.map(|value| value / distance), distance)
}

/// Projects a Gaussian at its time; `None` when it cannot be drawn: culled, not finite, or too faint or too far
/// outside the image to reach a weight of 1/255 anywhere.
#[must_use]
pub fn project<R: Real>(
    gaussian: &Gaussian<R>,
    view: &View<R>,
    settings: &RenderSettings,
) -> Option<Splat2d<R>> {
    let footprint = measure(gaussian, view, settings)?;
    let opacity = footprint.antialiasing * sigmoid(gaussian.opacity_logit);
    let occupancy = match settings.instances.map(|instances| instances.occupancy) {
        None => R::zero(),
        Some(OccupancySource::Own) => sigmoid(gaussian.occupancy_logit),
        Some(OccupancySource::Opacity) => opacity,
    };
    let strength = opacity.max(occupancy);
    if opacity.is_nan() || occupancy.is_nan() || strength < constant(MIN_ALPHA) {
        return None;
    }
    let [x, y, z] = footprint.point;
    let mean2d = [view.focal[0] * x / z + view.principal[0], view.focal[1] * y / z + view.principal[1]];
    let [c00, c01, c11] = footprint.dilated;
    let reach = R::of(2.0) * (strength / constant(MIN_ALPHA)).ln();
    let extents = [(reach * c00).sqrt(), (reach * c11).sqrt()];
    for (axis, size) in [view.width, view.height].into_iter().enumerate() {
        let (low, high) = (mean2d[axis] - extents[axis], mean2d[axis] + extents[axis]);
        if !low.is_finite() || !high.is_finite() || high < R::zero() || low > R::of(f64::from(size)) {
            return None;
        }
    }
    let half = R::of(0.5);
    let (middle, difference) = (half * (c00 + c11), half * (c00 - c11));
    let larger_variance = middle + (difference * difference + c01 * c01).sqrt();

    let (direction, distance) = view_direction(gaussian.mean, view);
    let basis = spherical_harmonics::basis(direction, settings.sh_degree);
    let count = spherical_harmonics::coefficient_count(settings.sh_degree);
    let color: [R; 3] = std::array::from_fn(|channel| {
        half + (0..count).map(|m| basis[m] * gaussian.sh[m * 3 + channel]).sum::<R>()
    });
    if !color.iter().all(|channel| channel.is_finite()) {
        return None;
    }
    Some(Splat2d {
        mean2d,
        factor: footprint.factor(),
        depth: z,
        sort_key: match settings.sort_metric {
            SortMetric::Z => z,
            SortMetric::Distance => distance,
        },
        color: color.map(|channel| channel.max(R::zero())),
        color_clamped: color.map(|channel| channel <= R::zero()),
        opacity,
        occupancy,
        radius: R::of(3.0) * larger_variance.sqrt(),
        extents,
    })
}

/// Result of [`project_backward`].
#[derive(Clone, Debug, PartialEq)]
pub struct ProjectGradient<R> {
    /// By the raw parameters of the Gaussian at its time.
    pub gaussian: Gaussian<R>,
    /// True when the norm of the camera-space position gradient was clipped (methods reference 7, row 16).
    pub clipped: bool,
}

/// Carries the gradient of a splat to the Gaussian's raw parameters.
#[must_use]
pub fn project_backward<R: Real>(
    gaussian: &Gaussian<R>,
    view: &View<R>,
    settings: &RenderSettings,
    splat: &Splat2d<R>,
    v: &SplatGradient<R>,
) -> ProjectGradient<R> {
    let mut result = ProjectGradient { gaussian: Gaussian::zero(), clipped: false };
    let Some(footprint) = measure(gaussian, view, settings) else { return result };
    let (one, two) = (R::one(), R::of(2.0));

    // Instance weight b = min(0.99, pi P): d log pi / dh = 1 - pi. With pi := o the same reaches the opacity.
    let mut v_opacity = v.opacity;
    match settings.instances.map(|instances| instances.occupancy) {
        None => {}
        Some(OccupancySource::Own) => {
            result.gaussian.occupancy_logit = (one - splat.occupancy) * v.log_occupancy;
        }
        Some(OccupancySource::Opacity) => v_opacity += v.log_occupancy / splat.opacity,
    }

    // 1. By T = J R_v B. With C = T T^T + 0.3 I and the gradient -L^T M L / 2 by C, v_T = -L^T M W, and the
    // log-scale of column c gets T_c . v_T_c = -W_c^T M W_c: along a needle no large numbers cancel in that.
    let [l00, l01, l11] = splat.factor;
    let [w0, w1] = footprint.whitened_spread();
    let mut m = v.moments;
    let mut v_image_spread = [[R::zero(); 3]; 2];

    // 2. Antialiasing factor, and 8. opacity: d log rho / dT is C0^-1 T - C^-1 T, and C^-1 T = L^T W.
    let base_opacity = sigmoid(gaussian.opacity_logit);
    let rho = footprint.antialiasing;
    if settings.antialiased && !footprint.antialiasing_floored {
        let slope = base_opacity * v_opacity * rho;
        m[0] += slope;
        m[2] += slope;
        let [t0, t1] = footprint.image_spread;
        let inverse = slope / footprint.sharp_determinant;
        v_image_spread = [cross(t1, footprint.normal), cross(footprint.normal, t0)]
            .map(|row| row.map(|value| inverse * value));
    }
    result.gaussian.opacity_logit = base_opacity * (one - base_opacity) * rho * v_opacity;

    // 6. Log-scales: no gradient where clamped.
    let [t0, t1] = footprint.image_spread;
    for c in 0..3 {
        let moved = [m[0] * w0[c] + m[1] * w1[c], m[1] * w0[c] + m[2] * w1[c]];
        if !footprint.scale_clamped[c] {
            result.gaussian.log_scale[c] = t0[c] * v_image_spread[0][c] + t1[c] * v_image_spread[1][c]
                - (w0[c] * moved[0] + w1[c] * moved[1]);
        }
        v_image_spread[0][c] -= l00 * moved[0];
        v_image_spread[1][c] -= l01 * moved[0] + l11 * moved[1];
    }

    // 3. v_J = v_T (R_v B)^T.
    let v_j = v_image_spread.map(|row| apply(&footprint.spread_in_camera, row));

    // 4. Camera-space point.
    let [x, y, z] = footprint.point;
    let ([fx, fy], r) = (view.focal, z.recip());
    let mut v_point =
        [fx * r * v.mean2d[0], fy * r * v.mean2d[1], -(fx * x * v.mean2d[0] + fy * y * v.mean2d[1]) * r * r];
    v_point[2] += v.depth - (fx * v_j[0][0] + fy * v_j[1][1]) * r * r;
    for axis in 0..2 {
        let slope = view.focal[axis] * r * r * v_j[axis][2];
        let along_depth = slope * footprint.clamped_xy[axis] * r;
        if footprint.ratio_clamped[axis] {
            v_point[2] += along_depth;
        } else {
            v_point[axis] -= slope;
            v_point[2] += two * along_depth;
        }
    }
    let norm = dot(v_point, v_point).sqrt();
    if norm > constant(MAX_POSITION_GRADIENT) {
        result.clipped = true;
        v_point = v_point.map(|value| value * (constant::<R>(MAX_POSITION_GRADIENT) / norm));
    }

    // 5. To the world: v_x = R_v^T v_t, v_B = R_v^T J^T v_T.
    let world_from_camera = transpose(&view.rotation);
    result.gaussian.mean = apply(&world_from_camera, v_point);
    let j = &footprint.jacobian;
    let v_spread_in_camera: Matrix<R> = std::array::from_fn(|r| {
        std::array::from_fn(|c| j[0][r] * v_image_spread[0][c] + j[1][r] * v_image_spread[1][c])
    });
    let v_spread = multiply(&world_from_camera, &v_spread_in_camera);

    // 7. Quaternion.
    let v_rotation = scale_columns(&v_spread, footprint.scales);
    result.gaussian.quaternion = quaternion::to_rotation_backward(gaussian.quaternion, v_rotation);

    // 9. Spherical harmonics, and the view direction's share of the mean.
    color_backward(gaussian, view, settings.sh_degree, splat, v.color, &mut result.gaussian);
    result
}

fn color_backward<R: Real>(
    gaussian: &Gaussian<R>,
    view: &View<R>,
    degree: u8,
    splat: &Splat2d<R>,
    v_color: [R; 3],
    gradient: &mut Gaussian<R>,
) {
    let v_color: [R; 3] =
        std::array::from_fn(|c| if splat.color_clamped[c] { R::zero() } else { v_color[c] });
    let (direction, distance) = view_direction(gaussian.mean, view);
    let basis = spherical_harmonics::basis(direction, degree);
    let basis_gradient = spherical_harmonics::basis_gradient(direction, degree);
    let mut v_direction = [R::zero(); 3];
    for m in 0..spherical_harmonics::coefficient_count(degree) {
        for channel in 0..3 {
            gradient.sh[m * 3 + channel] += basis[m] * v_color[channel];
            let along = gaussian.sh[m * 3 + channel] * v_color[channel];
            for axis in 0..3 {
                v_direction[axis] += basis_gradient[m][axis] * along;
            }
        }
    }
    let radial = dot(direction, v_direction);
    for axis in 0..3 {
        gradient.mean[axis] += (v_direction[axis] - direction[axis] * radial) / distance;
    }
}
