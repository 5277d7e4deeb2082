//! Sparse identity distributions: `p_i^k = softmax_k(log phat_i^k + mu_i^k)` over the support of row i.
//! Source: methods reference 5.2 and 5.3.

/// Estimate of a row whose owner is told, not estimated: `ln 2`. Estimates are shares of an image, so a measured
/// one is never above 0.
pub const TOLD: f32 = std::f32::consts::LN_2;

/// Estimate of a row that is told to belong to no instance: its labelled share is 0. Measured estimates are
/// shares above 1e-8.
pub const TOLD_BACKGROUND: f32 = -104.0;

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
    /// Fixed identity estimate per entry: log ptilde, whose row sum is [`Self::labelled_shares`].
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
            self.row_probabilities(row, &mut probabilities[self.range(row)]);
        }
        probabilities
    }

    /// Probabilities of the entries of one row, see [`Self::probabilities`].
    ///
    /// # Panics
    /// When `probabilities` has another length than the row.
    pub fn row_probabilities(&self, row: usize, probabilities: &mut [f32]) {
        let range = self.range(row);
        assert_eq!(probabilities.len(), range.len(), "one probability per entry");
        let logit = |entry: usize| self.log_estimates[entry] + self.log_calibrations[entry];
        let largest = range.clone().map(logit).fold(f32::NEG_INFINITY, f32::max);
        let mut sum = 0.0;
        for (probability, entry) in probabilities.iter_mut().zip(range) {
            *probability = (logit(entry) - largest).exp();
            sum += *probability;
        }
        for probability in probabilities {
            *probability /= sum;
        }
    }

    /// Most probable label of every row; the lowest one where several are. Rows must not be empty.
    #[must_use]
    pub fn argmax(&self) -> Vec<u16> {
        (0..self.len())
            .map(|row| {
                let logit = |entry: usize| self.log_estimates[entry] + self.log_calibrations[entry];
                let range = self.range(row);
                let mut best = range.start;
                for entry in range {
                    if logit(entry) > logit(best) {
                        best = entry;
                    }
                }
                self.labels[best]
            })
            .collect()
    }

    /// Probability of one label in every row, `[N]`; 0 outside a row's support.
    #[must_use]
    pub fn probability_of(&self, label: u16) -> Vec<f32> {
        let probabilities = self.probabilities();
        (0..self.len())
            .map(|row| {
                let range = self.range(row);
                let found = self.labels[range.clone()].binary_search(&label);
                found.map_or(0.0, |at| probabilities[range.start + at])
            })
            .collect()
    }

    /// Share of each Gaussian's image that fell on labelled pixels when its identity was estimated, `[N]`,
    /// in [0, 1]: the sum of a row's estimates. Rows are estimated over all pixels, labelled or not
    /// (ptilde = n / d of methods reference 5.1); the softmax does not see the difference, but what belongs
    /// to no instance shows here.
    #[must_use]
    pub fn labelled_shares(&self) -> Vec<f32> {
        (0..self.len())
            .map(|row| self.log_estimates[self.range(row)].iter().map(|log| log.exp()).sum::<f32>().min(1.0))
            .collect()
    }

    /// No rows yet.
    #[must_use]
    pub fn empty() -> Self {
        Self {
            row_offsets: vec![0],
            labels: Vec::new(),
            log_estimates: Vec::new(),
            log_calibrations: Vec::new(),
        }
    }

    /// Adds a row at the end whose owner is told: an instance, or none of them.
    pub fn push_told(&mut self, owner: Option<u16>) {
        self.labels.push(owner.unwrap_or(0));
        self.log_estimates.push(if owner.is_some() { TOLD } else { TOLD_BACKGROUND });
        self.log_calibrations.push(0.0);
        self.row_offsets.push(self.labels.len() as u32);
    }

    /// Owner of a row that was told ([`Self::push_told`]): `Some(None)` for none of the instances, `None` for a
    /// row that was estimated.
    #[must_use]
    pub fn told_owner(&self, row: usize) -> Option<Option<u16>> {
        let range = self.range(row);
        let [estimate] = self.log_estimates[range.clone()] else { return None };
        if estimate == TOLD {
            Some(Some(self.labels[range.start]))
        } else {
            (estimate <= TOLD_BACKGROUND).then_some(None)
        }
    }

    /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        let mut gathered = Self::empty();
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

#[cfg(test)]
mod tests {
    use super::*;

    fn identities() -> Identities {
        Identities {
            row_offsets: vec![0, 3, 4, 6],
            labels: vec![0, 2, 5, 1, 2, 5],
            log_estimates: [0.2_f32, 0.5, 0.3, 1.0, 0.5, 0.5].map(f32::ln).to_vec(),
            log_calibrations: vec![0.0, -20.0, 0.1, 3.0, 0.0, 0.0],
        }
    }

    #[test]
    fn probabilities_are_a_softmax_over_the_support() {
        let probabilities = identities().probabilities();
        let weights = [0.2_f64, 0.5 * (-20.0_f64).exp(), 0.3 * 0.1_f64.exp()];
        let sum: f64 = weights.iter().sum();
        for (found, weight) in probabilities.iter().zip(weights) {
            assert!((f64::from(*found) - weight / sum).abs() < 1e-7);
        }
        assert_eq!(probabilities[3..], [1.0, 0.5, 0.5]);
    }

    #[test]
    fn a_common_shift_of_the_calibration_changes_nothing() {
        let mut shifted = identities();
        shifted.log_calibrations.iter_mut().for_each(|value| *value += 1000.0);
        for (a, b) in shifted.probabilities().iter().zip(identities().probabilities()) {
            assert!((a - b).abs() < 1e-4, "{a} vs {b}");
        }
    }

    #[test]
    fn argmax_prefers_the_lowest_of_equals() {
        assert_eq!(identities().argmax(), [5, 1, 2]);
    }

    #[test]
    fn probability_of_a_label_is_zero_outside_the_support() {
        let probabilities = identities().probability_of(2);
        assert!(probabilities[0] < 1e-8 && probabilities[0] > 0.0);
        assert_eq!(probabilities[1..], [0.0, 0.5]);
    }

    #[test]
    fn told_rows_are_told_apart_from_estimated_ones() {
        let mut rows = identities();
        assert_eq!([0, 1, 2].map(|row| rows.told_owner(row)), [None; 3]);
        rows.push_told(Some(5));
        rows.push_told(None);
        rows.validate(5, 6).unwrap();
        assert_eq!([3, 4].map(|row| rows.told_owner(row)), [Some(Some(5)), Some(None)]);
        assert_eq!(rows.argmax()[3], 5);
        assert_eq!(rows.labelled_shares()[3..], [1.0, 0.0]);
        assert_eq!(rows.gather(&[4]).told_owner(0), Some(None));
    }

    #[test]
    fn gathering_repeats_whole_rows() {
        let gathered = identities().gather(&[2, 0, 2]);
        gathered.validate(3, 6).unwrap();
        assert_eq!(gathered.labels, [2, 5, 0, 2, 5, 2, 5]);
        assert_eq!(gathered.row_offsets, [0, 2, 5, 7]);
        assert_eq!(gathered.probabilities()[2..5], identities().probabilities()[..3]);
    }
}
