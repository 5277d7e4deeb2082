//! The environment variables, from the table that is read.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use cif_system::environment::{ALL, Readers};

const HEAD: &str = "\
# Environment variables

Generated from `crates/cif-system/src/environment.rs` by `make docs`; do not edit.
";

/// The page.
pub(super) fn page() -> String {
    let mut page = HEAD.to_owned();
    for (readers, heading) in
        [(Readers::Users, "Of the command and the Python module"), (Readers::Tests, "Of tests and the build")]
    {
        write!(page, "\n## {heading}\n\n| variable | values | default | effect |\n|---|---|---|---|\n")
            .unwrap();
        for variable in ALL.iter().filter(|variable| variable.readers() == readers) {
            let (name, values, default) = (variable.name(), variable.values(), variable.default());
            writeln!(page, "| `{name}` | {values} | {default} | {} |", variable.effect().trim()).unwrap();
        }
    }
    page
}

/// Files below a folder of the repository that end in `ending`.
pub(super) fn files(folder: &Path, ending: &str, found: &mut Vec<PathBuf>) {
    for entry in folder.read_dir().unwrap().map(|entry| entry.unwrap()) {
        let path = entry.path();
        if path.is_dir() {
            files(&path, ending, found);
        } else if path.extension().is_some_and(|extension| extension == ending) {
            found.push(path);
        }
    }
}

/// Files of some folders of the repository, with their names from its root.
fn sources(folders: &[&str], ending: &str) -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut found = Vec::new();
    folders.iter().for_each(|folder| files(&root.join(folder), ending, &mut found));
    let name = |path: &PathBuf| path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
    found.iter().map(|path| (name(path), std::fs::read_to_string(path).unwrap())).collect()
}

#[test]
fn variables_are_read_through_the_table_alone() {
    // Tests that start themselves as a child process hand it a folder by a variable of their own.
    const HANDED_TO_CHILDREN: [&str; 3] = [
        "crates/cif-dataset/tests/masks.rs",
        "crates/cif-output/src/unfinished.rs",
        "crates/cif-vision/src/library.rs",
    ];
    const CALLS: [&str; 4] = ["var", "var_os", "vars", "vars_os"];
    let readers: BTreeSet<String> = sources(&["crates", "tests", "examples"], "rs")
        .into_iter()
        .filter(|(_, text)| CALLS.iter().any(|call| text.contains(&format!("env::{call}("))))
        .map(|(name, _)| name)
        .filter(|name| !HANDED_TO_CHILDREN.contains(&name.as_str()))
        // Cargo gives a build script its output folder in variables.
        .filter(|name| !name.ends_with("/build.rs"))
        .collect();
    assert_eq!(readers, BTreeSet::from(["crates/cif-system/src/environment.rs".to_owned()]));
}

#[test]
fn variables_of_python_code_are_in_the_table() {
    let mut read = BTreeSet::new();
    for (_, text) in sources(&["crates/cif-python/python", "tests/python"], "py") {
        for word in text.split(|character: char| !character.is_alphanumeric() && character != '_') {
            let is_ours = word.starts_with("CIF_TEST_") || word.starts_with("PXR_");
            if is_ours {
                read.insert(word.to_owned());
            }
        }
    }
    assert!(read.contains("CIF_TEST_MUJOCO") && read.contains("PXR_PLUGINPATH_NAME"), "{read:?}");
    let known: BTreeSet<String> = ALL.iter().map(|variable| variable.name().to_owned()).collect();
    assert!(read.is_subset(&known), "{:?}", read.difference(&known));
}
