//! A glTF file in memory: its JSON, checked for what must be understood, and its buffers.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Component, Path, PathBuf};
use std::rc::Rc;

use base64::Engine;
use cif_scene::files::{FileError, folder_of};
use gltf::json;
use serde_json::Value;

use super::pointers::{self, Pointed};
use crate::{EXTENSION, GltfError, POINTER, VISIBILITY};

/// Extensions that may be required: they are understood, or change nothing that is read.
const UNDERSTOOD: [&str; 5] =
    [EXTENSION, "KHR_mesh_quantization", VISIBILITY, POINTER, "KHR_lights_punctual"];
/// Families of extensions about surfaces, of which splats have none.
const SURFACES: [&str; 4] = ["KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_"];

/// A file that was read.
pub(crate) struct Source {
    pub(crate) path: PathBuf,
    pub(crate) root: json::Root,
    /// Channels of the first animation that show and hide nodes.
    pub(crate) pointed: Vec<Pointed>,
    /// Places of nodes that single precision does not hold, as they are written.
    pub(crate) places: BTreeMap<usize, [f64; 3]>,
    buffers: Vec<Option<Buffer>>,
    /// Bytes of all files together.
    pub(crate) bytes: u64,
}

struct Buffer {
    bytes: Rc<Vec<u8>>,
    range: Range<usize>,
}

impl Source {
    /// Reads a file and everything it refers to.
    pub(crate) fn open(path: &Path) -> Result<Self, GltfError> {
        let failed = |source| FileError::Read { path: path.to_owned(), source };
        let bytes = cif_input::read(path).map_err(failed)?;
        let (json, binary) =
            if bytes.starts_with(b"glTF") { split(path, &bytes)? } else { (0..bytes.len(), None) };
        let mut value: Value = serde_json::from_slice(&bytes[json])
            .map_err(|error| unreadable(path, &format!("its JSON is damaged ({error})")))?;
        check_version(path, &value)?;
        check_extensions(path, &value)?;
        rename_attributes(&mut value);
        let pointed = pointers::take(&mut value);
        let places = places(&value);
        let root: json::Root = serde_json::from_value(value)
            .map_err(|error| unreadable(path, &format!("its JSON does not follow glTF 2.0 ({error})")))?;
        let (buffers, size) = (Vec::new(), bytes.len() as u64);
        let mut source = Self { path: path.to_owned(), root, pointed, places, buffers, bytes: size };
        source.load_buffers(Rc::new(bytes), binary)?;
        Ok(source)
    }

    fn load_buffers(&mut self, file: Rc<Vec<u8>>, binary: Option<Range<usize>>) -> Result<(), GltfError> {
        let mut files: BTreeMap<PathBuf, Rc<Vec<u8>>> = BTreeMap::new();
        for (index, buffer) in self.root.buffers.iter().enumerate() {
            let needed = buffer.byte_length.0;
            let object = || format!("buffer {index}");
            let loaded = match (&buffer.uri, &binary) {
                (Some(uri), _) if uri.starts_with("data:") => {
                    let bytes = data_uri(uri).map_err(|what| self.invalid(object(), what))?;
                    Some(Buffer { range: 0..bytes.len(), bytes: Rc::new(bytes) })
                }
                (Some(uri), _) => {
                    let path = self.sibling(uri).map_err(|what| self.invalid(object(), what))?;
                    let bytes = match files.get(&path) {
                        Some(bytes) => Rc::clone(bytes),
                        None => {
                            let bytes =
                                self.read_beside(&path, uri).map_err(|what| self.invalid(object(), what))?;
                            self.bytes += bytes.len() as u64;
                            let bytes = Rc::new(bytes);
                            files.insert(path, Rc::clone(&bytes));
                            bytes
                        }
                    };
                    Some(Buffer { range: 0..bytes.len(), bytes })
                }
                (None, Some(range)) if index == 0 => {
                    Some(Buffer { bytes: Rc::clone(&file), range: range.clone() })
                }
                // Some compressions leave such buffers behind; they matter only when something lies in them.
                (None, _) => None,
            };
            if let Some(found) = loaded.as_ref().map(|buffer| buffer.range.len() as u64)
                && found < needed
            {
                let what = format!(
                    "{needed} bytes are announced, {found} are there: the file is cut off; copy or export it again"
                );
                return Err(self.invalid(object(), what));
            }
            self.buffers.push(loaded);
        }
        Ok(())
    }

