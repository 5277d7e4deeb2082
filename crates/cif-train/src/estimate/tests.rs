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

#[test]
fn rows_are_normalised_mass_with_small_entries_dropped() {
    let mut counts = empty_counts(2, 3);
    counts.label_mass = vec![3.0, 0.0, 1.0, 1e-5, 9.99999, 0.0];
    // Unlabelled pixels add to the total: they cancel in the rows and show in the labelled share.
    counts.total_mass = vec![40.0, 10.0];
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
    let mut counts = empty_counts(6, 2);
    counts.label_mass = vec![5.0, 0.0, 0.0, 5.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    counts.total_mass = vec![5.0, 5.0, 1e-4, 0.0, 0.0, 30.0];
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
    let mut counts = empty_counts(2, 12);
    counts.label_mass[..12].copy_from_slice(&std::array::from_fn::<f64, 12, _>(|k| 1.0 + k as f64));
    counts.total_mass[0] = 100.0;
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
    let mut counts = empty_counts(1, 1);
    for _ in 0..30_000_000 {
        counts.label_mass[0] += 1.0;
        counts.total_mass[0] += 1.0;
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
    };
    assert_eq!(most_probable(&rows, 0), 3);
    rows.log_calibrations[1] = 0.1;
    assert_eq!(most_probable(&rows, 0), 7);
}
