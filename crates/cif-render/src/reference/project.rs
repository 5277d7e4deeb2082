//! Projects a Gaussian to the image, and carries gradients back. Source: methods reference 3.1 and 3.2, steps 1
//! to 9: EWA splatting by the local affine approximation, 0.3 px^2 dilation.

use cif_field::SortMetric;
use cif_geometry::scalar::sigmoid;
use cif_geometry::{PinholeCamera, Real, quaternion, spherical_harmonics};

use super::constant;
use super::matrix::{Matrix, apply, dot, multiply, scale_columns, squared_area, transpose};
use super::scene::Gaussian;
use crate::constants::{
    JACOBIAN_MARGIN, LOG_SCALE_RANGE, LOW_PASS, MAX_COVARIANCE, MAX_POSITION_GRADIENT, MIN_ALPHA,
    MIN_ANTIALIASING,
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
    /// X00, X01, X11 of the inverse of the dilated covariance, px^-2.
    pub conic: [R; 3],
    /// Camera z, metres.
    pub depth: R,
    /// What the blending order compares: z, or the distance to the camera centre, metres.
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
    /// By X00, X01 (the single off-diagonal parameter), X11.
    pub conic: [R; 3],
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
            conic: [zero; 3],
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
    /// Rotation of the normalised quaternion.
    rotation: Matrix<R>,
    /// exp of the clamped log-scales.
    scales: [R; 3],
    scale_clamped: [bool; 3],
    /// Sigma in the camera frame.
    covariance: Matrix<R>,
    /// J, with the clamped tx, ty.
    jacobian: [[R; 3]; 2],
    clamped_xy: [R; 2],
    ratio_clamped: [bool; 2],
    /// C0 and C as 00, 01, 11, and their determinants.
    sharp: [R; 3],
    sharp_determinant: R,
    dilated: [R; 3],
    determinant: R,
    /// rho, and whether it sits on its floor.
    antialiasing: R,
    antialiasing_floored: bool,
}

impl<R: Real> Footprint<R> {
    fn conic(&self) -> [R; 3] {
        let [c00, c01, c11] = self.dilated;
        [c11 / self.determinant, -c01 / self.determinant, c00 / self.determinant]
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

    let spread = scale_columns(&rotation, scales);
    let spread_in_camera = multiply(&view.rotation, &spread);
    let covariance = multiply(&spread_in_camera, &transpose(&spread_in_camera));

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

    // C0 = J V J^T = T T^T with T = J R_v B. Taking the determinant from T instead of C0 keeps it a sum of
    // non-negative terms: needles neither cancel nor turn it negative.
    let columns = transpose(&spread_in_camera);
    let mut rows: [[R; 3]; 2] = jacobian.map(|row| std::array::from_fn(|c| dot(row, columns[c])));
    let largest = dot(rows[0], rows[0]).max(dot(rows[1], rows[1]));
    if largest > constant(MAX_COVARIANCE) {
        let factor = (constant::<R>(MAX_COVARIANCE) / largest).sqrt();
        rows = rows.map(|row| row.map(|value| value * factor));
    }
    let sharp = [dot(rows[0], rows[0]), dot(rows[0], rows[1]), dot(rows[1], rows[1])];
    let sharp_determinant = squared_area(rows[0], rows[1]);
    let low_pass = constant::<R>(LOW_PASS);
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
        rotation,
        scales,
        scale_clamped,
        covariance,
        jacobian,
        clamped_xy,
        ratio_clamped,
        sharp,
        sharp_determinant,
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
        conic: footprint.conic(),
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

/// What [`project_backward`] returns.
#[derive(Clone, Debug, PartialEq)]
pub struct ProjectGradient<R> {
    /// By the raw parameters of the Gaussian at its time.
    pub gaussian: Gaussian<R>,
    /// Whether the norm of the camera-space position gradient was clipped (methods reference 7, row 16).
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
    let (half, one, two) = (R::of(0.5), R::one(), R::of(2.0));

    // Instance weight b = min(0.99, pi P): d log pi / dh = 1 - pi. With pi := o the same reaches the opacity.
    let mut v_opacity = v.opacity;
    match settings.instances.map(|instances| instances.occupancy) {
        None => {}
        Some(OccupancySource::Own) => {
            result.gaussian.occupancy_logit = (one - splat.occupancy) * v.log_occupancy;
        }
        Some(OccupancySource::Opacity) => v_opacity += v.log_occupancy / splat.opacity,
    }

    // 1. Conic to dilated covariance: G = -X V_X X.
    let [x00, x01, x11] = splat.conic;
    let (v00, v01, v11) = (v.conic[0], half * v.conic[1], v.conic[2]);
    let (a00, a01) = (x00 * v00 + x01 * v01, x00 * v01 + x01 * v11);
    let (a10, a11) = (x01 * v00 + x11 * v01, x01 * v01 + x11 * v11);
    let mut g = [-(a00 * x00 + a01 * x01), -(a00 * x01 + a01 * x11), -(a10 * x01 + a11 * x11)];

    // 2. Antialiasing factor, and 8. opacity.
    let base_opacity = sigmoid(gaussian.opacity_logit);
    let rho = footprint.antialiasing;
    if settings.antialiased && !footprint.antialiasing_floored {
        let slope = base_opacity * v_opacity * rho * half;
        let [c00, c01, c11] = footprint.sharp;
        let determinant = footprint.sharp_determinant;
        g[0] += slope * (c11 / determinant - x00);
        g[1] += slope * (-c01 / determinant - x01);
        g[2] += slope * (c00 / determinant - x11);
    }
    result.gaussian.opacity_logit = base_opacity * (one - base_opacity) * rho * v_opacity;

    // 3. v_V = J^T G J, v_J = 2 G J V.
    let j = &footprint.jacobian;
    let gj: [[R; 3]; 2] = [
        std::array::from_fn(|c| g[0] * j[0][c] + g[1] * j[1][c]),
        std::array::from_fn(|c| g[1] * j[0][c] + g[2] * j[1][c]),
    ];
    let v_covariance: Matrix<R> =
        std::array::from_fn(|r| std::array::from_fn(|c| j[0][r] * gj[0][c] + j[1][r] * gj[1][c]));
    let v_j = gj.map(|row| apply(&footprint.covariance, row).map(|value| two * value));

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

    // 5. To the world: v_x = R_v^T v_t, v_Sigma = R_v^T v_V R_v, v_B = 2 v_Sigma B.
    let world_from_camera = transpose(&view.rotation);
    result.gaussian.mean = apply(&world_from_camera, v_point);
    let v_sigma = multiply(&multiply(&world_from_camera, &v_covariance), &view.rotation);
    let spread = scale_columns(&footprint.rotation, footprint.scales);
    let v_spread = multiply(&v_sigma, &spread).map(|row| row.map(|value| two * value));

    // 6. Log-scales: no gradient where clamped.
    let (spread_columns, v_spread_columns) = (transpose(&spread), transpose(&v_spread));
    for c in 0..3 {
        if !footprint.scale_clamped[c] {
            result.gaussian.log_scale[c] = dot(spread_columns[c], v_spread_columns[c]);
        }
    }

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
