//! Reads Cryptomatte layers of EXR files: single-part or multi-part, with any lossless compression.

use std::collections::BTreeMap;
use std::path::{Component, Path};

use cif_geometry::PixelGrid;
use exr::prelude::{AttributeValue, FlatSamples};

use super::{CONVERSION, Cryptomatte, HASH, object_id};
use crate::Error;
use crate::files::exr::Headers;

/// Cryptomatte metadata in the header of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Name of the layer.
    pub layer: String,
    /// Width of the picture, pixels.
    pub width: u32,
    /// Height of the picture, pixels.
    pub height: u32,
    /// Id of every object of the manifest by name.
    pub objects: BTreeMap<String, u32>,
}

/// Reads the header of a file.
///
/// # Errors
/// When the file is missing, damaged, no EXR, or has no Cryptomatte with a manifest.
pub fn read_header(path: &Path) -> Result<Header, Error> {
    header_of(path, &Headers::read(path)?)
}

/// Cryptomatte metadata among the attributes of a file.
fn header_of(path: &Path, headers: &Headers) -> Result<Header, Error> {
    // Multi-part files keep the metadata in one part, which need not be that of the layer.
    let texts: BTreeMap<String, String> = headers
        .attributes()
        .filter_map(|(name, value)| match value {
            // Names of objects are UTF-8; `to_string` would take each byte for a character.
            AttributeValue::Text(text) if name.starts_with("cryptomatte/") => {
                Some((name, String::from_utf8_lossy(text.as_slice()).into_owned()))
            }
            _ => None,
        })
        .collect();
    let (key, layer) = choose_layer(path, &texts)?;
    let text = |name: &str| texts.get(&format!("cryptomatte/{key}/{name}"));
    if let Some(conversion) = text("conversion").filter(|conversion| *conversion != CONVERSION) {
        return Err(Error::mask(
            path,
            format!("its ids are converted by '{conversion}'; only {CONVERSION} is known"),
        ));
    }
    let manifest = match (text("manifest"), text("manif_file")) {
        (Some(manifest), _) => manifest.clone(),
        (None, Some(file)) => side_car(path, file)?,
        (None, None) => {
            return Err(Error::mask(
                path,
                format!(
                    "the Cryptomatte {layer} has no manifest, so nobody knows which object an id is; render it \
                     again with the manifest embedded"
                ),
            ));
        }
    };
    let objects = parse_manifest(path, &manifest, text("hash").is_none_or(|hash| hash == HASH))?;
    let (width, height) = headers.size;
    Ok(Header { layer, width, height, objects })
}

/// The layer of objects, as (key, name).
fn choose_layer(path: &Path, texts: &BTreeMap<String, String>) -> Result<(String, String), Error> {
    let layers: Vec<(&str, &str)> = texts
        .iter()
        .filter_map(|(name, value)| {
            let key = name.strip_prefix("cryptomatte/")?.strip_suffix("/name")?;
            Some((key, value.as_str()))
        })
        .collect();
    let objects: Vec<_> =
        layers.iter().filter(|(_, layer)| layer.to_lowercase().contains("object")).copied().collect();
    match (layers.as_slice(), objects.as_slice()) {
        ([], _) => Err(Error::mask(
            path,
            "the EXR file holds no Cryptomatte (no cryptomatte/.../name in its header); render it with the object \
             Cryptomatte switched on",
        )),
        (_, [(key, layer)]) | ([(key, layer)], _) => Ok(((*key).to_owned(), (*layer).to_owned())),
        _ => Err(Error::mask(
            path,
            format!(
                "several Cryptomattes could be meant: {}; export one of objects",
                layers.iter().map(|(_, layer)| *layer).collect::<Vec<_>>().join(", ")
            ),
        )),
    }
}

/// A manifest next to the file.
fn side_car(path: &Path, file: &str) -> Result<String, Error> {
    let inside = Path::new(file).components().all(|part| matches!(part, Component::Normal(_)));
    if !inside {
        return Err(Error::mask(path, format!("its manifest {file} lies outside its folder")));
    }
    let manifest = path.with_file_name(file);
    cif_input::read_to_string(&manifest).map_err(Error::read(&manifest))
}

