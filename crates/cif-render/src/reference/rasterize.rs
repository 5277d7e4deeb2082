//! Blends splats into pixels, and carries pixel gradients back. Source: methods reference 3.1 (pixel loop), 3.2
//! (colour backward) and 4.2 (K-free instance backward).
//!
//! Both directions walk front to back with the same operations, so that transmittances in the backward pass
//! equal those of the forward pass bit for bit and nothing is ever divided by `1 - alpha` twice.

use cif_geometry::{PixelGrid, Real};

use super::constant;
use super::cross_entropy::is_supported;
use super::pixel::{InstanceTarget, PixelState};
use super::project::{Splat2d, SplatGradient};
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE};
use crate::image::UNLABELLED;
use crate::settings::{GeometryPath, InstanceNormalisation};

/// A splat evaluated at a pixel centre.
#[derive(Clone, Copy, Debug)]
pub struct Footprint<R> {
    /// `u = L (mean2d - pixel centre)`, standard deviations.
    pub whitened: [R; 2],
    /// P = exp(-|u|^2 / 2), at most 1.
    pub peak: R,
}

/// Evaluates a splat at pixel (column, row). sigma is a sum of squares, which is never negative and cancels nothing.
#[must_use]
pub fn footprint<R: Real>(splat: &Splat2d<R>, pixel: [u32; 2]) -> Footprint<R> {
    let [dx, dy]: [R; 2] =
        std::array::from_fn(|axis| splat.mean2d[axis] - (R::of(f64::from(pixel[axis])) + R::of(0.5)));
    let [l00, l01, l11] = splat.factor;
    let whitened = [l00 * dx + l01 * dy, l11 * dy];
    let sigma = R::of(0.5) * (whitened[0] * whitened[0] + whitened[1] * whitened[1]);
    Footprint { whitened, peak: (-sigma).exp() }
}

/// A blending weight.
#[derive(Clone, Copy, Debug)]
pub struct Weight<R> {
    /// In [1/255, 0.99].
    pub value: R,
    /// True when it sits at 0.99, where no gradient reaches strength and footprint.
    pub clamped: bool,
}

/// `min(0.99, strength P)`; `None` below 1/255.
#[must_use]
pub fn weight<R: Real>(strength: R, peak: R) -> Option<Weight<R>> {
    let unclamped = strength * peak;
    let clamped = unclamped > constant(MAX_ALPHA);
    let value = if clamped { constant(MAX_ALPHA) } else { unclamped };
    (value >= constant(MIN_ALPHA)).then_some(Weight { value, clamped })
}

/// Forward pass over an image of `width` x `height`. `splats` are indexed by Gaussian, `order` lists the visible
/// ones front to back; without `target` the instance pass is skipped.
#[must_use]
pub fn rasterize<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    width: u32,
    height: u32,
    target: Option<&InstanceTarget<'_, R>>,
) -> PixelGrid<PixelState<R>> {
    let mut pixels = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height {
        for x in 0..width {
            pixels.push(rasterize_pixel(splats, order, [x, y], target));
        }
    }
    PixelGrid::from_pixels(width, height, pixels)
}

fn rasterize_pixel<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    pixel: [u32; 2],
    target: Option<&InstanceTarget<'_, R>>,
) -> PixelState<R> {
    let one = R::one();
    let mut state = PixelState::empty();
    let label = target.map_or(UNLABELLED, |target| *target.labels.at(pixel[0], pixel[1]));
    let mut color_done = false;
    let mut instance_done = label == UNLABELLED;
    for (position, &index) in order.iter().enumerate() {
        if color_done && instance_done {
            break;
        }
        let Some(splat) = &splats[index as usize] else { continue };
        let footprint = footprint(splat, pixel);
        if !color_done && let Some(alpha) = weight(splat.opacity, footprint.peak) {
            let next = state.transmittance * (one - alpha.value);
            if next < constant(MIN_TRANSMITTANCE) {
                color_done = true;
            } else {
                let share = state.transmittance * alpha.value;
                for channel in 0..3 {
                    state.color[channel] += share * splat.color[channel];
                }
                state.depth += share * splat.depth;
                state.transmittance = next;
                state.end = position + 1;
            }
        }
        if let Some(target) = target
            && !instance_done
            && let Some(b) = weight(splat.occupancy, footprint.peak)
        {
            let next = state.instance_transmittance * (one - b.value);
            if next < constant(MIN_TRANSMITTANCE) {
                instance_done = true;
            } else {
                let identity = target.identities.of(index as usize, usize::from(label - 1));
                state.label_probability += state.instance_transmittance * b.value * identity;
                state.instance_transmittance = next;
                state.instance_end = position + 1;
            }
        }
    }
    state
}

