//! NumPy arrays of numbers: `.npy` files and members of `.npz` archives.

use std::io::{BufReader, Cursor, Read};
use std::path::Path;

use npyz::{Deserialize, NpyFile, Order};
use zip::ZipArchive;

use super::MAX_DEFLATE_RATIO;
use crate::Error;

/// Longest header text accepted; NumPy writes about 120 bytes.
const MAX_HEADER: usize = 4096;

/// Most elements of a packed array: a few bytes of an archive can stand for many, which are then all in memory.
const MAX_PACKED: u64 = 1 << 27;

/// An array of any number of dimensions.
pub(crate) struct Array<T = f64> {
    /// Lengths of the dimensions.
    pub(crate) shape: Vec<usize>,
    /// Values in C order: the last dimension varies fastest.
    pub(crate) values: Vec<T>,
}

/// A matrix, row by row.
pub(crate) struct Matrix {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    /// `[rows * columns]`.
    pub(crate) values: Vec<f64>,
}

/// Types that the elements of an array may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Elements {
    /// Floats of 4 or 8 bytes.
    Floats,
    /// Integers of 1 to 8 bytes, signed or not, of which those below 2^53 are exact.
    Integers,
}

/// Reads a matrix of 4- or 8-byte floats.
///
/// # Errors
/// When the file is not such a matrix, or shorter than its header claims.
pub(crate) fn read_matrix(path: &Path) -> Result<Matrix, Error> {
    let Array { shape, values } = read_floats(path)?;
    match *shape {
        [rows, columns] => Ok(Matrix { rows, columns, values }),
        _ => Err(Error::invalid(path, format!("shape {shape:?} where two dimensions are expected"))),
    }
}

/// Reads an array of 4- or 8-byte floats.
///
/// # Errors
/// As [`read_matrix`], for any number of dimensions.
pub(crate) fn read_floats(path: &Path) -> Result<Array, Error> {
    let bytes = cif_input::read(path).map_err(Error::read(path))?;
    parse(&*bytes, bytes.len() as u64, Elements::Floats, Ok).map_err(|problem| Error::invalid(path, problem))
}

/// Reads an array of ids, integers of 0 to 65 535: a `.npy` file, or a `.npz` archive that holds one array.
///
/// # Errors
/// When the file is damaged, of other elements, or an archive of several arrays, or an id is outside of the range.
pub(crate) fn read_ids(path: &Path) -> Result<Array<u16>, Error> {
    let id = |value: f64| {
        let fits = (0.0..=65_535.0).contains(&value);
        fits.then_some(value as u16)
            .ok_or_else(|| format!("id {value} is outside 0 to 65535; give the object a smaller one"))
    };
    if !super::listing::has_extension(path, &["npz"]) {
        let bytes = cif_input::read(path).map_err(Error::read(path))?;
        return parse(&*bytes, bytes.len() as u64, Elements::Integers, id)
            .map_err(|problem| Error::invalid(path, problem));
    }
    let mut archive = Archive::open(path)?;
    let names: Vec<String> = archive
        .zip
        .file_names()
        .map(|name| name.map_or_else(|_| "?".to_owned(), |name| name.into_owned()))
        .collect();
    match names.as_slice() {
        [name] => archive.read(name.strip_suffix(".npy").unwrap_or(name), Elements::Integers, id),
        _ => Err(Error::invalid(
            path,
            format!("{} arrays where one of ids is expected: {}", names.len(), names.join(", ")),
        )),
    }
}

/// An opened `.npz` archive.
pub(crate) struct Archive<'a> {
    path: &'a Path,
    zip: ZipArchive<Cursor<Vec<u8>>>,
    /// Bytes that a member can hold at most.
    limit: u64,
}

impl<'a> Archive<'a> {
    /// Opens an archive as `numpy.savez` and `numpy.savez_compressed` write them.
    ///
    /// # Errors
    /// When the file cannot be read, or is no archive.
    pub(crate) fn open(path: &'a Path) -> Result<Self, Error> {
        let bytes = cif_input::read(path).map_err(Error::read(path))?;
        let limit = (bytes.len() as u64).saturating_mul(MAX_DEFLATE_RATIO);
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|error| {
            Error::invalid(path, format!("not a NumPy archive (.npz), or cut short ({error}); copy it again"))
        })?;
        Ok(Self { path, zip, limit })
    }

    /// Reads an array by its name.
    ///
    /// # Errors
    /// When the archive lacks it, or it is damaged or of other elements.
    pub(crate) fn array(&mut self, name: &str, elements: Elements) -> Result<Array, Error> {
        self.read(name, elements, Ok)
    }

    fn read<T: Copy>(
        &mut self,
        name: &str,
        elements: Elements,
        into: impl Fn(f64) -> Result<T, String>,
    ) -> Result<Array<T>, Error> {
        let path = self.path;
        let invalid = |problem: String| Error::invalid(path, format!("array `{name}`: {problem}"));
        let damaged = |error: &dyn std::fmt::Display| invalid(format!("damaged ({error}); copy it again"));
        let index = self.zip.index_for_name(&format!("{name}.npy"));
        let index = index.ok_or_else(|| invalid("missing; write the file with numpy.savez again".into()))?;
        let member = self.zip.by_index(index).map_err(|error| damaged(&error))?;
        // Unpacked while it is read: the bytes are never all in memory.
        let size = member.size().min(self.limit);
        let mut reader = BufReader::new(member.take(self.limit));
        let array = parse(&mut reader, size, elements, into).map_err(invalid)?;
        // The end has the check sum of all.
        std::io::copy(&mut reader, &mut std::io::sink()).map_err(|error| damaged(&error))?;
        Ok(array)
    }
}

