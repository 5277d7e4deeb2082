//! Rules that every [`Field`] keeps, so that renderers and exporters need not check again.

use cif_geometry::Bounds;

use crate::error::finite;
use crate::gaussians::SH_FLOATS;
use crate::tracks::{NO_GROUP, Samples, TrackGroup, Tracks};
use crate::{
    Deformation, Field, FieldError, Gaussians, Identities, Instance, Owner, RecordedCamera, Timeline,
};

/// Largest deviation of a camera rotation from orthonormality.
const MAX_ORTHONORMALITY_ERROR: f64 = 1e-3;

/// Why a text with one is refused: it would come back from USD as another.
const NUL: &str = "a NUL character, at which USD ends texts; leave it out";

impl Field {
    /// Checks every rule: lengths that belong together, index ranges, finite values, usable cameras.
    ///
    /// # Errors
    /// The first broken rule, naming array and place.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.gaussians.validate()?;
        if let Some(deformation) = &self.deformation {
            deformation.validate()?;
            let (found, expected) = (deformation.still.len(), self.gaussians.len());
            if found > expected {
                return Err(FieldError::Length { array: "deformation.still", found, expected });
            }
        }
        if let Some(tracks) = &self.tracks {
            tracks.validate(self.gaussians.len())?;
        }
        validate_instances(&self.instances)?;
        if let Some(identities) = &self.identities {
            identities.validate(self.gaussians.len(), self.instances.len())?;
        }
        self.validate_group_instances()?;
        self.timeline.validate()?;
        for (index, camera) in self.cameras.iter().enumerate() {
            validate_camera(camera, self.timeline.times.len()).map_err(|problem| FieldError::Camera {
                index,
                name: camera.name.clone(),
                problem,
            })?;
        }
        let value = |name, value: String, expected| Err(FieldError::Value { name, value, expected });
        if self.sh_degree > 3 {
            return value("sh_degree", self.sh_degree.to_string(), "0 to 3");
        }
        if !self.background.iter().all(|channel| (0.0..=1.0).contains(channel)) {
            return value("background", format!("{:?}", self.background), "three values in [0, 1]");
        }
        if !(self.extent.is_finite() && self.extent >= 0.0) {
            return value("extent", self.extent.to_string(), "a finite length in metres");
        }
        Ok(())
    }

    /// Checks what [`TrackGroup::instance`] promises.
    fn validate_group_instances(&self) -> Result<(), FieldError> {
        let Some(tracks) = &self.tracks else { return Ok(()) };
        let broken = |index: usize, problem: String| {
            Err(FieldError::Track { index, name: tracks.groups[index].name.clone(), problem })
        };
        let mut instance_of = Vec::with_capacity(tracks.groups.len());
        for (index, group) in tracks.groups.iter().enumerate() {
            let known = group.instance.map(|id| (id, self.instance_by_id(id)));
            if let Some((id, None)) = known {
                return broken(
                    index,
                    format!("is of the instance id {id}, which is not in the instance table"),
                );
            }
            let base = group.joint.map(|joint| tracks.groups[joint.base as usize].instance);
            if base.is_some_and(|base| base != group.instance) {
                return broken(index, "has a joint on a group of another instance".to_owned());
            }
            instance_of.push(known.and_then(|(_, instance)| instance));
        }
        let Some(identities) = &self.identities else { return Ok(()) };
        for row in 0..self.gaussians.len() {
            let Some((group, own)) = tracks.group(row).and_then(|group| Some((group, instance_of[group]?)))
            else {
                continue;
            };
            let owner = identities.owner(row);
            if owner != Owner::Estimated && owner != Owner::Instance(own as u16) {
                let id = self.instances[own].id;
                return broken(group, format!("is of the instance id {id}, but its Gaussian {row} is not"));
            }
        }
        Ok(())
    }
}

