//! Numbers in a block of bytes, packed as the eye allows.

use half::bf16;

use crate::document::{Array, Kept};

/// A block of bytes that arrays are added to.
#[derive(Clone, Debug, Default)]
pub(crate) struct Block(Vec<u8>);

impl Block {
    /// All bytes.
    pub(crate) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    fn add(&mut self, kind: Kept, scale: f32, length: usize, bytes: impl IntoIterator<Item = u8>) -> Array {
        let at = self.0.len();
        self.0.extend(bytes);
        self.0.resize(self.0.len().next_multiple_of(4), 0);
        Array { at, length, kind, scale }
    }

    /// Values as they are.
    pub(crate) fn exact(&mut self, values: &[f32]) -> Array {
        self.add(Kept::F32, 1.0, values.len(), values.iter().flat_map(|value| value.to_le_bytes()))
    }

    /// Values to 1 part in 256, whatever their size.
    pub(crate) fn rounded(&mut self, values: &[f32]) -> Array {
        let bytes = values.iter().flat_map(|value| bf16::from_f32(*value).to_le_bytes());
        self.add(Kept::Bf16, 1.0, values.len(), bytes)
    }

    /// Values to 1 part in 65 534 of the largest.
    pub(crate) fn fine(&mut self, values: &[f32]) -> Array {
        let scale = step(values, f32::from(i16::MAX));
        let bytes = values.iter().flat_map(|value| ((value / scale).round() as i16).to_le_bytes());
        self.add(Kept::I16, scale, values.len(), bytes)
    }

    /// Values to 1 part in 254 of the largest.
    pub(crate) fn coarse(&mut self, values: &[f32]) -> Array {
        let scale = step(values, f32::from(i8::MAX));
        let bytes = values.iter().flat_map(|value| ((value / scale).round() as i8).to_le_bytes());
        self.add(Kept::I8, scale, values.len(), bytes)
    }
}

/// The step between stored integers so that the largest value is `most` of them; 1 where all values are 0.
fn step(values: &[f32], most: f32) -> f32 {
    let largest = values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
    // Steps below the smallest normal number would make infinities of divisions.
    let step = largest / most;
    if step >= f32::MIN_POSITIVE { step } else { 1.0 }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Values as the page reads them.
    pub(crate) fn read(array: Array, bytes: &[u8]) -> Vec<f32> {
        let of = |width: usize| bytes[array.at..array.at + array.length * width].chunks_exact(width);
        let values: Vec<f32> = match array.kind {
            Kept::F32 => of(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect(),
            Kept::Bf16 => of(2).map(|b| bf16::from_le_bytes(b.try_into().unwrap()).to_f32()).collect(),
            Kept::I16 => of(2).map(|b| f32::from(i16::from_le_bytes(b.try_into().unwrap()))).collect(),
            Kept::I8 => of(1).map(|b| f32::from(b[0].cast_signed())).collect(),
        };
        values.into_iter().map(|value| value * array.scale).collect()
    }

    #[test]
    fn values_come_back_as_precisely_as_stated() {
        let values = [0.0_f32, -3.25, 1e-3, 2.5, 0.7, -0.1, 3.1];
        let mut block = Block::default();
        let arrays =
            [block.exact(&values), block.rounded(&values), block.fine(&values), block.coarse(&values)];
        let tiny = [block.fine(&[0.0, 1e-44]), block.coarse(&[0.0; 3]), block.exact(&[])];
        let bytes = block.into_bytes();
        let allowed = |value: f32| [0.0, value.abs() / 256.0, 3.25 / 65_534.0, 3.25 / 254.0];
        for (kind, array) in arrays.into_iter().enumerate() {
            assert_eq!(array.at % 4, 0);
            for (stored, value) in read(array, &bytes).into_iter().zip(values) {
                assert!(
                    (stored - value).abs() <= allowed(value)[kind] * 1.001,
                    "{:?}: {stored} {value}",
                    array.kind
                );
            }
        }
        assert_eq!(read(tiny[0], &bytes), [0.0; 2]);
        assert_eq!(read(tiny[1], &bytes), [0.0; 3]);
        assert_eq!(tiny[2].length, 0);
    }
}
