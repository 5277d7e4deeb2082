//! Points as files hold them.

use std::path::Path;

use super::npy;
use crate::Error;

/// Points of a file.
pub(crate) struct RawPoints {
    /// In double precision: worlds of surveyors begin so far away that floats are half a metre apart.
    pub(crate) positions: Vec<[f64; 3]>,
    pub(crate) colors: Option<Vec<[u8; 3]>>,
    /// How numbers of an unusual type were taken as colours.
    pub(crate) note: Option<String>,
}

/// Reads `points.npy`: `[P, 3]` world positions.
///
/// # Errors
/// When the file is not an array of that shape.
pub(crate) fn read_npy(path: &Path) -> Result<RawPoints, Error> {
    let matrix = npy::read_matrix(path)?;
    if matrix.columns != 3 {
        return Err(Error::invalid(
            path,
            format!("shape [{}, {}] where [points, 3] is expected", matrix.rows, matrix.columns),
        ));
    }
    Ok(RawPoints {
        positions: matrix.values.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect(),
        colors: None,
        note: None,
    })
}

impl RawPoints {
    /// Drops points that are not finite in single precision, and says how many.
    pub(crate) fn retain_finite(&mut self) -> usize {
        let keep: Vec<bool> =
            self.positions.iter().map(|p| p.iter().all(|v| (*v as f32).is_finite())).collect();
        let dropped = keep.iter().filter(|keep| !**keep).count();
        if dropped > 0 {
            let mut flags = keep.iter();
            self.positions.retain(|_| *flags.next().expect("one flag per point"));
            if let Some(colors) = &mut self.colors {
                let mut flags = keep.iter();
                colors.retain(|_| *flags.next().expect("one flag per point"));
            }
        }
        dropped
    }
}

/// Ranges in which colours are stored, by their largest number.
const RANGES: [f64; 3] = [1.0, 255.0, 65_535.0];

/// How far fractions may overshoot their range, as colours of models do: ranges are hundreds of times as large as the next.
const OVERSHOOT: f64 = 2.0;

/// Colours out of numbers that are no bytes: the range is the smallest of 0 to 1 (of fractions alone), 0 to 255 and 0 to
/// 65 535 that holds all of them, or nearly so; returned with its end.
pub(crate) fn by_range(values: &[[f64; 3]], whole: bool) -> (Vec<[u8; 3]>, f64) {
    let largest = values.iter().flatten().copied().filter(|value| value.is_finite()).fold(0.0, f64::max);
    let (ranges, slack) = if whole { (&RANGES[1..], 1.0) } else { (&RANGES[..], OVERSHOOT) };
    let end = ranges.iter().copied().find(|end| largest <= slack * end).unwrap_or(RANGES[2]);
    let byte = |value: f64| (255.0 * value / end).round().clamp(0.0, 255.0) as u8;
    (values.iter().map(|color| color.map(byte)).collect(), end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_range_tells_what_numbers_mean() {
        let of = |color: [f64; 3], whole| by_range(&[color, [0.0, f64::NAN, 0.0]], whole);
        assert_eq!(of([1.0, 0.5, 0.0], false).0[0], [255, 128, 0]);
        assert_eq!(of([200.0, 100.0, 0.0], false), (vec![[200, 100, 0], [0; 3]], 255.0));
        assert_eq!(of([1.0, 1.0, 0.0], true).0[0], [1, 1, 0]);
        assert_eq!(of([65_535.0, 32_768.0, 257.0], true).0[0], [255, 128, 1]);
        assert_eq!(of([51_400.0, 0.0, 0.0], false).1, 65_535.0);
    }

    #[test]
    fn non_finite_points_are_dropped_with_their_colors() {
        let mut points = RawPoints {
            positions: vec![[0.0; 3], [f64::NAN, 0.0, 0.0], [2.0; 3]],
            colors: Some(vec![[1; 3], [2; 3], [3; 3]]),
            note: None,
        };
        assert_eq!(points.retain_finite(), 1);
        assert_eq!(points.positions, vec![[0.0; 3], [2.0; 3]]);
        assert_eq!(points.colors, Some(vec![[1; 3], [3; 3]]));
    }
}
