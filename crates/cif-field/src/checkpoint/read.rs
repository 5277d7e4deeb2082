//! Reading: the header is checked against the file's length before anything is allocated, tensors are read
//! one by one straight into place.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo};

use super::contents::{Checkpoint, StateTensor, TrainingState};
use super::error::CheckpointError;
use super::format::{
    FIELD_KEY, FORMAT, FORMAT_KEY, FieldJson, HEAD_KEY, HEAD_PREFIX, LABELS, LOG_ESTIMATES, MAX_HEADER,
    OWNERS, POSE_FLOATS, ROW_OFFSETS, STILL, SamplesJson, TRACK_COLORS, TRACK_GROUPS, TRACK_LOG_SCALES,
    TRACK_MEANS, TRACK_OPACITIES, TRACK_POSES, TRACK_QUATERNIONS, TRAINING_KEY, TRAINING_PREFIX, TrackArrays,
    TrackGroupJson, VERSION_KEY,
};
use crate::gaussians::RowSource;
use crate::gaussians::SH_FLOATS;
use crate::parameters::{LOG_CALIBRATIONS, MEANS, MLP, PLANES};
use crate::{Deformation, Field, Gaussians, Identities, Owner, Parameter, Record, Tracks};

pub(super) fn load(path: &Path, with_states: bool) -> Result<Checkpoint, CheckpointError> {
    let checkpoint = load_unchecked(path, with_states)?;
    validated(checkpoint, path)
}

/// Refuses values that no cif writes.
fn validated(checkpoint: Checkpoint, path: &Path) -> Result<Checkpoint, CheckpointError> {
    checkpoint
        .field
        .validate()
        .map_err(|source| CheckpointError::InvalidField { path: path.to_owned(), source })?;
    Ok(checkpoint)
}

/// As [`load`], with whatever values the file holds; shapes and sizes are right.
pub(super) fn load_unchecked(path: &Path, with_states: bool) -> Result<Checkpoint, CheckpointError> {
    let failed = |source: io::Error| CheckpointError::Read { path: path.to_owned(), source };
    let file = cif_input::open(path).map_err(failed)?;
    read_unchecked(&mut BufReader::new(file), path, with_states)
}

pub(super) fn read<S: Read + Seek>(
    source: &mut S,
    path: &Path,
    with_states: bool,
) -> Result<Checkpoint, CheckpointError> {
    validated(read_unchecked(source, path, with_states)?, path)
}

fn read_unchecked<S: Read + Seek>(
    source: &mut S,
    path: &Path,
    with_states: bool,
) -> Result<Checkpoint, CheckpointError> {
    let mut reader = Reader::open(source, path)?;
    let metadata = reader.header.metadata().clone().unwrap_or_default();
    reader.check_format(metadata.get(FORMAT_KEY), metadata.get(VERSION_KEY))?;
    let json =
        metadata.get(FIELD_KEY).ok_or_else(|| reader.damaged(format!("the header has no `{FIELD_KEY}`")))?;
    let json: FieldJson =
        serde_json::from_str(json).map_err(|error| reader.damaged(format!("`{FIELD_KEY}`: {error}")))?;

    let field = read_field(&mut reader, json)?;
    let training = match metadata.get(TRAINING_KEY) {
        Some(json) if with_states => Some(read_state(&mut reader, json, (TRAINING_KEY, TRAINING_PREFIX))?),
        _ => None,
    };
    let head = match metadata.get(HEAD_KEY) {
        Some(json) if with_states => Some(read_state(&mut reader, json, (HEAD_KEY, HEAD_PREFIX))?),
        _ => None,
    };
    let unknown = reader.header.offset_keys().into_iter().find(|name| {
        let is_state = name.starts_with(TRAINING_PREFIX) || name.starts_with(HEAD_PREFIX);
        !reader.known.contains(name) && !is_state
    });
    if let Some(name) = unknown {
        return Err(reader.tensor_error(&name, "is not part of a scene"));
    }
    Ok(Checkpoint { field, training, head })
}

