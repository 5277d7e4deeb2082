//! Run-length codes of masks.
//!
//! Sources: the mask API of COCO (`maskApi.c`) for column-wise runs and their text form; the XML format of CVAT 1.1 for
//! row-wise runs inside a box. Both begin with the pixels that are not covered.

use std::ops::Range;

use super::brush;
use super::coverage::Coverage;

/// Run-length codes in the forms of several tools.
pub(super) enum Code {
    /// COCO: column by column.
    Columns(Vec<u64>),
    /// CVAT: row by row inside a box.
    Box { left: u32, top: u32, width: u32, height: u32, counts: Vec<u64> },
    /// Label Studio: bits of four channels per pixel, of which the last is opacity.
    Brush(Vec<u8>),
}

/// Adds the pixels that a code covers.
///
/// # Errors
/// When the runs are fewer or more than the pixels.
pub(super) fn cover(code: &Code, coverage: &mut Coverage) -> Result<(), String> {
    let (width, height) = (u64::from(coverage.width), u64::from(coverage.height));
    match code {
        Code::Columns(counts) => {
            for run in runs(counts, width * height)? {
                for at in run {
                    let place = at % height * width + at / height;
                    coverage.add(place..place + 1);
                }
            }
            Ok(())
        }
        Code::Box { left, top, width: box_width, height: box_height, counts } => {
            let [left, top, box_width, box_height] = [*left, *top, *box_width, *box_height].map(u64::from);
            if left + box_width > width || top + box_height > height {
                return Err(format!(
                    "its box of {box_width} x {box_height} pixels at ({left}, {top}) leaves the picture of {width} x \
                     {height}"
                ));
            }
            for run in runs(counts, box_width * box_height)? {
                // Row by row of the box.
                let mut at = run.start;
                while at < run.end {
                    let (x, y) = (at % box_width, at / box_width);
                    let length = (box_width - x).min(run.end - at);
                    let place = (top + y) * width + left + x;
                    coverage.add(place..place + length);
                    at += length;
                }
            }
            Ok(())
        }
        Code::Brush(bytes) => brush::cover(bytes, coverage),
    }
}

/// Every other run, from the second on, which are covered.
fn runs(counts: &[u64], pixels: u64) -> Result<impl Iterator<Item = Range<u64>>, String> {
    let total = counts.iter().try_fold(0_u64, |sum, count| sum.checked_add(*count));
    if total != Some(pixels) {
        let total = total.map_or_else(|| "too many".to_owned(), |total| total.to_string());
        return Err(format!(
            "broken run-length code: its runs add up to {total} pixels, the picture has {pixels}"
        ));
    }
    let mut at = 0;
    let all = counts.iter().enumerate().map(move |(k, count)| {
        at += count;
        (k, at - count..at)
    });
    Ok(all.filter(|(k, _)| k % 2 == 1).map(|(_, run)| run))
}

/// Runs from the text form of COCO: groups of five bits, low ones first, each in a letter from `0` on; from the fourth
/// run on, differences to the run before the last.
///
/// # Errors
/// When a letter is none of the code, the text stops inside a number, or a run is negative.
pub(super) fn from_text(text: &str) -> Result<Vec<u64>, String> {
    let mut counts: Vec<i64> = Vec::new();
    let mut letters = text.bytes();
    while let Some(first) = letters.next() {
        let (mut value, mut shift, mut letter) = (0_i64, 0, first);
        loop {
            let bits = letter.checked_sub(48).filter(|bits| *bits < 64).ok_or_else(|| {
                format!("broken run-length code: {:?} is no letter of it", char::from(letter))
            })?;
            if shift > 50 {
                return Err("broken run-length code: a run of more than 50 bits".to_owned());
            }
            value |= i64::from(bits & 31) << shift;
            shift += 5;
            if bits & 32 == 0 {
                if bits & 16 != 0 {
                    value |= -1_i64 << shift;
                }
                break;
            }
            letter = letters.next().ok_or("broken run-length code: it stops inside a number")?;
        }
        if counts.len() > 2 {
            value += counts[counts.len() - 2];
        }
        if value < 0 {
            return Err("broken run-length code: a run of negative length".to_owned());
        }
        counts.push(value);
    }
    Ok(counts.into_iter().map(|count| count as u64).collect())
}
