//! Identity distributions: `p_i^k = softmax_k(log phat_i^k + mu_i^k)` over the support of row i, the gradient of
//! mu, and the label mass from which phat is estimated. Source: methods reference 4.2, 5.1 to 5.3.

use cif_geometry::{PixelGrid, Real};

use super::constant;
use super::project::Splat2d;
use super::rasterize::{PixelState, footprint, weight};
use crate::constants::{MIN_COVERAGE, MIN_TRANSMITTANCE};
use crate::cpu::IdentityCounts;

/// Identity rows without their calibration, compressed sparse rows as in [`cif_field::Identities`].
#[derive(Clone, Debug, PartialEq)]
pub struct IdentityRows<R> {
    /// `[N + 1]`.
    pub row_offsets: Vec<u32>,
    /// Dense instance index per entry, ascending in a row.
    pub labels: Vec<u16>,
    /// log phat per entry.
    pub log_estimates: Vec<R>,
}

/// Calibrated identity rows.
#[derive(Clone, Debug, PartialEq)]
pub struct IdentityProbabilities<R> {
    /// `[N + 1]`.
    pub row_offsets: Vec<u32>,
    /// Dense instance index per entry, ascending in a row.
    pub labels: Vec<u16>,
    /// p per entry; rows sum to 1.
    pub values: Vec<R>,
    /// Labelled share of each row, `[N]`: the sum of its estimates.
    pub labelled_shares: Vec<R>,
}

impl<R: Real> IdentityRows<R> {
    /// Softmax of every row with the calibration `log_calibrations` per entry, by maximum subtraction.
    #[must_use]
    pub fn probabilities(&self, log_calibrations: &[R]) -> IdentityProbabilities<R> {
        let mut values: Vec<R> =
            self.log_estimates.iter().zip(log_calibrations).map(|(estimate, mu)| *estimate + *mu).collect();
        for bounds in self.row_offsets.windows(2) {
            let row = &mut values[bounds[0] as usize..bounds[1] as usize];
            let largest = row.iter().copied().fold(R::neg_infinity(), R::max);
            for value in row.iter_mut() {
                *value = (*value - largest).exp();
            }
            let sum: R = row.iter().copied().sum();
            for value in row.iter_mut() {
                *value /= sum;
            }
        }
        let labelled_shares = self
            .row_offsets
            .windows(2)
            .map(|bounds| {
                let row = &self.log_estimates[bounds[0] as usize..bounds[1] as usize];
                row.iter().map(|log| log.exp()).sum::<R>().min(R::one())
            })
            .collect();
        IdentityProbabilities {
            row_offsets: self.row_offsets.clone(),
            labels: self.labels.clone(),
            values,
            labelled_shares,
        }
    }
}

impl<R: Real> IdentityProbabilities<R> {
    /// Entries of a row.
    #[must_use]
    pub fn range(&self, row: usize) -> std::ops::Range<usize> {
        self.row_offsets[row] as usize..self.row_offsets[row + 1] as usize
    }

    /// Entry of a dense instance index in a row, if it supports it.
    #[must_use]
    pub fn entry(&self, row: usize, instance: usize) -> Option<usize> {
        self.range(row).find(|entry| usize::from(self.labels[*entry]) == instance)
    }

    /// p of a dense instance index in a row; 0 outside the support.
    #[must_use]
    pub fn of(&self, row: usize, instance: usize) -> R {
        self.entry(row, instance).map_or(R::zero(), |entry| self.values[entry])
    }

    /// `v_mu_i^k = -(rho_i^k - p_i^k R_i)` from the weighted label responsibilities rho per entry (4.2).
    #[must_use]
    pub fn calibration_backward(&self, label_mass: &[R]) -> Vec<R> {
        let mut v = vec![R::zero(); self.values.len()];
        for row in 0..self.row_offsets.len() - 1 {
            let total: R = label_mass[self.range(row)].iter().copied().sum();
            for entry in self.range(row) {
                v[entry] = -(label_mass[entry] - self.values[entry] * total);
            }
        }
        v
    }

    /// Gradient of mu from the gradient of every probability: the softmax Jacobian (dense oracle).
    #[must_use]
    pub fn softmax_backward(&self, v_probabilities: &[R]) -> Vec<R> {
        let mut v = vec![R::zero(); self.values.len()];
        for row in 0..self.row_offsets.len() - 1 {
            let mean: R = self.range(row).map(|entry| self.values[entry] * v_probabilities[entry]).sum();
            for entry in self.range(row) {
                v[entry] = self.values[entry] * (v_probabilities[entry] - mean);
            }
        }
        v
    }
}

/// Adds a view's colour-weighted label mass (5.1): `w_i(u) = T_i alpha_i / A_c(u)` goes to d_i on every pixel
/// covered by at least 1e-3, and to n_i^y where the pixel has a label y. `pixels` is the forward pass.
pub fn count_label_mass<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    pixels: &PixelGrid<PixelState<R>>,
    labels: &PixelGrid<u16>,
    counts: &mut IdentityCounts,
) {
    for (position, (state, label)) in pixels.pixels.iter().zip(&labels.pixels).enumerate() {
        let coverage = R::one() - state.transmittance;
        if coverage < constant(MIN_COVERAGE) {
            continue;
        }
        let pixel = [position as u32 % pixels.width, position as u32 / pixels.width];
        let mut transmittance = R::one();
        for &index in order {
            let Some(splat) = &splats[index as usize] else { continue };
            let footprint = footprint(splat, pixel);
            let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
            let next = transmittance * (R::one() - alpha.value);
            if next < constant(MIN_TRANSMITTANCE) {
                break;
            }
            let mass = (transmittance * alpha.value / coverage).to_double();
            counts.add_total_mass(index as usize, mass);
            if let Some(instance) = label.checked_sub(1) {
                counts.add_label_mass(index as usize, instance, mass);
            }
            transmittance = next;
        }
    }
}