fn read_field<S: Read + Seek>(reader: &mut Reader<'_, S>, json: FieldJson) -> Result<Field, CheckpointError> {
    let record = Record::from_json(json.provenance)
        .map_err(|error| reader.damaged(format!("`{FIELD_KEY}`: {error}")))?;
    let means = MEANS.file_name();
    let n = match reader.info(&means, Dtype::F32)?.shape[..] {
        [n, 3] => n,
        ref other => return Err(reader.shape_error(&means, other, "[N, 3]")),
    };
    let gaussians = Gaussians::try_from_rows(ParameterRows { reader: &mut *reader, rows: n })?;
    let deformation = match json.deformation {
        None => None,
        Some(shape) => {
            // Layout arithmetic is safe only within the limits.
            shape.config.validate().map_err(|source| CheckpointError::InvalidField {
                path: reader.path.to_owned(),
                source: source.into(),
            })?;
            let planes = shape.config.plane_layout().1;
            let mlp = shape.config.mlp_layout().len;
            Some(Deformation {
                planes: reader.values(&PLANES.file_name(), Dtype::F32, planes, &[])?,
                mlp: reader.values(&MLP.file_name(), Dtype::F32, mlp, &[])?,
                config: shape.config,
                bounds: shape.bounds,
                still: if shape.has_still { read_still(reader, n)? } else { Vec::new() },
            })
        }
    };
    let tracks = json.tracks.map(|groups| read_tracks(reader, groups, n)).transpose()?;
    let identities = if json.has_identities {
        let entries = match reader.info(LABELS, Dtype::U16)?.shape[..] {
            [entries] => entries,
            ref other => return Err(reader.shape_error(LABELS, other, "[E]")),
        };
        Some(of_older_files(Identities {
            // n counts rows of 12 bytes in this file, so n + 1 cannot overflow.
            row_offsets: reader.values(ROW_OFFSETS, Dtype::U32, n + 1, &[])?,
            labels: reader.values(LABELS, Dtype::U16, entries, &[])?,
            log_estimates: reader.values(LOG_ESTIMATES, Dtype::F32, entries, &[])?,
            log_calibrations: reader.values(&LOG_CALIBRATIONS.file_name(), Dtype::F32, entries, &[])?,
            owners: if json.has_owners { read_owners(reader, n)? } else { Vec::new() },
        }))
    } else {
        None
    };
    Ok(Field {
        gaussians,
        deformation,
        tracks,
        identities,
        instances: json.instances,
        timeline: json.timeline,
        cameras: json.cameras,
        sh_degree: json.sh_degree,
        background: json.background,
        sort_metric: json.sort_metric,
        extent: json.extent,
        record,
    })
}

/// Tensors of a file with `rows` rows, by parameter.
struct ParameterRows<'r, 'a, S> {
    reader: &'r mut Reader<'a, S>,
    rows: usize,
}

impl<S: Read + Seek> RowSource<CheckpointError> for ParameterRows<'_, '_, S> {
    fn rows<T: bytemuck::Pod>(&mut self, parameter: &Parameter) -> Result<Vec<T>, CheckpointError> {
        self.reader.values(&parameter.file_name(), Dtype::F32, self.rows, parameter.shape)
    }
}

fn read_still<S: Read + Seek>(reader: &mut Reader<'_, S>, n: usize) -> Result<Vec<bool>, CheckpointError> {
    let flags: Vec<u8> = reader.values(STILL, Dtype::U8, n, &[])?;
    match flags.iter().find(|flag| **flag > 1) {
        Some(flag) => Err(reader.tensor_error(STILL, &format!("holds {flag}, where 0 or 1 must be"))),
        None => Ok(flags.into_iter().map(|flag| flag != 0).collect()),
    }
}

fn read_owners<S: Read + Seek>(reader: &mut Reader<'_, S>, n: usize) -> Result<Vec<Owner>, CheckpointError> {
    let codes: Vec<i32> = reader.values(OWNERS, Dtype::I32, n, &[])?;
    codes
        .into_iter()
        .map(|code| {
            Owner::from_code(code)
                .ok_or_else(|| reader.tensor_error(OWNERS, &format!("holds {code}, which is no owner")))
        })
        .collect()
}

/// Layouts before 4 had no owners: a row with the one estimate ln 2 belonged to its label, and one with the one
/// estimate -104 to none. Measured estimates are never above 0 and never below -19.
fn of_older_files(rows: Identities) -> Identities {
    const OF_AN_INSTANCE: f32 = std::f32::consts::LN_2;
    const OF_NONE: f32 = -104.0;
    let owner = |row: usize| match rows.log_estimates.get(rows.range(row)) {
        Some(&[OF_AN_INSTANCE]) => Some(Some(rows.labels[rows.range(row).start])),
        Some(&[estimate]) if estimate <= OF_NONE => Some(None),
        _ => None,
    };
    let ascend = rows.row_offsets.windows(2).all(|pair| pair[0] <= pair[1]);
    if !rows.owners.is_empty() || !ascend || !(0..rows.len()).any(|row| owner(row).is_some()) {
        return rows;
    }
    let mut owned = Identities::empty();
    for row in 0..rows.len() {
        match owner(row) {
            Some(owner) => owned.push_certain(owner),
            None => owned.append_row(&rows, row),
        }
    }
    owned
}