/// Reads a `.npy` file of so many bytes at the most; the error is the problem alone.
fn parse<T: Copy>(
    mut reader: impl Read,
    size: u64,
    elements: Elements,
    into: impl Fn(f64) -> Result<T, String>,
) -> Result<Array<T>, String> {
    let head = read_header(&mut reader, size)?;
    // Boxed, as the file is handed back by every type that does not fit.
    let whole: Box<dyn Read + '_> = Box::new(Cursor::new(head).chain(reader));
    let file = NpyFile::new(whole).map_err(|error| format!("not a NumPy array ({error})"))?;
    let shape: Vec<usize> = file.shape().iter().map(|length| *length as usize).collect();
    let order = file.order();
    let values = match elements {
        Elements::Floats => {
            values::<f64, _, _>(file, &into).or_else(|file| values::<f32, _, _>(file, |v| into(v.into())))
        }
        Elements::Integers => values::<i64, _, _>(file, |v| into(v as f64))
            .or_else(|file| values::<u64, _, _>(file, |v| into(v as f64)))
            .or_else(|file| values::<i32, _, _>(file, |v| into(v.into())))
            .or_else(|file| values::<u32, _, _>(file, |v| into(v.into())))
            .or_else(|file| values::<i16, _, _>(file, |v| into(v.into())))
            .or_else(|file| values::<u16, _, _>(file, |v| into(v.into())))
            .or_else(|file| values::<i8, _, _>(file, |v| into(v.into())))
            .or_else(|file| values::<u8, _, _>(file, |v| into(v.into())))
            // Of one object: true is 1.
            .or_else(|file| values::<bool, _, _>(file, |v| into(u8::from(v).into()))),
    };
    let values = values.unwrap_or_else(|file| {
        let expected = match elements {
            Elements::Floats => "4- or 8-byte floats",
            Elements::Integers => "integers",
        };
        Err(format!("elements of type {} where {expected} are expected", file.dtype().descr()))
    })?;
    let values = if order == Order::Fortran { in_c_order(&shape, &values) } else { values };
    Ok(Array { shape, values })
}

/// The values of an array whose elements are of a type; the file itself where they are of another.
fn values<E: Deserialize, R: Read, T>(
    file: NpyFile<R>,
    into: impl Fn(E) -> Result<T, String>,
) -> Result<Result<Vec<T>, String>, NpyFile<R>> {
    let data = file.try_data::<E>()?;
    let damaged = |error: std::io::Error| format!("cut short or damaged ({error}); copy it again");
    Ok(data.map(|value| into(value.map_err(damaged)?)).collect())
}

/// Values whose first dimension varies fastest, so that the last one does.
fn in_c_order<T: Copy>(shape: &[usize], values: &[T]) -> Vec<T> {
    let mut index = vec![0; shape.len()];
    (0..values.len())
        .map(|_| {
            let place = shape.iter().zip(&index).rev().fold(0, |place, (length, at)| place * length + at);
            for (at, length) in index.iter_mut().zip(shape).rev() {
                *at += 1;
                if *at < *length {
                    break;
                }
                *at = 0;
            }
            values[place]
        })
        .collect()
}

