use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::testing;

/// The definition, with covariances inverted and no index.
fn brute_force(field: &Field, point: DVec3, time: f64) -> (f64, BTreeMap<u16, f64>, u32) {
    let gaussians = field.deformed(time);
    let identities = field.identities.as_ref().unwrap();
    let probabilities = identities.probabilities();
    let (mut nothing, mut total, mut count) = (1.0, 0.0, 0);
    let mut shares = BTreeMap::new();
    for row in 0..gaussians.len() {
        let unit = quaternion::try_normalize(gaussians.quaternions[row].map(f64::from)).unwrap();
        let r = quaternion::to_rotation(unit);
        let rotation = DMat3::from_cols_array_2d(&r).transpose();
        let variance = gaussians.log_scales[row].map(|s| (2.0 * f64::from(s)).exp());
        let covariance = rotation * DMat3::from_diagonal(DVec3::from_array(variance)) * rotation.transpose();
        let offset = point - DVec3::from_array(gaussians.means[row].map(f64::from));
        let density = (-0.5 * offset.dot(covariance.inverse() * offset)).exp();
        if density < 1.0 / 255.0 {
            continue;
        }
        count += 1;
        let weight = sigmoid(f64::from(gaussians.occupancy_logits[row])) * density;
        nothing *= 1.0 - weight;
        total += weight;
        for entry in identities.range(row) {
            *shares.entry(identities.labels[entry]).or_insert(0.0) +=
                weight * f64::from(probabilities[entry]);
        }
    }
    shares.values_mut().for_each(|share| *share /= total);
    (1.0 - nothing, shares, count)
}

#[test]
fn the_index_agrees_with_the_definition() {
    let mut rng = Pcg64::seed_from_u64(5);
    let mut covered = 0;
    for seed in 0..3 {
        let mut field = testing::field(400, seed);
        // A few that cover everything, and a few needles.
        for row in 0..5 {
            field.gaussians.log_scales[row] = [1.0, 0.5, 0.0];
            field.gaussians.log_scales[100 + row] = [-7.0, -7.0, 0.0];
        }
        let time = 0.3 * seed as f64;
        let points: Vec<DVec3> = (0..150)
            .map(|_| DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.5..1.5))))
            .collect();
        for (point, found) in points.iter().zip(field.query(&points, time)) {
            let (existence, identity, count) = brute_force(&field, *point, time);
            assert!((found.existence - existence).abs() < 1e-6, "{point}: {found:?} vs {existence}");
            assert_eq!(found.gaussians, count);
            assert_eq!(found.identity.len(), identity.len());
            for ((label, probability), (expected_label, expected)) in found.identity.iter().zip(&identity) {
                assert_eq!(label, expected_label);
                assert!((probability - expected).abs() < 1e-6);
            }
            covered += usize::from(count > 0);
        }
    }
    assert!(covered > 100, "{covered}");
}

/// One unit Gaussian at the origin, with occupancy 1/2, static, certainly instance 2.
fn single() -> Field {
    let mut field = testing::field(1, 0);
    field.deformation = None;
    field.gaussians.means[0] = [0.0; 3];
    field.gaussians.log_scales[0] = [0.0; 3];
    field.gaussians.occupancy_logits[0] = 0.0;
    field.identities = Some(Identities {
        row_offsets: vec![0, 1],
        labels: vec![2],
        log_estimates: vec![0.0],
        log_calibrations: vec![0.0],
        owners: Vec::new(),
    });
    field
}

#[test]
fn one_gaussian_by_hand() {
    let field = single();
    let edge = (2.0 * 255.0_f64.ln()).sqrt();
    let points = [0.0, 1.0, edge - 1e-6, edge + 1e-6].map(|x| DVec3::new(0.0, x, 0.0));
    let found = field.query(&points, 0.5);
    let expected = [0.5, 0.5 * (-0.5_f64).exp(), 0.5 / 255.0];
    for (found, expected) in found.iter().zip(expected) {
        assert!((found.existence - expected).abs() < 1e-7, "{found:?}");
        assert_eq!((found.identity.as_slice(), found.gaussians), (&[(2, 1.0)][..], 1));
        assert_eq!(found.instance(), Some(2));
        assert_eq!((found.gamma(2), found.gamma(1)), (found.existence, 0.0));
    }
    assert_eq!(found[3], QueryResult { existence: 0.0, identity: Vec::new(), gaussians: 0 });
    assert_eq!(found[3].instance(), None);
}

#[test]
fn coincident_gaussians_combine_as_independent_events() {
    let one = single();
    let field = Field {
        gaussians: one.gaussians.gather(&[0; 3000]),
        identities: one.identities.as_ref().map(|rows| rows.gather(&[0; 3000])),
        ..one
    };
    let at = DVec3::new(3.0, 0.0, 0.0);
    let found = &field.query(&[at], 0.0)[0];
    let weight = 0.5 * (-4.5_f64).exp();
    assert!((found.existence - (1.0 - (1.0 - weight).powi(3000))).abs() < 1e-12);
    assert_eq!((found.gaussians, found.instance()), (3000, Some(2)));
}

#[test]
fn degenerate_gaussians_and_points_are_nowhere() {
    let mut field = testing::field(3, 1);
    field.deformation = None;
    field.gaussians.means = vec![[0.0; 3]; 3];
    field.gaussians.quaternions[0] = [0.0; 4];
    field.gaussians.log_scales[1] = [f32::NAN; 3];
    field.gaussians.means[2] = [f32::INFINITY; 3];
    let found = field.query(&[DVec3::ZERO, DVec3::NAN, DVec3::INFINITY], 0.0);
    assert!(found.iter().all(|result| result.gaussians == 0 && result.existence == 0.0));
}

#[test]
fn an_empty_field_holds_nothing() {
    let empty = testing::field(0, 0);
    assert_eq!(empty.query(&[DVec3::ZERO], 0.0)[0].existence, 0.0);
    assert!(empty.query(&[], 0.0).is_empty());
}

#[test]
fn without_identities_there_is_existence_alone() {
    let field = Field { identities: None, ..single() };
    let found = &field.query(&[DVec3::ZERO], 0.0)[0];
    assert_eq!((found.existence, found.identity.len(), found.gaussians), (0.5, 0, 1));
}

#[test]
fn covering_rows_ascend() {
    let field = testing::field(300, 8);
    let at_time = FieldAtTime::new(&field, 0.25);
    let covering = at_time.covering(DVec3::new(0.1, 0.0, -0.1));
    assert!(covering.len() > 2);
    assert!(covering.windows(2).all(|pair| pair[0].0 < pair[1].0));
    assert!(covering.iter().all(|(_, density)| (MIN_DENSITY..=1.0).contains(density)));
    assert_eq!(at_time.gaussians(), &field.deformed(0.25));
}
