//! Arrays of the binary buffer: views of the graph's own arrays, converted while they are written, so that
//! a scene is never held twice.

use std::io::{self, Write};
use std::ops::Range;

use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};
use cif_scene::{IdentityShares, Splats};

use crate::conventions;

/// An array of the buffer.
pub(crate) enum Array<'a> {
    /// Centres.
    Means(&'a [[f32; 3]]),
    /// Fallback colours of points: RGB in linear light and opacity, normalised 16 bits.
    Colors(&'a Splats, Range<usize>),
    /// (w, x, y, z) to (x, y, z, w).
    Orientations(&'a [[f32; 4]]),
    /// Standard deviations.
    Scales(&'a [[f32; 3]]),
    /// One coefficient of every splat, RGB.
    Coefficient(&'a Splats, Range<usize>, usize),
    /// One number per splat.
    Numbers(&'a [f32]),
    /// Rows of the field: low and high 16 bits, as unsigned integers of 32 bits are not allowed in attributes.
    Rows(&'a [u32]),
    /// Ids of the instances that splats may belong to.
    Ids(&'a [IdentityShares]),
    /// Their shares.
    Shares(&'a [IdentityShares]),
    /// Keys of animations.
    Keys(Vec<f32>),
    /// Keys of animations that are true or false.
    Flags(Vec<bool>),
}

impl Array<'_> {
    /// Bytes in the buffer; a multiple of 4 for all of them.
    pub(crate) fn bytes(&self) -> u64 {
        let (count, size) = match self {
            Self::Means(values) | Self::Scales(values) => (values.len(), 12),
            Self::Colors(_, range) => (range.len(), 8),
            Self::Orientations(values) => (values.len(), 16),
            Self::Coefficient(_, range, _) => (range.len(), 12),
            Self::Numbers(values) => (values.len(), 4),
            Self::Rows(values) => (values.len(), 4),
            Self::Ids(values) => (values.len(), 8),
            Self::Shares(values) => (values.len(), 16),
            Self::Keys(values) => (values.len(), 4),
            Self::Flags(values) => (values.len().div_ceil(4), 4),
        };
        count as u64 * size
    }

    /// Writes it, little endian.
    pub(crate) fn write(&self, out: &mut impl Write) -> io::Result<()> {
        match self {
            Self::Means(values) | Self::Scales(values) => blocks(out, values, |v| v.map(f32::to_le_bytes)),
            Self::Orientations(values) => {
                blocks(out, values, |&[w, x, y, z]| [x, y, z, w].map(f32::to_le_bytes))
            }
            Self::Numbers(values) => blocks(out, values, |v| [v.to_le_bytes()]),
            Self::Keys(values) => blocks(out, values, |v| [v.to_le_bytes()]),
            Self::Flags(values) => {
                let mut bytes: Vec<u8> = values.iter().map(|value| u8::from(*value)).collect();
                bytes.resize(bytes.len().next_multiple_of(4), 0);
                out.write_all(&bytes)
            }
            Self::Rows(values) => blocks(out, values, |v| [v.to_le_bytes()]),
            Self::Ids(values) => blocks(out, values, |v| {
                let [a, b, c, d] = v.map(|entry| entry.id.to_le_bytes());
                [[a[0], a[1], b[0], b[1]], [c[0], c[1], d[0], d[1]]]
            }),
            Self::Shares(values) => blocks(out, values, |v| v.map(|entry| entry.share.to_le_bytes())),
            Self::Coefficient(splats, range, index) => {
                let stride = 3 * coefficient_count(splats.sh_degree);
                let rows = &splats.sh_coefficients[range.start * stride..range.end * stride];
                let mut buffer = Vec::with_capacity(BLOCK * 12);
                for block in rows.chunks(BLOCK * stride) {
                    buffer.clear();
                    for row in block.chunks_exact(stride) {
                        for value in &row[3 * index..3 * index + 3] {
                            buffer.extend_from_slice(&value.to_le_bytes());
                        }
                    }
                    out.write_all(&buffer)?;
                }
                Ok(())
            }
            Self::Colors(splats, range) => {
                let stride = 3 * coefficient_count(splats.sh_degree);
                let rows = splats.sh_coefficients[range.start * stride..range.end * stride]
                    .chunks_exact(stride)
                    .zip(&splats.opacities[range.clone()]);
                let table = LinearTable::new();
                let mut buffer = Vec::with_capacity(BLOCK * 8);
                for (row, opacity) in rows {
                    for &coefficient in &row[..3] {
                        let color = 0.5 + BAND_0 as f32 * coefficient;
                        buffer.extend_from_slice(&table.linear(color).to_le_bytes());
                    }
                    buffer.extend_from_slice(&unorm16(*opacity).to_le_bytes());
                    if buffer.len() == BLOCK * 8 {
                        out.write_all(&buffer)?;
                        buffer.clear();
                    }
                }
                out.write_all(&buffer)
            }
        }
    }
}

/// Values converted at a time.
const BLOCK: usize = 4096;

fn blocks<T, const N: usize>(
    out: &mut impl Write,
    values: &[T],
    convert: impl Fn(&T) -> [[u8; 4]; N],
) -> io::Result<()> {
    let mut buffer = Vec::with_capacity(BLOCK * 4 * N);
    for block in values.chunks(BLOCK) {
        buffer.clear();
        for value in block {
            buffer.extend_from_slice(convert(value).as_flattened());
        }
        out.write_all(&buffer)?;
    }
    Ok(())
}

fn unorm16(value: f32) -> u16 {
    (value.clamp(0.0, 1.0) * 65_535.0).round() as u16
}

/// Linear light of display-referred values, in steps finer than a display shows; powers are slow.
struct LinearTable(Vec<u16>);

impl LinearTable {
    const STEPS: f32 = 4095.0;

    fn new() -> Self {
        let steps = 0..=Self::STEPS as u16;
        Self(steps.map(|k| unorm16(conventions::linear_from_srgb(f32::from(k) / Self::STEPS))).collect())
    }

    fn linear(&self, display: f32) -> u16 {
        self.0[(display.clamp(0.0, 1.0) * Self::STEPS).round() as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(array: &Array<'_>) -> Vec<u8> {
        let mut out = Vec::new();
        array.write(&mut out).unwrap();
        assert_eq!(out.len() as u64, array.bytes());
        out
    }

    fn floats(array: &Array<'_>) -> Vec<f32> {
        written(array).chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    }

    #[test]
    fn coefficients_are_gathered_by_index() {
        let splats = Splats {
            sh_degree: 1,
            sh_coefficients: (0..36).map(|k| k as f32).collect(),
            opacities: vec![1.0; 3],
            ..Splats::default()
        };
        assert_eq!(floats(&Array::Coefficient(&splats, 1..3, 2)), [18.0, 19.0, 20.0, 30.0, 31.0, 32.0]);
    }

    #[test]
    fn long_arrays_are_written_whole() {
        let values: Vec<f32> = (0..3 * BLOCK + 7).map(|k| k as f32).collect();
        assert_eq!(floats(&Array::Numbers(&values)), values);
        let splats = Splats {
            sh_coefficients: vec![0.0; 3 * values.len()],
            opacities: vec![1.0; values.len()],
            ..Splats::default()
        };
        let colors = written(&Array::Colors(&splats, 0..values.len()));
        // Mid grey of a display is 21 % of linear light.
        let grey = unorm16(conventions::linear_from_srgb(0.5)).to_le_bytes();
        assert!((13_900..14_200).contains(&u16::from_le_bytes(grey)));
        let close = |bytes: &[u8]| {
            let value = u16::from_le_bytes([bytes[0], bytes[1]]);
            value.abs_diff(u16::from_le_bytes(grey)) < 12
        };
        assert!(colors.chunks_exact(8).all(|c| close(c) && c[6..] == [255, 255]));
    }

    #[test]
    fn quaternions_and_rows_change_their_layout() {
        assert_eq!(floats(&Array::Orientations(&[[1.0, 2.0, 3.0, 4.0]])), [2.0, 3.0, 4.0, 1.0]);
        assert_eq!(written(&Array::Rows(&[0x0003_0002])), [2, 0, 3, 0]);
    }
}
