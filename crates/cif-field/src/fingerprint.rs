//! Fingerprints, by which equal fields are recognised.

use xxhash_rust::xxh3::Xxh3;

use crate::Field;

/// Version of the rules below; a change of them changes every fingerprint.
const RULES: &str = "cif-field 1";

impl Field {
    /// A fingerprint of what a scene is made from: Gaussians, learned and recorded motion, identities, the
    /// instance table, times, and colour settings. Equal on every machine; cameras and record do not count.
    ///
    /// 32 hexadecimal digits (XXH3, 128 bits). It distinguishes files that were mixed up, not files that were
    /// forged.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut hash = Hash(Xxh3::new());
        hash.bytes(RULES.as_bytes());
        for (_, values) in self.gaussians.tensors() {
            hash.array(values);
        }
        if let Some(deformation) = &self.deformation {
            hash.json(&(&deformation.config, deformation.bounds));
            hash.array(&deformation.planes);
            hash.array(&deformation.mlp);
            if deformation.still.contains(&true) {
                hash.array(
                    &(0..self.len()).map(|row| u8::from(deformation.is_still(row))).collect::<Vec<_>>(),
                );
            }
        }
        hash.array(&[u8::from(self.deformation.is_some()), u8::from(self.tracks.is_some())]);
        if let Some(tracks) = &self.tracks {
            hash.array(&tracks.group_of);
            for group in &tracks.groups {
                if let Some(id) = group.instance {
                    hash.array(&[id]);
                }
                hash.array(&[u8::from(group.deformed)]);
                hash.array(&group.pivot.to_array());
                for pose in &group.poses {
                    let (t, q) = (pose.translation, pose.rotation);
                    hash.array(&[pose.time, t.x, t.y, t.z, q.w, q.x, q.y, q.z]);
                }
                for step in &group.visibility {
                    hash.array(&[step.time, f64::from(u8::from(step.visible))]);
                }
                if let Some(joint) = &group.joint {
                    hash.array(&[joint.base, joint.kind as u32]);
                    hash.array(&joint.axis.to_array());
                }
                if let Some(dense) = &group.dense {
                    hash.array(&dense.times);
                    hash.array(&dense.means);
                    hash.array(&dense.quaternions);
                    hash.array(dense.log_scales.as_deref().unwrap_or_default());
                }
                if let Some(opacities) = &group.opacities {
                    hash.array(&opacities.times);
                    hash.array(&opacities.values);
                }
                if let Some(colors) = &group.colors {
                    hash.array(&colors.times);
                    hash.array(colors.values.as_flattened());
                }
            }
        }
        if let Some(identities) = &self.identities {
            hash.array(&identities.row_offsets);
            hash.array(&identities.labels);
            hash.array(&identities.log_estimates);
            hash.array(&identities.log_calibrations);
            if !identities.owners.is_empty() {
                hash.array(&identities.owners.iter().map(|owner| owner.code()).collect::<Vec<i32>>());
            }
        }
        for instance in &self.instances {
            hash.array(&[instance.id]);
            hash.bytes(instance.label.as_bytes());
            hash.bytes(instance.category.as_bytes());
            for (taxonomy, name) in &instance.taxonomies {
                hash.bytes(taxonomy.as_bytes());
                hash.bytes(name.as_bytes());
            }
        }
        hash.array(&self.timeline.times);
        hash.array(&[self.timeline.frames_per_second]);
        hash.array(&[self.sh_degree]);
        hash.array(&self.background);
        hash.json(&self.sort_metric);
        format!("{:032x}", hash.0.digest128())
    }
}

struct Hash(Xxh3);

impl Hash {
    /// Every run of bytes is preceded by its length, so that nothing slides from one array into the next.
    fn bytes(&mut self, bytes: &[u8]) {
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    fn array<T: bytemuck::NoUninit>(&mut self, values: &[T]) {
        self.bytes(bytemuck::cast_slice(values));
    }

    fn json(&mut self, value: &impl serde::Serialize) {
        let text = serde_json::to_vec(value).expect("plain structures of numbers and names");
        self.bytes(&text);
    }
}

#[cfg(test)]
mod tests {
    use crate::{Field, testing};

    #[test]
    fn every_part_that_a_scene_is_made_from_counts() {
        type Change = fn(&mut Field);
        let changes: [Change; 15] = [
            |field| field.gaussians.means[3][1] = field.gaussians.means[3][1].next_up(),
            |field| field.gaussians.sh_coefficients[0][47] += 0.25,
            |field| field.gaussians.means.swap(0, 1),
            |field| field.deformation = None,
            |field| field.deformation.as_mut().unwrap().planes[0] += 0.5,
            |field| field.tracks = None,
            |field| field.tracks.as_mut().unwrap().groups[1].instance = Some(field.instances[0].id),
            |field| field.tracks.as_mut().unwrap().groups[0].poses[0].translation.x += 1e-9,
            |field| field.tracks.as_mut().unwrap().groups[1].visibility[0].visible ^= true,
            |field| field.tracks.as_mut().unwrap().groups[0].opacities.as_mut().unwrap().values[0] = 0.25,
            |field| field.tracks.as_mut().unwrap().groups[2].colors.as_mut().unwrap().values[0][5] += 0.25,
            |field| field.identities.as_mut().unwrap().log_calibrations[0] += 0.5,
            |field| field.identities.as_mut().unwrap().owners = vec![crate::Owner::Background; 30],
            |field| field.instances[1].label.push('s'),
            |field| field.timeline.times[1] += 1e-9,
        ];
        let field = testing::tracked_field(30, 5);
        let same = Field { cameras: Vec::new(), record: crate::Record::default(), ..field.clone() };
        assert_eq!(same.fingerprint(), field.fingerprint());
        assert_eq!(field.fingerprint().len(), 32);
        let mut seen = vec![field.fingerprint()];
        for change in changes {
            let mut changed = field.clone();
            change(&mut changed);
            seen.push(changed.fingerprint());
        }
        let count = seen.len();
        seen.sort();
        seen.dedup();
        assert_eq!(seen.len(), count);
    }

    #[test]
    fn the_fingerprint_is_the_same_everywhere() {
        let field = Field {
            gaussians: crate::Gaussians {
                means: vec![[0.0, 0.5, 1.0]],
                log_scales: vec![[-2.0; 3]],
                quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
                opacity_logits: vec![1.5],
                occupancy_logits: vec![-1.5],
                sh_coefficients: vec![[0.25; 48]],
            },
            deformation: None,
            tracks: None,
            identities: None,
            instances: Vec::new(),
            timeline: crate::Timeline { times: vec![0.0, 0.5], frames_per_second: 24.0 },
            ..testing::field(0, 1)
        };
        assert_eq!(field.fingerprint(), "4756fe2eb119afcc59405d96414e8efd");
    }
}
