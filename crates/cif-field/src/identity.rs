//! Sparse identity distributions: `p_i^k = softmax_k(log phat_i^k + mu_i^k)` over the support of row i.
//! Source: methods reference 5.2 and 5.3.

/// The object that a Gaussian is part of, where something else than its identity row decides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Owner {
    /// Decided by the identity row: the Gaussian was trained.
    #[default]
    Estimated,
    /// Part of an instance (dense index), as in the file that it was imported from.
    Instance(u16),
    /// Part of no instance, as in the file that it was imported from.
    Background,
}

impl Owner {
    /// The number that stands for it in files: the dense index of an instance, -1 for none of them, -2 where the
    /// identity row decides.
    #[must_use]
    pub fn code(self) -> i32 {
        match self {
            Self::Estimated => -2,
            Self::Background => -1,
            Self::Instance(index) => i32::from(index),
        }
    }

    /// Inverse of [`Self::code`]; `None` for other numbers.
    #[must_use]
    pub fn from_code(code: i32) -> Option<Self> {
        match code {
            -2 => Some(Self::Estimated),
            -1 => Some(Self::Background),
            _ => u16::try_from(code).ok().map(Self::Instance),
        }
    }
}

/// Identity rows of N Gaussians in compressed sparse row form.
///
/// Labels are dense indices into [`crate::Field::instances`] (not mask ids), ascending in a row. A row without
/// entries adds to no label: pixels that only such Gaussians cover stay unlabelled. Estimated rows have entries.
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
    /// Owner of every row, `[N]`; empty where all rows are [`Owner::Estimated`].
    pub owners: Vec<Owner>,
}

impl Default for Identities {
    /// No rows.
    fn default() -> Self {
        Self {
            row_offsets: vec![0],
            labels: Vec::new(),
            log_estimates: Vec::new(),
            log_calibrations: Vec::new(),
            owners: Vec::new(),
        }
    }
}

impl Identities {
    /// Number of rows N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.row_offsets.len() - 1
    }

    /// True when there are no rows.
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

    /// Most probable label of every row, the lowest one where several are; `None` for a row without entries.
    #[must_use]
    pub fn argmax(&self) -> Vec<Option<u16>> {
        (0..self.len())
            .map(|row| {
                let logit = |entry: usize| self.log_estimates[entry] + self.log_calibrations[entry];
                let best = self
                    .range(row)
                    .reduce(|best, entry| if logit(entry) > logit(best) { entry } else { best });
                best.map(|entry| self.labels[entry])
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
            owners: Vec::new(),
        }
    }

    /// Adds a row at the end. `shares` are labels, ascending, with the share of the Gaussian's image that each has,
    /// above 0: their sum is the labelled share.
    pub fn push(&mut self, owner: Owner, shares: &[(u16, f32)]) {
        self.push_entries(owner, shares.iter().map(|(label, share)| (*label, share.ln(), 0.0)));
    }

    /// Adds a row at the end from its entries: label, estimate and calibration, labels ascending.
    pub fn push_entries(&mut self, owner: Owner, entries: impl IntoIterator<Item = (u16, f32, f32)>) {
        if owner != Owner::Estimated || !self.owners.is_empty() {
            self.owners.resize(self.len(), Owner::Estimated);
            self.owners.push(owner);
        }
        for (label, estimate, calibration) in entries {
            self.labels.push(label);
            self.log_estimates.push(estimate);
            self.log_calibrations.push(calibration);
        }
        self.row_offsets.push(self.labels.len() as u32);
    }

    /// Entries of a row: label, estimate and calibration.
    pub fn entries(&self, row: usize) -> impl Iterator<Item = (u16, f32, f32)> {
        self.range(row)
            .map(|entry| (self.labels[entry], self.log_estimates[entry], self.log_calibrations[entry]))
    }

    /// Adds a row at the end that is certain of its owner: an instance, or none of them.
    pub fn push_certain(&mut self, owner: Option<u16>) {
        match owner {
            Some(label) => self.push(Owner::Instance(label), &[(label, 1.0)]),
            None => self.push(Owner::Background, &[]),
        }
    }

    /// Owner of a row.
    #[must_use]
    pub fn owner(&self, row: usize) -> Owner {
        self.owners.get(row).copied().unwrap_or_default()
    }

    /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        let mut gathered = Self::empty();
        sources.iter().for_each(|&source| gathered.append_row(self, source as usize));
        gathered
    }

    /// Adds a row of `other` at the end, with its owner.
    ///
    /// # Panics
    /// When the row is out of range.
    pub fn append_row(&mut self, other: &Self, row: usize) {
        self.push_entries(other.owner(row), other.entries(row));
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
            owners: Vec::new(),
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
        assert_eq!(identities().argmax(), [Some(5), Some(1), Some(2)]);
    }

    #[test]
    fn probability_of_a_label_is_zero_outside_the_support() {
        let probabilities = identities().probability_of(2);
        assert!(probabilities[0] < 1e-8 && probabilities[0] > 0.0);
        assert_eq!(probabilities[1..], [0.0, 0.5]);
    }

    #[test]
    fn owners_stand_beside_the_rows() {
        let mut rows = identities();
        assert_eq!([0, 1, 2].map(|row| rows.owner(row)), [Owner::Estimated; 3]);
        rows.push_certain(Some(5));
        rows.push_certain(None);
        rows.push(Owner::Background, &[(1, 0.125), (4, 0.25)]);
        rows.push(Owner::Estimated, &[(0, 1.0)]);
        rows.validate(7, 6).unwrap();
        assert_eq!(
            [2, 3, 4, 5].map(|row| rows.owner(row)),
            [Owner::Estimated, Owner::Instance(5), Owner::Background, Owner::Background]
        );
        assert_eq!(rows.argmax()[3..], [Some(5), None, Some(4), Some(0)]);
        assert_eq!(rows.labelled_shares()[3..], [1.0, 0.0, 0.375, 1.0]);
        assert_eq!(rows.gather(&[4, 0]).owners, [Owner::Background, Owner::Estimated]);
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
