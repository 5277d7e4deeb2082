//! Identity estimation: whose is each Gaussian, from the label mass that colour rendering gave it.
//! Source: methods reference 5.

use std::collections::BTreeMap;

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

/// Normalises counts to sparse rows; Gaussians without mass take the inverse-distance weighted mean of their
/// nearest counted neighbours, or all instances alike where none is near: of a long table the
/// [`UNIFORM_SUPPORT`] instances with the most mass, so that memory does not grow with it. `extent` in metres.
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
    let (n, k) = (gaussians.len(), counts.instances());
    assert!(k > 0, "identities need instances");
    assert_eq!(counts.gaussians(), n, "counts belong to other Gaussians");
    let min_mass = f64::from(config.min_mass);
    let truncation = f64::from(config.truncation);

    // Share of a Gaussian's mass that lies on labelled pixels, sum n / d. It leaves the softmax untouched and
    // distinguishes the background from the instances later on.
    let share = |row: usize| -> Option<f64> {
        let (total, labelled) = (counts.total_mass(row), mass_of(counts.row(row)));
        (total >= min_mass).then(|| (labelled / total).clamp(MIN_LABELLED_SHARE, 1.0))
    };
    let counted: Vec<Option<(Row, f64)>> = (0..n)
        .into_par_iter()
        .map(|row| {
            let masses = counts.row(row);
            let sum = mass_of(masses);
            let enough = counts.total_mass(row) >= min_mass && sum >= min_mass;
            enough.then(|| truncated(masses, sum, truncation))
        })
        .collect();
    let mut label_mass = vec![0.0; k];
    for (label, mass) in (0..n).flat_map(|row| counts.row(row)) {
        label_mass[usize::from(*label)] += mass;
    }
    let uniform = uniform(&label_mass);

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
                return (uniform.clone(), share(row).unwrap_or(MIN_LABELLED_SHARE), RowSource::Uniform);
            }
            let mut mixed = BTreeMap::new();
            let (mut shares, mut weights) = (0.0, 0.0);
            for (neighbour, distance) in near {
                let weight = 1.0 / distance.max(1e-6 * extent.max(f64::MIN_POSITIVE));
                shares += weight * share(neighbour).unwrap_or(1.0);
                weights += weight;
                if let Some((entries, _)) = &counted[neighbour] {
                    for (label, probability) in entries {
                        *mixed.entry(*label).or_insert(0.0) += weight * probability;
                    }
                }
            }
            let own = share(row).unwrap_or(shares / weights);
            (strongest(mixed, MAX_FILLED_SUPPORT), own, RowSource::Neighbours)
        })
        .collect();

    let mut identities = Identities::default();
    for (entries, share, _) in &rows {
        for (label, probability) in entries {
            identities.labels.push(*label);
            identities.log_estimates.push((probability * share).ln() as f32);
        }
        identities.row_offsets.push(identities.labels.len() as u32);
    }
    identities.log_calibrations = vec![0.0; identities.labels.len()];
    let dropped: f64 = counted.iter().flatten().map(|(_, dropped)| dropped).sum();
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

/// Most instances that a row without any evidence names.
pub const UNIFORM_SUPPORT: usize = 64;

fn mass_of(masses: &[(u16, f64)]) -> f64 {
    masses.iter().map(|(_, mass)| mass).sum()
}

/// Entries of at least `truncation`, renormalised, and the probability dropped. The largest always stays.
fn truncated(masses: &[(u16, f64)], sum: f64, truncation: f64) -> (Row, f64) {
    let largest = masses.iter().map(|(_, mass)| *mass).fold(0.0, f64::max);
    let stays = |mass: f64| mass > 0.0 && (mass >= truncation * sum || mass == largest);
    let kept: Row = masses.iter().copied().filter(|(_, mass)| stays(*mass)).collect();
    let total = mass_of(&kept);
    (kept.into_iter().map(|(label, mass)| (label, mass / total)).collect(), 1.0 - total / sum)
}

/// All instances alike, or those with the most mass of a long table.
fn uniform(label_mass: &[f64]) -> Row {
    let mut labels: Vec<u16> = (0..label_mass.len()).map(|label| label as u16).collect();
    if labels.len() > UNIFORM_SUPPORT {
        let mass = |label: &u16| label_mass[usize::from(*label)];
        labels.sort_by(|a, b| mass(b).total_cmp(&mass(a)).then(a.cmp(b)));
        labels.truncate(UNIFORM_SUPPORT);
        labels.sort_unstable();
    }
    let probability = 1.0 / labels.len() as f64;
    labels.into_iter().map(|label| (label, probability)).collect()
}

/// The `most` largest entries, normalised; lower labels first among equals.
fn strongest(mass: BTreeMap<u16, f64>, most: usize) -> Row {
    let mut row: Row = mass.into_iter().filter(|(_, mass)| *mass > 0.0).collect();
    row.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    row.truncate(most);
    row.sort_unstable_by_key(|(label, _)| *label);
    let sum = mass_of(&row);
    row.into_iter().map(|(label, mass)| (label, mass / sum)).collect()
}

#[cfg(test)]
mod tests;
