//! Writing: validated first, streamed, atomic.

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use cif_output::NewFile;
use safetensors::Dtype;
use safetensors::tensor::TensorInfo;
use serde::Serialize;

use super::contents::{StateTensor, States};
use super::error::CheckpointError;
use super::format::{
    FIELD_KEY, FORMAT_KEY, FieldJson, HEAD_KEY, HEAD_PREFIX, LABELS, LOG_ESTIMATES, MAX_HEADER, OWNERS,
    POSE_FLOATS, ROW_OFFSETS, STILL, TRACK_COLORS, TRACK_GROUPS, TRACK_LOG_SCALES, TRACK_MEANS,
    TRACK_OPACITIES, TRACK_POSES, TRACK_QUATERNIONS, TRAINING_KEY, TRAINING_PREFIX, TrackArrays, VERSION_KEY,
    format_of, owner_codes, still_rows,
};
use crate::Field;
use crate::gaussians::SH_FLOATS;

/// Deepest nesting of free-form JSON; the parser stops at 128, a few of which the file's own levels take.
pub(super) const MAX_JSON_DEPTH: usize = 100;

/// A tensor about to be written.
struct Tensor<'a> {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: &'a [u8],
}

/// Ordered twin of the safetensors crate's header, whose hash maps would shuffle the bytes.
#[derive(Serialize)]
struct Header<'a> {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<&'a str, String>,
    #[serde(flatten)]
    tensors: BTreeMap<&'a str, TensorInfo>,
}

/// Writes a file next to `path` and renames it.
pub(super) fn save(path: &Path, field: &Field, states: States<'_>) -> Result<(), CheckpointError> {
    replace_file(path, |file| write(file, path, field, states))
}

/// Runs `write` on a temporary file in the folder of `path`, and gives it that name once it is on disk.
/// On failure the temporary file is removed and whatever `path` was stays.
pub(super) fn replace_file(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<(), CheckpointError>,
) -> Result<(), CheckpointError> {
    let failed = |source: io::Error| CheckpointError::writing(path, source);
    let new = NewFile::create(path).map_err(failed)?;
    let mut buffered = BufWriter::with_capacity(1 << 20, new.file());
    write(&mut buffered)?;
    buffered.flush().map_err(failed)?;
    drop(buffered);
    new.finish().map_err(failed)
}

/// Writes the bytes of a file.
pub(super) fn write(
    sink: &mut dyn Write,
    path: &Path,
    field: &Field,
    States { training, head }: States<'_>,
) -> Result<(), CheckpointError> {
    field.validate().map_err(|source| CheckpointError::Unsaveable { path: path.to_owned(), source })?;
    let unsaveable =
        |problem: String| CheckpointError::Write { path: path.to_owned(), problem, source: None };
    let json = |value: serde_json::Result<String>| value.map_err(|error| unsaveable(error.to_string()));
    let own = FieldJson::of(field);
    let free_form =
        [Some(&own.provenance), training.map(|training| &training.json), head.map(|head| &head.json)];
    if free_form.into_iter().flatten().any(|value| deeper_than(value, MAX_JSON_DEPTH)) {
        return Err(unsaveable("its record or training state is nested too deeply".to_owned()));
    }

    let mut metadata = BTreeMap::from([
        (FORMAT_KEY, format_of(field, head.is_some()).to_string()),
        (VERSION_KEY, env!("CARGO_PKG_VERSION").to_owned()),
        (FIELD_KEY, json(serde_json::to_string(&own))?),
    ]);
    let track_arrays = field.tracks.as_ref().map(TrackArrays::of);
    let mut tensors = field_tensors(field, track_arrays.as_ref());
    let owners = owner_codes(field);
    if let Some(codes) = &owners {
        tensors.push(Tensor {
            name: OWNERS.to_owned(),
            dtype: Dtype::I32,
            shape: vec![codes.len()],
            bytes: bytemuck::cast_slice(codes),
        });
    }
    let still = still_rows(field);
    if let Some(rows) = &still {
        tensors.push(Tensor {
            name: STILL.to_owned(),
            dtype: Dtype::U8,
            shape: vec![rows.len()],
            bytes: rows,
        });
    }
    for (state, key, prefix) in [(training, TRAINING_KEY, TRAINING_PREFIX), (head, HEAD_KEY, HEAD_PREFIX)] {
        if let Some(state) = state {
            metadata.insert(key, json(serde_json::to_string(&state.json))?);
            tensors.extend(state.tensors.iter().map(|(name, tensor)| state_tensor(prefix, name, tensor)));
        }
    }
    // Widest elements first, so that every tensor is aligned in the file; names break ties.
    tensors.sort_by(|a, b| b.dtype.bitsize().cmp(&a.dtype.bitsize()).then_with(|| a.name.cmp(&b.name)));

    let mut offset = 0;
    let mut infos = BTreeMap::new();
    for tensor in &tensors {
        let data_offsets = (offset, offset + tensor.bytes.len());
        offset = data_offsets.1;
        let info = TensorInfo { dtype: tensor.dtype, shape: tensor.shape.clone(), data_offsets };
        infos.insert(tensor.name.as_str(), info);
    }
    let mut header = json(serde_json::to_string(&Header { metadata, tensors: infos }))?.into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    if header.len() as u64 > MAX_HEADER {
        return Err(unsaveable(format!(
            "its names, cameras and record take {} bytes, more than the {MAX_HEADER} that the format holds",
            header.len()
        )));
    }
    let mut put = |bytes: &[u8]| sink.write_all(bytes).map_err(|e| CheckpointError::writing(path, e));
    put(&(header.len() as u64).to_le_bytes())?;
    put(&header)?;
    tensors.iter().try_for_each(|tensor| put(tensor.bytes))
}