impl Gaussians {
    /// Checks that all arrays have N rows of finite values.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn validate(&self) -> Result<(), FieldError> {
        let n = self.len();
        if u32::try_from(n).is_err() {
            return Err(FieldError::TooMany { array: "means", found: n });
        }
        for (parameter, values) in self.tensors() {
            same_length(parameter.name, values.len() / parameter.width(), n)?;
        }
        self.tensors()
            .into_iter()
            .try_for_each(|(parameter, values)| finite(parameter.name, values, parameter.width()))
    }
}

impl Deformation {
    /// Checks the shape, the box, and that all parameters are there and finite.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.config.validate()?;
        let Bounds { low, high } = self.bounds;
        // Read in f32 too, where a thin box far from the origin may vanish.
        let (thin_low, thin_high) = (low.as_vec3(), high.as_vec3());
        if !(thin_low.is_finite() && thin_high.is_finite() && thin_low.cmplt(thin_high).all()) {
            return Err(FieldError::Bounds { low: low.to_array(), high: high.to_array() });
        }
        same_length("deformation.planes", self.planes.len(), self.config.plane_layout().1)?;
        same_length("deformation.mlp", self.mlp.len(), self.config.mlp_layout().len)?;
        finite("deformation.planes", &self.planes, 1)?;
        finite("deformation.mlp", &self.mlp, 1)
    }
}

impl Identities {
    /// Checks the rows against `gaussians` rows and labels below `instances`: offsets ascend from 0 to the
    /// number of entries, labels ascend strictly in a row, owners exist, and values are finite.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn validate(&self, gaussians: usize, instances: usize) -> Result<(), FieldError> {
        let entries = self.labels.len();
        if u32::try_from(entries).is_err() {
            return Err(FieldError::TooMany { array: "identities.labels", found: entries });
        }
        same_length("identities.row_offsets", self.row_offsets.len(), gaussians + 1)?;
        same_length("identities.log_estimates", self.log_estimates.len(), entries)?;
        same_length("identities.log_calibrations", self.log_calibrations.len(), entries)?;
        if !self.owners.is_empty() {
            same_length("identities.owners", self.owners.len(), gaussians)?;
        }
        let broken = |row, problem: String| Err(FieldError::IdentityRow { row, problem });
        if self.row_offsets[0] != 0 {
            return broken(0, format!("starts at entry {}, expected 0", self.row_offsets[0]));
        }
        for row in 0..gaussians {
            let (start, end) = (self.row_offsets[row] as usize, self.row_offsets[row + 1] as usize);
            if end > entries || start > end {
                return broken(row, format!("spans entries {start} to {end} of {entries}"));
            }
            let labels = &self.labels[start..end];
            if labels.windows(2).any(|pair| pair[0] >= pair[1]) {
                return broken(row, "has labels that do not ascend".to_owned());
            }
            if let Some(last) = labels.last().filter(|last| usize::from(**last) >= instances) {
                return broken(row, format!("has the label {last}, but there are {instances} instances"));
            }
            if let Owner::Instance(owner) = self.owner(row)
                && usize::from(owner) >= instances
            {
                return broken(row, format!("belongs to instance {owner}, but there are {instances}"));
            }
        }
        let used = self.row_offsets[gaussians] as usize;
        if used != entries {
            return Err(FieldError::Length { array: "identities.labels", found: entries, expected: used });
        }
        finite("identities.log_estimates", &self.log_estimates, 1)?;
        finite("identities.log_calibrations", &self.log_calibrations, 1)
    }
}

/// Largest deviation of a track's quaternion from unit norm.
const MAX_NORM_ERROR: f64 = 1e-6;

