//! Identity estimation: whose is each Gaussian, from the label mass that colour rendering gave it.
//! Source: methods reference 5.

use cif_field::neighbours::NearestNeighbours;
use cif_field::{Gaussians, Identities};
use cif_render::cpu::IdentityCounts;
use rayon::prelude::*;

use crate::config::IdentityConfig;

/// Where a row comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowSource {
    /// Its own label mass.
    Counted,
    /// Seen neighbours: the Gaussian had no label mass itself.
    Neighbours,
    /// Nothing: all instances alike.
    Uniform,
}

/// Estimated rows.
#[derive(Clone, Debug, PartialEq)]
pub struct IdentityEstimate {
    /// Sparse rows with calibrations 0.
    pub identities: Identities,
    /// Source of every row, `[N]`.
    pub sources: Vec<RowSource>,
    /// Probability dropped by truncation, mean over counted rows.
    pub dropped_mass: f64,
    /// Label mass per instance, pixels, `[K]`.
    pub label_mass: Vec<f64>,
}

impl IdentityEstimate {
    /// Rows with a source.
    #[must_use]
    pub fn count(&self, source: RowSource) -> usize {
        self.sources.iter().filter(|s| **s == source).count()
    }

    /// Dense indices of instances that are most probable for no counted Gaussian.
    #[must_use]
    pub fn empty_instances(&self) -> Vec<u16> {
        let mut won = vec![false; self.label_mass.len()];
        for (row, source) in self.sources.iter().enumerate() {
            if *source == RowSource::Counted {
                won[usize::from(most_probable(&self.identities, row))] = true;
            }
        }
        (0..won.len() as u16).filter(|k| !won[usize::from(*k)]).collect()
    }
}

/// Label with the largest probability of a row; the lowest of equals.
#[must_use]
pub fn most_probable(identities: &Identities, row: usize) -> u16 {
    let mut best = (f32::NEG_INFINITY, 0);
    for entry in identities.range(row) {
        let logit = identities.log_estimates[entry] + identities.log_calibrations[entry];
        if logit > best.0 {
            best = (logit, identities.labels[entry]);
        }
    }
    best.1
}

/// Zero counts of `n` Gaussians and `k` instances.
#[must_use]
pub fn empty_counts(n: usize, k: usize) -> IdentityCounts {
    IdentityCounts { instances: k, label_mass: vec![0.0; n * k], total_mass: vec![0.0; n] }
}

