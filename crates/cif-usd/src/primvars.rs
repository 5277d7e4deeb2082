//! Values per point: repetitions, colours and their checksum.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};

/// View-independent colours `clamp(0.5 + 0.28209 c0)`, display-referred, of splat-major coefficients.
pub(crate) fn base_colors(coefficients: &[f32], degree: u8) -> Vec<[f32; 3]> {
    coefficients
        .chunks_exact(3 * coefficient_count(degree))
        .map(|sh| std::array::from_fn(|c| (0.5 + BAND_0 as f32 * sh[c]).clamp(0.0, 1.0)))
        .collect()
}

/// Integers as USD has them; -1 for what has none ([`cif_scene::Splats::NO_ROW`]). Other counts beyond `i32` do
/// not occur: they would be 400 GB of splats.
pub(crate) fn as_ints(values: &[u32]) -> Vec<i32> {
    values.iter().map(|&value| i32::try_from(value).unwrap_or(-1)).collect()
}

/// Inverse of [`as_ints`].
pub(crate) fn from_ints(values: &[i32]) -> Vec<u32> {
    values.iter().map(|&value| u32::try_from(value).unwrap_or(cif_scene::Splats::NO_ROW)).collect()
}

/// Multiplicative hashing: keys are bit patterns that nobody chooses to collide.
#[derive(Default)]
struct Multiply(u64);

impl Hasher for Multiply {
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 32)
    }

    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.write_u32(u32::from(byte));
        }
    }

    fn write_u32(&mut self, value: u32) {
        self.0 = (self.0.rotate_left(23) ^ u64::from(value)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }

    fn write_usize(&mut self, value: usize) {
        self.write_u32(value as u32);
    }
}

/// Values without repetitions in the order of first appearance, and an index per value; no indices where
/// nothing repeats. Validators ask for indices as soon as one value repeats (requirement VG.009).
pub(crate) fn without_repetitions<const C: usize>(values: &[[f32; C]]) -> (Vec<[f32; C]>, Option<Vec<i32>>) {
    let mut places: HashMap<[u32; C], i32, BuildHasherDefault<Multiply>> =
        HashMap::with_capacity_and_hasher(values.len(), BuildHasherDefault::default());
    let mut unique: Vec<[f32; C]> = Vec::with_capacity(values.len());
    let mut indices = Vec::with_capacity(values.len());
    for value in values {
        // Adding 0 makes one zero of both.
        let value = value.map(|component| component + 0.0);
        let next = unique.len() as i32;
        let index = *places.entry(value.map(f32::to_bits)).or_insert(next);
        if index == next {
            unique.push(value);
        }
        indices.push(index);
    }
    let repeats = unique.len() < values.len();
    (unique, repeats.then_some(indices))
}

/// Indices that every value has, where `always` asks for them although nothing repeats.
pub(crate) fn indices_or_all(indices: Option<Vec<i32>>, count: usize, always: bool) -> Option<Vec<i32>> {
    indices.or_else(|| always.then(|| (0..count as i32).collect()))
}

/// Checksum of colours: 16 hexadecimal digits, the same on every machine.
pub(crate) fn checksum(colors: &[[f32; 3]]) -> String {
    let mut hash = Multiply(0xcbf2_9ce4_8422_2325);
    for component in colors.as_flattened() {
        hash.write_u32((component + 0.0).to_bits());
    }
    format!("{:016x}", hash.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_values_are_kept_once() {
        let (unique, indices) = without_repetitions(&[[1.0, 2.0], [0.0, 3.0], [1.0, 2.0], [-0.0, 3.0]]);
        assert_eq!(unique, [[1.0, 2.0], [0.0, 3.0]]);
        assert_eq!(indices.unwrap(), [0, 1, 0, 1]);
        assert_eq!(without_repetitions(&[[1.0], [2.0]]), (vec![[1.0], [2.0]], None));
    }

    #[test]
    fn checksums_tell_colours_apart() {
        let colors = [[0.1, 0.2, 0.3], [0.0, 0.5, 1.0]];
        assert_eq!(checksum(&colors), checksum(&[[0.1, 0.2, 0.3], [-0.0, 0.5, 1.0]]));
        assert_ne!(checksum(&colors), checksum(&[[0.1, 0.2, 0.3], [0.0, 0.5, 0.999]]));
        assert_ne!(checksum(&colors), checksum(&[colors[1], colors[0]]));
    }

    #[test]
    fn colours_come_from_the_first_coefficients() {
        let mut coefficients = vec![9.0; 24];
        coefficients[..3].copy_from_slice(&[0.0, 1.0, -10.0]);
        coefficients[12..15].copy_from_slice(&[10.0, 0.0, 0.0]);
        let colors = base_colors(&coefficients, 1);
        assert_eq!(colors, [[0.5, 0.5 + BAND_0 as f32, 0.0], [1.0, 0.5, 0.5]]);
    }
}
