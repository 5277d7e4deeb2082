//! The brush of Label Studio: a bit stream of runs.
//!
//! Source: `rle-pack` of thi.ng/umbrella, which Label Studio writes. 32 bits: number of values; 5: bits of a value, less
//! 1; four times 4: bits of the four lengths of counters, less 1. Then records: 1 bit that says whether one value is
//! repeated, 2 that choose the counter, the count less 1, and the value or values. Values are those of red, green, blue
//! and opacity, pixel by pixel and row by row.

use super::coverage::Coverage;

/// Bits of a code, the highest of every byte first.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Bits<'_> {
    fn read(&mut self, count: u32) -> Result<u32, String> {
        let mut value = 0;
        for _ in 0..count {
            let byte = self.bytes.get(self.at / 8).ok_or("broken brush code: it is cut short")?;
            value = value << 1 | u32::from(byte >> (7 - self.at % 8) & 1);
            self.at += 1;
        }
        Ok(value)
    }
}

/// Adds the pixels that the brush covered.
///
/// # Errors
/// When the code is cut short, or for another number of pixels.
pub(super) fn cover(bytes: &[u8], coverage: &mut Coverage) -> Result<(), String> {
    let (width, height) = (coverage.width, coverage.height);
    let mut bits = Bits { bytes, at: 0 };
    let values = u64::from(bits.read(32)?);
    let pixels = u64::from(width) * u64::from(height);
    if values != 4 * pixels {
        return Err(format!(
            "broken brush code: it has {values} values where {width} x {height} pixels of four channels have {}",
            4 * pixels
        ));
    }
    let word = bits.read(5)? + 1;
    let mut lengths = [0; 4];
    for length in &mut lengths {
        *length = bits.read(4)? + 1;
    }
    // The pixel of a value, where the value is opacity and not 0.
    let mut paint = |value: u64, opacity: u32| {
        if opacity != 0 && value % 4 == 3 {
            coverage.add(value / 4..value / 4 + 1);
        }
    };
    let mut at = 0;
    while at < values {
        let repeated = bits.read(1)? == 1;
        let counter = lengths[bits.read(2)? as usize];
        let end = at + u64::from(bits.read(counter)?) + 1;
        if end > values {
            return Err("broken brush code: a run goes beyond the picture".to_owned());
        }
        if repeated {
            let value = bits.read(word)?;
            (at..end).for_each(|place| paint(place, value));
        } else {
            for place in at..end {
                paint(place, bits.read(word)?);
            }
        }
        at = end;
    }
    Ok(())
}
