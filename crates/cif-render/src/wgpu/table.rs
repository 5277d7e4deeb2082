//! The stages of the renderer, a row each: its kernels, the files of its plain and of its fast version, and the test that
//! holds its gradients to finite differences. A new stage has its files and its row here.

use super::kernel::Module;
use super::{blend, counts, deform, poses, speed, stages, workgroup};

/// A stage in all its versions.
#[derive(Clone, Copy, Debug)]
pub struct StageRow {
    /// Name.
    pub name: &'static str,
    /// WGSL files, in the order in which a view goes through them.
    pub modules: &'static [&'static Module],
    /// Files of the fast version in `src/cpu/`.
    pub cpu: &'static [&'static str],
    /// File of the plain version in `src/reference/`; `None` where that has no need of the stage.
    pub reference: Option<&'static str>,
    /// File in `tests/renderers/` and name of the test that compares its gradients with finite differences; `None` where
    /// nothing is differentiated.
    pub gradients: Option<(&'static str, &'static str)>,
}

/// Every stage, in the order in which a view goes through them.
pub const STAGES: &[StageRow] = &[
    StageRow {
        name: "deform",
        modules: deform::MODULES,
        cpu: &["deform/mod.rs", "deform/lookup.rs", "deform/network.rs"],
        reference: Some("deform.rs"),
        gradients: Some(("gradients.rs", "deformed_with_all_heads")),
    },
    StageRow {
        name: "poses",
        modules: &[&poses::POSES, &poses::POSES_BACKWARD, &poses::POSES_SUM],
        cpu: &["groups.rs"],
        reference: Some("tracks.rs"),
        gradients: Some(("tracks.rs", "poses_and_their_gaussians_have_the_gradients_of_the_reference")),
    },
    StageRow {
        name: "project",
        modules: &[
            &stages::PROJECT,
            &stages::PROJECT_PACKED,
            &stages::PROJECT_TURNED,
            &stages::PROJECT_BACKWARD,
            &stages::PROJECT_BACKWARD_TURNED,
        ],
        cpu: &["project.rs"],
        reference: Some("project.rs"),
        gradients: Some(("gradients.rs", "static_scene")),
    },
    StageRow {
        name: "sort",
        modules: &[&stages::SCAN, &stages::SORT],
        cpu: &["bin.rs"],
        reference: Some("sort.rs"),
        gradients: None,
    },
    StageRow {
        name: "bin",
        modules: &[&stages::BIN, &stages::EMIT, &stages::RANGES],
        cpu: &["bin.rs"],
        reference: None,
        gradients: None,
    },
    StageRow {
        name: "rasterize",
        modules: &[
            &stages::RASTERIZE,
            &stages::RASTERIZE_COLOR,
            &stages::COTANGENTS,
            &stages::RASTERIZE_BACKWARD,
            &stages::RASTERIZE_BACKWARD_COLOR,
            &stages::GATHER_GRADIENTS,
        ],
        cpu: &["rasterize.rs", "rasterize_backward.rs"],
        reference: Some("rasterize.rs"),
        gradients: Some(("gradients.rs", "many_overlapping_gaussians")),
    },
    StageRow {
        name: "identity",
        modules: &[&stages::IDENTITY_BACKWARD],
        cpu: &["identity.rs"],
        reference: Some("identity.rs"),
        gradients: Some(("gradients.rs", "coverage_normalisation")),
    },
    StageRow {
        name: "dense",
        modules: &[&stages::DENSE],
        cpu: &["dense.rs"],
        reference: Some("dense.rs"),
        gradients: None,
    },
    StageRow {
        name: "blend",
        modules: &[
            &blend::BLEND,
            &blend::BLEND_BACKWARD,
            &blend::BLEND_BACKWARD_WEIGHTS,
            &blend::GATHER_VALUES,
            &blend::GATHER_VALUES_WEIGHTS,
        ],
        cpu: &["blend.rs", "blend_backward.rs"],
        reference: Some("blend.rs"),
        gradients: Some(("blend.rs", "one_gaussian")),
    },
    StageRow {
        name: "count",
        modules: &[&counts::COUNT_LABELS, &counts::GATHER_COUNTS],
        cpu: &["counts.rs", "renderer/count.rs"],
        reference: Some("identity.rs"),
        gradients: None,
    },
];

/// Kernels that look at the device itself.
pub const OF_THE_DEVICE: &[&Module] = &[&workgroup::SELF_CHECK, &speed::SPEED];

/// Every WGSL file of this crate that has entry points.
pub fn modules() -> impl Iterator<Item = &'static Module> {
    STAGES.iter().flat_map(|row| row.modules).chain(OF_THE_DEVICE).copied()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;

    /// Names without the ending of the WGSL files below a folder that have entry points.
    fn kernels_below(folder: &Path, found: &mut BTreeSet<String>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                kernels_below(&path, found);
            } else if path.extension().is_some_and(|ending| ending == "wgsl")
                && std::fs::read_to_string(&path).unwrap().contains("@compute")
            {
                found.insert(path.file_stem().unwrap().to_str().unwrap().to_owned());
            }
        }
    }

    #[test]
    fn every_kernel_is_in_the_table() {
        let mut found = BTreeSet::new();
        kernels_below(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src/wgpu"), &mut found);
        let listed: BTreeSet<String> = modules().map(|module| module.name.to_owned()).collect();
        assert_eq!(listed, found);
    }

    #[test]
    fn rows_name_files_and_tests_that_are_there() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        for row in STAGES {
            let cpu = row.cpu.iter().map(|file| folder.join("src/cpu").join(file));
            let reference = row.reference.iter().map(|file| folder.join("src/reference").join(file));
            for path in cpu.chain(reference) {
                assert!(path.is_file(), "{}: {} is not there", row.name, path.display());
            }
            if let Some((file, test)) = row.gradients {
                let text = std::fs::read_to_string(folder.join("tests/renderers").join(file)).unwrap();
                assert!(
                    text.contains(&format!("#[test]\nfn {test}()")),
                    "{}: {file} has no {test}",
                    row.name
                );
            }
        }
    }
}
