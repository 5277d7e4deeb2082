//! Vertices of PLY files, ASCII and binary.

use std::io::BufReader;
use std::path::Path;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use super::points::{RawPoints, by_range};
use crate::Error;

#[derive(Clone, Copy)]
struct Vertex {
    position: [f64; 3],
    color: [f64; 3],
}

/// A number of any type.
fn number(value: &Property) -> Option<f64> {
    match value {
        Property::Double(value) => Some(*value),
        Property::Int(value) => Some(f64::from(*value)),
        Property::UInt(value) => Some(f64::from(*value)),
        // Floats hold all smaller types exactly.
        other => other.to_f32_lossy().map(f64::from),
    }
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: [f64::NAN; 3], color: [0.0; 3] }
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        let position = match name {
            "x" => 0,
            "y" => 1,
            "z" => 2,
            _ => {
                let channel = match name {
                    "red" | "r" | "diffuse_red" => 0,
                    "green" | "g" | "diffuse_green" => 1,
                    "blue" | "b" | "diffuse_blue" => 2,
                    _ => return PropertyAccessResult::Ignored,
                };
                if let Some(value) = number(&value) {
                    self.color[channel] = value;
                }
                return PropertyAccessResult::Set;
            }
        };
        if let Some(value) = number(&value) {
            self.position[position] = value;
        }
        PropertyAccessResult::Set
    }
}

/// Reads the vertices of a PLY file, with colours where it has them.
///
/// # Errors
/// When the file is no PLY, lacks x, y, z, or is shorter than its header claims.
pub(crate) fn read_points(path: &Path) -> Result<RawPoints, Error> {
    let file = cif_input::open(path).map_err(Error::read(path))?;
    let size = file.metadata().map_err(Error::read(path))?.len();
    let mut reader = Reader::new(BufReader::new(file));
    let parser = Parser::<Vertex>::new();
    let damaged = |error: ply_rs_bw::parser::ParseError| {
        let text = error.to_string();
        Error::invalid(path, format!("not a readable PLY file ({})", text.lines().next().unwrap_or_default()))
    };
    let header = parser.read_header(&mut reader).map_err(damaged)?;
    for (name, element) in &header.elements {
        let least = smallest_size(element, header.encoding == Encoding::Ascii);
        if element.count > 0 && (least == 0 || (element.count as u64).saturating_mul(least) > size) {
            return Err(Error::invalid(
                path,
                format!(
                    "its header claims {} elements `{name}`, more than its {size} bytes can hold; copy it again",
                    element.count
                ),
            ));
        }
        if name != "vertex" {
            // Elements before the vertices are read past.
            parser.read_payload_for_element(&mut reader, element, &header).map_err(damaged)?;
            continue;
        }
        let kind = |names: &[&str]| {
            let property = names.iter().find_map(|name| element.properties.get(*name))?;
            Some(property.data_type.clone())
        };
        let has = |names: &[&str]| kind(names).is_some();
        if !(has(&["x"]) && has(&["y"]) && has(&["z"])) {
            return Err(Error::invalid(path, "its vertices have no x, y and z"));
        }
        let red = kind(&["red", "r", "diffuse_red"]);
        let colored = has(&["green", "g", "diffuse_green"]) && has(&["blue", "b", "diffuse_blue"]);
        let vertices = parser.read_payload_for_element(&mut reader, element, &header).map_err(damaged)?;
        let colors = red.filter(|_| colored).map(|kind| {
            let values: Vec<[f64; 3]> = vertices.iter().map(|vertex| vertex.color).collect();
            colors(&values, &kind)
        });
        let (colors, note) = colors.unzip();
        return Ok(RawPoints {
            positions: vertices.iter().map(|vertex| vertex.position).collect(),
            colors,
            note: note.flatten(),
        });
    }
    Err(Error::invalid(path, "it has no element `vertex`; a point cloud is expected"))
}

/// Colours of the numbers of a type, and how they were taken where it is not the one of bytes.
fn colors(values: &[[f64; 3]], kind: &PropertyType) -> (Vec<[u8; 3]>, Option<String>) {
    use ScalarType::{Char, Double, Float, UChar};
    let (PropertyType::Scalar(scalar) | PropertyType::List(_, scalar)) = kind;
    if matches!(scalar, Char | UChar) {
        // Bytes that were declared with a sign.
        let byte = |value: f64| if value < 0.0 { value + 256.0 } else { value } as u8;
        return (values.iter().map(|color| color.map(byte)).collect(), None);
    }
    let is_fraction = matches!(scalar, Float | Double);
    let (colors, end) = by_range(values, !is_fraction);
    let what = if is_fraction { "fractions" } else { "whole numbers" };
    (colors, Some(format!("its colours are {what} up to {end}")))
}

/// Fewest bytes that one element can take.
fn smallest_size(element: &ElementDef, ascii: bool) -> u64 {
    element
        .properties
        .iter()
        .map(|(_, property)| match (&property.data_type, ascii) {
            // A digit and a separator.
            (_, true) => 2,
            (PropertyType::Scalar(scalar) | PropertyType::List(scalar, _), false) => match scalar {
                ScalarType::Char | ScalarType::UChar => 1,
                ScalarType::Short | ScalarType::UShort => 2,
                ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
                ScalarType::Double => 8,
            },
        })
        // The last line of a text file may end without its separator.
        .sum::<u64>()
        .saturating_sub(u64::from(ascii))
}
