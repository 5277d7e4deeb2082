//! Pictures of what a head gives the pixels of a view, and the labels that it gives Gaussians.

use cif_field::{Field, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::cpu::Renderer;
use cif_render::{BlendRequest, BlendedImage, Blending, InstanceImage, InstanceSettings, RenderSettings};

use super::head::ValueHead;
use super::tensors::HeadTensors;

/// The values of a head blended over a view by `renderer`, which `settings` without instances are for.
pub(crate) fn blended(
    renderer: &mut Renderer,
    head: &dyn ValueHead,
    tensors: &HeadTensors,
    field: &Field,
    (camera, time): (&PinholeCamera, f64),
    settings: &RenderSettings,
) -> BlendedImage {
    let instances = (head.blending() == Blending::Own).then(InstanceSettings::default);
    renderer.prepare(field, camera, time, &RenderSettings { instances, ..*settings });
    let values = head.values(tensors, field, time);
    let (channels, blending) = (head.channels(field), head.blending());
    renderer.blend(&BlendRequest { values: &values[..], channels, blending })
}

/// Instance outputs of blended values.
pub(crate) fn instance_image(
    head: &dyn ValueHead,
    tensors: &HeadTensors,
    blended: &BlendedImage,
    alpha: &PixelGrid<f32>,
) -> InstanceImage {
    let decoded: Vec<(u16, f32)> = blended.pixels().map(|pixel| head.decode(tensors, pixel)).collect();
    let (width, height) = (blended.width, blended.height);
    let grid = |values: Vec<f32>| PixelGrid::from_pixels(width, height, values);
    let probability: Vec<f32> = decoded.iter().map(|(_, probability)| *probability).collect();
    let entropy = |p: &f32| if *p > 0.0 { -p * p.ln() } else { 0.0 };
    InstanceImage {
        label: PixelGrid::from_pixels(width, height, decoded.iter().map(|(label, _)| *label).collect()),
        entropy: grid(probability.iter().map(entropy).collect()),
        foreground: grid(probability.clone()),
        probability: grid(probability),
        coverage: alpha.clone(),
    }
}

/// Identity rows that say what a head says of every Gaussian.
pub(crate) fn identities(labels: &[u16]) -> Identities {
    let mut identities = Identities::empty();
    for label in labels {
        identities.push_certain(label.checked_sub(1));
    }
    identities
}

/// The place of the largest value, the first of equals.
pub(crate) fn largest(values: impl IntoIterator<Item = f32>) -> Option<(usize, f32)> {
    let numbered = values.into_iter().enumerate();
    numbered.reduce(|best, next| if next.1 > best.1 { next } else { best })
}
