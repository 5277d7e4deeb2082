use super::*;

fn gaussians(positions: &[[f32; 3]]) -> Gaussians {
    Gaussians {
        means: positions.to_vec(),
        log_scales: vec![[0.0; 3]; positions.len()],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; positions.len()],
        opacity_logits: vec![0.0; positions.len()],
        occupancy_logits: vec![0.0; positions.len()],
        sh_coefficients: vec![[0.0; 48]; positions.len()],
    }
}

/// Counts from dense rows of label mass and the total masses.
fn counts<const K: usize>(label_mass: &[[f64; K]], total_mass: &[f64]) -> IdentityCounts {
    let mut counts = IdentityCounts::zeros(total_mass.len(), K);
    for (row, masses) in label_mass.iter().enumerate() {
        for (label, mass) in masses.iter().enumerate() {
            counts.add_label_mass(row, label as u16, *mass);
        }
    }
    for (row, mass) in total_mass.iter().enumerate() {
        counts.add_total_mass(row, *mass);
    }
    counts
}

#[test]
fn rows_are_normalised_mass_with_small_entries_dropped() {
    // Unlabelled pixels add to the total: they cancel in the rows and show in the labelled share.
    let counts = counts(&[[3.0, 0.0, 1.0], [1e-5, 9.99999, 0.0]], &[40.0, 10.0]);
    let result = estimate(&counts, &gaussians(&[[0.0; 3], [1.0, 0.0, 0.0]]), 1.0, &IdentityConfig::default());
    let rows = &result.identities;
    assert_eq!((rows.row_offsets.as_slice(), rows.labels.as_slice()), (&[0, 2, 3][..], &[0, 2, 1][..]));
    let p = rows.probabilities();
    assert!((p[0] - 0.75).abs() < 1e-6 && (p[1] - 0.25).abs() < 1e-6, "{p:?}");
    assert_eq!(p[2], 1.0, "a single label is certain");
    let shares = rows.labelled_shares();
    assert!((shares[0] - 0.1).abs() < 1e-6 && (shares[1] - 1.0).abs() < 1e-5, "{shares:?}");
    assert!((result.dropped_mass - 0.5e-6).abs() < 1e-9, "{}", result.dropped_mass);
    assert_eq!(result.empty_instances(), [2]);
}

#[test]
fn hidden_gaussians_take_their_neighbours_rows_and_nothing_is_nan() {
    // Rows 2 and 3 were never seen, row 4 is far from everything; row 5 saw unlabelled pixels only.
    let positions =
        [[0.0; 3], [0.1, 0.0, 0.0], [0.025, 0.0, 0.0], [0.0; 3], [50.0, 0.0, 0.0], [0.1, 0.001, 0.0]];
    let counts = counts(&[[5.0, 0.0], [0.0, 5.0], [0.0, 1e-4]], &[5.0, 5.0, 1e-4, 0.0, 0.0, 30.0]);
    let config = IdentityConfig { neighbour_distance: 0.2, ..IdentityConfig::default() };
    let result = estimate(&counts, &gaussians(&positions), 1.0, &config);
    use RowSource::{Counted, Neighbours, Uniform};
    assert_eq!(result.sources, [Counted, Counted, Neighbours, Neighbours, Uniform, Neighbours]);
    let p = result.identities.probabilities();
    assert!(p.iter().all(|v| v.is_finite()));
    let row = |row: usize| {
        let mut dense = [0.0; 2];
        for entry in result.identities.range(row) {
            dense[usize::from(result.identities.labels[entry])] = p[entry];
        }
        dense
    };
    assert!((row(2)[0] - 0.75).abs() < 1e-5, "three times nearer to row 0: {:?}", row(2));
    assert!(row(3)[0] > 0.999);
    assert_eq!(row(4), [0.5, 0.5]);
    assert!(row(5)[1] > 0.98);
    let shares = result.identities.labelled_shares();
    assert!(shares[0] > 0.999 && shares[3] > 0.999, "{shares:?}");
    assert!(
        shares[4] < 1e-5 && shares[5] < 1e-5,
        "what no label was seen on belongs to no instance: {shares:?}"
    );
}

