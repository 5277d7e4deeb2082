//! Instance-guided resampling: weak Gaussians of an instance become replicas of its strong ones, with opacity
//! and occupancy shared out so that what is rendered stays. Source: methods reference 6.

mod conserve;
mod draw;

use cif_field::{Field, Identities};
use cif_geometry::scalar::{logit, sigmoid};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

pub use conserve::{conserved_logit, footprint_integral, scale_correction};
pub use draw::{draw_with_replacement, draw_without_replacement, limited_shares, shares};

use crate::config::{Excess, LabelShares, ResampleConfig, ScaleCorrection, WeakSet, Weakness};
use crate::density::rearrangement::in_world;
use crate::estimate::most_probable;

/// Inputs of a resampling event in addition to the field.
#[derive(Clone, Copy, Debug)]
pub struct ResampleContext<'a> {
    /// Settings.
    pub config: &'a ResampleConfig,
    /// Gaussians whose rows were not estimated from their own mass; never sources.
    pub unseen: &'a [bool],
    /// Labelled pixels per instance, for shares by pixels.
    pub label_pixels: &'a [f64],
    /// True when opacity takes the place of occupancy (ablation ii).
    pub opacity_is_occupancy: bool,
    /// True when occupancy stays as it is (ablation i).
    pub occupancy_is_constant: bool,
    /// Lowest occupancy.
    pub occupancy_floor: f32,
}

/// A relocation: row `weak` becomes a replica of row `source`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pair {
    /// Overwritten row.
    pub weak: u32,
    /// Copied row.
    pub source: u32,
}

/// Pairs of one event, in the order of their instances.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Relocations {
    /// Relocations; no row is both weak and source, and none is weak twice.
    pub pairs: Vec<Pair>,
    /// Instances with at least one pair.
    pub labels: usize,
}

/// Rows and entries that a resampling event changed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Relocated {
    /// Relocated rows: fresh moments.
    pub weak: Vec<u32>,
    /// Sources, ascending: fresh moments for opacity and occupancy.
    pub sources: Vec<u32>,
    /// Old entry of every new identity entry that keeps its moments; `None` for fresh ones.
    pub entry_origins: Vec<Option<u32>>,
    /// Occupancies that were raised to the floor.
    pub floored: usize,
}

/// `occupancy x identity` of every supported (Gaussian, instance), clamped to [floor, 1], in entry order.
fn gammas(field: &Field, identities: &Identities, context: &ResampleContext<'_>) -> Vec<f64> {
    let mut gamma: Vec<f64> = identities.probabilities().iter().map(|p| f64::from(*p)).collect();
    for row in 0..identities.len() {
        let occupancy = f64::from(if context.opacity_is_occupancy {
            sigmoid(field.gaussians.opacity_logits[row])
        } else {
            sigmoid(field.gaussians.occupancy_logits[row])
        });
        for entry in identities.range(row) {
            gamma[entry] = (gamma[entry] * occupancy).clamp(f64::from(context.config.gamma_floor), 1.0);
        }
    }
    gamma
}