impl Tracks {
    /// Checks the groups against `gaussians` rows: every group is there, samples ascend in time, poses are
    /// finite and unit, joints have unit axes and earlier groups as bases, dense samples hold all members.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn validate(&self, gaussians: usize) -> Result<(), FieldError> {
        same_length("tracks.group_of", self.group_of.len(), gaussians)?;
        let mut members = vec![0_usize; self.groups.len()];
        for (row, &group) in self.group_of.iter().enumerate().filter(|(_, group)| **group != NO_GROUP) {
            let Some(count) = members.get_mut(group as usize) else {
                return Err(FieldError::Value {
                    name: "tracks.group_of",
                    value: format!("{group} at row {row}"),
                    expected: "the index of a group",
                });
            };
            *count += 1;
        }
        for (index, (group, &members)) in self.groups.iter().zip(&members).enumerate() {
            let checked = validate_group(group, members).and_then(|()| validate_joint(group, index));
            checked.map_err(|problem| FieldError::Track { index, name: group.name.clone(), problem })?;
        }
        Ok(())
    }
}

fn ascending(what: &str, times: impl Iterator<Item = f64> + Clone) -> Result<(), String> {
    if let Some(time) = times.clone().find(|time| !time.is_finite()) {
        return Err(format!("has a {what} at the time {time}"));
    }
    match times.clone().zip(times.skip(1)).find(|(before, after)| before >= after) {
        Some((before, after)) => {
            Err(format!("has a {what} at {after} after one at {before}, but times must ascend"))
        }
        None => Ok(()),
    }
}

fn validate_group(group: &TrackGroup, members: usize) -> Result<(), String> {
    if !group.pivot.is_finite() {
        return Err("has a pivot that is not finite".to_owned());
    }
    ascending("pose", group.poses.iter().map(|pose| pose.time))?;
    ascending("change of visibility", group.visibility.iter().map(|step| step.time))?;
    if group.poses.iter().any(|pose| !pose.translation.is_finite()) {
        return Err("has a pose whose translation is not finite".to_owned());
    }
    // Written so that a NaN fails too.
    if !group.poses.iter().all(|pose| (pose.rotation.length() - 1.0).abs() <= MAX_NORM_ERROR) {
        return Err("has a pose whose quaternion is not unit".to_owned());
    }
    validate_appearance(group, members)?;
    let Some(dense) = &group.dense else { return Ok(()) };
    ascending("dense sample", dense.times.iter().copied())?;
    if dense.times.is_empty() {
        return Err("has a dense track without samples".to_owned());
    }
    let expected = dense.times.len().checked_mul(members);
    let lengths = [
        ("centres", dense.means.len()),
        ("quaternions", dense.quaternions.len()),
        ("log-scales", dense.log_scales.as_ref().map_or(dense.means.len(), Vec::len)),
    ];
    for (what, found) in lengths {
        if Some(found) != expected {
            let samples = dense.times.len();
            return Err(format!("has {found} {what} for {samples} samples of {members} Gaussians"));
        }
    }
    let not_finite = |error: FieldError| error.to_string();
    finite("its centres", dense.means.as_flattened(), 3).map_err(not_finite)?;
    finite("its quaternions", dense.quaternions.as_flattened(), 4).map_err(not_finite)?;
    finite("its log-scales", dense.log_scales.as_deref().unwrap_or_default().as_flattened(), 3)
        .map_err(not_finite)
}

fn validate_joint(group: &TrackGroup, index: usize) -> Result<(), String> {
    let Some(joint) = &group.joint else { return Ok(()) };
    if joint.base as usize >= index {
        return Err(format!("has a joint on group {}, but only an earlier one can be its base", joint.base));
    }
    if !joint.axis.is_finite() || (joint.axis.length() - 1.0).abs() > MAX_NORM_ERROR {
        return Err("has a joint whose axis is not unit".to_owned());
    }
    Ok(())
}