fn read_tracks<S: Read + Seek>(
    reader: &mut Reader<'_, S>,
    groups: Vec<TrackGroupJson>,
    n: usize,
) -> Result<Tracks, CheckpointError> {
    let group_of = reader.values(TRACK_GROUPS, Dtype::U32, n, &[])?;
    let rows_of = |group: &TrackGroupJson| group.dense.as_ref().map_or(0, |dense| dense.rows);
    let scale_rows_of = |group: &TrackGroupJson| {
        group.dense.as_ref().filter(|dense| dense.log_scales).map_or(0, |dense| dense.rows)
    };
    // The tensors must have exactly as many rows as the groups say, so that no sum can overflow afterwards.
    let total = |count: &dyn Fn(&TrackGroupJson) -> usize| {
        groups.iter().try_fold(0_usize, |sum, group| sum.checked_add(count(group))).unwrap_or(usize::MAX)
    };
    let rows_in = |samples: &Option<SamplesJson>| samples.as_ref().map_or(0, |samples| samples.rows);
    let opacity_rows_of = |group: &TrackGroupJson| rows_in(&group.opacities);
    let color_rows_of = |group: &TrackGroupJson| rows_in(&group.colors);
    let rows = total(&rows_of);
    let all = TrackArrays {
        poses: reader.values(TRACK_POSES, Dtype::F64, total(&|group| group.poses), &[POSE_FLOATS])?,
        means: reader.values(TRACK_MEANS, Dtype::F32, rows, &[3])?,
        quaternions: reader.values(TRACK_QUATERNIONS, Dtype::F32, rows, &[4])?,
        log_scales: reader.values(TRACK_LOG_SCALES, Dtype::F32, total(&scale_rows_of), &[3])?,
        opacities: if groups.iter().any(|group| group.opacities.is_some()) {
            reader.values(TRACK_OPACITIES, Dtype::F32, total(&opacity_rows_of), &[])?
        } else {
            Vec::new()
        },
        colors: if groups.iter().any(|group| group.colors.is_some()) {
            reader.values(TRACK_COLORS, Dtype::F32, total(&color_rows_of), &[SH_FLOATS])?
        } else {
            Vec::new()
        },
    };
    let (mut poses, mut means) = (all.poses.into_iter(), all.means.into_iter());
    let (mut quaternions, mut log_scales) = (all.quaternions.into_iter(), all.log_scales.into_iter());
    let (mut opacities, mut colors) = (all.opacities.into_iter(), all.colors.into_iter());
    let groups = groups
        .into_iter()
        .map(|group| {
            let (rows, scale_rows) = (rows_of(&group), scale_rows_of(&group));
            let (opacity_rows, color_rows) = (opacity_rows_of(&group), color_rows_of(&group));
            let own = TrackArrays {
                poses: poses.by_ref().take(group.poses).collect(),
                means: means.by_ref().take(rows).collect(),
                quaternions: quaternions.by_ref().take(rows).collect(),
                log_scales: log_scales.by_ref().take(scale_rows).collect(),
                opacities: opacities.by_ref().take(opacity_rows).collect(),
                colors: colors.by_ref().take(color_rows).collect(),
            };
            group.group(own)
        })
        .collect();
    Ok(Tracks { group_of, groups })
}

fn read_state<S: Read + Seek>(
    reader: &mut Reader<'_, S>,
    json: &str,
    (key, prefix): (&str, &str),
) -> Result<TrainingState, CheckpointError> {
    let json = serde_json::from_str(json).map_err(|error| reader.damaged(format!("`{key}`: {error}")))?;
    let mut tensors = BTreeMap::new();
    for name in reader.header.offset_keys() {
        let Some(short) = name.strip_prefix(prefix) else { continue };
        let Some(info) = reader.header.info(&name).cloned() else { continue };
        let [length] = info.shape[..] else {
            return Err(reader.shape_error(&name, &info.shape, "[length]"));
        };
        let tensor = match info.dtype {
            Dtype::F32 => StateTensor::F32(reader.values(&name, info.dtype, length, &[])?),
            Dtype::F64 => StateTensor::F64(reader.values(&name, info.dtype, length, &[])?),
            Dtype::U32 => StateTensor::U32(reader.values(&name, info.dtype, length, &[])?),
            Dtype::U64 => StateTensor::U64(reader.values(&name, info.dtype, length, &[])?),
            other => return Err(reader.tensor_error(&name, &format!("has the type {other}"))),
        };
        tensors.insert(short.to_owned(), tensor);
    }
    Ok(TrainingState { json, tensors })
}

/// An open file whose header is known to agree with its length.
struct Reader<'a, S> {
    source: &'a mut S,
    path: &'a Path,
    header: Metadata,
    /// First byte of tensor data.
    data_start: u64,
    /// Tensors asked for.
    known: BTreeSet<String>,
}

