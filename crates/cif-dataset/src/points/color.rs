//! Colours for points whose source has none, or has them in numbers of another kind than bytes.

use glam::DVec3;

use super::GREY;
use crate::{Dataset, Error};

/// Training frames that are looked at.
const FRAMES: usize = 8;

/// Mean colour of the pixels onto which each point projects, over up to eight training frames spread evenly
/// over the capture; occlusion is not considered. Grey where no frame shows the point.
///
/// # Errors
/// When an image cannot be decoded.
pub(crate) fn sample_colors(dataset: &Dataset, positions: &[[f32; 3]]) -> Result<Vec<[u8; 3]>, Error> {
    let train = dataset.train_frames();
    let count = train.len().min(FRAMES);
    let mut sums = vec![([0_u32; 3], 0_u32); positions.len()];
    for k in 0..count {
        let index = train[k * train.len() / count];
        let camera = &dataset.frames[index].camera;
        let image = dataset.load_image(index, [0.5; 3])?;
        for (position, (sum, seen)) in positions.iter().zip(&mut sums) {
            let point = DVec3::from_array(position.map(f64::from));
            if let Some([x, y]) = camera.pixel_of(point) {
                let color = image.at(x, y);
                for c in 0..3 {
                    sum[c] += u32::from(color[c]);
                }
                *seen += 1;
            }
        }
    }
    Ok(sums
        .iter()
        .map(|(sum, seen)| if *seen == 0 { GREY } else { sum.map(|v| ((v + seen / 2) / seen) as u8) })
        .collect())
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
}
