//! Which rungs nothing else beats, and what the next dB costs.

/// Gains below this count as none: dB, and points of IoU.
const NOTHING: (f64, f64) = (0.02, 0.1);

/// For each (cost, value), true when it is on the Pareto front: no other one costs no more and gives no less, and one
/// of the two strictly. Values that are missing are never on it.
#[must_use]
pub(super) fn front(points: &[(f64, Option<f64>)]) -> Vec<bool> {
    let beats = |(cost, value): (f64, Option<f64>), (other_cost, other_value): (f64, Option<f64>)| {
        value >= other_value && cost <= other_cost && (value > other_value || cost < other_cost)
    };
    points
        .iter()
        .map(|point| {
            point.1.is_some() && !points.iter().any(|other| other.1.is_some() && beats(*other, *point))
        })
        .collect()
}

/// A step from one rung to the next one up.
#[derive(Clone, Copy, Debug)]
pub(super) struct Climb {
    /// Added cost.
    pub cost: f64,
    /// Added PSNR, dB.
    pub psnr: Option<f64>,
    /// Added IoU over the whole image, points.
    pub iou: Option<f64>,
}

/// In one sentence what a climb costs; `unit` is that of the cost.
#[must_use]
pub(super) fn sentence(from: &str, to: &str, climb: &Climb, unit: &str) -> String {
    let price = |gain: Option<f64>, nothing: f64, name: &str, one: &str| {
        let gain = gain?;
        Some(if gain.abs() < nothing {
            format!("leaves {name} as it is")
        } else if gain < 0.0 {
            format!("loses {:.2} {one}", -gain)
        } else if climb.cost > 0.0 {
            format!("brings {gain:.2} {one}, at {} per {one}", amount(climb.cost / gain, unit))
        } else {
            format!("brings {gain:.2} {one}")
        })
    };
    let gains: Vec<String> =
        [price(climb.psnr, NOTHING.0, "PSNR", "dB"), price(climb.iou, NOTHING.1, "IoU", "points of IoU")]
            .into_iter()
            .flatten()
            .map(|text| text.replace("per points of IoU", "per point"))
            .collect();
    let cost = if climb.cost >= 0.0 {
        format!("costs {} more", amount(climb.cost, unit))
    } else {
        format!("saves {}", amount(-climb.cost, unit))
    };
    match gains.is_empty() {
        true => format!("From {from} to {to}: {cost}."),
        false => format!("From {from} to {to}: {cost} and {}.", gains.join(", and ")),
    }
}

/// A cost with a sensible number of digits.
#[must_use]
pub(super) fn amount(value: f64, unit: &str) -> String {
    match (unit, value.abs()) {
        ("B", size) if size >= 1e6 => format!("{:.2} MB", value / 1e6),
        ("B", _) => format!("{:.1} kB", value / 1e3),
        ("s", size) if size < 1.0 => format!("{:.1} ms", 1e3 * value),
        (_, size) if size < 100.0 => format!("{value:.1} {unit}"),
        _ => format!("{value:.0} {unit}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points =
            [(1.0, Some(20.0)), (2.0, Some(25.0)), (3.0, Some(24.0)), (4.0, Some(25.0)), (0.5, None)];
        assert_eq!(front(&points), [true, true, false, false, false]);
        // Equal points do not beat each other.
        assert_eq!(front(&[(1.0, Some(1.0)), (1.0, Some(1.0))]), [true, true]);
    }

    #[test]
    fn climbs_are_described_in_one_sentence() {
        let climb = |cost, psnr, iou| Climb { cost, psnr, iou };
        let text = sentence("a", "b", &climb(100.0, Some(0.5), Some(2.0)), "s");
        assert_eq!(
            text,
            "From a to b: costs 100 s more and brings 0.50 dB, at 200 s per dB, and brings 2.00 points of IoU, at \
             50.0 s per point."
        );
        let text = sentence("a", "b", &climb(-10.0, Some(-0.5), Some(0.05)), "s");
        assert_eq!(text, "From a to b: saves 10.0 s and loses 0.50 dB, and leaves IoU as it is.");
        assert_eq!(sentence("a", "b", &climb(2e6, None, None), "B"), "From a to b: costs 2.00 MB more.");
        assert_eq!(amount(0.0123, "s"), "12.3 ms");
    }
}
