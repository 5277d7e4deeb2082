//! Objects that 2D masks show: from what a detector found on frames of a capture to instances of a scene.
//!
//! Source: methods reference 10.3. With rendered identities M, blending weights w of colour and W of the instance
//! pass, and the found masks Q of the training frames:
//!
//! - vote of an instance: `v_k = sum_Q m_k / sum m_k`, over the frames that have a mask, with `m_k = f M_k / A`: its
//!   share of the foreground f. M_k itself is nowhere 0 on the background, which is large: a mug whose every pixel is
//!   in the masks would have a vote of an eighth. Chosen are the instances above 1/2, else the best if it is above
//!   1/5;
//! - score of a Gaussian: `a_i / d_i`, its part of colour inside the masks;
//! - rendered mask: `F > A / 2` with `F = sum over the chosen Gaussians of W_i` and the instance coverage A, where
//!   the foreground f is at least a gate. The paper has no such gate (0); [`GATE`] keeps faint stray occupancy on the
//!   background out.
//!
//! [`grouping`] has another rule, which asks one rendered view.

pub mod grouping;

use std::collections::BTreeSet;
use std::path::PathBuf;

use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::cpu::{IdentityCounts, Renderer};
use cif_render::{BlendRequest, Blending, Channels, RenderSettings};
use serde::Serialize;

/// Share of an instance that has to lie inside the masks.
const CHOSEN: f64 = 0.5;
/// Share that is enough for the best one where no instance reaches [`CHOSEN`].
const BEST: f64 = 0.2;
/// Share of a Gaussian's colour that has to lie inside the masks.
const INSIDE: f64 = 0.5;
/// Foreground from which on a pixel may belong to what was found, unless the user says otherwise: as in the instance
/// maps of `cif eval` pictures, a pixel that is mostly background is nobody's.
pub const GATE: f32 = 0.5;
/// Instances per pixel that vote: exact for scenes of no more, and the rest of a pixel is nothing otherwise.
const VOTERS: usize = 32;

/// Which Gaussians make up what was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Selection {
    /// Those of the chosen instances.
    #[default]
    Instance,
    /// Those that lie inside the masks themselves.
    Gaussian,
    /// Those that are both: parts of instances.
    Both,
}

/// Masks of a capture's frames.
#[derive(Clone, Debug)]
pub struct FoundMasks {
    /// Files per frame, `[frames]`; empty where the detector was not asked.
    pub files: Vec<Vec<PathBuf>>,
    /// True when they were made on loaded images, without lens, rather than on captured ones.
    pub loaded: bool,
}

/// Vote of the masks for an instance.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Vote {
    /// Dense index.
    #[serde(skip)]
    pub index: usize,
    /// Mask value.
    pub id: u16,
    /// Human name.
    pub label: String,
    /// Class.
    pub category: String,
    /// v_k: share of what the frames show of it that lies inside the masks, in [0, 1].
    pub score: f64,
    /// True when it is chosen.
    pub chosen: bool,
}

/// Result of a query by masks.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Instances with any vote, highest first.
    pub votes: Vec<Vote>,
    /// Rows of the field that make it up, ascending.
    pub rows: Vec<u32>,
    /// Frames that voted.
    pub frames: usize,
}

/// Agreement of a rendered mask with the detector's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameAgreement {
    /// Frame of the capture.
    pub name: String,
    /// Percent of all pixels that agree.
    pub accuracy: f64,
    /// Intersection over union, percent; `None` where the detector found nothing.
    pub iou: Option<f64>,
}

/// Agreement over frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// Percent of pixels that agree, mean over frames where the detector found something.
    pub macc: Option<f64>,
    /// Mean intersection over union over the same frames, percent.
    pub miou: Option<f64>,
    /// Frames that count.
    pub frames: usize,
    /// Frames left out because the detector found nothing.
    pub empty_frames: usize,
    /// Every frame, also the empty ones.
    pub per_frame: Vec<FrameAgreement>,
}

