//! PLY files of splats, ASCII and binary, whatever the order of their properties.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_scene::assemble::{AssembleError, Prim, Prims, assemble};
use cif_scene::files::FileError;
use cif_scene::{CaptureFrame, SceneGraph, Splats, UpAxis};
use ply_rs_bw::parser::{ParseError, Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use crate::PlyError;
use crate::pose::turn_up;
use crate::write::{TURNED, WORLD_OFFSET, WORLD_SCALE};

/// Positions of what is read in a row.
const POSITION: usize = 0;
const OPACITY: usize = 3;
const SCALE: usize = 4;
const ROTATION: usize = 7;
const COLOR: usize = 11;
const REST: usize = 14;
const SLOTS: usize = REST + 45;

/// Rows reserved before any is seen.
const FIRST_ROWS: usize = 1 << 16;

/// An element that is read past.
struct Ignored;

impl PropertyAccess for Ignored {
    fn new() -> Self {
        Self
    }

    fn set_property(&mut self, _: &str, _: Property) -> PropertyAccessResult {
        PropertyAccessResult::Ignored
    }
}

/// Reads splats: INRIA layout, ASCII or binary of either byte order, properties in any order, spherical harmonics
/// of degree 0 to 3. They become one still object that carries the file's name, occupied and certain of its
/// identity, in the axes of the file, or as captured where we turned them; `rows` count the splats of the file.
///
/// # Errors
/// No PLY, cut off, or without what a splat needs; the message says what is missing.
pub fn read(path: &Path) -> Result<SceneGraph, PlyError> {
    let failed = |source| FileError::Read { path: path.to_owned(), source };
    let invalid = |what: String| PlyError::Invalid { path: path.to_owned(), what };
    let file = cif_input::open(path).map_err(failed)?;
    let size = file.metadata().map_err(failed)?.len();
    let mut reader = Reader::new(BufReader::with_capacity(1 << 16, file));
    let parser = Parser::<Ignored>::new();
    let damaged = |error: ParseError| {
        let text = error.to_string();
        invalid(format!("not a readable PLY file ({})", text.lines().next().unwrap_or_default()))
    };
    let header = parser.read_header(&mut reader).map_err(damaged)?;
    let frame = frame(&header.comments).map_err(invalid)?;
    for (name, element) in &header.elements {
        let ascii = header.encoding == Encoding::Ascii;
        let least = smallest_size(element, ascii);
        if element.count > 0 && (least == 0 || (element.count as u64).saturating_mul(least) > size) {
            return Err(invalid(format!(
                "its header claims {} elements `{name}`, more than its {size} bytes can hold: it is cut off or damaged; copy it again",
                element.count
            )));
        }
        if name != "vertex" {
            // Elements before the splats are read past.
            parser.read_payload_for_element(&mut reader, element, &header).map_err(damaged)?;
            continue;
        }
        let columns = Columns::of(element, header.encoding).map_err(invalid)?;
        let (mut splats, left_out) = columns
            .read(reader.get_mut(), element.count)
            .map_err(|what| invalid(format!("{what}; copy it again")))?;
        match turned(&header.comments) {
            Some(UpAxis::Y) => turn_up(&mut splats, UpAxis::Y, UpAxis::Z),
            Some(UpAxis::Z) => turn_up(&mut splats, UpAxis::Z, UpAxis::Y),
            None => {}
        }
        if splats.is_empty() {
            return Err(invalid(format!("none of its {} splats can be drawn", element.count)));
        }
        return scene(path, splats, left_out, frame).map_err(|error| invalid(error.to_string()));
    }
    Err(invalid("it has no element `vertex`; splats are expected".to_owned()))
}

/// True where the file is one of ours.
fn is_ours(comments: &[String]) -> bool {
    comments.first().is_some_and(|comment| comment.trim_start().starts_with("cif "))
}

/// The axis that one of our files was turned to.
fn turned(comments: &[String]) -> Option<UpAxis> {
    let mut ours = comments.iter().filter(|_| is_ours(comments));
    ours.find_map(|comment| comment.trim().strip_prefix(TURNED)?.trim().parse().ok())
}

/// Where our comments place the scene in the world of its capture.
fn frame(comments: &[String]) -> Result<CaptureFrame, String> {
    let mut frame = CaptureFrame::default();
    if !is_ours(comments) {
        return Ok(frame);
    }
    let numbers = |comment: &str, name: &str| -> Option<Option<Vec<f64>>> {
        let words = comment.trim().strip_prefix(name)?.split_ascii_whitespace();
        Some(words.map(|word| word.parse().ok()).collect())
    };
    for comment in comments {
        let wrong = || format!("its comment '{}' tells no place; remove it", comment.trim());
        if let Some(offset) = numbers(comment, WORLD_OFFSET) {
            frame.offset = offset.and_then(|offset| offset.try_into().ok()).ok_or_else(wrong)?;
        } else if let Some(scale) = numbers(comment, WORLD_SCALE) {
            let [scale] = scale.and_then(|scale| scale.try_into().ok()).ok_or_else(wrong)?;
            frame.scale = scale;
        } else {
            continue;
        }
        if !frame.is_valid() {
            return Err(wrong());
        }
    }
    Ok(frame)
}

/// Where in an element the values of a splat stand.
struct Columns {
    encoding: Encoding,
    /// Type, byte offset in a binary row, and slot, per property.
    properties: Vec<(ScalarType, usize, Option<usize>)>,
    row_bytes: usize,
    degree: u8,
}

impl Columns {
    fn of(element: &ElementDef, encoding: Encoding) -> Result<Self, String> {
        let has = |name: &str| element.properties.contains_key(name);
        if has("packed_position") {
            return Err(
                "its splats are packed (compressed PLY); unpack them, for example with: splat-transform in.compressed.ply out.ply"
                    .to_owned(),
            );
        }
        let required = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"];
        let numbered = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
        let missing: Vec<&str> = required.into_iter().chain(numbered).filter(|name| !has(name)).collect();
        if missing.len() > 10 && has("x") {
            return Err(
                "it is a point cloud without splats; scale_*, rot_*, opacity and f_dc_* are expected"
                    .to_owned(),
            );
        }
        if !missing.is_empty() {
            return Err(format!("its splats have no {}; export them whole", missing.join(", ")));
        }
        let rest = (0..).take_while(|k| has(&format!("f_rest_{k}"))).count();
        let all = element.properties.keys().filter(|name| name.starts_with("f_rest_")).count();
        let degree = match rest {
            0 => 0,
            9 => 1,
            24 => 2,
            45 => 3,
            _ => 4,
        };
        if degree > 3 || all != rest {
            return Err(format!(
                "it has {all} properties f_rest_*; 0, 9, 24 or 45 without gaps are expected (degrees 0 to 3)"
            ));
        }
        let mut properties = Vec::new();
        let mut row_bytes = 0;
        for (name, property) in &element.properties {
            let PropertyType::Scalar(scalar) = &property.data_type else {
                return Err(format!("the property {name} of its splats is a list; remove it"));
            };
            properties.push((scalar.clone(), row_bytes, slot(name, rest)));
            row_bytes += scalar_size(scalar);
        }
        Ok(Self { encoding, properties, row_bytes, degree })
    }

    /// Splats, and how many could not be used.
    fn read(&self, input: &mut impl BufRead, count: usize) -> Result<(Splats, usize), String> {
        let mut collected = Collected::new(self.degree, count.min(FIRST_ROWS));
        let mut slots = [0.0_f32; SLOTS];
        let mut bytes = vec![0_u8; self.row_bytes];
        let mut line = String::new();
        for number in 0..count {
            let cut = || format!("it ends after {number} of {count} splats, so it was cut off");
            if self.encoding == Encoding::Ascii {
                line.clear();
                // A line longer than any row of numbers is not read on and on.
                let read = input.by_ref().take(64 * self.properties.len() as u64 + 64).read_line(&mut line);
                if read.map_err(|error| format!("splat {number} is not text ({error})"))? == 0 {
                    return Err(cut());
                }
                self.parse(&line, &mut slots).map_err(|what| format!("splat {number}: {what}"))?;
            } else {
                input.read_exact(&mut bytes).map_err(|_| cut())?;
                self.decode(&bytes, &mut slots);
            }
            collected.push(number as u32, &slots);
        }
        Ok((collected.splats, collected.left_out))
    }

    fn parse(&self, line: &str, slots: &mut [f32; SLOTS]) -> Result<(), String> {
        let mut words = line.split_ascii_whitespace();
        for (_, _, slot) in &self.properties {
            let word =
                words.next().ok_or_else(|| format!("{} numbers are expected", self.properties.len()))?;
            if let Some(slot) = slot {
                slots[*slot] = word.parse().map_err(|_| format!("'{word}' is not a number"))?;
            }
        }
        if words.next().is_some() {
            return Err(format!("more than {} numbers in a line", self.properties.len()));
        }
        Ok(())
    }

    fn decode(&self, row: &[u8], slots: &mut [f32; SLOTS]) {
        let swapped = self.encoding == Encoding::BinaryBigEndian;
        for (scalar, offset, slot) in &self.properties {
            if let Some(slot) = slot {
                slots[*slot] = number(&row[*offset..], scalar, swapped);
            }
        }
    }
}

/// Slot of a property; that of `f_rest_*` counts coefficients first and channels last, as ours do.
fn slot(name: &str, rest: usize) -> Option<usize> {
    let numbered = |prefix: &str| name.strip_prefix(prefix)?.parse::<usize>().ok();
    match name {
        "x" => return Some(POSITION),
        "y" => return Some(POSITION + 1),
        "z" => return Some(POSITION + 2),
        "opacity" => return Some(OPACITY),
        _ => {}
    }
    if let Some(k) = numbered("scale_").filter(|k| *k < 3) {
        return Some(SCALE + k);
    }
    if let Some(k) = numbered("rot_").filter(|k| *k < 4) {
        return Some(ROTATION + k);
    }
    if let Some(k) = numbered("f_dc_").filter(|k| *k < 3) {
        return Some(COLOR + k);
    }
    let per_channel = rest / 3;
    numbered("f_rest_").filter(|k| *k < rest).map(|k| REST + 3 * (k % per_channel) + k / per_channel)
}

fn scalar_size(scalar: &ScalarType) -> usize {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

fn number(bytes: &[u8], scalar: &ScalarType, swapped: bool) -> f32 {
    fn take<const N: usize>(bytes: &[u8], swapped: bool) -> [u8; N] {
        let mut taken: [u8; N] = std::array::from_fn(|k| bytes[k]);
        if swapped {
            taken.reverse();
        }
        taken
    }
    match scalar {
        ScalarType::Char => f32::from(bytes[0] as i8),
        ScalarType::UChar => f32::from(bytes[0]),
        ScalarType::Short => f32::from(i16::from_le_bytes(take(bytes, swapped))),
        ScalarType::UShort => f32::from(u16::from_le_bytes(take(bytes, swapped))),
        ScalarType::Int => i32::from_le_bytes(take(bytes, swapped)) as f32,
        ScalarType::UInt => u32::from_le_bytes(take(bytes, swapped)) as f32,
        ScalarType::Float => f32::from_le_bytes(take(bytes, swapped)),
        ScalarType::Double => f64::from_le_bytes(take(bytes, swapped)) as f32,
    }
}

/// Fewest bytes that one element can take.
fn smallest_size(element: &ElementDef, ascii: bool) -> u64 {
    let size = |data_type: &PropertyType| match data_type {
        // A digit and a separator.
        _ if ascii => 2,
        PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => scalar_size(scalar) as u64,
    };
    let bytes: u64 = element.properties.iter().map(|(_, property)| size(&property.data_type)).sum();
    // The last line of a text file may end without its separator.
    bytes.saturating_sub(u64::from(ascii))
}

/// Splats as they are collected, in post-activation form.
struct Collected {
    splats: Splats,
    left_out: usize,
}

impl Collected {
    fn new(degree: u8, rows: usize) -> Self {
        let mut splats = Splats { sh_degree: degree, ..Splats::default() };
        splats.means.reserve(rows);
        splats.orientations.reserve(rows);
        splats.scales.reserve(rows);
        splats.sh_coefficients.reserve(rows * 3 * coefficient_count(degree));
        Self { splats, left_out: 0 }
    }

    fn push(&mut self, row: u32, slots: &[f32; SLOTS]) {
        let splats = &mut self.splats;
        let three = |at: usize| [slots[at], slots[at + 1], slots[at + 2]];
        let mean = three(POSITION);
        let scale = three(SCALE).map(|log| log.exp().max(f32::MIN_POSITIVE));
        let rotation: [f32; 4] = std::array::from_fn(|k| slots[ROTATION + k]);
        let harmonics = &slots[COLOR..COLOR + 3 * coefficient_count(splats.sh_degree)];
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        let usable = finite(&mean) && finite(&scale) && finite(harmonics) && !slots[OPACITY].is_nan();
        let Some(rotation) = quaternion::try_normalize(rotation).filter(|_| usable) else {
            self.left_out += 1;
            return;
        };
        splats.means.push(mean);
        splats.orientations.push(rotation);
        splats.scales.push(scale);
        splats.opacities.push(1.0 / (1.0 + (-slots[OPACITY]).exp()));
        splats.sh_coefficients.extend_from_slice(harmonics);
        splats.occupancies.push(1.0);
        splats.identity_probabilities.push(1.0);
        splats.rows.push(row);
    }
}

/// A still scene of one object, labelled by the name of the file.
fn scene(
    path: &Path,
    splats: Splats,
    left_out: usize,
    frame: CaptureFrame,
) -> Result<SceneGraph, AssembleError> {
    let label =
        path.file_stem().map_or_else(|| "splats".to_owned(), |stem| stem.to_string_lossy().into_owned());
    let mut warnings = Vec::new();
    if left_out > 0 {
        warnings.push(format!(
            "{left_out} splats with values that are not finite, or without a rotation, were left out"
        ));
    }
    let prims = vec![Prim::still(path.display().to_string(), label, splats)];
    assemble(Prims { frame, prims, warnings, ..Prims::default() })
}
