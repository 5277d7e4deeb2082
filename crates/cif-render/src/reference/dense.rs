//! Rendered identities of all K instances at every pixel: images for looking and measuring, soft labels, and the
//! oracle of the K-free form. Source: methods reference 4.1, 4.2 (dense-K alternative), 4.3.

use cif_geometry::{PixelGrid, Real};

use super::constant;
use super::identity_rows::IdentityProbabilities;
use super::project::{Splat2d, SplatGradient};
use super::rasterize::{covariance_backward, footprint, mean_backward, weight};
use crate::constants::{MIN_LABEL_PROBABILITY, MIN_TRANSMITTANCE};
use crate::image::{InstanceImage, InstanceRanks, UNLABELLED};
use crate::settings::{GeometryPath, InstanceNormalisation};

/// Rendered identities M_k.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseMaps<R> {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Number of instances K.
    pub instances: usize,
    /// M, `[height * width, K]`.
    pub values: Vec<R>,
    /// Labelled shares of the Gaussians, blended like colour, `[height * width]`.
    pub labelled: Vec<R>,
    /// Instance transmittance S behind the last contributor, `[height * width]`.
    pub transmittances: Vec<R>,
    /// Position in the order after the last contributor, `[height * width]`.
    pub ends: Vec<usize>,
}

/// Blends the identities of all splats, with the same gates as the K-free pass.
#[must_use]
pub fn rasterize_dense<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    width: u32,
    height: u32,
    identities: &IdentityProbabilities<R>,
    instances: usize,
) -> DenseMaps<R> {
    let pixels = width as usize * height as usize;
    let mut maps = DenseMaps {
        width,
        height,
        instances,
        values: vec![R::zero(); pixels * instances],
        labelled: vec![R::zero(); pixels],
        transmittances: vec![R::one(); pixels],
        ends: vec![0; pixels],
    };
    for pixel in 0..pixels {
        let position = [pixel as u32 % width, pixel as u32 / width];
        let mut transmittance = R::one();
        for (rank, &index) in order.iter().enumerate() {
            let Some(splat) = &splats[index as usize] else { continue };
            let footprint = footprint(splat, position);
            let Some(b) = weight(splat.occupancy, footprint.peak) else { continue };
            let next = transmittance * (R::one() - b.value);
            if next < constant(MIN_TRANSMITTANCE) {
                break;
            }
            for entry in identities.range(index as usize) {
                let instance = usize::from(identities.labels[entry]);
                maps.values[pixel * instances + instance] +=
                    transmittance * b.value * identities.values[entry];
            }
            transmittance = next;
            maps.ends[pixel] = rank + 1;
        }
        maps.transmittances[pixel] = transmittance;
        let mut transmittance = R::one();
        for &index in order {
            let Some(splat) = &splats[index as usize] else { continue };
            let footprint = footprint(splat, position);
            let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
            let next = transmittance * (R::one() - alpha.value);
            if next < constant(MIN_TRANSMITTANCE) {
                break;
            }
            maps.labelled[pixel] += transmittance * alpha.value * identities.labelled_shares[index as usize];
            transmittance = next;
        }
    }
    maps
}

/// Cross-entropy of soft targets `[height * width, K]`, mean over the pixels whose targets are not all zero;
/// and its gradient by M.
#[must_use]
pub fn dense_cross_entropy<R: Real>(
    maps: &DenseMaps<R>,
    targets: &[R],
    normalisation: InstanceNormalisation,
) -> (R, Vec<R>) {
    let k = maps.instances;
    let floor = constant::<R>(MIN_LABEL_PROBABILITY);
    let labelled =
        targets.chunks(k).filter(|row| row.iter().any(|target| *target > R::zero())).count().max(1);
    let pixel_weight = R::one() / R::of(labelled as f64);
    let mut loss = R::zero();
    let mut v_maps = vec![R::zero(); maps.values.len()];
    for (pixel, row) in targets.chunks(k).enumerate() {
        let values = &maps.values[pixel * k..(pixel + 1) * k];
        let coverage = match normalisation {
            InstanceNormalisation::None => R::one(),
            InstanceNormalisation::Coverage => values.iter().copied().sum(),
        };
        for instance in 0..k {
            let target = row[instance];
            if target <= R::zero() {
                continue;
            }
            let probability = if coverage > R::zero() { values[instance] / coverage } else { R::zero() };
            loss -= pixel_weight * target * probability.max(floor).ln();
            if probability < floor {
                continue;
            }
            v_maps[pixel * k + instance] -= pixel_weight * target / values[instance];
            if normalisation == InstanceNormalisation::Coverage {
                for v in &mut v_maps[pixel * k..(pixel + 1) * k] {
                    *v += pixel_weight * target / coverage;
                }
            }
        }
    }
    (loss, v_maps)
}

/// Gradients of the dense pass.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseGradients<R> {
    /// Per Gaussian.
    pub splats: Vec<SplatGradient<R>>,
    /// By the probability of each identity entry.
    pub probabilities: Vec<R>,
}