/// Asks the training frames that have a mask.
///
/// # Errors
/// When a mask cannot be read, or `go_on` says so.
///
/// # Panics
/// When the field has no identities.
pub fn find<E: From<cif_dataset::Error>>(
    field: &Field,
    dataset: &Dataset,
    masks: &FoundMasks,
    selection: Selection,
    renderer: &mut Renderer,
    settings: &RenderSettings,
    mut go_on: impl FnMut() -> Result<(), E>,
) -> Result<Found, E> {
    let identities = field.identities.as_ref().expect("a scene with instances is asked");
    let instances = field.instances.len();
    let (mut inside, mut total) = (vec![0.0_f64; instances], vec![0.0_f64; instances]);
    let mut counts = IdentityCounts::zeros(field.gaussians.len(), 1);
    let mut frames = 0;
    for (index, frame) in dataset.frames.iter().enumerate() {
        if frame.split != Split::Train || masks.files[index].is_empty() {
            continue;
        }
        go_on()?;
        frames += 1;
        let found = dataset.load_found_mask(index, &masks.files[index], masks.loaded)?;
        let channels = Channels { depth: false, instances: true };
        let image = renderer.render(field, &frame.camera, frame.time, settings, channels);
        let layers = image.instances.expect("instances were asked for");
        let ranks = renderer.instance_ranks(identities, instances.min(VOTERS));
        for (labels, probabilities) in &ranks.ranks {
            for (pixel, found) in found.pixels.iter().enumerate() {
                if let Some(instance) = usize::from(labels.pixels[pixel]).checked_sub(1) {
                    // A rank above 0 means coverage above 0.
                    let share = layers.foreground.pixels[pixel] * probabilities.pixels[pixel]
                        / layers.coverage.pixels[pixel];
                    total[instance] += f64::from(share);
                    inside[instance] += if *found { f64::from(share) } else { 0.0 };
                }
            }
        }
        let labels = found.map(|found| u16::from(*found));
        renderer.count_identities(field, &frame.camera, frame.time, settings, &labels, &mut counts);
    }
    let mut votes: Vec<Vote> = field
        .instances
        .iter()
        .enumerate()
        .filter(|(index, _)| inside[*index] > 0.0)
        .map(|(index, instance)| Vote {
            index,
            id: instance.id,
            label: instance.label.clone(),
            category: instance.category.clone(),
            score: inside[index] / total[index],
            chosen: false,
        })
        .collect();
    votes.sort_by(|a, b| b.score.total_cmp(&a.score));
    choose(&mut votes);
    let rows = rows(identities, &votes, &counts, selection);
    Ok(Found { votes, rows, frames })
}

/// Chooses among votes in descending order.
fn choose(votes: &mut [Vote]) {
    for vote in votes.iter_mut() {
        vote.chosen = vote.score > CHOSEN;
    }
    if let Some(best) = votes.first_mut() {
        best.chosen |= best.score > BEST;
    }
}

fn rows(
    identities: &cif_field::Identities,
    votes: &[Vote],
    counts: &IdentityCounts,
    selection: Selection,
) -> Vec<u32> {
    let chosen: BTreeSet<usize> = votes.iter().filter(|vote| vote.chosen).map(|vote| vote.index).collect();
    let owners = identities.argmax();
    (0..owners.len())
        .filter(|row| {
            let of_instance = owners[*row].is_some_and(|owner| chosen.contains(&usize::from(owner)));
            let (a, d) = (counts.label_mass(*row, 0), counts.total_mass(*row));
            let by_itself = d > 0.0 && a / d > INSIDE;
            match selection {
                Selection::Instance => of_instance,
                Selection::Gaussian => by_itself,
                Selection::Both => of_instance && by_itself,
            }
        })
        .map(|row| row as u32)
        .collect()
}

