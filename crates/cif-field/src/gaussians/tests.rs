use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;

fn random(n: usize, seed: u64) -> Gaussians {
    let mut rng = Pcg64::seed_from_u64(seed);
    let positions: Vec<[f32; 3]> =
        (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
    let colors: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| rng.random_range(0.0..1.0))).collect();
    Gaussians::from_points(&positions, &colors).unwrap()
}

#[test]
fn fresh_gaussians_have_the_initial_values() {
    let positions = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
    let colors = [[0.5, 0.0, 1.0]; 4];
    let gaussians = Gaussians::from_points(&positions, &colors).unwrap();
    gaussians.validate().unwrap();
    // Squared distances of the origin to the others: 1, 4, 9.
    let expected = (14.0_f32 / 3.0).sqrt();
    for scale in gaussians.scale(0) {
        assert!((scale - expected).abs() < 1e-6, "{scale}");
    }
    assert!((gaussians.opacity(2) - 0.1).abs() < 1e-7);
    assert!((gaussians.occupancy(2) - 0.02).abs() < 1e-8);
    for (found, expected) in gaussians.base_color(3).iter().zip(colors[3]) {
        assert!((found - expected).abs() < 1e-6);
    }
    assert!(gaussians.sh_coefficients[3][3..].iter().all(|value| *value == 0.0));
}

#[test]
fn ten_thousand_identical_points_get_the_smallest_scale() {
    let gaussians = Gaussians::from_points(&vec![[0.3, 0.1, -2.0]; 10_000], &vec![[0.5; 3]; 10_000]).unwrap();
    let floor = (MIN_SQUARED_DISTANCE.ln() / 2.0) as f32;
    assert!(gaussians.log_scales.iter().all(|scale| *scale == [floor; 3]));
    gaussians.validate().unwrap();
}

#[test]
fn one_point_and_huge_coordinates_stay_finite() {
    Gaussians::from_points(&[[1.0; 3]], &[[0.5; 3]]).unwrap().validate().unwrap();
    Gaussians::from_points(&[], &[]).unwrap().validate().unwrap();
    let far = [[3e38, 0.0, 0.0], [-3e38, 0.0, 0.0], [0.0, 3e38, 1.0]];
    Gaussians::from_points(&far, &[[0.5; 3]; 3]).unwrap().validate().unwrap();
}

#[test]
fn broken_points_are_named() {
    let error = Gaussians::from_points(&[[0.0; 3], [0.0, f32::NAN, 0.0]], &[[0.5; 3]; 2]).unwrap_err();
    assert_eq!(error.to_string(), "`positions` holds NaN at row 1, column 1, where a finite value must be");
    let error = Gaussians::from_points(&[[0.0; 3]], &[]).unwrap_err();
    assert_eq!(error, FieldError::Length { array: "colors", found: 0, expected: 1 });
}

#[test]
fn covariance_turns_with_the_quaternion() {
    let mut gaussians = random(1, 3);
    gaussians.log_scales[0] = [0.0, (2.0_f32).ln(), (3.0_f32).ln()];
    // A quarter turn about z, given as a quaternion of norm 5, swaps the x and y variances.
    let half = std::f32::consts::FRAC_1_SQRT_2 * 5.0;
    gaussians.quaternions[0] = [half, 0.0, 0.0, half];
    let expected = [4.0, 0.0, 0.0, 1.0, 0.0, 9.0];
    for (found, expected) in gaussians.covariance(0).unwrap().iter().zip(expected) {
        assert!((found - expected).abs() < 1e-5, "{found} vs {expected}");
    }
    gaussians.quaternions[0] = [0.0, 1e-7, 0.0, 0.0];
    assert!(gaussians.covariance(0).is_none());
    gaussians.log_scales[0] = [60.0, -90.0, 0.0];
    assert_eq!(gaussians.scale(0), [10.0_f32.exp(), (-20.0_f32).exp(), 1.0]);
}

#[test]
fn retain_and_append_move_whole_rows() {
    let (mut gaussians, tail) = (random(20, 4), random(5, 5));
    gaussians.append(&tail);
    gaussians.validate().unwrap();
    let keep: Vec<bool> = (0..25).map(|row| row % 3 == 0).collect();
    let sources: Vec<u32> = (0..25).filter(|row| row % 3 == 0).collect();
    let expected = gaussians.gather(&sources);
    gaussians.retain(&keep);
    assert_eq!(gaussians, expected);
    assert_eq!(gaussians.means[8], tail.means[4]);
}

#[test]
fn morton_order_is_a_permutation_that_keeps_neighbours_together() {
    let gaussians = random(4000, 6);
    let order = gaussians.morton_order();
    let mut sorted = order.clone();
    sorted.sort_unstable();
    assert!(sorted.iter().copied().eq(0..4000));
    let length = |order: &[u32]| {
        let step = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt();
        let mean = |row: u32| gaussians.means[row as usize];
        order.windows(2).map(|pair| step(mean(pair[0]), mean(pair[1]))).sum::<f32>()
    };
    let unsorted: Vec<u32> = (0..4000).collect();
    assert!(length(&order) < 0.2 * length(&unsorted));
}

#[test]
fn morton_order_of_coincident_points_is_their_order() {
    let gaussians = Gaussians::from_points(&[[2.0; 3]; 100], &[[0.5; 3]; 100]).unwrap();
    assert!(gaussians.morton_order().into_iter().eq(0..100));
    assert!(Gaussians::default().morton_order().is_empty());
}

#[test]
fn spreading_moves_every_bit() {
    for bit in 0..MORTON_BITS {
        assert_eq!(spread_bits(1 << bit), 1 << (3 * bit));
    }
}