/// Normalises counts to sparse rows; Gaussians without mass take the inverse-distance weighted mean of their
/// nearest counted neighbours, or all instances alike where none is near. `extent` in metres.
///
/// # Panics
/// When there are no instances, or the counts are not of these Gaussians.
#[must_use]
pub fn estimate(
    counts: &IdentityCounts,
    gaussians: &Gaussians,
    extent: f64,
    config: &IdentityConfig,
) -> IdentityEstimate {
    let (n, k) = (gaussians.len(), counts.instances);
    assert!(k > 0, "identities need instances");
    assert_eq!(counts.label_mass.len(), n * k, "counts belong to other Gaussians");
    let min_mass = f64::from(config.min_mass);
    let truncation = f64::from(config.truncation);

    // Share of a Gaussian's mass that lies on labelled pixels, sum n / d. It leaves the softmax untouched and
    // tells the background from the instances later on.
    let share = |row: usize| -> Option<f64> {
        let total = counts.total_mass[row];
        let labelled: f64 = counts.label_mass[row * k..(row + 1) * k].iter().sum();
        (total >= min_mass).then(|| (labelled / total).clamp(MIN_LABELLED_SHARE, 1.0))
    };
    let counted: Vec<Option<(Row, f64)>> = counts
        .label_mass
        .par_chunks(k)
        .zip(&counts.total_mass)
        .map(|(mass, total)| {
            let sum: f64 = mass.iter().sum();
            (*total >= min_mass && sum >= min_mass).then(|| truncated(mass, sum, truncation))
        })
        .collect();

    let seen: Vec<u32> = (0..n as u32).filter(|row| counted[*row as usize].is_some()).collect();
    let positions: Vec<[f32; 3]> = seen.iter().map(|row| gaussians.means[*row as usize]).collect();
    let index = NearestNeighbours::new(&positions);
    let reach = f64::from(config.neighbour_distance) * extent;
    let rows: Vec<(Row, f64, RowSource)> = (0..n)
        .into_par_iter()
        .map(|row| {
            if let Some((entries, _)) = &counted[row] {
                return (entries.clone(), share(row).unwrap_or(1.0), RowSource::Counted);
            }
            let position = gaussians.means[row].map(f64::from);
            let near: Vec<(usize, f64)> = index
                .nearest(position, config.neighbours as usize)
                .into_iter()
                .map(|found| (seen[found.row as usize] as usize, found.squared_distance.sqrt()))
                .filter(|(_, distance)| *distance <= reach)
                .collect();
            if near.is_empty() {
                let uniform = (0..k as u16).map(|label| (label, 1.0 / k as f64)).collect();
                return (uniform, share(row).unwrap_or(MIN_LABELLED_SHARE), RowSource::Uniform);
            }
            let mut mixed = vec![0.0; k];
            let (mut shares, mut weights) = (0.0, 0.0);
            for (neighbour, distance) in near {
                let weight = 1.0 / distance.max(1e-6 * extent.max(f64::MIN_POSITIVE));
                shares += weight * share(neighbour).unwrap_or(1.0);
                weights += weight;
                if let Some((entries, _)) = &counted[neighbour] {
                    for (label, probability) in entries {
                        mixed[usize::from(*label)] += weight * probability;
                    }
                }
            }
            let own = share(row).unwrap_or(shares / weights);
            (strongest(&mixed, MAX_FILLED_SUPPORT), own, RowSource::Neighbours)
        })
        .collect();

    let mut identities = Identities {
        row_offsets: vec![0],
        labels: Vec::new(),
        log_estimates: Vec::new(),
        log_calibrations: Vec::new(),
    };
    for (entries, share, _) in &rows {
        for (label, probability) in entries {
            identities.labels.push(*label);
            identities.log_estimates.push((probability * share).ln() as f32);
        }
        identities.row_offsets.push(identities.labels.len() as u32);
    }
    identities.log_calibrations = vec![0.0; identities.labels.len()];
    let dropped: f64 = counted.iter().flatten().map(|(_, dropped)| dropped).sum();
    let label_mass = (0..k).map(|k_| counts.label_mass.iter().skip(k_).step_by(k).sum()).collect();
    IdentityEstimate {
        identities,
        sources: rows.into_iter().map(|(_, _, source)| source).collect(),
        dropped_mass: dropped / (seen.len().max(1)) as f64,
        label_mass,
    }
}

/// Labels and probabilities of a row, ascending labels.
type Row = Vec<(u16, f64)>;

/// Smallest labelled share that is kept, so that its logarithm stays finite.
const MIN_LABELLED_SHARE: f64 = 1e-6;

/// Support of a row that was filled from neighbours.
const MAX_FILLED_SUPPORT: usize = 8;

/// Entries of at least `truncation`, renormalised, and the probability dropped. The largest always stays.
fn truncated(mass: &[f64], sum: f64, truncation: f64) -> (Row, f64) {
    let largest = mass.iter().copied().fold(0.0, f64::max);
    let stays = |m: f64| m > 0.0 && (m >= truncation * sum || m == largest);
    let kept: f64 = mass.iter().copied().filter(|m| stays(*m)).sum();
    let entries = mass
        .iter()
        .enumerate()
        .filter(|(_, m)| stays(**m))
        .map(|(label, m)| (label as u16, m / kept))
        .collect();
    (entries, 1.0 - kept / sum)
}

/// The `most` largest entries, normalised; lower labels first among equals.
fn strongest(mass: &[f64], most: usize) -> Row {
    let mut order: Vec<usize> = (0..mass.len()).filter(|k| mass[*k] > 0.0).collect();
    order.sort_by(|a, b| mass[*b].total_cmp(&mass[*a]).then(a.cmp(b)));
    order.truncate(most);
    order.sort_unstable();
    let sum: f64 = order.iter().map(|k| mass[*k]).sum();
    order.into_iter().map(|k| (k as u16, mass[k] / sum)).collect()
}

#[cfg(test)]
mod tests;