fn parse_manifest(path: &Path, manifest: &str, hashed: bool) -> Result<BTreeMap<String, u32>, Error> {
    let entries: BTreeMap<String, String> = serde_json::from_str(manifest).map_err(|error| {
        Error::mask(
            path,
            format!("the manifest of its Cryptomatte cannot be read ({error}); render it again"),
        )
    })?;
    let mut objects = BTreeMap::new();
    for (name, hexadecimal) in entries {
        if name.contains('\0') {
            return Err(Error::mask(
                path,
                format!("its manifest names {name:?}, with a NUL character; leave it out"),
            ));
        }
        let id = u32::from_str_radix(&hexadecimal, 16).map_err(|_| {
            Error::mask(
                path,
                format!("the manifest gives '{name}' the id '{hexadecimal}', which is no 32-bit hexadecimal number"),
            )
        })?;
        let expected = object_id(&name);
        if hashed && id != expected {
            return Err(Error::mask(
                path,
                format!(
                    "the manifest gives '{name}' the id {id:08x}, but its {HASH} is {expected:08x}: names or ids were \
                     changed after rendering; render it again"
                ),
            ));
        }
        objects.insert(name, id);
    }
    Ok(objects)
}

/// Reads the Cryptomatte of a file.
///
/// # Errors
/// As [`read_header`], and when channels are missing, not 32-bit floats, or the file is truncated.
pub fn read(path: &Path) -> Result<Cryptomatte, Error> {
    let headers = Headers::read(path)?;
    let header = header_of(path, &headers)?;
    let mut planes: BTreeMap<(usize, usize), PixelGrid<f32>> = BTreeMap::new();
    for channel in headers.decode()?.channels() {
        let Some((rank, component)) = place_of(&header.layer, channel.part.as_deref(), &channel.name) else {
            continue;
        };
        let FlatSamples::F32(samples) = channel.samples else {
            return Err(Error::mask(
                path,
                format!(
                    "its channel {} is {}, but Cryptomatte ids survive in 32-bit floats only; export it with full \
                     float",
                    channel.name,
                    if matches!(channel.samples, FlatSamples::F16(_)) { "half" } else { "an integer" }
                ),
            ));
        };
        planes.insert((rank, component), channel.plane(samples.iter().copied(), 0.0));
    }
    let levels = planes.keys().map(|(rank, _)| rank + 1).max().unwrap_or(0);
    let mut ranks = Vec::new();
    for level in 0..levels.max(1) {
        for pair in 0..2 {
            let mut take = |component: usize| {
                planes.remove(&(level, component)).ok_or_else(|| {
                    Error::mask(
                        path,
                        format!(
                            "its channel {}{level:02}.{} is missing; render the Cryptomatte again with all its channels",
                            header.layer,
                            ["R", "G", "B", "A"][component]
                        ),
                    )
                })
            };
            let (ids, coverages) = (take(2 * pair)?, take(2 * pair + 1)?);
            ranks.push((
                ids.map(|id| id.to_bits()),
                coverages.map(|coverage| if coverage.is_finite() { coverage.clamp(0.0, 1.0) } else { 0.0 }),
            ));
        }
    }
    Ok(Cryptomatte { layer: header.layer, objects: header.objects, ranks })
}

/// Level and component (0 to 3) of a channel such as `uCryptoObject01.G`; multi-part files may keep the layer in
/// the name of the part.
fn place_of(layer: &str, part: Option<&str>, channel: &str) -> Option<(usize, usize)> {
    let in_layer = |name: &str| -> Option<(usize, usize)> {
        let (level, component) = name.strip_prefix(layer)?.split_once('.')?;
        let component = match component.to_lowercase().as_str() {
            "r" | "red" => 0,
            "g" | "green" => 1,
            "b" | "blue" => 2,
            "a" | "alpha" => 3,
            _ => return None,
        };
        // At least two digits by the specification, so that `L` itself stays free for a preview.
        let digits = level.len() >= 2 && level.bytes().all(|digit| digit.is_ascii_digit());
        Some((level.parse().ok().filter(|_| digits)?, component))
    };
    in_layer(channel).or_else(|| in_layer(&format!("{}.{channel}", part?)))
}
