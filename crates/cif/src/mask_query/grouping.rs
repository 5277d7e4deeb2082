//! Objects that a prompt names in one rendered view, in the manner of Gaussian Grouping.
//!
//! Source: `render_lerf_mask.py` of its authors. The detector is asked about the first view as it is rendered. An id is
//! kept when more than 0.7 of the pixels that it has there lie in the mask; in every view the answer is where the
//! probability of any id that was kept exceeds 0.2. Pixels have the id that is most probable: of an instance
//! `f M_k / A` with the foreground f, rendered identities M and coverage A, and 1 - f of none.

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::cpu::Renderer;
use cif_render::{Channels, RenderSettings};

use super::{Found, VOTERS, Vote};

/// Share of an id's pixels that has to lie in the mask.
const OVERLAP: f64 = 0.7;
/// Probability that a pixel of the answer has to exceed.
const PROBABLE: f32 = 0.2;

/// Instances of every pixel of a view, by probability.
fn each_instance(
    field: &Field,
    camera: &PinholeCamera,
    time: f64,
    renderer: &mut Renderer,
    settings: &RenderSettings,
    mut each: impl FnMut(usize, usize, f32, f32),
) {
    let identities = field.identities.as_ref().expect("a scene with instances is asked");
    let image = renderer.render(field, camera, time, settings, Channels { depth: false, instances: true });
    let layers = image.instances.expect("instances were asked for");
    let ranks = renderer.instance_ranks(identities, field.instances.len().min(VOTERS));
    for (rank, (labels, probabilities)) in ranks.ranks.iter().enumerate() {
        for (pixel, label) in labels.pixels.iter().enumerate() {
            if let Some(instance) = usize::from(*label).checked_sub(1) {
                let foreground = layers.foreground.pixels[pixel];
                // A rank above 0 means coverage above 0.
                let share = foreground * probabilities.pixels[pixel] / layers.coverage.pixels[pixel];
                let of_pixel = if rank == 0 && share >= 1.0 - foreground { share } else { 0.0 };
                each(instance, pixel, share, of_pixel);
            }
        }
    }
}

/// Instances by the share of their pixels in a view that lies in a mask, highest first.
///
/// # Panics
/// When the field has no identities, or the mask is not of the size of the view.
#[must_use]
pub fn find(
    field: &Field,
    mask: &PixelGrid<bool>,
    camera: &PinholeCamera,
    time: f64,
    renderer: &mut Renderer,
    settings: &RenderSettings,
) -> Found {
    assert_eq!((mask.width, mask.height), (camera.width, camera.height), "the mask is that of another view");
    let mut pixels = vec![(0_u64, 0_u64); field.instances.len()];
    each_instance(field, camera, time, renderer, settings, |instance, pixel, _, of_pixel| {
        if of_pixel > 0.0 {
            pixels[instance].0 += u64::from(mask.pixels[pixel]);
            pixels[instance].1 += 1;
        }
    });
    let shown = field.instances.iter().enumerate().zip(pixels).filter(|(_, (inside, _))| *inside > 0);
    let mut votes: Vec<Vote> = shown
        .map(|((index, instance), (inside, all))| {
            let score = inside as f64 / all as f64;
            Vote {
                index,
                id: instance.id,
                label: instance.label.clone(),
                category: instance.category.clone(),
                score,
                chosen: score > OVERLAP,
            }
        })
        .collect();
    votes.sort_by(|a, b| b.score.total_cmp(&a.score));
    let owners = field.identities.as_ref().map(cif_field::Identities::argmax).unwrap_or_default();
    let is_chosen = |owner: usize| votes.iter().any(|vote| vote.chosen && vote.index == owner);
    let rows = (0..owners.len())
        .filter(|row| owners[*row].is_some_and(|owner| is_chosen(usize::from(owner))))
        .map(|row| row as u32)
        .collect();
    Found { votes, rows, frames: 1 }
}

/// The answer in a view: true where any chosen instance is probable enough.
///
/// # Panics
/// When the field has no identities.
#[must_use]
pub fn render(
    field: &Field,
    votes: &[Vote],
    camera: &PinholeCamera,
    time: f64,
    renderer: &mut Renderer,
    settings: &RenderSettings,
) -> PixelGrid<bool> {
    let mut answer = PixelGrid::filled(camera.width, camera.height, false);
    each_instance(field, camera, time, renderer, settings, |instance, pixel, share, _| {
        let is_chosen = || votes.iter().any(|vote| vote.chosen && vote.index == instance);
        answer.pixels[pixel] |= share > PROBABLE && is_chosen();
    });
    answer
}
