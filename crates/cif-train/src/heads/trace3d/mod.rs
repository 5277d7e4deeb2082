//! Trace3D: Gaussians of several labels are split or deleted, then codes are learnt by contrast.
//!
//! Source: Shen et al., Trace3D: Consistent Segmentation Lifting via Gaussian Instance Tracing, ICCV 2025, and its
//! released code; methods reference 8.5. First the field is trained by colours for a while. In cycles, Gaussians whose
//! pixels in a view are of several labels, in many views, are split in two, and all that then still are so are
//! deleted; Gaussians that no view shows go at the first and the last of these steps. Then the field is frozen, and a
//! code per Gaussian is learnt: codes blended over pixels of one label shall be alike, those of others not. Pixels
//! have the label whose mean code over the training views is nearest.
//!
//! The number of Gaussians changes. The cull by opacity of the published code never acts there, and is left out.
//!
//! Deviations: masks are consistent over views, so that patches need no merging; views at all times are traced, with
//! Gaussians where they are then; colours train as in the stages before, without the normals of 2D Gaussians; shorter
//! runs shorten all parts alike. A probability of a pixel is the softmax of negative squared distances (ours).
//!
//! Constants: published 9 000 steps of colour with 4 cycles of 1 200 steps from step 10 on, and 20 000 of codes; a
//! Gaussian counts in a view with more than 25 pixels there, is ambiguous below a share of 0.8, and goes when that is
//! so in more than 0.4 of its views; children have 1 / 1.6 of the scale; codes of 16 from N(0, 1) at a rate of 5e-3; 4
//! 096 pixels; temperatures 100 within a label and 1 between labels.

mod contrast;

use cif_field::Field;
use cif_field::parameters::Parameter;
use cif_render::cpu::{ContributorMass, ContributorRule};
use fearless_simd::Level;
use rand::seq::index::sample;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;

use self::contrast::{CODE, contrast};
use super::head::{HeadLoss, HeadView, Phase, ValueHead};
use super::labels::blended;
use super::tensors::{HeadTensors, per_gaussian, shared};
use super::views::TrainingViews;
use crate::config::HeadName;
use crate::density::{Rearrangement, keep, with_copies};
use crate::error::TrainError;
use crate::random::{Purpose, stream};

/// Rate of codes.
const RATE: f32 = 5e-3;

/// Pixels of a view that are compared.
const PIXELS: usize = 4_096;

/// Published steps by colour, between cycles, and before the first one.
const COLOR_STEPS: u32 = 9_000;
const CYCLE: u32 = 1_200;
const FIRST: u32 = 10;

/// Cycles.
const CYCLES: u32 = 4;

/// Pixels of a view that a Gaussian must have for that view to count.
const MIN_PIXELS: f64 = 25.0;

/// Share of the most frequent label below which a Gaussian is ambiguous in a view.
const CLEAR_SHARE: f64 = 0.8;

/// Share of ambiguous views above which it is split or deleted.
const AMBIGUOUS_SHARE: f64 = 0.4;

const PART: &str = "trace3d";

/// Codes of every Gaussian.
const CODES: Parameter = per_gaussian(PART, "codes", &[CODE]);

/// Mean codes of the labels.
const CENTROIDS: Parameter = shared(PART, "centroids", &[CODE]);

/// 1 for labels that have a mean code.
const KNOWN: Parameter = shared(PART, "known", &[]);

/// A change of the set of Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    DeleteUnseen,
    Split,
    DeleteAmbiguous,
}

/// Codes learnt by contrast on Gaussians of one label each.
#[derive(Clone, Copy, Debug, Default)]
pub struct Trace3d;

/// A published number of steps in a run of so many.
fn scaled(published: u32, steps: u32) -> u32 {
    let all = u64::from(HeadName::Trace3d.published_steps());
    (u64::from(published) * u64::from(steps) / all) as u32
}

/// Changes that fall behind a step of a run.
fn changes(step: u32, steps: u32) -> Vec<Change> {
    let (last, cycle, first) =
        (scaled(COLOR_STEPS, steps), scaled(CYCLE, steps).max(1), scaled(FIRST, steps).max(1));
    let mut changes = Vec::new();
    if step > last {
        return changes;
    }
    if step == 1 || step == last {
        changes.push(Change::DeleteUnseen);
    }
    if step >= first && (step - first).is_multiple_of(cycle) && (step - first) / cycle < CYCLES {
        changes.extend([Change::Split, Change::DeleteAmbiguous]);
    }
    changes
}

/// Gets the row of a Gaussian in a view, its pixels per label, and their number.
type Traced<'a> = dyn FnMut(usize, &[(u16, f64)], f64) + 'a;

/// Gaussians that are ambiguous in many of the views where they count.
fn ambiguous(views: &mut TrainingViews<'_>) -> Result<Vec<bool>, TrainError> {
    let n = views.field().len();
    let (mut counted, mut ambiguous) = (vec![0_u32; n], vec![0_u32; n]);
    trace(views, &mut |row, shares, total| {
        if total > MIN_PIXELS {
            let most = shares.iter().map(|(_, pixels)| *pixels).fold(0.0, f64::max);
            counted[row] += 1;
            ambiguous[row] += u32::from(most < CLEAR_SHARE * total);
        }
    })?;
    let exceeds = |(of, all): (u32, u32)| f64::from(of) > AMBIGUOUS_SHARE * f64::from(all);
    Ok(ambiguous.into_iter().zip(counted).map(exceeds).collect())
}

