//! The set of the largest expected overlap, where members belong to it with known probabilities.

/// Rounds of Dinkelbach's method for ratios; it converges faster than linearly, and 8 agree to single precision.
const ROUNDS: usize = 8;

/// Probability above which members belong to the set whose expected intersection over union is largest; `members` are
/// weights and probabilities.
///
/// With weights `d` and probabilities `p` a set `O` has the ratio `sum_O d p / (sum d p + sum_O d (1 - p))`, which is
/// largest, with the value `v`, where `O` has the members with `p > v / (1 + v)`. 0 without any weight.
#[must_use]
pub fn bound(members: &[(f64, f64)]) -> f64 {
    let all: f64 = members.iter().map(|(weight, probability)| weight * probability).sum();
    let mut bound = 0.0;
    for _ in 0..ROUNDS {
        let (mut own, mut others) = (0.0, 0.0);
        for (weight, probability) in members.iter().filter(|(_, probability)| *probability > bound) {
            own += weight * probability;
            others += weight * (1.0 - probability);
        }
        let ratio = own / (all + others);
        if ratio.is_nan() {
            break;
        }
        bound = ratio / (1.0 + ratio);
    }
    bound
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_gives_the_largest_expected_ratio() {
        let probabilities = [0.95, 0.9, 0.7, 0.55, 0.45, 0.4, 0.3, 0.25, 0.1, 0.05];
        let members = probabilities.map(|probability| (2.0, probability));
        let all: f64 = probabilities.iter().sum();
        let ratio = |bound: f64| {
            let set: Vec<f64> = probabilities.iter().copied().filter(|p| *p > bound).collect();
            set.iter().sum::<f64>() / (all + set.iter().map(|p| 1.0 - p).sum::<f64>())
        };
        let best = (0..100).map(|k| ratio(0.01 * f64::from(k))).fold(0.0, f64::max);
        assert!((ratio(bound(&members)) - best).abs() < 1e-12);
        assert_eq!((bound(&[]), bound(&[(0.0, 0.5)])), (0.0, 0.0));
    }
}
