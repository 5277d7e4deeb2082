//! Sparse identity distributions: `p_i^k = softmax_k(log phat_i^k + mu_i^k)` over the support of row i.
//! Source: methods reference 5.2 and 5.3.

/// Identity rows of N Gaussians in compressed sparse row form.
///
/// Labels are dense indices into [`crate::Field::instances`] (not mask ids), ascending in a row. A row is
/// never empty once estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct Identities {
    /// `[N + 1]`: row i is `row_offsets[i]..row_offsets[i + 1]`.
    pub row_offsets: Vec<u32>,
    /// Dense instance index per entry.
    pub labels: Vec<u16>,
    /// Fixed identity estimate log phat per entry.
    pub log_estimates: Vec<f32>,
    /// Learnable log-calibration mu per entry.
    pub log_calibrations: Vec<f32>,
}

impl Identities {
    /// Number of rows N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.row_offsets.len() - 1
    }

    /// Whether there are no rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Entries of row `row`.
    #[must_use]
    pub fn range(&self, row: usize) -> std::ops::Range<usize> {
        self.row_offsets[row] as usize..self.row_offsets[row + 1] as usize
    }

    /// Probabilities of every entry, rows summing to 1: softmax by maximum subtraction.
    #[must_use]
    pub fn probabilities(&self) -> Vec<f32> {
        let mut probabilities = vec![0.0; self.labels.len()];
        for row in 0..self.len() {
            let range = self.range(row);
            let logit = |entry: usize| self.log_estimates[entry] + self.log_calibrations[entry];
            let largest = range.clone().map(logit).fold(f32::NEG_INFINITY, f32::max);
            let mut sum = 0.0;
            for entry in range.clone() {
                probabilities[entry] = (logit(entry) - largest).exp();
                sum += probabilities[entry];
            }
            for entry in range {
                probabilities[entry] /= sum;
            }
        }
        probabilities
    }

    /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        let mut gathered = Self {
            row_offsets: vec![0],
            labels: Vec::new(),
            log_estimates: Vec::new(),
            log_calibrations: Vec::new(),
        };
        for &source in sources {
            let range = self.range(source as usize);
            gathered.labels.extend_from_slice(&self.labels[range.clone()]);
            gathered.log_estimates.extend_from_slice(&self.log_estimates[range.clone()]);
            gathered.log_calibrations.extend_from_slice(&self.log_calibrations[range]);
            gathered.row_offsets.push(gathered.labels.len() as u32);
        }
        gathered
    }
}