impl<'a, S: Read + Seek> Reader<'a, S> {
    fn open(source: &'a mut S, path: &'a Path) -> Result<Self, CheckpointError> {
        let failed = |source: io::Error| CheckpointError::Read { path: path.to_owned(), source };
        let not_safetensors = || CheckpointError::NotSafetensors { path: path.to_owned() };
        let truncated =
            |expected, found| CheckpointError::Truncated { path: path.to_owned(), expected, found };
        let found = source.seek(SeekFrom::End(0)).map_err(failed)?;
        source.seek(SeekFrom::Start(0)).map_err(failed)?;
        if found < 9 {
            return Err(if found == 0 { truncated(9, 0) } else { not_safetensors() });
        }
        let mut start = [0; 9];
        source.read_exact(&mut start).map_err(failed)?;
        let (length, brace) = start.split_at(8);
        let header_length = u64::from_le_bytes(length.try_into().expect("split at 8"));
        if !(2..=MAX_HEADER).contains(&header_length) || brace != b"{" {
            return Err(not_safetensors());
        }
        let data_start = 8 + header_length;
        if data_start > found {
            return Err(truncated(data_start, found));
        }
        let mut text = vec![0; header_length as usize];
        source.seek(SeekFrom::Start(8)).map_err(failed)?;
        source.read_exact(&mut text).map_err(failed)?;
        // Parsing also checks that the tensors lie end to end and that shapes and sizes agree, without overflow.
        let header: Metadata = serde_json::from_slice(&text).map_err(|error| CheckpointError::Header {
            path: path.to_owned(),
            problem: format!("its header cannot be read ({error})"),
        })?;
        let expected = data_start.saturating_add(header.data_len() as u64);
        if found < expected {
            return Err(truncated(expected, found));
        }
        if found > expected {
            return Err(CheckpointError::TrailingBytes { path: path.to_owned(), expected, found });
        }
        Ok(Self { source, path, header, data_start, known: BTreeSet::new() })
    }

    fn check_format(&self, format: Option<&String>, version: Option<&String>) -> Result<(), CheckpointError> {
        let Some(format) = format else {
            return Err(CheckpointError::NotAScene { path: self.path.to_owned() });
        };
        match format.parse::<u64>() {
            Ok(found) if found > u64::from(FORMAT) => Err(CheckpointError::NewerFormat {
                path: self.path.to_owned(),
                found,
                writer: version.map_or_else(
                    || "of a later version".to_owned(),
                    |text| text.chars().filter(|c| !c.is_control()).take(40).collect(),
                ),
            }),
            Ok(found) if found > 0 => Ok(()),
            _ => Err(self.damaged(format!("`{FORMAT_KEY}` is not a format number"))),
        }
    }

    fn damaged(&self, problem: String) -> CheckpointError {
        CheckpointError::Header { path: self.path.to_owned(), problem }
    }

    fn tensor_error(&self, tensor: &str, problem: &str) -> CheckpointError {
        CheckpointError::Tensor {
            path: self.path.to_owned(),
            tensor: tensor.chars().filter(|c| !c.is_control()).take(80).collect(),
            problem: problem.to_owned(),
        }
    }

    fn shape_error(&self, tensor: &str, found: &[usize], expected: &str) -> CheckpointError {
        self.tensor_error(tensor, &format!("has the shape {found:?}, expected {expected}"))
    }

    fn info(&self, name: &str, dtype: Dtype) -> Result<TensorInfo, CheckpointError> {
        let info = self.header.info(name).ok_or_else(|| self.tensor_error(name, "is missing"))?;
        if info.dtype != dtype {
            let problem = format!("has the type {}, expected {dtype}", info.dtype);
            return Err(self.tensor_error(name, &problem));
        }
        Ok(info.clone())
    }

    /// Reads a tensor of shape `[rows, ..row]` as `rows` values of `T`, which spans one row.
    fn values<T: bytemuck::Pod>(
        &mut self,
        name: &str,
        dtype: Dtype,
        rows: usize,
        row: &[usize],
    ) -> Result<Vec<T>, CheckpointError> {
        let info = self.info(name, dtype)?;
        let (first, rest) = info.shape.split_first().unwrap_or((&usize::MAX, &[]));
        if *first != rows || rest != row {
            let mut expected = vec![rows];
            expected.extend_from_slice(row);
            return Err(self.shape_error(name, &info.shape, &format!("{expected:?}")));
        }
        // The header was checked: `rows` values are exactly the tensor's bytes, which the file has.
        let mut values = vec![T::zeroed(); rows];
        let failed = |source: io::Error| CheckpointError::Read { path: self.path.to_owned(), source };
        self.source
            .seek(SeekFrom::Start(self.data_start + info.data_offsets.0 as u64))
            .and_then(|_| self.source.read_exact(bytemuck::cast_slice_mut(&mut values)))
            .map_err(failed)?;
        self.known.insert(name.to_owned());
        Ok(values)
    }
}