#[test]
fn a_filled_row_keeps_at_most_eight_labels() {
    let counts = counts(&[std::array::from_fn::<f64, 12, _>(|k| 1.0 + k as f64)], &[100.0, 0.0]);
    let result =
        estimate(&counts, &gaussians(&[[0.0; 3], [0.01, 0.0, 0.0]]), 1.0, &IdentityConfig::default());
    let range = result.identities.range(1);
    assert_eq!(result.identities.labels[range.clone()], [4, 5, 6, 7, 8, 9, 10, 11]);
    let sum: f32 = result.identities.probabilities()[range].iter().sum();
    assert!((sum - 1.0).abs() < 1e-6);
}

#[test]
fn thirty_million_equal_increments_are_counted_exactly() {
    // Row 28: single precision stalls at 2^24.
    let mut counts = IdentityCounts::zeros(1, 1);
    for _ in 0..30_000_000 {
        counts.add_label_mass(0, 0, 1.0);
        counts.add_total_mass(0, 1.0);
    }
    let result = estimate(&counts, &gaussians(&[[0.0; 3]]), 1.0, &IdentityConfig::default());
    assert_eq!(result.label_mass, [30_000_000.0]);
    assert_eq!(result.identities.log_estimates, [0.0]);
}

#[test]
fn the_most_probable_label_counts_calibration_and_prefers_the_lowest() {
    let mut rows = Identities {
        row_offsets: vec![0, 2],
        labels: vec![3, 7],
        log_estimates: vec![-1.0, -1.0],
        log_calibrations: vec![0.0, 0.0],
        owners: Vec::new(),
    };
    assert_eq!(most_probable(&rows, 0), 3);
    rows.log_calibrations[1] = 0.1;
    assert_eq!(most_probable(&rows, 0), 7);
}

#[test]
fn the_longest_table_costs_what_was_met() {
    // 65 535 instances and 20 000 Gaussians: a dense count would take 10 GB, dense rows as much again.
    const INSTANCES: usize = 65_535;
    let n = 20_000;
    let mut counts = IdentityCounts::zeros(n, INSTANCES);
    for row in (0..n).step_by(2) {
        let label = (row * 3 % INSTANCES) as u16;
        counts.add_label_mass(row, label, 3.0);
        counts.add_label_mass(row, 65_534, 1.0);
        counts.add_total_mass(row, 4.0);
    }
    // Every other Gaussian is unseen, half of those near a seen one and half far from all.
    let positions: Vec<[f32; 3]> = (0..n)
        .map(|row| [(row / 2 * 2) as f32, if row % 4 == 3 { 1e4 } else { 0.001 * (row % 2) as f32 }, 0.0])
        .collect();
    let result = estimate(&counts, &gaussians(&positions), 1.0, &IdentityConfig::default());
    assert_eq!(result.count(RowSource::Counted), n / 2);
    assert_eq!((result.count(RowSource::Neighbours), result.count(RowSource::Uniform)), (n / 4, n / 4));
    let rows = &result.identities;
    let p = rows.probabilities();
    let labels = |row: usize| &rows.labels[rows.range(row)];
    assert_eq!(labels(2), [6, 65_534]);
    assert!((p[rows.range(2)][0] - 0.75).abs() < 1e-6);
    assert!(labels(1).contains(&65_534) && labels(1).len() <= 8, "{:?}", labels(1));
    assert_eq!(labels(3).len(), UNIFORM_SUPPORT);
    assert_eq!(labels(3).last(), Some(&65_534), "the instance with the most mass stays");
    assert!(p[rows.range(3)].iter().all(|p| (p * UNIFORM_SUPPORT as f32 - 1.0).abs() < 1e-5));
    assert_eq!(result.label_mass.len(), INSTANCES);
    assert_eq!(result.label_mass[65_534], (n / 2) as f64);
}
