//! Run-length codes of masks.
//!
//! Sources: the mask API of COCO (`maskApi.c`) for column-wise runs and their text form; the XML format of CVAT 1.1 for
//! row-wise runs inside a box. Both begin with the pixels that are not covered.

use super::brush;

/// Run-length codes in the forms of several tools.
pub(super) enum Code {
    /// COCO: column by column.
    Columns(Vec<u64>),
    /// CVAT: row by row inside a box.
    Box { left: u32, top: u32, width: u32, height: u32, counts: Vec<u64> },
    /// Label Studio: bits of four channels per pixel, of which the last is opacity.
    Brush(Vec<u8>),
}

/// Places of the covered pixels in a picture of a size, row by row, ascending.
///
/// # Errors
/// When the runs are fewer or more than the pixels.
pub(super) fn covered(code: &Code, (width, height): (u32, u32)) -> Result<Vec<u32>, String> {
    match code {
        Code::Columns(counts) => {
            let columns = places(counts, u64::from(width) * u64::from(height))?;
            let mut rows: Vec<u32> = columns.iter().map(|at| at % height * width + at / height).collect();
            rows.sort_unstable();
            Ok(rows)
        }
        Code::Box { left, top, width: box_width, height: box_height, counts } => {
            let fits = |start: u32, length: u32, whole: u32| {
                start.checked_add(length).is_some_and(|end| end <= whole)
            };
            if !fits(*left, *box_width, width) || !fits(*top, *box_height, height) {
                return Err(format!(
                    "its box of {box_width} x {box_height} pixels at ({left}, {top}) leaves the picture of {width} x \
                     {height}"
                ));
            }
            let inside = places(counts, u64::from(*box_width) * u64::from(*box_height))?;
            Ok(inside.iter().map(|at| (top + at / box_width) * width + left + at % box_width).collect())
        }
        Code::Brush(bytes) => brush::covered(bytes, (width, height)),
    }
}

/// Places of the pixels of every other run, from the second on.
fn places(counts: &[u64], pixels: u64) -> Result<Vec<u32>, String> {
    let total = counts.iter().try_fold(0_u64, |sum, count| sum.checked_add(*count));
    if total != Some(pixels) {
        let total = total.map_or_else(|| "too many".to_owned(), |total| total.to_string());
        return Err(format!(
            "broken run-length code: its runs add up to {total} pixels, the picture has {pixels}"
        ));
    }
    let mut found = Vec::new();
    let mut at = 0_u64;
    for (k, count) in counts.iter().enumerate() {
        if k % 2 == 1 {
            found.extend((at..at + count).map(|place| place as u32));
        }
        at += count;
    }
    Ok(found)
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
