//! Another label for an object of a file: only the JSON changes, everything else is copied.

use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use cif_output::NewFile;
use cif_scene::files::{FileError, folder_of, target_of};
use serde_json::{Value, json};

use crate::{GltfError, Relabelled};

/// Marks of a `.glb`.
const MAGIC: &[u8; 4] = b"glTF";
const JSON_CHUNK: &[u8; 4] = b"JSON";

/// Gives an object another label, and another class where one is given. `object` is a mask value or the name of a
/// node. Nodes of ours keep their names; of other files the name of the node is its label, so that is what changes.
/// The file is written anew next to `output`, which may be `path` itself, and then takes its place.
///
/// # Errors
/// A file that is missing, damaged or no glTF, no such object or several, an output of another kind, or in another
/// folder while the file names others next to it. Nothing existing is touched then.
pub fn relabel(
    path: &Path,
    output: &Path,
    object: &str,
    label: &str,
    category: Option<&str>,
) -> Result<Relabelled, GltfError> {
    let read = |source| FileError::Read { path: path.to_owned(), source };
    let unreadable = |reason: String| GltfError::Unreadable { path: path.to_owned(), reason };
    let invalid = |what: String| GltfError::Invalid {
        path: path.to_owned(),
        object: format!("object '{object}'"),
        what,
    };
    if output.extension() != path.extension() {
        return Err(invalid(format!("{} has another ending; keep that of the file", output.display())));
    }
    let file = cif_input::open(path).map_err(read)?;
    let size = file.metadata().map_err(read)?.len();
    let mut file = BufReader::new(file);
    let mut start = Vec::new();
    file.by_ref().take(20).read_to_end(&mut start).map_err(read)?;
    let binary = start.starts_with(MAGIC);
    let mut text = Vec::new();
    if binary {
        let word = |at: usize| -> Option<u64> {
            let bytes: [u8; 4] = start.get(at..at + 4)?.try_into().ok()?;
            Some(u64::from(u32::from_le_bytes(bytes)))
        };
        let length = word(12).filter(|length| start.get(16..20) == Some(JSON_CHUNK) && 20 + length <= size);
        let length =
            length.ok_or_else(|| unreadable("its first chunk is no JSON; export it again".into()))?;
        file.by_ref().take(length).read_to_end(&mut text).map_err(read)?;
    } else {
        text.extend_from_slice(&start);
        file.read_to_end(&mut text).map_err(read)?;
    }
    let mut document: Value = serde_json::from_slice(&text)
        .map_err(|error| unreadable(format!("its JSON is damaged ({error}); export it again")))?;
    let target = target_of(output, false)?;
    let folder = |path: &Path| std::fs::canonicalize(folder_of(path)).ok();
    let original = std::fs::canonicalize(path).map_err(read)?;
    if folder(&original) != folder(&target) && names_files(&document) {
        return Err(invalid(format!(
            "the file names others next to it, which {} would not find; write into the same folder",
            output.display()
        )));
    }
    let done = edit(&mut document, object, label, category).map_err(invalid)?;
    let mut json = serde_json::to_vec(&document)
        .map_err(|error| unreadable(format!("its JSON cannot be written again ({error})")))?;
    if binary {
        json.resize(json.len().next_multiple_of(4), b' ');
    }
    let rest = size.saturating_sub(20 + text.len() as u64);
    let whole = 20 + json.len() as u64 + rest;
    let whole =
        u32::try_from(whole).map_err(|_| GltfError::TooLarge { path: output.to_owned(), bytes: whole })?;
    let written = crate::write::written(output, |out| {
        if binary {
            out.write_all(&start[..8])?;
            out.write_all(&whole.to_le_bytes())?;
            out.write_all(&(json.len() as u32).to_le_bytes())?;
            out.write_all(JSON_CHUNK)?;
        }
        out.write_all(&json)?;
        if binary {
            io::copy(&mut file, out)?;
        }
        Ok(())
    });
    let unwritable = |source| FileError::Write { path: output.to_owned(), source };
    written.and_then(NewFile::finish).map_err(unwritable)?;
    Ok(done)
}

/// True when buffers or images lie in files of their own.
fn names_files(document: &Value) -> bool {
    ["buffers", "images"].iter().any(|key| {
        document[*key].as_array().is_some_and(|list| {
            list.iter().any(|one| one["uri"].as_str().is_some_and(|uri| !uri.starts_with("data:")))
        })
    })
}

fn edit(
    document: &mut Value,
    object: &str,
    label: &str,
    category: Option<&str>,
) -> Result<Relabelled, String> {
    let Some(nodes) = document.get_mut("nodes").and_then(Value::as_array_mut) else {
        return Err("the file has no nodes".to_owned());
    };
    let name = |node: &Value| node["name"].as_str().unwrap_or_default().to_owned();
    let is_object = |node: &Value| {
        // Nodes of others count by their mesh; of ours, parts and cameras do not.
        node["extras"]["cif"]["kind"].as_str().map_or(node["mesh"].is_u64(), |kind| kind == "instance")
    };
    let found: Vec<usize> = (0..nodes.len())
        .filter(|index| {
            let node = &nodes[*index];
            let id = node["extras"]["cif"]["id"].as_u64();
            is_object(node) && (name(node) == object || id.is_some_and(|id| object.parse() == Ok(id)))
        })
        .collect();
    let [index] = found[..] else {
        let known: Vec<String> = nodes.iter().filter(|node| is_object(node)).map(name).collect();
        return Err(match found.len() {
            0 if known.is_empty() => "there is no object in the file".to_owned(),
            0 => format!("there is none; {}", cif_scene::known_names(object, "objects", &known)),
            count => format!("{count} nodes are called so; rename them apart first"),
        });
    };
    let node = &mut nodes[index];
    let before_name = name(node);
    let Some(ours) = node.pointer_mut("/extras/cif").and_then(Value::as_object_mut) else {
        node["name"] = json!(label);
        return Ok(Relabelled {
            object: label.to_owned(),
            before: before_name,
            label: label.to_owned(),
            category: label.to_owned(),
        });
    };
    let text = |key: &str| ours.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    let (before, old_category) = (text("label"), text("category"));
    let category = match category {
        Some(category) => category.to_owned(),
        None if old_category == before => label.to_owned(),
        None => old_category,
    };
    ours.insert("label".to_owned(), json!(label));
    ours.insert("category".to_owned(), json!(category));
    Ok(Relabelled { object: before_name, before, label: label.to_owned(), category })
}
