//! Label mass of Gaussians over views, as sparse rows: a Gaussian meets few of the instances there are.

/// Label mass of a Gaussian: (dense instance index, pixels), ascending indices.
pub(super) type LabelMasses = Vec<(u16, f64)>;

/// Colour-weighted label mass per Gaussian (methods reference 5.1); add views, then normalise.
///
/// Memory grows with the labels that each Gaussian really meets, never with N x K.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct IdentityCounts {
    instances: usize,
    rows: Vec<LabelMasses>,
    total_mass: Vec<f64>,
}

impl IdentityCounts {
    /// No mass yet for N Gaussians and K instances.
    #[must_use]
    pub fn zeros(gaussians: usize, instances: usize) -> Self {
        Self { instances, rows: vec![Vec::new(); gaussians], total_mass: vec![0.0; gaussians] }
    }

    /// Number of Gaussians N.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.rows.len()
    }

    /// Number of instances K.
    #[must_use]
    pub fn instances(&self) -> usize {
        self.instances
    }

    /// Mass n_i^k of a Gaussian over labelled pixels, pixels: (dense instance index, mass), ascending indices.
    #[must_use]
    pub fn row(&self, gaussian: usize) -> &[(u16, f64)] {
        &self.rows[gaussian]
    }

    /// Mass n_i^k of one instance, pixels; 0 where they never met.
    #[must_use]
    pub fn label_mass(&self, gaussian: usize, instance: u16) -> f64 {
        let row = &self.rows[gaussian];
        row.binary_search_by_key(&instance, |(label, _)| *label).map_or(0.0, |entry| row[entry].1)
    }

    /// Mass d_i of a Gaussian over all pixels used, labelled or not, pixels.
    #[must_use]
    pub fn total_mass(&self, gaussian: usize) -> f64 {
        self.total_mass[gaussian]
    }

    /// Adds mass on pixels of an instance; instances that the table does not have are left out.
    pub fn add_label_mass(&mut self, gaussian: usize, instance: u16, mass: f64) {
        if usize::from(instance) < self.instances {
            add_to(&mut self.rows[gaussian], instance, mass);
        }
    }

    /// Adds mass on any pixels.
    pub fn add_total_mass(&mut self, gaussian: usize, mass: f64) {
        self.total_mass[gaussian] += mass;
    }

    /// The rows and the total masses, to add to in parallel.
    pub(super) fn parts_mut(&mut self) -> (&mut [LabelMasses], &mut [f64]) {
        (&mut self.rows, &mut self.total_mass)
    }
}

/// Adds mass to an entry of a row, which is made where it is not there yet.
pub(super) fn add_to(row: &mut LabelMasses, instance: u16, mass: f64) {
    match row.binary_search_by_key(&instance, |(label, _)| *label) {
        Ok(entry) => row[entry].1 += mass,
        Err(entry) => row.insert(entry, (instance, mass)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_hold_what_was_met_in_ascending_order() {
        let mut counts = IdentityCounts::zeros(2, 65_535);
        for (instance, mass) in [(65_534, 1.0), (3, 0.5), (700, 2.0), (3, 0.25), (65_535, 9.0)] {
            counts.add_label_mass(1, instance, mass);
        }
        counts.add_total_mass(1, 4.0);
        assert_eq!(counts.row(1), [(3, 0.75), (700, 2.0), (65_534, 1.0)], "65535 is not an instance");
        assert_eq!((counts.label_mass(1, 700), counts.label_mass(1, 4)), (2.0, 0.0));
        assert_eq!((counts.row(0), counts.total_mass(0), counts.total_mass(1)), (&[][..], 0.0, 4.0));
        assert_eq!((counts.gaussians(), counts.instances()), (2, 65_535));
    }
}