/// Renders what was found in a view: true where most of what the instance pass shows is of the rows, and the foreground
/// is at least `gate` (see [`GATE`]; 0 for none).
///
/// # Panics
/// When the field has no identities.
#[must_use]
pub fn render(
    field: &Field,
    rows: &[u32],
    gate: f32,
    camera: &cif_geometry::PinholeCamera,
    time: f64,
    renderer: &mut Renderer,
    settings: &RenderSettings,
) -> PixelGrid<bool> {
    let mut chosen = vec![0.0_f32; field.gaussians.len()];
    for row in rows {
        chosen[*row as usize] = 1.0;
    }
    let image = renderer.render(field, camera, time, settings, Channels { depth: false, instances: true });
    let layers = image.instances.expect("a scene with instances is asked");
    let share = renderer.blend(&BlendRequest { values: &chosen, channels: 1, blending: Blending::Own });
    let pixels = (0..share.values.len())
        .map(|pixel| {
            share.values[pixel] > 0.5 * layers.coverage.pixels[pixel]
                && layers.foreground.pixels[pixel] >= gate
        })
        .collect();
    PixelGrid::from_pixels(camera.width, camera.height, pixels)
}

impl FrameAgreement {
    /// Compares a rendered mask with the true one, or that of a detector.
    #[must_use]
    pub fn of(name: &str, rendered: &PixelGrid<bool>, truth: &PixelGrid<bool>) -> Self {
        let (mut agree, mut both, mut either) = (0_u64, 0_u64, 0_u64);
        for (a, b) in rendered.pixels.iter().zip(&truth.pixels) {
            agree += u64::from(a == b);
            both += u64::from(*a && *b);
            either += u64::from(*a || *b);
        }
        let percent = |part: u64, whole: u64| 100.0 * part as f64 / whole as f64;
        let shown = truth.pixels.contains(&true);
        Self {
            name: name.to_owned(),
            accuracy: percent(agree, truth.pixels.len() as u64),
            iou: shown.then(|| percent(both, either)),
        }
    }
}

/// Means over frames.
#[must_use]
pub fn agreement(per_frame: Vec<FrameAgreement>) -> Agreement {
    let counted: Vec<(f64, f64)> =
        per_frame.iter().filter_map(|frame| Some((frame.accuracy, frame.iou?))).collect();
    let mean = |values: &mut dyn Iterator<Item = f64>| {
        (!counted.is_empty()).then(|| values.sum::<f64>() / counted.len() as f64)
    };
    Agreement {
        macc: mean(&mut counted.iter().map(|(accuracy, _)| *accuracy)),
        miou: mean(&mut counted.iter().map(|(_, iou)| *iou)),
        frames: counted.len(),
        empty_frames: per_frame.len() - counted.len(),
        per_frame,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vote(score: f64) -> Vote {
        Vote { index: 0, id: 1, label: String::new(), category: String::new(), score, chosen: false }
    }

    #[test]
    fn votes_above_a_half_are_chosen_else_a_good_best_one() {
        for (scores, chosen) in [
            (vec![0.9, 0.51, 0.5], vec![true, true, false]),
            (vec![0.4, 0.3], vec![true, false]),
            (vec![0.2, 0.1], vec![false, false]),
        ] {
            let mut votes: Vec<Vote> = scores.into_iter().map(vote).collect();
            choose(&mut votes);
            assert_eq!(votes.iter().map(|vote| vote.chosen).collect::<Vec<_>>(), chosen);
        }
    }

    #[test]
    fn agreement_counts_all_pixels_and_skips_empty_frames() {
        let grid = |pixels: &[u8]| PixelGrid::from_pixels(4, 1, pixels.iter().map(|p| *p == 1).collect());
        let frames = [
            ("a", grid(&[1, 1, 0, 0]), grid(&[1, 0, 0, 0])),
            ("b", grid(&[0, 0, 0, 0]), grid(&[0, 0, 0, 1])),
            ("c", grid(&[1, 0, 0, 0]), grid(&[0, 0, 0, 0])),
        ];
        let of = |(name, rendered, truth): &(&str, _, _)| FrameAgreement::of(name, rendered, truth);
        let result = agreement(frames.iter().map(of).collect());
        assert_eq!((result.macc, result.miou), (Some(75.0), Some(25.0)));
        assert_eq!((result.frames, result.empty_frames, result.per_frame[2].iou), (2, 1, None));
        assert_eq!(agreement(Vec::new()).miou, None);
    }
}