/// `dl/dp_i^k = W_i v_M_k`; `dl/db_i = S_i (v_M . p_i) - (sum_{j>i} W_j v_M . p_j) / (1 - b_i)`.
#[must_use]
pub fn rasterize_dense_backward<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    maps: &DenseMaps<R>,
    identities: &IdentityProbabilities<R>,
    v_maps: &[R],
    geometry: GeometryPath,
) -> DenseGradients<R> {
    let mut gradients = DenseGradients {
        splats: vec![SplatGradient::zero(); splats.len()],
        probabilities: vec![R::zero(); identities.values.len()],
    };
    let k = maps.instances;
    for (pixel, v_map) in v_maps.chunks(k).enumerate() {
        let position = [pixel as u32 % maps.width, pixel as u32 / maps.width];
        let contributors: Vec<_> = order[..maps.ends[pixel]]
            .iter()
            .filter_map(|&index| {
                let splat = splats[index as usize].as_ref()?;
                let footprint = footprint(splat, position);
                Some((index as usize, splat, footprint, weight(splat.occupancy, footprint.peak)?))
            })
            .collect();
        let along = |index: usize| -> R {
            identities
                .range(index)
                .map(|entry| v_map[usize::from(identities.labels[entry])] * identities.values[entry])
                .sum()
        };
        let mut transmittance = R::one();
        for (rank, (index, splat, footprint, b)) in contributors.iter().enumerate() {
            for entry in identities.range(*index) {
                gradients.probabilities[entry] +=
                    transmittance * b.value * v_map[usize::from(identities.labels[entry])];
            }
            if !b.clamped {
                // Summed afresh from what lies behind: slow, but without any cancellation.
                let (mut behind, mut through) = (R::zero(), R::one());
                for (other, _, _, b) in &contributors[rank + 1..] {
                    behind += through * b.value * along(*other);
                    through *= R::one() - b.value;
                }
                let v_b = transmittance * (along(*index) - behind);
                let v = &mut gradients.splats[*index];
                v.log_occupancy += b.value * v_b;
                let v_sigma = -b.value * v_b;
                if geometry != GeometryPath::Off {
                    mean_backward(splat, footprint, v_sigma, v);
                }
                if geometry == GeometryPath::Full {
                    covariance_backward(footprint, v_sigma, v);
                }
            }
            transmittance *= R::one() - b.value;
        }
    }
    gradients
}

/// Most probable instance, its probability, coverage, foreground and entropy per pixel.
#[must_use]
pub fn instance_image<R: Real>(maps: &DenseMaps<R>) -> InstanceImage {
    let mut image = InstanceImage {
        label: PixelGrid::filled(maps.width, maps.height, UNLABELLED),
        probability: PixelGrid::filled(maps.width, maps.height, 0.0),
        coverage: PixelGrid::filled(maps.width, maps.height, 0.0),
        foreground: PixelGrid::filled(maps.width, maps.height, 0.0),
        entropy: PixelGrid::filled(maps.width, maps.height, 0.0),
    };
    for pixel in 0..maps.transmittances.len() {
        let values = &maps.values[pixel * maps.instances..(pixel + 1) * maps.instances];
        let coverage: R = values.iter().copied().sum();
        image.foreground.pixels[pixel] = maps.labelled[pixel].min(R::one()).to_double() as f32;
        if coverage <= R::zero() {
            continue;
        }
        let mut best = 0;
        for instance in 1..values.len() {
            if values[instance] > values[best] {
                best = instance;
            }
        }
        let entropy: R = values
            .iter()
            .map(|value| *value / coverage)
            .filter(|share| *share > R::zero())
            .map(|share| -share * share.ln())
            .sum();
        image.label.pixels[pixel] = best as u16 + 1;
        image.probability.pixels[pixel] = values[best].to_double() as f32;
        image.coverage.pixels[pixel] = coverage.to_double() as f32;
        image.entropy.pixels[pixel] = entropy.to_double() as f32;
    }
    image
}

/// The most probable instances of every pixel, most probable first, ties by index.
#[must_use]
pub fn instance_ranks<R: Real>(maps: &DenseMaps<R>, ranks: usize) -> InstanceRanks {
    let empty = || {
        (
            PixelGrid::filled(maps.width, maps.height, UNLABELLED),
            PixelGrid::filled(maps.width, maps.height, 0.0),
        )
    };
    let mut image = InstanceRanks { ranks: (0..ranks).map(|_| empty()).collect() };
    for pixel in 0..maps.transmittances.len() {
        let values = &maps.values[pixel * maps.instances..(pixel + 1) * maps.instances];
        let mut order: Vec<usize> = (0..values.len()).filter(|k| values[*k] > R::zero()).collect();
        order.sort_by(|a, b| values[*b].to_double().total_cmp(&values[*a].to_double()));
        for ((labels, probabilities), instance) in image.ranks.iter_mut().zip(order) {
            labels.pixels[pixel] = instance as u16 + 1;
            probabilities.pixels[pixel] = values[instance].to_double() as f32;
        }
    }
    image
}