/// The bytes of the header, up to the first element. Headers that would make the parser allocate, recurse or overflow are
/// refused.
fn read_header(reader: &mut impl Read, size: u64) -> Result<Vec<u8>, String> {
    let mut head = Vec::new();
    let mut more = |head: &mut Vec<u8>, length: usize| {
        let from = head.len();
        reader
            .by_ref()
            .take(length as u64)
            .read_to_end(head)
            .map_err(|error| format!("damaged ({error}); copy it again"))?;
        if head.len() < from + length {
            return Err("cut short: no NumPy header; copy it again".to_owned());
        }
        Ok(())
    };
    let magic = b"\x93NUMPY";
    more(&mut head, magic.len() + 2).map_err(|_| "not a NumPy array (.npy)".to_owned())?;
    if !head.starts_with(magic) {
        return Err("not a NumPy array (.npy)".to_owned());
    }
    let length = match head[6] {
        1 => {
            more(&mut head, 2)?;
            usize::from(u16::from_le_bytes([head[8], head[9]]))
        }
        _ => {
            more(&mut head, 4)?;
            u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize
        }
    };
    if length > MAX_HEADER {
        return Err(format!("header of {length} bytes; a plain array of floats is expected"));
    }
    let start = head.len();
    more(&mut head, length)?;
    let header = &head[start..];
    if header.iter().filter(|c| b"([{".contains(c)).count() > 8 {
        return Err("structured array; a plain array of floats is expected".to_owned());
    }
    // Every number in the header, shape included, times the others must stay below the size: the product
    // of the shape is then safe too. Item sizes are single digits.
    let text = String::from_utf8_lossy(header);
    let shape = text.split("'shape'").nth(1).unwrap_or("").split(')').next().unwrap_or("");
    let mut product: u64 = 1;
    for number in shape.split(|c: char| !c.is_ascii_digit()).filter(|part| !part.is_empty()) {
        let value: u64 = number.parse().map_err(|_| format!("dimension {number} is too large"))?;
        product = product
            .checked_mul(value.max(1))
            .filter(|product| *product <= size)
            .ok_or_else(|| "its header claims more elements than the file holds; copy it again".to_owned())?;
    }
    if product > MAX_PACKED {
        let shape = shape.trim_start_matches([':', ' ', '(']);
        return Err(format!(
            "[{shape}] = {product} elements, more than {MAX_PACKED} at once; save them as several files, such as one per \
             frame"
        ));
    }
    Ok(head)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A version 1.0 file.
    fn file(descr: &str, fortran: &str, shape: &str, data: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn parsed(bytes: &[u8], elements: Elements) -> Result<Array, String> {
        parse(bytes, bytes.len() as u64, elements, Ok)
    }

    #[test]
    fn arrays_of_three_dimensions_are_read_in_either_order() {
        let data: Vec<u8> = (0..12).flat_map(|k| (k as f32).to_le_bytes()).collect();
        let c = parsed(&file("<f4", "False", "(2, 3, 2)", &data), Elements::Floats).unwrap();
        assert_eq!((c.shape, c.values), (vec![2, 3, 2], (0..12).map(f64::from).collect()));
        let f = parsed(&file("<f4", "True", "(2, 3, 2)", &data), Elements::Floats).unwrap();
        // Element (i, j, k) lies at i + 2 (j + 3 k).
        let expected = [0.0, 6.0, 2.0, 8.0, 4.0, 10.0, 1.0, 7.0, 3.0, 9.0, 5.0, 11.0];
        assert_eq!((f.shape, f.values), (vec![2, 3, 2], expected.to_vec()));
    }

    #[test]
    fn integers_of_any_width_are_read_and_floats_are_distinguished() {
        for (descr, data) in [
            ("<i8", 7_i64.to_le_bytes().to_vec()),
            ("<u8", 7_u64.to_le_bytes().to_vec()),
            ("<i4", 7_i32.to_le_bytes().to_vec()),
            ("<u2", 7_u16.to_le_bytes().to_vec()),
            ("|u1", vec![7]),
        ] {
            let array = parsed(&file(descr, "False", "(1,)", &data), Elements::Integers).unwrap();
            assert_eq!((array.shape, array.values), (vec![1], vec![7.0]), "{descr}");
        }
        let floats = file("<f8", "False", "(1,)", &7_f64.to_le_bytes());
        let message = parsed(&floats, Elements::Integers).err().unwrap();
        assert!(message.contains("integers are expected"), "{message}");
    }

    #[test]
    fn short_files_are_refused() {
        let message = parsed(&file("<f8", "False", "(2, 1)", &[0; 12]), Elements::Floats).err().unwrap();
        assert!(message.contains("cut short"), "{message}");
        let message = parsed(&file("<f8", "False", "(2, 100000)", &[0; 12]), Elements::Floats).err().unwrap();
        assert!(message.contains("more elements than the file holds"), "{message}");
    }

    #[test]
    fn packed_arrays_are_refused_by_what_they_would_take() {
        // 600 frames of zeros: 1032 times smaller when they are packed.
        let header = file("|u1", "False", "(600, 1024, 1024)", &[]);
        let size = header.len() as u64 + 600 * (1 << 20);
        let message = parse(header.chain(std::io::repeat(0)), size, Elements::Integers, Ok).err().unwrap();
        assert!(message.contains("[600, 1024, 1024] = 629145600 elements"), "{message}");
    }
}
