//! Medians and quantiles. Floats are ordered by [`f64::total_cmp`], so that a value which is not a number comes last and
//! results do not depend on the order of the input.

/// Mean of some values; `None` of none.
#[must_use]
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Median, of an even number the mean of the middle two; `None` of nothing. Sorts `values`.
pub fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    median_of_sorted(values)
}

/// As [`median`], of ascending values.
#[must_use]
pub fn median_of_sorted(values: &[f64]) -> Option<f64> {
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        count if count % 2 == 1 => Some(values[middle]),
        _ => Some((values[middle - 1] + values[middle]) / 2.0),
    }
}

/// Median, of an even number the larger of the middle two; `None` of nothing. Sorts `values`.
pub fn upper_median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Smallest value below which at least `quantile` of the weight lies; 0 without weight.
#[must_use]
pub fn weighted_quantile(values: &[f64], weights: &[f64], quantile: f64) -> f64 {
    let mut order: Vec<u32> = (0..values.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| values[a as usize].total_cmp(&values[b as usize]).then(a.cmp(&b)));
    let target = quantile * weights.iter().sum::<f64>();
    let mut sum = 0.0;
    for index in order {
        sum += weights[index as usize];
        if sum >= target && sum > 0.0 {
            return values[index as usize];
        }
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_differ_for_even_numbers_alone() {
        assert_eq!(median(&mut [5.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(upper_median(&mut [5.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [5.0, 1.0, 2.0, 4.0]), Some(3.0));
        assert_eq!(upper_median(&mut [5.0, 1.0, 2.0, 4.0]), Some(4.0));
        assert_eq!((median(&mut []), upper_median(&mut [])), (None, None));
        assert_eq!(median(&mut [f64::NAN, 1.0, 2.0]), Some(2.0), "what is no number comes last");
    }

    #[test]
    fn quantiles_follow_the_weights() {
        assert_eq!(weighted_quantile(&[3.0, 1.0, 2.0], &[1.0, 1.0, 8.0], 0.5), 2.0);
        assert_eq!(weighted_quantile(&[3.0, 1.0, 2.0], &[1.0, 1.0, 8.0], 1.0), 3.0);
        assert_eq!(weighted_quantile(&[], &[], 0.5), 0.0);
    }
}