/// Gradients of the pixel outputs.
#[derive(Clone, Copy, Debug)]
pub struct PixelCotangents<'a, R> {
    /// By the colour composited on the background.
    pub color: &'a PixelGrid<[R; 3]>,
    /// By the blended depth D.
    pub depth: Option<&'a PixelGrid<R>>,
    /// By the coverage 1 - T.
    pub alpha: Option<&'a PixelGrid<R>>,
}

/// The instance loss in the backward pass.
#[derive(Clone, Copy, Debug)]
pub struct InstanceCotangent<'a, R> {
    /// As in the forward pass.
    pub target: InstanceTarget<'a, R>,
    /// Weight of every labelled pixel: the loss weight over the number of labelled pixels.
    pub pixel_weight: R,
    /// Which geometry the loss reaches.
    pub geometry: GeometryPath,
}

/// Gradients by splats and identities.
#[derive(Clone, Debug, PartialEq)]
pub struct RasterGradients<R> {
    /// Per Gaussian; zero where it is not visible.
    pub splats: Vec<SplatGradient<R>>,
    /// rho: weighted label responsibility per identity entry (4.2); empty without instance loss.
    pub label_mass: Vec<R>,
}

/// Backward pass; `pixels` is the forward pass with the same splats, order and target.
#[must_use]
pub fn rasterize_backward<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    background: [R; 3],
    pixels: &PixelGrid<PixelState<R>>,
    cotangents: &PixelCotangents<'_, R>,
    instances: Option<&InstanceCotangent<'_, R>>,
) -> RasterGradients<R> {
    let entries = instances.map_or(0, |instances| instances.target.identities.values.len());
    let mut gradients = RasterGradients {
        splats: vec![SplatGradient::zero(); splats.len()],
        label_mass: vec![R::zero(); entries],
    };
    for y in 0..pixels.height {
        for x in 0..pixels.width {
            let state = pixels.at(x, y);
            color_backward(splats, order, background, [x, y], state, cotangents, &mut gradients);
            if let Some(instances) = instances {
                instance_backward(splats, order, [x, y], state, instances, &mut gradients);
            }
        }
    }
    gradients
}

/// `v_alpha_i = T_i e_i - (E - E_i) / (1 - alpha_i) + T_end / (1 - alpha_i) (v_A - v_C . bg)`, with
/// `e_i = v_C . c_i + v_D z_i`, E the sum of `T_i alpha_i e_i` and E_i its prefix through i.
fn color_backward<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    background: [R; 3],
    pixel: [u32; 2],
    state: &PixelState<R>,
    cotangents: &PixelCotangents<'_, R>,
    gradients: &mut RasterGradients<R>,
) {
    let one = R::one();
    let at = |grid: Option<&PixelGrid<R>>| grid.map_or(R::zero(), |grid| *grid.at(pixel[0], pixel[1]));
    let v_color = *cotangents.color.at(pixel[0], pixel[1]);
    let (v_depth, v_alpha_image) = (at(cotangents.depth), at(cotangents.alpha));
    let along = |color: [R; 3]| (0..3).map(|channel| v_color[channel] * color[channel]).sum::<R>();

    let total = along(state.color) + v_depth * state.depth;
    let behind = state.transmittance * (v_alpha_image - along(background));
    let (mut transmittance, mut prefix) = (one, R::zero());
    for (position, &index) in order[..state.end].iter().enumerate() {
        let Some(splat) = &splats[index as usize] else { continue };
        let footprint = footprint(splat, pixel);
        let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
        let v = &mut gradients.splats[index as usize];
        let share = transmittance * alpha.value;
        let e = along(splat.color) + v_depth * splat.depth;
        prefix += share * e;
        // Nothing follows the last contributor; the subtraction would leave rounding there.
        let remainder = if position + 1 == state.end { R::zero() } else { total - prefix };
        for channel in 0..3 {
            v.color[channel] += share * v_color[channel];
        }
        v.depth += share * v_depth;
        if !alpha.clamped {
            let v_alpha = transmittance * e + (behind - remainder) / (one - alpha.value);
            v.opacity += footprint.peak * v_alpha;
            let v_sigma = -alpha.value * v_alpha;
            mean_backward(splat, &footprint, v_sigma, v);
            covariance_backward(&footprint, v_sigma, v);
        }
        transmittance *= one - alpha.value;
    }
}

