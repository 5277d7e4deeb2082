//! Distribution of the colours inside a mask.

/// Bins of a channel, and of a colour.
const BINS: usize = 6;
const COLORS: usize = BINS * BINS * BINS;

/// Distribution of colours, summing to one.
#[derive(Clone, Debug)]
pub(super) struct Colors(Vec<f64>);

impl Colors {
    /// Distribution of the colours of some pixels.
    pub(super) fn of(pixels: impl Iterator<Item = [u8; 3]>) -> Self {
        let mut sum = vec![0.0; COLORS];
        let mut count = 0.0_f64;
        for color in pixels {
            add(&mut sum, color);
            count += 1.0;
        }
        sum.iter_mut().for_each(|value| *value /= count.max(1.0));
        Self(sum)
    }

    /// Mean of some, by their weights.
    pub(super) fn mean<'a>(all: impl Iterator<Item = (&'a Self, f64)>) -> Self {
        let mut sum = vec![0.0; COLORS];
        let mut count = 0.0_f64;
        for (Self(colors), weight) in all {
            count += weight;
            sum.iter_mut().zip(colors).for_each(|(sum, value)| *sum += weight * value);
        }
        sum.iter_mut().for_each(|value| *value /= count.max(1.0));
        Self(sum)
    }

    /// Bhattacharyya coefficient: 1 for equal distributions, 0 for those without a common colour.
    pub(super) fn likeness(&self, other: &Self) -> f64 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a * b).sqrt()).sum()
    }
}

/// Adds a colour to the bins around it.
fn add(sum: &mut [f64], color: [u8; 3]) {
    let places = color.map(|value| {
        let at = (f64::from(value) / 255.0 * (BINS - 1) as f64).clamp(0.0, (BINS - 1) as f64);
        let low = (at as usize).min(BINS - 2);
        (low, at - low as f64)
    });
    for corner in 0..8 {
        let (mut bin, mut share) = (0, 1.0);
        for (channel, (low, more)) in places.iter().enumerate() {
            let up = corner >> channel & 1;
            bin = bin * BINS + low + up;
            share *= if up == 1 { *more } else { 1.0 - more };
        }
        sum[bin] += share;
    }
}