/// Draws the pairs of one event: weak ones without replacement with weight 1 / strength (see [`Weakness`]), then a
/// source for each with weight gamma, among Gaussians that support the instance and are not weak in this event.
///
/// Shares that an instance cannot use (too few candidates, see [`ResampleConfig::weak_share`]) are left out or go to the
/// others, see [`ResampleConfig::excess`]; those of an instance without a source are left out.
#[must_use]
pub fn choose(field: &Field, context: &ResampleContext<'_>, rng: &mut impl Rng) -> Relocations {
    let Some(identities) = &field.identities else { return Relocations::default() };
    let n = identities.len();
    let k = field.instances.len();
    let gamma = gammas(field, identities, context);
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); k];
    let mut summed = vec![0.0; k];
    for row in 0..n {
        members[usize::from(most_probable(identities, row))].push(row as u32);
        for entry in identities.range(row) {
            summed[usize::from(identities.labels[entry])] += gamma[entry];
        }
    }
    let weights: Vec<f64> = (0..k)
        .map(|label| {
            if members[label].len() < 2 {
                return 0.0;
            }
            match context.config.label_shares {
                LabelShares::Equal => 1.0,
                LabelShares::Gamma => summed[label],
                LabelShares::Pixels => context.label_pixels.get(label).copied().unwrap_or(0.0),
            }
        })
        .collect();
    let budget = (f64::from(context.config.rate) * n as f64).round() as usize;
    let most: Vec<usize> =
        members.iter().map(|members| most_weak(members.len(), n, context.config)).collect();
    let shares = match context.config.excess {
        Excess::Drop => {
            shares(budget, &weights).into_iter().zip(&most).map(|(share, most)| share.min(*most)).collect()
        }
        Excess::Share => limited_shares(budget, &weights, &most),
    };

    let mut is_weak = vec![false; n];
    let mut weak: Vec<Vec<u32>> = vec![Vec::new(); k];
    for label in (0..k).filter(|label| shares[*label] > 0) {
        let candidates: Vec<u32> = match context.config.weak_set {
            WeakSet::Members => members[label].clone(),
            WeakSet::Literal => (0..n as u32).collect(),
        };
        let free: Vec<u32> = candidates.into_iter().filter(|row| !is_weak[*row as usize]).collect();
        let weights: Vec<f64> = free
            .iter()
            .map(|row| {
                let floor = f64::from(context.config.gamma_floor);
                let strength = gamma_of(identities, &gamma, *row as usize, label as u16).unwrap_or(floor);
                let opacity = f64::from(sigmoid(field.gaussians.opacity_logits[*row as usize]));
                match context.config.weakness {
                    Weakness::Occupancy => 1.0 / strength,
                    Weakness::Visibility => 1.0 / strength.max(opacity),
                }
            })
            .collect();
        weak[label] =
            draw_without_replacement(&weights, shares[label], rng).into_iter().map(|k| free[k]).collect();
        for row in &weak[label] {
            is_weak[*row as usize] = true;
        }
    }
    let mut plan = Relocations::default();
    for (label, weak) in weak.into_iter().enumerate().filter(|(_, weak)| !weak.is_empty()) {
        let (mut candidates, mut weights) = (Vec::new(), Vec::new());
        for row in (0..n).filter(|row| !is_weak[*row] && !context.unseen.get(*row).is_some_and(|u| *u)) {
            if let Some(gamma) = gamma_of(identities, &gamma, row, label as u16) {
                candidates.push(row as u32);
                weights.push(gamma);
            }
        }
        if candidates.is_empty() {
            continue;
        }
        plan.labels += 1;
        let drawn = draw_with_replacement(&weights, weak.len(), rng);
        plan.pairs
            .extend(weak.iter().zip(drawn).map(|(weak, k)| Pair { weak: *weak, source: candidates[k] }));
    }
    plan
}

/// Most Gaussians that one event relocates for an instance of so many members. Of the members one stays in any case,
/// so that there is something to copy.
fn most_weak(members: usize, all: usize, config: &ResampleConfig) -> usize {
    let share = |candidates: usize| (f64::from(config.weak_share) * candidates as f64) as usize;
    match config.weak_set {
        WeakSet::Members => share(members).min(members.saturating_sub(1)),
        WeakSet::Literal => share(all),
    }
}

/// Clamped gamma of a Gaussian and an instance; `None` outside its support.
fn gamma_of(identities: &Identities, gamma: &[f64], row: usize, label: u16) -> Option<f64> {
    let range = identities.range(row);
    identities.labels[range.clone()].iter().position(|l| *l == label).map(|at| gamma[range.start + at])
}