/// Calls `each` with the row of every Gaussian in every view, its pixels per label, unlabelled ones as a label of
/// their own, and their number.
fn trace(views: &mut TrainingViews<'_>, each: &mut Traced<'_>) -> Result<(), TrainError> {
    let rule = ContributorRule { mass: ContributorMass::One, ..ContributorRule::ALL };
    views.each_count(&rule, &mut |counts| {
        for row in 0..counts.gaussians() {
            each(row, counts.row(row), counts.total_mass(row));
        }
    })
}

impl ValueHead for Trace3d {
    fn parameters(&self) -> Vec<Parameter> {
        vec![CODES, CENTROIDS, KNOWN]
    }

    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32> {
        if *parameter != CODES {
            return vec![0.0; field.instances.len() * parameter.width()];
        }
        let mut random = stream(seed, Purpose::Codes, 0);
        (0..field.len() * CODE).map(|_| StandardNormal.sample(&mut random)).collect()
    }

    fn rate(&self, parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        if *parameter == CODES { RATE } else { 0.0 }
    }

    fn phase(&self, step: u32, steps: u32) -> Phase {
        if step <= scaled(COLOR_STEPS, steps) { Phase::Field } else { Phase::Head }
    }

    fn codes(&self) -> Parameter {
        CODES
    }

    fn loss(
        &self,
        _tensors: &mut HeadTensors,
        view: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        let labels = &view.labels.pixels;
        let labelled: Vec<usize> = (0..labels.len()).filter(|pixel| labels[*pixel] != 0).collect();
        let mut random = stream(view.seed, Purpose::HeadSamples, 0);
        let chosen: Vec<usize> = sample(&mut random, labelled.len(), PIXELS.min(labelled.len()))
            .into_iter()
            .map(|k| labelled[k])
            .collect();
        let (of_pixels, _) = view.blended.values.as_chunks::<CODE>();
        let codes: Vec<[f32; CODE]> = chosen.iter().map(|pixel| of_pixels[*pixel]).collect();
        let of: Vec<u16> = chosen.iter().map(|pixel| labels[*pixel]).collect();
        let (loss, v_codes) = contrast(Level::new(), &codes, &of);
        for (pixel, v_code) in chosen.iter().zip(v_codes) {
            let v = &mut v_blended[pixel * CODE..(pixel + 1) * CODE];
            v.iter_mut().zip(v_code).for_each(|(total, v)| *total += weight * v);
        }
        HeadLoss { loss, unsupported: 0.0 }
    }

    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32) {
        let centroids = tensors.values(&CENTROIDS).chunks_exact(CODE);
        let distances: Vec<(u16, f32)> = centroids
            .zip(tensors.values(&KNOWN))
            .enumerate()
            .filter(|(_, (_, known))| **known > 0.0)
            .map(|(label, (centroid, _))| {
                let squared = centroid.iter().zip(blended).map(|(a, b)| (a - b) * (a - b)).sum();
                (label as u16 + 1, squared)
            })
            .collect();
        let Some((label, least)) = distances.iter().copied().reduce(|a, b| if b.1 < a.1 { b } else { a })
        else {
            return (0, 0.0);
        };
        (label, 1.0 / distances.iter().map(|(_, squared)| (least - squared).exp()).sum::<f32>())
    }

    fn finish(&self, tensors: &mut HeadTensors, views: &mut TrainingViews<'_>) -> Result<(), TrainError> {
        let instances = views.field().instances.len();
        let (mut sums, mut pixels) = (vec![0.0_f64; instances * CODE], vec![0.0_f64; instances]);
        let (field, settings) = (views.field(), views.settings());
        views.each_masked(&|camera| self.trains_on(camera), &mut |renderer, frame, labels| {
            let view = (&frame.camera, frame.time);
            let blended = blended(renderer, self, tensors, field, view, &settings);
            for (code, label) in blended.pixels().zip(&labels.pixels) {
                let Some(label) = usize::from(*label).checked_sub(1) else { continue };
                pixels[label] += 1.0;
                let sums = &mut sums[label * CODE..(label + 1) * CODE];
                sums.iter_mut().zip(code).for_each(|(sum, value)| *sum += f64::from(*value));
            }
        })?;
        let means = sums.chunks_exact(CODE).zip(&pixels);
        let means: Vec<f32> =
            means.flat_map(|(sums, pixels)| sums.iter().map(|sum| (sum / pixels.max(1.0)) as f32)).collect();
        tensors.values_mut(&CENTROIDS).copy_from_slice(&means);
        for (known, pixels) in tensors.values_mut(&KNOWN).iter_mut().zip(pixels) {
            *known = f32::from(u8::from(pixels > 0.0));
        }
        Ok(())
    }

    fn rearrangements(&self, step: u32, steps: u32) -> u32 {
        changes(step, steps).len() as u32
    }

    fn rearrange(
        &self,
        part: u32,
        step: u32,
        steps: u32,
        views: &mut TrainingViews<'_>,
        random: &mut Pcg64,
    ) -> Result<Option<Rearrangement>, TrainError> {
        let change = changes(step, steps)[part as usize];
        if change == Change::DeleteUnseen {
            let mut seen = vec![false; views.field().len()];
            trace(views, &mut |row, _, total| seen[row] |= total > 0.0)?;
            let kept = (0..seen.len() as u32).filter(|row| seen[*row as usize]).collect();
            return Ok(keep(&views.field().gaussians, kept));
        }
        let ambiguous = ambiguous(views)?;
        let (goes, stays): (Vec<u32>, Vec<u32>) =
            (0..ambiguous.len() as u32).partition(|row| ambiguous[*row as usize]);
        let gaussians = &views.field().gaussians;
        Ok(match change {
            Change::Split if goes.is_empty() => None,
            Change::Split => Some(with_copies(gaussians, &[], &goes, random)),
            _ => keep(gaussians, stays),
        })
    }
}

#[cfg(test)]
mod tests;
