//! Frames in a pipe, as portable pixmaps (PPM, `P6`), which state their own size.

use std::io::{self, BufRead, Read};

/// A frame as ffmpeg writes it.
pub(super) struct Pixmap {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) samples: Samples,
}

/// Red, green and blue of all pixels, row by row.
pub(super) enum Samples {
    Eight(Vec<u8>),
    /// Big-endian pairs of bytes.
    Sixteen(Vec<u8>),
}

/// Frames of more bytes are taken for damage.
const MOST_BYTES: u64 = 1 << 31;

/// The next frame of a pipe, into the memory of an earlier one; `None` at its end.
///
/// # Errors
/// When the pipe breaks, or holds something else.
pub(super) fn next(pipe: &mut impl BufRead, mut memory: Vec<u8>) -> io::Result<Option<Pixmap>> {
    let damaged = || io::Error::new(io::ErrorKind::InvalidData, "ffmpeg wrote no pictures");
    if pipe.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let mut words = [0_u64; 3];
    if word(pipe)? != b"P6" {
        return Err(damaged());
    }
    for value in &mut words {
        let digits = word(pipe)?;
        *value = std::str::from_utf8(&digits).ok().and_then(|text| text.parse().ok()).ok_or_else(damaged)?;
    }
    let [width, height, most] = words;
    let wide = match most {
        255 => false,
        65_535 => true,
        _ => return Err(damaged()),
    };
    let bytes = width.checked_mul(height).and_then(|pixels| pixels.checked_mul(if wide { 6 } else { 3 }));
    let bytes = bytes.filter(|bytes| (1..=MOST_BYTES).contains(bytes)).ok_or_else(damaged)?;
    memory.resize(bytes as usize, 0);
    pipe.read_exact(&mut memory)?;
    let samples = if wide { Samples::Sixteen(memory) } else { Samples::Eight(memory) };
    Ok(Some(Pixmap { width: width as u32, height: height as u32, samples }))
}

/// A word of the head, and the one space after it.
fn word(pipe: &mut impl BufRead) -> io::Result<Vec<u8>> {
    let mut word = Vec::new();
    // Longer words than any size are not read to their end.
    for byte in pipe.by_ref().take(24).bytes() {
        match byte? {
            space if space.is_ascii_whitespace() => break,
            other => word.push(other),
        }
    }
    Ok(word)
}

impl Pixmap {
    /// The memory, for another frame.
    pub(super) fn into_memory(self) -> Vec<u8> {
        match self.samples {
            Samples::Eight(memory) | Samples::Sixteen(memory) => memory,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_follow_each_other() {
        let mut pipe = b"P6\n2 1\n255\n123456P6\n1 1\n65535\nabcdef".as_slice();
        let first = next(&mut pipe, Vec::new()).unwrap().unwrap();
        assert!(matches!(&first.samples, Samples::Eight(samples) if samples == b"123456"));
        assert_eq!((first.width, first.height), (2, 1));
        let second = next(&mut pipe, first.into_memory()).unwrap().unwrap();
        assert!(matches!(&second.samples, Samples::Sixteen(samples) if samples == b"abcdef"));
        assert!(next(&mut pipe, Vec::new()).unwrap().is_none());
    }

    #[test]
    fn damage_is_refused_before_memory_is_taken() {
        for damaged in
            ["P5\n1 1\n255\n1", "P6\n1 1\n255\n12", "P6\n9999999 9999999\n255\n1", "P6\n1 x\n255\n123"]
        {
            assert!(next(&mut damaged.as_bytes(), Vec::new()).is_err(), "{damaged}");
        }
    }
}