fn validate_appearance(group: &TrackGroup, members: usize) -> Result<(), String> {
    fn complete<V>(what: &str, samples: &Samples<V>, members: usize) -> Result<(), String> {
        ascending(&format!("sample of {what}"), samples.times.iter().copied())?;
        if samples.times.is_empty() {
            return Err(format!("has {what} over time without samples"));
        }
        let (found, times) = (samples.values.len(), samples.times.len());
        if times.checked_mul(members) != Some(found) {
            return Err(format!("has {found} {what} for {times} samples of {members} Gaussians"));
        }
        Ok(())
    }
    if let Some(samples) = &group.opacities {
        complete("opacities", samples, members)?;
        // Written so that a NaN fails too.
        if let Some(opacity) = samples.values.iter().find(|opacity| !(0.0..=1.0).contains(*opacity)) {
            return Err(format!("has the opacity {opacity}, which is not between 0 and 1"));
        }
    }
    if let Some(samples) = &group.colors {
        complete("colours", samples, members)?;
        let coefficients = samples.values.as_flattened();
        finite("its colours", coefficients, SH_FLOATS).map_err(|error| error.to_string())?;
    }
    Ok(())
}

impl Timeline {
    /// Checks that there is a time, that times ascend strictly in [0, 1], and that the rate is positive.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn validate(&self) -> Result<(), FieldError> {
        let broken = |problem: String| Err(FieldError::Timeline { problem });
        if self.times.is_empty() {
            return broken("it has no times".to_owned());
        }
        if let Some(time) = self.times.iter().find(|time| !(0.0..=1.0).contains(*time)) {
            return broken(format!("the time {time} is outside [0, 1]"));
        }
        if let Some(pair) = self.times.windows(2).find(|pair| pair[0] >= pair[1]) {
            return broken(format!("the time {} does not come after {}", pair[1], pair[0]));
        }
        if !(self.frames_per_second.is_finite() && self.frames_per_second > 0.0) {
            return broken(format!("{} frames per second", self.frames_per_second));
        }
        Ok(())
    }
}

fn validate_instances(instances: &[Instance]) -> Result<(), FieldError> {
    let broken = |index: usize, problem: String| {
        Err(FieldError::Instance { index, label: instances[index].label.clone(), problem })
    };
    let mut owners = vec![None; 1 << 16];
    for (index, instance) in instances.iter().enumerate() {
        if instance.id == 0 {
            return broken(index, "has the id 0, which means unlabelled".to_owned());
        }
        if let Some(other) = owners[usize::from(instance.id)].replace(index) {
            return broken(index, format!("has the id {} of instance {other}", instance.id));
        }
        if [&instance.label, &instance.category].iter().any(|text| text.contains('\0')) {
            return broken(index, format!("has a label or class with {NUL}"));
        }
        for (taxonomy, name) in &instance.taxonomies {
            if let Err(problem) = cif_output::check_taxonomy(taxonomy) {
                return broken(index, format!("has a taxonomy {taxonomy:?}, which {problem}"));
            }
            if name.is_empty() || name.contains('\0') {
                return broken(index, format!("has no name in the taxonomy {taxonomy}, or one with {NUL}"));
            }
        }
    }
    Ok(())
}

fn validate_camera(record: &RecordedCamera, times: usize) -> Result<(), String> {
    let camera = &record.camera;
    if record.name.contains('\0') {
        return Err(format!("has a name with {NUL}"));
    }
    if record.time_index >= times {
        return Err(format!("has the time index {}, but there are {times} times", record.time_index));
    }
    cif_geometry::camera::check_image_size(camera.width, camera.height)
        .map_err(|problem| format!("is not usable: {problem}"))?;
    if !(camera.focal_px.is_finite() && camera.focal_px.min_element() > 0.0) {
        return Err(format!("has the focal lengths {}", camera.focal_px));
    }
    if !camera.principal_px.is_finite() {
        return Err(format!("has the principal point {}", camera.principal_px));
    }
    if !camera.camera_from_world.translation.is_finite() {
        return Err("has a position that is not finite".to_owned());
    }
    let error = camera.camera_from_world.orthonormality_error();
    if error.is_nan() || error > MAX_ORTHONORMALITY_ERROR {
        return Err(format!("has a rotation that is not orthonormal (deviation {error})"));
    }
    Ok(())
}

fn same_length(array: &'static str, found: usize, expected: usize) -> Result<(), FieldError> {
    if found == expected { Ok(()) } else { Err(FieldError::Length { array, found, expected }) }
}