fn deeper_than(value: &serde_json::Value, levels: usize) -> bool {
    let inner = |value| levels == 0 || deeper_than(value, levels - 1);
    match value {
        serde_json::Value::Array(values) => values.iter().any(inner),
        serde_json::Value::Object(values) => values.values().any(inner),
        _ => false,
    }
}

fn field_tensors<'a>(field: &'a Field, track_arrays: Option<&'a TrackArrays>) -> Vec<Tensor<'a>> {
    fn tensor<'a, T: bytemuck::NoUninit>(
        name: &str,
        dtype: Dtype,
        values: &'a [T],
        row: &[usize],
    ) -> Tensor<'a> {
        let mut shape = vec![values.len()];
        shape.extend_from_slice(row);
        Tensor { name: name.to_owned(), dtype, shape, bytes: bytemuck::cast_slice(values) }
    }
    let has_part = |part: &str| match part {
        "deformation" => field.deformation.is_some(),
        "identities" => field.identities.is_some(),
        _ => true,
    };
    let learnt = field.tensors().into_iter().filter(|(parameter, _)| has_part(parameter.part));
    let mut tensors: Vec<Tensor<'_>> = learnt
        .map(|(parameter, values)| {
            let mut shape = vec![values.len() / parameter.width()];
            shape.extend_from_slice(parameter.shape);
            let bytes = bytemuck::cast_slice(values);
            Tensor { name: parameter.file_name(), dtype: Dtype::F32, shape, bytes }
        })
        .collect();
    if let Some((tracks, arrays)) = field.tracks.as_ref().zip(track_arrays) {
        tensors.push(tensor(TRACK_GROUPS, Dtype::U32, &tracks.group_of, &[]));
        tensors.push(tensor(TRACK_POSES, Dtype::F64, &arrays.poses, &[POSE_FLOATS]));
        tensors.push(tensor(TRACK_MEANS, Dtype::F32, &arrays.means, &[3]));
        tensors.push(tensor(TRACK_QUATERNIONS, Dtype::F32, &arrays.quaternions, &[4]));
        tensors.push(tensor(TRACK_LOG_SCALES, Dtype::F32, &arrays.log_scales, &[3]));
        if tracks.groups.iter().any(|group| group.opacities.is_some()) {
            tensors.push(tensor(TRACK_OPACITIES, Dtype::F32, &arrays.opacities, &[]));
        }
        if tracks.groups.iter().any(|group| group.colors.is_some()) {
            tensors.push(tensor(TRACK_COLORS, Dtype::F32, &arrays.colors, &[SH_FLOATS]));
        }
    }
    if let Some(identities) = &field.identities {
        tensors.push(tensor(ROW_OFFSETS, Dtype::U32, &identities.row_offsets, &[]));
        tensors.push(tensor(LABELS, Dtype::U16, &identities.labels, &[]));
        tensors.push(tensor(LOG_ESTIMATES, Dtype::F32, &identities.log_estimates, &[]));
    }
    tensors
}

fn state_tensor<'a>(prefix: &str, name: &str, tensor: &'a StateTensor) -> Tensor<'a> {
    let (dtype, length, bytes): (Dtype, usize, &[u8]) = match tensor {
        StateTensor::F32(values) => (Dtype::F32, values.len(), bytemuck::cast_slice(values)),
        StateTensor::F64(values) => (Dtype::F64, values.len(), bytemuck::cast_slice(values)),
        StateTensor::U32(values) => (Dtype::U32, values.len(), bytemuck::cast_slice(values)),
        StateTensor::U64(values) => (Dtype::U64, values.len(), bytemuck::cast_slice(values)),
    };
    Tensor { name: format!("{prefix}{name}"), dtype, shape: vec![length], bytes }
}
