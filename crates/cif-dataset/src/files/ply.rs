//! Vertices of PLY files, ASCII and binary.

use std::io::BufReader;
use std::path::Path;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use super::super::points::RawPoints;
use crate::Error;

#[derive(Clone, Copy)]
struct Vertex {
    position: [f32; 3],
    color: [u8; 3],
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: [f32::NAN; 3], color: [128; 3] }
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
                if let Some(value) = value.to_u8_color_lossy() {
                    self.color[channel] = value;
                }
                return PropertyAccessResult::Set;
            }
        };
        if let Some(value) = value.to_f32_lossy() {
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
        let has = |wanted: &[&str]| wanted.iter().any(|wanted| element.properties.contains_key(*wanted));
        if !(has(&["x"]) && has(&["y"]) && has(&["z"])) {
            return Err(Error::invalid(path, "its vertices have no x, y and z"));
        }
        let colored = has(&["red", "r", "diffuse_red"])
            && has(&["green", "g", "diffuse_green"])
            && has(&["blue", "b", "diffuse_blue"]);
        let vertices = parser.read_payload_for_element(&mut reader, element, &header).map_err(damaged)?;
        return Ok(RawPoints {
            positions: vertices.iter().map(|vertex| vertex.position).collect(),
            colors: colored.then(|| vertices.iter().map(|vertex| vertex.color).collect()),
        });
    }
    Err(Error::invalid(path, "it has no element `vertex`; a point cloud is expected"))
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
