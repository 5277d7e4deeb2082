//! Identity distributions: `p_i^k = softmax_k(log phat_i^k + mu_i^k)` over the support of row i, and the gradient of
//! mu. Source: methods reference 4.2, 5.1 to 5.3.

use cif_geometry::Real;

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