/// With responsibilities `r_i = W_i p_i^y / M_y` and their running sum c_i:
/// `q_i = r_i - b_i (1 - c_i) / (1 - b_i)`, dl/dsigma = q, dl/dlog pi = -q, rho += r.
fn instance_backward<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    pixel: [u32; 2],
    state: &PixelState<R>,
    instances: &InstanceCotangent<'_, R>,
    gradients: &mut RasterGradients<R>,
) {
    let one = R::one();
    let label = *instances.target.labels.at(pixel[0], pixel[1]);
    if label == UNLABELLED || !is_supported(state, instances.target.normalisation) {
        return;
    }
    let identities = instances.target.identities;
    let coverage = one - state.instance_transmittance;
    let (mut transmittance, mut running) = (one, R::zero());
    for (position, &index) in order[..state.instance_end].iter().enumerate() {
        let Some(splat) = &splats[index as usize] else { continue };
        let footprint = footprint(splat, pixel);
        let Some(b) = weight(splat.occupancy, footprint.peak) else { continue };
        let v = &mut gradients.splats[index as usize];
        let share = transmittance * b.value;
        let responsibility =
            identities.entry(index as usize, usize::from(label - 1)).map_or(R::zero(), |entry| {
                let responsibility = share * identities.values[entry] / state.label_probability;
                gradients.label_mass[entry] += instances.pixel_weight * responsibility;
                responsibility
            });
        running += responsibility;
        let remainder =
            if position + 1 == state.instance_end { R::zero() } else { (one - running).max(R::zero()) };
        if !b.clamped {
            let mut q = responsibility - b.value * remainder / (one - b.value);
            if instances.target.normalisation == InstanceNormalisation::Coverage {
                q -= b.value * state.instance_transmittance / (coverage * (one - b.value));
            }
            let v_sigma = instances.pixel_weight * q;
            v.log_occupancy -= v_sigma;
            match instances.geometry {
                GeometryPath::Full => {
                    mean_backward(splat, &footprint, v_sigma, v);
                    covariance_backward(&footprint, v_sigma, v);
                }
                GeometryPath::MeansOnly => mean_backward(splat, &footprint, v_sigma, v),
                GeometryPath::Off => {}
            }
        }
        transmittance *= one - b.value;
    }
}

/// Adds `v_mean2d += v_sigma L^T u`.
pub(super) fn mean_backward<R: Real>(
    splat: &Splat2d<R>,
    footprint: &Footprint<R>,
    v_sigma: R,
    v: &mut SplatGradient<R>,
) {
    let [u0, u1] = footprint.whitened;
    let [l00, l01, l11] = splat.factor;
    v.mean2d[0] += v_sigma * (l00 * u0);
    v.mean2d[1] += v_sigma * (l01 * u0 + l11 * u1);
}

/// Adds the second moments, which are the gradient of the dilated covariance in the frame of its factor.
pub(super) fn covariance_backward<R: Real>(footprint: &Footprint<R>, v_sigma: R, v: &mut SplatGradient<R>) {
    let [u0, u1] = footprint.whitened;
    v.moments[0] += v_sigma * u0 * u0;
    v.moments[1] += v_sigma * u0 * u1;
    v.moments[2] += v_sigma * u1 * u1;
}
