//! The rows of `crates/README.md`: a crate uses only crates on lower rows, and Python stays in two of them.

use std::collections::BTreeMap;

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand, Package};

/// Row of every crate; 0 is the lowest.
const ROWS: [(&str, u32); 14] = [
    ("cif-geometry", 0),
    ("cif-output", 0),
    ("cif-input", 0),
    ("cif-dataset", 1),
    ("cif-field", 1),
    ("cif-render", 2),
    ("cif-train", 3),
    ("cif-scene", 3),
    ("cif-usd", 4),
    ("cif-gltf", 4),
    ("cif-ply", 4),
    ("cif-exr", 4),
    ("cif", 5),
    ("cif-python", 6),
];

/// Packages that are not part of the product and may use all of it.
const OUTSIDE: [&str; 2] = ["cif-test", "cif-examples"];

fn metadata() -> Metadata {
    MetadataCommand::new()
        .manifest_path(concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml"))
        .no_deps()
        .other_options(vec!["--offline".to_owned()])
        .exec()
        .expect("cargo metadata runs")
}

/// Uses of a crate on the same row or above.
fn upward(package: &Package, rows: &BTreeMap<&str, u32>) -> Vec<String> {
    let Some(row) = rows.get(package.name.as_str()) else { return Vec::new() };
    package
        .dependencies
        .iter()
        .filter(|dependency| rows.get(dependency.name.as_str()).is_some_and(|used| used >= row))
        .map(|dependency| format!("{} uses {}", package.name, dependency.name))
        .collect()
}

#[test]
fn crates_use_only_lower_rows() {
    let rows = BTreeMap::from(ROWS);
    let wrong: Vec<String> =
        metadata().workspace_packages().iter().flat_map(|package| upward(package, &rows)).collect();
    assert!(wrong.is_empty(), "against the rows of crates/README.md: {}", wrong.join(", "));
}

#[test]
fn an_upward_dependency_would_be_found() {
    // The same check with the rows turned over must object.
    let rows: BTreeMap<&str, u32> = ROWS.into_iter().map(|(name, row)| (name, 6 - row)).collect();
    let wrong: Vec<String> =
        metadata().workspace_packages().iter().flat_map(|package| upward(package, &rows)).collect();
    assert!(wrong.contains(&"cif-field uses cif-geometry".to_owned()), "{wrong:?}");
}

#[test]
fn every_package_has_a_row() {
    let rows = BTreeMap::from(ROWS);
    for package in metadata().workspace_packages() {
        let name = package.name.as_str();
        assert!(rows.contains_key(name) || OUTSIDE.contains(&name), "{name} needs a row in crates/README.md");
    }
}

#[test]
fn python_stays_in_two_crates() {
    for package in metadata().workspace_packages() {
        let name = package.name.as_str();
        let python = package.dependencies.iter().filter(|d| ["pyo3", "numpy"].contains(&d.name.as_str()));
        for dependency in python {
            assert!(["cif-usd", "cif-python"].contains(&name), "{name} uses {}", dependency.name);
            let optional = dependency.optional || dependency.kind == DependencyKind::Development;
            assert!(name == "cif-python" || optional, "cif-usd needs Python only with its feature");
        }
    }
}