    /// Path of a relative URI, which must stay in the folder of the file.
    fn sibling(&self, uri: &str) -> Result<PathBuf, String> {
        let scheme = uri.split_once(':').is_some_and(|(scheme, _)| {
            scheme.starts_with(|c: char| c.is_ascii_alphabetic())
                && scheme.chars().all(|c| c.is_ascii_alphanumeric() || "+.-".contains(c))
        });
        if scheme {
            return Err(format!(
                "it lies at {uri}; put that file next to this one and name it by its file name"
            ));
        }
        let name = percent_encoding::percent_decode_str(uri)
            .decode_utf8()
            .map_err(|_| format!("its URI {uri} is not UTF-8"))?;
        let relative = Path::new(name.as_ref());
        let inside =
            relative.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
        let outside = || format!("{uri} leaves the folder of the file; put the buffer next to the file");
        if !inside || name.contains('\\') || name.is_empty() {
            return Err(outside());
        }
        let missing =
            |error: std::io::Error| format!("{uri} cannot be read ({error}); put it next to the file");
        let folder = folder_of(&self.path).canonicalize().map_err(missing)?;
        // Links may lead out as well.
        let path = folder.join(relative).canonicalize().map_err(missing)?;
        if path.starts_with(&folder) { Ok(path) } else { Err(outside()) }
    }

    fn read_beside(&self, path: &Path, uri: &str) -> Result<Vec<u8>, String> {
        let failed = |error: std::io::Error| format!("{uri} cannot be read ({error})");
        cif_input::read(path).map_err(failed)
    }

    /// Bytes of a buffer view.
    pub(crate) fn view(&self, index: usize) -> Result<&[u8], String> {
        let views = &self.root.buffer_views;
        let view = views.get(index).ok_or_else(|| {
            format!("it lies in buffer view {index}, but the file has {}; export the file again", views.len())
        })?;
        let number = view.buffer.value();
        let buffer = self
            .buffers
            .get(number)
            .ok_or_else(|| format!("it lies in buffer {number}, but the file has {}", self.buffers.len()))?;
        let Some(buffer) = buffer else {
            return Err(format!(
                "it lies in buffer {number}, which has no data in the file; if it was compressed, decompress it first"
            ));
        };
        let bytes = &buffer.bytes[buffer.range.clone()];
        let start = view.byte_offset.unwrap_or_default().0;
        let end = start.checked_add(view.byte_length.0);
        match end {
            Some(end) if end <= bytes.len() as u64 => Ok(&bytes[start as usize..end as usize]),
            _ => Err(format!(
                "buffer view {index} takes {} bytes from {start} on, but buffer {number} ends at {}; export the file again",
                view.byte_length.0,
                bytes.len()
            )),
        }
    }

    pub(crate) fn invalid(&self, object: String, what: impl Into<String>) -> GltfError {
        GltfError::Invalid { path: self.path.clone(), object, what: what.into() }
    }

    /// True of files of a splat-transform whose scales are logarithms: that before 2.6.1.
    pub(crate) fn has_logarithmic_scales(&self) -> bool {
        let generator = self.root.asset.generator.as_deref().unwrap_or_default();
        let Some(version) = generator.trim().strip_prefix("splat-transform ") else { return false };
        let numbers: Vec<u32> =
            version.trim_start_matches('v').split('.').map_while(|n| n.parse().ok()).collect();
        matches!(numbers[..], [_, _, _]) && numbers[..] <= [2, 6, 0][..]
    }

    /// `node 3 "mug"`.
    pub(crate) fn node_name(&self, index: usize) -> String {
        named("node", index, self.root.nodes.get(index).and_then(|node| node.name.as_deref()))
    }

    /// `mesh 3 "mug"`.
    pub(crate) fn mesh_name(&self, index: usize) -> String {
        named("mesh", index, self.root.meshes.get(index).and_then(|mesh| mesh.name.as_deref()))
    }
}

fn named(kind: &str, index: usize, name: Option<&str>) -> String {
    match name {
        Some(name) => format!("{kind} {index} \"{name}\""),
        None => format!("{kind} {index}"),
    }
}

fn unreadable(path: &Path, reason: &str) -> GltfError {
    GltfError::Unreadable { path: path.to_owned(), reason: reason.to_owned() }
}

/// Translations of nodes and of their matrices that are farther from a number of single precision than rounding of
/// ordinary places.
fn places(value: &Value) -> BTreeMap<usize, [f64; 3]> {
    /// Metres.
    const ROUNDING: f64 = 1e-6;
    let number = |value: Option<&Value>| value.and_then(Value::as_f64);
    let place = |node: &Value| -> Option<[f64; 3]> {
        let (values, first) = match node.get("matrix") {
            Some(matrix) => (matrix, 12),
            None => (node.get("translation")?, 0),
        };
        let [x, y, z] = [0, 1, 2].map(|axis| number(values.get(first + axis)));
        Some([x?, y?, z?])
    };
    let rounded = |value: &f64| (f64::from(*value as f32) - value).abs() > ROUNDING;
    let nodes = value.get("nodes").and_then(Value::as_array).into_iter().flatten().enumerate();
    let places = nodes.filter_map(|(index, node)| Some((index, place(node)?)));
    places.filter(|(_, place)| place.iter().any(rounded)).collect()
}

