//! File kinds, containers, atomic replacement, and what may be replaced.
//!
//! The container is written here and not through `gltf::Glb`, which wants the whole buffer in memory: a scene of
//! a million splats has 250 MB of it.

use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use cif_output::{NewFile, finish_all};
use cif_scene::SceneGraph;
use cif_scene::files::{FileError, existing_folder, target_of};
use serde::Deserialize;

use crate::author::{Authored, author};
use crate::names::GENERATOR_PREFIX;
use crate::{ExportOptions, ExportSummary, GltfError, loose};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// JSON and buffer in one file.
    Binary,
    /// JSON next to a file with the buffer.
    Text,
}

fn kind_of(path: &Path) -> Result<Kind, GltfError> {
    let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
    match extension.as_deref().and_then(|extension| extension.to_str()) {
        Some("glb") => Ok(Kind::Binary),
        Some("gltf") => Ok(Kind::Text),
        _ => Err(GltfError::Extension { path: path.to_owned() }),
    }
}

/// The file with the buffer of a `.gltf`.
fn buffer_path(path: &Path) -> PathBuf {
    path.with_extension("bin")
}

/// A `.glb`, or a `.gltf` and its buffer.
pub(crate) fn files(path: &Path) -> Vec<PathBuf> {
    let text = kind_of(path).is_ok_and(|kind| kind == Kind::Text);
    std::iter::once(path.to_owned()).chain(text.then(|| buffer_path(path))).collect()
}

/// Checks everything about an output that can be checked before the work starts.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), GltfError> {
    checked_kind(path, options).map(|_| ())
}

/// The kind of an output and where its links lead.
fn checked_kind(path: &Path, options: ExportOptions) -> Result<(Kind, PathBuf), GltfError> {
    let kind = kind_of(path)?;
    existing_folder(path)?;
    let ours = is_ours(path);
    if path.is_dir() {
        return Err(GltfError::IsFolder { path: path.to_owned() });
    }
    if path.exists() && !options.force && !ours {
        return Err(FileError::Foreign { path: path.to_owned() }.into());
    }
    let target = target_of(path, kind == Kind::Text)?;
    if kind == Kind::Text {
        let buffer = buffer_path(&target);
        if buffer.is_dir() {
            return Err(GltfError::IsFolder { path: buffer });
        }
        // A buffer is ours where a .gltf of ours stands next to it.
        if buffer.exists() && !options.force && !ours {
            return Err(FileError::Foreign { path: buffer }.into());
        }
    }
    Ok((kind, target))
}

/// True when cif wrote a file: its generator says so. Only the JSON is read.
fn is_ours(path: &Path) -> bool {
    #[derive(Deserialize)]
    struct Document {
        asset: Asset,
    }
    #[derive(Deserialize)]
    struct Asset {
        #[serde(default)]
        generator: String,
    }
    let json = || -> io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let mut head = Vec::new();
        Read::by_ref(&mut file).take(20).read_to_end(&mut head)?;
        if head.starts_with(b"glTF") && head.len() == 20 {
            let length = u32::from_le_bytes([head[12], head[13], head[14], head[15]]);
            let mut json = Vec::new();
            file.take(u64::from(length)).read_to_end(&mut json)?;
            return Ok(json);
        }
        file.read_to_end(&mut head)?;
        Ok(head)
    };
    let document = json().ok().and_then(|json| serde_json::from_slice::<Document>(&json).ok());
    document.is_some_and(|document| document.asset.generator.starts_with(GENERATOR_PREFIX))
}

/// Writes a scene to a `.glb`, or to a `.gltf` with a `.bin` next to it: to temporary files in the same folder,
/// then renamed.
///
/// # Errors
/// Unknown ending, missing folder, a file there that is not ours (without [`ExportOptions::force`]), a node with
/// dense motion of more than [`cif_scene::LOOSE_SPLATS`] splats, values that are not finite, disk full. Nothing existing is touched then.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, GltfError> {
    let (kind, target) = checked_kind(path, options)?;
    let loose = loose::in_own_frames(graph)?;
    let mut authored = author(graph, &loose)?;
    let failed = |source: io::Error| FileError::Write { path: path.to_owned(), source };
    let mut paths = vec![path.to_owned()];
    let bytes = match kind {
        Kind::Binary => {
            let json = serde_json::to_vec(&authored.document).map_err(|error| failed(error.into()))?;
            let total = binary_size(&json, authored.bytes);
            if total > u64::from(u32::MAX) {
                return Err(GltfError::TooLarge { path: path.to_owned(), bytes: total });
            }
            let new = written(path, |out| write_binary(out, &json, &authored)).map_err(failed)?;
            new.finish().map_err(failed)?;
            total
        }
        Kind::Text => {
            let buffer = buffer_path(&target);
            let name = buffer.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let uri = percent_encoding::utf8_percent_encode(&name, percent_encoding::NON_ALPHANUMERIC);
            authored.document.buffers[0].uri = Some(uri.to_string());
            let json = serde_json::to_vec_pretty(&authored.document).map_err(|error| failed(error.into()))?;
            let heavy = written(&buffer, |out| write_arrays(out, &authored)).map_err(failed)?;
            let light = written(path, |out| out.write_all(&json)).map_err(failed)?;
            finish_all([heavy, light]).map_err(failed)?;
            paths.push(buffer);
            json.len() as u64 + authored.bytes
        }
    };
    Ok(ExportSummary {
        path: path.to_owned(),
        files: paths,
        bytes,
        nodes: graph.nodes.len(),
        splats: graph.nodes.iter().map(|node| node.splats.len()).sum(),
        samples: graph.time_codes.samples.len(),
        not_held: graph.nodes.iter().flat_map(cif_scene::appearance::lost_without_samples).collect(),
        library: None,
        kept: Vec::new(),
    })
}

/// Writes a file that is still to be finished.
pub(crate) fn written(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>,
) -> io::Result<NewFile> {
    let new = NewFile::create(path)?;
    let mut out = BufWriter::with_capacity(1 << 16, new.file());
    write(&mut out)?;
    out.flush()?;
    drop(out);
    Ok(new)
}

fn padded(length: usize) -> u64 {
    length.next_multiple_of(4) as u64
}

/// Bytes of a `.glb`: header, JSON chunk and, where there is a buffer, its chunk.
fn binary_size(json: &[u8], buffer: u64) -> u64 {
    12 + 8 + padded(json.len()) + if buffer > 0 { 8 + buffer } else { 0 }
}

/// The container of the glTF 2.0 specification, section 4.
fn write_binary(out: &mut impl Write, json: &[u8], authored: &Authored<'_>) -> io::Result<()> {
    let word = |value: u64| {
        u32::try_from(value).map(u32::to_le_bytes).map_err(|_| io::Error::other("chunk of more than 4 GiB"))
    };
    out.write_all(b"glTF")?;
    out.write_all(&2_u32.to_le_bytes())?;
    out.write_all(&word(binary_size(json, authored.bytes))?)?;
    out.write_all(&word(padded(json.len()))?)?;
    out.write_all(b"JSON")?;
    out.write_all(json)?;
    out.write_all(&b"   "[..json.len().next_multiple_of(4) - json.len()])?;
    if authored.bytes > 0 {
        out.write_all(&word(authored.bytes)?)?;
        out.write_all(b"BIN\0")?;
        write_arrays(out, authored)?;
    }
    Ok(())
}

fn write_arrays(out: &mut impl Write, authored: &Authored<'_>) -> io::Result<()> {
    authored.arrays.iter().try_for_each(|array| array.write(out))
}
