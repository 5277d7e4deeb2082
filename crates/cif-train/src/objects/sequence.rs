//! Values over time, of which each time prefers some and neighbours are alike: the sequence that costs least.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

/// The sequence of places in the rows of a table whose sum is least, of the values there and of the cost of going from a
/// place in the row before (row, from, to); and that sum.
pub(super) fn least(table: &[Vec<f64>], cost: impl Fn(usize, usize, usize) -> f64) -> (Vec<usize>, f64) {
    let count = table.first().map_or(0, Vec::len);
    // Least sum up to each row by the place there, and the place before it.
    let mut sums = vec![0.0; count];
    let mut before: Vec<Vec<usize>> = Vec::with_capacity(table.len());
    for (k, row) in table.iter().enumerate() {
        let reach = |to: usize| {
            let sum = |from: usize| sums[from] + cost(k, from, to);
            let best = (0..count).min_by(|a, b| sum(*a).total_cmp(&sum(*b))).unwrap_or(to);
            if k == 0 { (0.0, to) } else { (sum(best), best) }
        };
        let reached: Vec<(f64, usize)> = (0..count).map(reach).collect();
        sums = reached.iter().zip(row).map(|((sum, _), value)| sum + value).collect();
        before.push(reached.into_iter().map(|(_, from)| from).collect());
    }
    let mut at = (0..count).min_by(|a, b| sums[*a].total_cmp(&sums[*b])).unwrap_or(0);
    let sum = sums.get(at).copied().unwrap_or(0.0);
    let mut places = Vec::with_capacity(table.len());
    for from in before.iter().rev() {
        places.push(at);
        at = from[at];
    }
    places.reverse();
    (places, sum)
}

/// Takes whole turns out of the steps between neighbouring angles.
pub(super) fn unwind<'v>(angles: impl Iterator<Item = &'v mut f64>) {
    let mut last: Option<f64> = None;
    for angle in angles {
        if let Some(last) = last {
            *angle += ((last - *angle) / TAU).round() * TAU;
        }
        last = Some(*angle);
    }
}

/// Value at a time between those of others, or that of the nearest; 0 where there are none.
pub(super) fn between(values: &BTreeMap<usize, f64>, time: usize) -> f64 {
    let before = values.range(..=time).next_back();
    let after = values.range(time..).next();
    match (before, after) {
        (Some((a, x)), Some((b, y))) if b > a => x + (y - x) * (time - a) as f64 / (b - a) as f64,
        (Some((_, x)), _) | (_, Some((_, x))) => *x,
        (None, None) => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_that_prefers_another_value_follows_its_neighbours_where_changes_cost_more() {
        let table = [vec![0.0, 1.0], vec![0.6, 0.0], vec![0.0, 1.0]];
        let sequence = |change: f64| least(&table, |_, from, to| change * from.abs_diff(to) as f64);
        assert_eq!(sequence(0.2), (vec![0, 1, 0], 0.4));
        assert_eq!(sequence(0.5), (vec![0, 0, 0], 0.6));
        assert_eq!(least(&[], |_, _, _| 0.0), (Vec::new(), 0.0));
    }

    #[test]
    fn angles_go_on_beyond_a_whole_turn() {
        let mut angles = [6.0, 0.1, 6.1];
        unwind(angles.iter_mut());
        assert!((angles[1] - (0.1 + TAU)).abs() < 1e-12 && (angles[2] - 6.1).abs() < 1e-12, "{angles:?}");
    }
}
