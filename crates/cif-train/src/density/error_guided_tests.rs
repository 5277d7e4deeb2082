use super::*;
use crate::density::DensifyStatistics;

/// So many Gaussians in a row, of opacity 0.5, longest along y.
fn row_of(n: usize) -> Gaussians {
    Gaussians {
        means: (0..n).map(|k| [k as f32, 0.0, 0.0]).collect(),
        log_scales: vec![[0.1_f32.ln(), 0.4_f32.ln(), 0.2_f32.ln()]; n],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![0.0; n],
        occupancy_logits: (0..n).map(|k| -(k as f32)).collect(),
        sh_coefficients: (0..n).map(|k| [k as f32; 48]).collect(),
    }
}

fn settings(max_gaussians: u32) -> DensifyConfig {
    DensifyConfig { max_gaussians, turnover: 0.25, ..DensifyConfig::default() }
}

fn removed(gaussians: &Gaussians, weight: &[f32], made_for: &[u32], config: &DensifyConfig) -> Vec<u32> {
    let statistics = DensifyStatistics::zeros(gaussians.len());
    let contributions =
        Contributions { weight: weight.to_vec(), total: weight.to_vec(), error: vec![0.0; weight.len()] };
    let rows = Rows {
        gaussians,
        statistics: &statistics,
        contributions: Some(&contributions),
        made_for,
        extent: 1.0,
        opacities_were_reset: false,
    };
    let all = 0..gaussians.len() as u32;
    match make_room(&rows, Some(&contributions), config, true) {
        Some(change) => all.filter(|row| !change.parents.contains(row)).collect(),
        None => Vec::new(),
    }
}

#[test]
fn halves_have_mass_mean_and_variance_of_the_whole() {
    let mut whole = row_of(1);
    // A quarter turn about z: the longest axis of this Gaussian, its y, is the x axis of the world.
    whole.quaternions[0] = [0.5_f32.sqrt(), 0.0, 0.0, 0.5_f32.sqrt()];
    let change = halved(&whole, &[0]);
    let halves = &change.gaussians;
    assert_eq!((halves.len(), change.split, &change.parents[..]), (2, 1, &[0, 0][..]));
    let scale = |set: &Gaussians, row: usize, axis: usize| set.log_scales[row][axis].exp();
    let mass = |set: &Gaussians, row: usize| {
        sigmoid(set.opacity_logits[row]) * (0..3).map(|axis| scale(set, row, axis)).product::<f32>()
    };
    assert!(((mass(halves, 0) + mass(halves, 1)) / mass(&whole, 0) - 1.0).abs() < 1e-5);
    for axis in 0..3 {
        let mean = 0.5 * (halves.means[0][axis] + halves.means[1][axis]);
        assert!((mean - whole.means[0][axis]).abs() < 1e-6, "axis {axis}");
    }
    let apart = 0.5 * (halves.means[0][0] - halves.means[1][0]);
    let variance = scale(halves, 0, 1).powi(2) + apart * apart;
    assert!((variance / 0.4_f32.powi(2) - 1.0).abs() < 1e-5, "{variance}");
    assert!((scale(halves, 0, 0) - 0.1).abs() < 1e-6 && (scale(halves, 1, 2) - 0.2).abs() < 1e-6);
    assert_eq!(halves.occupancy_logits, [0.0; 2]);
}

#[test]
fn the_largest_errors_are_split_first_and_the_set_grows_by_equal_factors() {
    let gaussians = row_of(4);
    // What two views show has twice the sums of what one shows, where it is as wrong.
    let contributions = Contributions {
        weight: vec![1.0; 4],
        total: vec![2.0, 1.0, 2.0, 1.0],
        error: vec![0.2, 0.4, 0.0, 0.3],
    };
    let sizes = |additions_left: u32, most: u32| {
        let change = split(&gaussians, &contributions, &settings(most), additions_left)?;
        let fresh: Vec<u32> = change
            .parents
            .iter()
            .zip(&change.origins)
            .filter_map(|(row, kept)| kept.is_none().then_some(*row))
            .collect();
        Some((change.gaussians.len(), fresh))
    };
    // 4 to 16 in two additions: doubled by the first, but what shows no error is not split.
    assert_eq!(sizes(2, 16), Some((7, vec![0, 0, 1, 1, 3, 3])));
    // In four: by a half.
    assert_eq!(sizes(4, 16), Some((6, vec![1, 1, 3, 3])));
    assert_eq!(sizes(1, 5), Some((5, vec![1, 1])));
    assert_eq!(sizes(1, 4), None, "a full set stays");
    assert_eq!(sizes(1, 3), None, "as does one of more than may be added");
}

#[test]
fn of_a_full_set_those_of_least_weight_make_room() {
    let gaussians = row_of(8);
    let weight = [3.0, 1.0, 0.0, 2.0, 9.0, 8.0, 7.0, 6.0];
    let free = [0; 8];
    assert_eq!(removed(&gaussians, &weight, &free, &settings(8)), [1, 3], "what was not seen is not judged");
    assert_eq!(removed(&gaussians, &weight, &free, &settings(9)), [1], "one place is free");
    assert!(removed(&gaussians, &weight, &free, &settings(20)).is_empty());
    // What is transparent goes first, and counts.
    let mut faint = gaussians.clone();
    faint.opacity_logits[4] = logit(0.001);
    assert_eq!(removed(&faint, &weight, &free, &settings(8)), [1, 4]);
    // Of an object four stay.
    assert!(removed(&gaussians, &weight, &[1, 1, 1, 1, 0, 0, 0, 0], &settings(8)).is_empty());
    // Of one that is hardly shown no more than half goes, and others make room.
    let sliver = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 5.0, 4.0, 3.0, 2.0];
    let of_object = [1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0];
    let half = DensifyConfig { turnover: 0.5, ..settings(12) };
    assert_eq!(removed(&row_of(12), &sliver, &of_object, &half), [0, 1, 2, 3, 10, 11]);
}

#[test]
fn weights_are_those_of_the_view_that_shows_most_and_errors_add_up() {
    let mut contributions = Contributions::zeros(2);
    contributions.add_view(&[3.0, 0.5, 1.0, 0.25]);
    contributions.add_view(&[2.0, 0.5, 4.0, 1.0]);
    let expected = Contributions { weight: vec![3.0, 4.0], total: vec![5.0, 5.0], error: vec![1.0, 1.25] };
    assert_eq!(contributions, expected);
    assert_eq!([0, 1].map(|row| contributions.error_where_shown(row)), [0.6, 1.0]);
}

#[test]
fn nothing_is_known_of_rows_that_are_new() {
    let before = Contributions { weight: vec![1.0, 2.0], total: vec![5.0, 6.0], error: vec![3.0, 4.0] };
    let after = before.gather(&[Some(1), None]);
    assert_eq!(after, Contributions { weight: vec![2.0, 0.0], total: vec![6.0, 0.0], error: vec![4.0, 0.0] });
}
