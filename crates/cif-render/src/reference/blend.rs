//! Values per Gaussian blended into an image, and back. Source: methods reference 3.1 (pixel loop), 3.2 and 4.1.

use cif_geometry::Real;

use super::constant;
use super::project::{Splat2d, SplatGradient};
use super::rasterize::{Footprint, Weight, covariance_backward, footprint, mean_backward, weight};
use crate::constants::MIN_TRANSMITTANCE;
use crate::{BlendRequest, BlendedImage, Blending, GeometryPath};

/// A Gaussian that a pixel shows.
struct Contributor<'a, R> {
    index: usize,
    splat: &'a Splat2d<R>,
    footprint: Footprint<R>,
    weight: Weight<R>,
    /// Transmittance before it.
    transmittance: R,
}

/// Gaussians that a pixel shows, front to back.
fn contributors<'a, R: Real>(
    splats: &'a [Option<Splat2d<R>>],
    order: &[u32],
    pixel: [u32; 2],
    blending: Blending,
) -> Vec<Contributor<'a, R>> {
    let mut found = Vec::new();
    let mut transmittance = R::one();
    for &index in order {
        let Some(splat) = &splats[index as usize] else { continue };
        let footprint = footprint(splat, pixel);
        let strength = match blending {
            Blending::Color => splat.opacity,
            Blending::Own => splat.occupancy,
        };
        let Some(weight) = weight(strength, footprint.peak) else { continue };
        let next = transmittance * (R::one() - weight.value);
        if next < constant(MIN_TRANSMITTANCE) {
            break;
        }
        found.push(Contributor { index: index as usize, splat, footprint, weight, transmittance });
        transmittance = next;
    }
    found
}

/// Blends values over an image of `width` x `height`. `splats` are indexed by Gaussian, `order` lists the visible
/// ones front to back.
#[must_use]
pub fn blend<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    width: u32,
    height: u32,
    request: &BlendRequest<'_, [R]>,
) -> BlendedImage<R> {
    let mut image = BlendedImage::filled(width, height, request.channels, R::zero());
    for (position, blended) in image.values.chunks_exact_mut(request.channels).enumerate() {
        let pixel = [position as u32 % width, position as u32 / width];
        for shown in contributors(splats, order, pixel, request.blending) {
            let share = shown.transmittance * shown.weight.value;
            for (sum, value) in blended.iter_mut().zip(request.of(shown.index)) {
                *sum += share * *value;
            }
        }
    }
    image
}

/// Gradients of a blended image.
#[derive(Clone, Debug, PartialEq)]
pub struct BlendGradients<R> {
    /// By the values, `[N, C]`.
    pub values: Vec<R>,
    /// By the splats, `[N]`, through the blending weights; empty where not asked for.
    pub splats: Vec<SplatGradient<R>>,
}

/// Backward pass of [`blend`]: `v_blended` is the gradient by the image, `[height, width, C]`. With `weights`, the
/// gradient also goes through the blending weights, to the strength (opacity or occupancy) and to that geometry.
///
/// `v_v_i = T_i alpha_i v_B`; with `e_i = v_B . v_i` and `B_i = alpha_{i+1} e_{i+1} + (1 - alpha_{i+1}) B_{i+1}`,
/// what lies behind i as it were seen without i and all before it, `v_alpha_i = T_i (e_i - B_i)`.
#[must_use]
pub fn blend_backward<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    width: u32,
    request: &BlendRequest<'_, [R]>,
    v_blended: &[R],
    weights: Option<GeometryPath>,
) -> BlendGradients<R> {
    let mut gradients = BlendGradients {
        values: vec![R::zero(); request.values.len()],
        splats: vec![SplatGradient::zero(); if weights.is_some() { splats.len() } else { 0 }],
    };
    let channels = request.channels;
    for (position, v_pixel) in v_blended.chunks_exact(channels).enumerate() {
        let pixel = [position as u32 % width, position as u32 / width];
        let mut behind = R::zero();
        for shown in contributors(splats, order, pixel, request.blending).into_iter().rev() {
            let Contributor { index, splat, footprint, weight, transmittance } = shown;
            let share = transmittance * weight.value;
            let v_values = &mut gradients.values[index * channels..(index + 1) * channels];
            for (total, v) in v_values.iter_mut().zip(v_pixel) {
                *total += share * *v;
            }
            let Some(geometry) = weights else { continue };
            let e: R = v_pixel.iter().zip(request.of(index)).map(|(v, value)| *v * *value).sum();
            let v_alpha = transmittance * (e - behind);
            behind = weight.value * e + (R::one() - weight.value) * behind;
            if weight.clamped {
                continue;
            }
            let v = &mut gradients.splats[index];
            let v_sigma = -weight.value * v_alpha;
            match request.blending {
                Blending::Color => v.opacity += footprint.peak * v_alpha,
                Blending::Own => v.log_occupancy -= v_sigma,
            }
            if geometry != GeometryPath::Off {
                mean_backward(splat, &footprint, v_sigma, v);
            }
            if geometry == GeometryPath::Full {
                covariance_backward(&footprint, v_sigma, v);
            }
        }
    }
    gradients
}