/// Ranges of the JSON and of the buffer in a `.glb`.
fn split(path: &Path, bytes: &[u8]) -> Result<(Range<usize>, Option<Range<usize>>), GltfError> {
    let word =
        |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    let cut = |found: usize, needed: usize| {
        unreadable(
            path,
            &format!("{needed} bytes are announced, {found} are there: the file is cut off; copy it again"),
        )
    };
    match word(8) {
        // `gltf::Glb` subtracts the header from this length unseen.
        Some(length) if length < 20 => return Err(unreadable(path, "its header is damaged")),
        Some(length) if length > bytes.len() => return Err(cut(bytes.len(), length)),
        Some(_) => {}
        None => return Err(cut(bytes.len(), 20)),
    }
    let glb = gltf::Glb::from_slice(bytes)
        .map_err(|error| unreadable(path, &format!("the container is damaged ({error}); copy it again")))?;
    let json = 20..20 + glb.json.len();
    let start = json.end + 8;
    let binary = glb.bin.map(|binary| start..start + binary.len());
    Ok((json, binary))
}

fn data_uri(uri: &str) -> Result<Vec<u8>, String> {
    let Some((head, data)) = uri.split_once(',') else {
        return Err("its data URI has no data".to_owned());
    };
    if !head.ends_with(";base64") {
        return Ok(percent_encoding::percent_decode_str(data).collect());
    }
    let config = base64::engine::GeneralPurposeConfig::new()
        .with_decode_padding_mode(base64::engine::DecodePaddingMode::Indifferent);
    base64::engine::GeneralPurpose::new(&base64::alphabet::STANDARD, config)
        .decode(data)
        .map_err(|error| format!("its data URI is not base64 ({error})"))
}

fn check_version(path: &Path, value: &Value) -> Result<(), GltfError> {
    let version = value.pointer("/asset/version").and_then(Value::as_str);
    match version {
        Some(version) if version.starts_with("2.") => Ok(()),
        Some(version) => Err(unreadable(path, &format!("it is glTF {version}; convert it to glTF 2.0"))),
        None => Err(unreadable(path, "it names no glTF version (asset.version)")),
    }
}

fn check_extensions(path: &Path, value: &Value) -> Result<(), GltfError> {
    let required = value.get("extensionsRequired").and_then(Value::as_array).into_iter().flatten();
    for extension in required.filter_map(Value::as_str) {
        let known =
            UNDERSTOOD.contains(&extension) || SURFACES.iter().any(|prefix| extension.starts_with(prefix));
        if !known {
            return Err(unknown_extension(path, extension));
        }
    }
    Ok(())
}

/// The error for an extension without which the data cannot be read.
pub(crate) fn unknown_extension(path: &Path, extension: &str) -> GltfError {
    let (note, fix) = if extension.contains("spz") {
        (" (splats packed with SPZ)", "unpack them to plain KHR_gaussian_splatting, or to .ply")
    } else if extension.contains("meshopt") {
        (
            " (buffers packed with meshopt)",
            "unpack them, for example with: gltf-transform copy in.glb out.glb",
        )
    } else if extension.contains("draco") {
        (" (meshes packed with Draco)", "unpack them, for example with: gltf-transform copy in.glb out.glb")
    } else if extension.contains("gaussian_splatting") {
        (" (another form of splats)", "export plain KHR_gaussian_splatting")
    } else {
        ("", "export the file without it")
    };
    GltfError::UnknownExtension {
        path: path.to_owned(),
        extension: extension.to_owned(),
        note: note.to_owned(),
        fix: fix.to_owned(),
    }
}

/// `gltf-json` refuses attribute names with a colon, but keeps those that start with an underscore.
fn rename_attributes(value: &mut Value) {
    let meshes = value.get_mut("meshes").and_then(Value::as_array_mut).into_iter().flatten();
    let primitives = meshes
        .filter_map(|mesh| mesh.get_mut("primitives").and_then(Value::as_array_mut))
        .flatten()
        .filter_map(|primitive| primitive.get_mut("attributes").and_then(Value::as_object_mut));
    for attributes in primitives {
        let renamed = std::mem::take(attributes).into_iter().map(|(name, accessor)| {
            let name = if name.starts_with(EXTENSION) { format!("_{name}") } else { name };
            (name, accessor)
        });
        *attributes = renamed.collect();
    }
}
