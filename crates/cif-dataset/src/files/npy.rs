//! Two-dimensional NumPy arrays of floats.

use std::path::Path;

use npyz::{NpyFile, Order};

use crate::Error;

/// Longest header text accepted; NumPy writes about 120 bytes.
const MAX_HEADER: usize = 4096;

/// A matrix, row by row.
pub(crate) struct Matrix {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    /// `[rows * columns]`.
    pub(crate) values: Vec<f64>,
}

/// Reads a matrix of 4- or 8-byte floats.
///
/// # Errors
/// When the file is not such a matrix, or shorter than its header claims.
pub(crate) fn read_matrix(path: &Path) -> Result<Matrix, Error> {
    let bytes = cif_input::read(path).map_err(Error::read(path))?;
    check_header(&bytes).map_err(|problem| Error::invalid(path, problem))?;
    let file = NpyFile::new(bytes.as_slice())
        .map_err(|error| Error::invalid(path, format!("not a NumPy array ({error})")))?;
    let (rows, columns) = match *file.shape() {
        [rows, columns] => (rows as usize, columns as usize),
        ref shape => {
            return Err(Error::invalid(path, format!("shape {shape:?} where two dimensions are expected")));
        }
    };
    let order = file.order();
    let short = |error| Error::invalid(path, format!("cut short or damaged ({error}); copy it again"));
    let values: Vec<f64> = match file.try_data::<f64>() {
        Ok(data) => data.collect::<Result<_, _>>().map_err(short)?,
        Err(file) => match file.try_data::<f32>() {
            Ok(data) => data.map(|v| v.map(f64::from)).collect::<Result<_, _>>().map_err(short)?,
            Err(file) => {
                return Err(Error::invalid(
                    path,
                    format!(
                        "elements of type {} where 4- or 8-byte floats are expected",
                        file.dtype().descr()
                    ),
                ));
            }
        },
    };
    let values = match order {
        Order::C => values,
        Order::Fortran => (0..rows)
            .flat_map(|r| (0..columns).map(move |c| (r, c)))
            .map(|(r, c)| values[c * rows + r])
            .collect(),
    };
    Ok(Matrix { rows, columns, values })
}

/// Rejects headers that would make the parser allocate, recurse or overflow.
fn check_header(bytes: &[u8]) -> Result<(), String> {
    let short = || "cut short: no NumPy header; copy it again".to_owned();
    if bytes.get(..6) != Some(b"\x93NUMPY".as_slice()) {
        return Err("not a NumPy array (.npy)".to_owned());
    }
    let (start, length) = match bytes.get(6).ok_or_else(short)? {
        1 => (
            10,
            usize::from(u16::from_le_bytes([
                *bytes.get(8).ok_or_else(short)?,
                *bytes.get(9).ok_or_else(short)?,
            ])),
        ),
        _ => {
            let size = bytes.get(8..12).ok_or_else(short)?;
            (12, u32::from_le_bytes([size[0], size[1], size[2], size[3]]) as usize)
        }
    };
    if length > MAX_HEADER {
        return Err(format!("header of {length} bytes; a plain array of floats is expected"));
    }
    let header = bytes.get(start..start + length).ok_or_else(short)?;
    if header.iter().filter(|c| b"([{".contains(c)).count() > 8 {
        return Err("structured array; a plain array of floats is expected".to_owned());
    }
    // Every number in the header, shape included, times the others must stay below the file size: the product
    // of the shape is then safe too. Item sizes are single digits.
    let text = String::from_utf8_lossy(header);
    let shape = text.split("'shape'").nth(1).unwrap_or("").split(')').next().unwrap_or("");
    let mut product: u64 = 1;
    for number in shape.split(|c: char| !c.is_ascii_digit()).filter(|part| !part.is_empty()) {
        let value: u64 = number.parse().map_err(|_| format!("dimension {number} is too large"))?;
        product = product
            .checked_mul(value.max(1))
            .filter(|product| *product <= bytes.len() as u64)
            .ok_or_else(|| "its header claims more elements than the file holds; copy it again".to_owned())?;
    }
    Ok(())
}