/// Relocates the pairs of a plan in place.
pub fn apply(
    field: &mut Field,
    plan: &Relocations,
    context: &ResampleContext<'_>,
    rng: &mut impl Rng,
) -> Relocated {
    let mut replicas = std::collections::BTreeMap::<u32, u32>::new();
    for pair in &plan.pairs {
        *replicas.entry(pair.source).or_default() += 1;
    }
    let gaussians = &mut field.gaussians;
    let floor = logit(context.occupancy_floor);
    let mut relocated = Relocated::default();
    for (source, count) in &replicas {
        let row = *source as usize;
        let old = f64::from(gaussians.opacity_logits[row]);
        let new = conserved_logit(old, *count);
        gaussians.opacity_logits[row] = new as f32;
        if !context.occupancy_is_constant {
            let occupancy = conserved_logit(f64::from(gaussians.occupancy_logits[row]), *count) as f32;
            relocated.floored += usize::from(occupancy < floor);
            gaussians.occupancy_logits[row] = occupancy.max(floor);
        }
        if context.config.scale_correction == ScaleCorrection::Mcmc {
            let factor = scale_correction(sigmoid(old), sigmoid(new), *count + 1);
            for value in &mut gaussians.log_scales[row] {
                *value += factor.ln() as f32;
            }
        }
        relocated.sources.push(*source);
    }
    let offsets: Vec<[f32; 3]> =
        plan.pairs.iter().map(|pair| replica_offset(field, pair.source as usize, context, rng)).collect();
    let gaussians = &mut field.gaussians;
    for (pair, offset) in plan.pairs.iter().zip(offsets) {
        gaussians.copy_row(pair.weak as usize, pair.source as usize);
        for (value, offset) in gaussians.means[pair.weak as usize].iter_mut().zip(offset) {
            *value += offset;
        }
        relocated.weak.push(pair.weak);
    }
    if let Some(identities) = &mut field.identities {
        let mut rows: Vec<u32> = (0..identities.len() as u32).collect();
        for pair in &plan.pairs {
            rows[pair.weak as usize] = pair.source;
        }
        for (row, from) in rows.iter().enumerate() {
            let kept = row as u32 == *from;
            relocated
                .entry_origins
                .extend(identities.range(*from as usize).map(|entry| kept.then_some(entry as u32)));
        }
        *identities = identities.gather(&rows);
    }
    relocated
}

/// Times at which a replica must move like its source.
const PROBE_TIMES: usize = 3;

/// Offsets tried before a small one is taken.
const TRIES: usize = 3;

/// Largest norm of the normal deviate.
const MAX_DEVIATE: f32 = 2.0;

/// Share of the offset that is taken when no try moves like the source.
const SMALL_SHARE: f32 = 0.2;

/// Position of a replica relative to its source, world metres: `R diag(exp s) 0.5 xi`, retried while the
/// deformation there moves it more than half a standard deviation away from the source (6.5).
fn replica_offset(
    field: &Field,
    source: usize,
    context: &ResampleContext<'_>,
    rng: &mut impl Rng,
) -> [f32; 3] {
    let gaussians = &field.gaussians;
    let largest = gaussians.log_scales[source].iter().fold(f32::NEG_INFINITY, |a, b| a.max(*b)).exp();
    let here = displacements(field, gaussians.means[source]);
    let mut offset = [0.0; 3];
    for _ in 0..TRIES {
        let xi = loop {
            let xi: [f32; 3] = std::array::from_fn(|_| StandardNormal.sample(rng));
            if xi.iter().map(|v| v * v).sum::<f32>() <= MAX_DEVIATE * MAX_DEVIATE {
                break xi;
            }
        };
        offset = in_world(gaussians, source, xi.map(|v| v * context.config.offset));
        let there = displacements(field, std::array::from_fn(|k| gaussians.means[source][k] + offset[k]));
        let stays = here.iter().zip(&there).all(|(a, b)| {
            let squared: f32 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
            squared.sqrt() <= 0.5 * largest
        });
        if stays {
            return offset;
        }
    }
    offset.map(|v| v * SMALL_SHARE)
}

/// Displacement of a canonical position at the probe times, evenly spread over the captured ones.
fn displacements(field: &Field, position: [f32; 3]) -> [[f32; 3]; PROBE_TIMES] {
    let times = &field.timeline.times;
    let Some(deformation) = field.deformation.as_ref().filter(|_| !times.is_empty()) else {
        return [[0.0; 3]; PROBE_TIMES];
    };
    std::array::from_fn(|k| {
        let time = times[k * (times.len() - 1) / (PROBE_TIMES - 1)] as f32;
        let tape = deformation.evaluate(&deformation.planes, &deformation.mlp, position, time);
        deformation.deltas(&tape).position
    })
}

#[cfg(test)]
mod tests;
