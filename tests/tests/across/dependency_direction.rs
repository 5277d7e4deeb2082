//! The rows of `crates/README.md`: a crate uses only crates on lower rows, and Python stays in two of them.

use std::collections::BTreeMap;
use std::process::Command;

use serde_json::Value;

/// Row of every crate; 0 is the lowest.
const ROWS: [(&str, u32); 21] = [
    ("cif-geometry", 0),
    ("cif-output", 0),
    ("cif-input", 0),
    ("cif-system", 0),
    ("cif-dataset", 1),
    ("cif-field", 1),
    ("cif-vision", 1),
    ("cif-render", 2),
    ("cif-masks", 2),
    ("cif-batch", 2),
    ("cif-capture", 2),
    ("cif-train", 3),
    ("cif-scene", 3),
    ("cif-usd", 4),
    ("cif-gltf", 4),
    ("cif-ply", 4),
    ("cif-web", 4),
    ("cif-exr", 4),
    ("cif-bench", 5),
    ("cif", 6),
    ("cif-python", 7),
];

/// Packages that are not part of the product and may use all of it.
const OUTSIDE: [&str; 2] = ["cif-test", "cif-examples"];

/// A package of the workspace, as its manifest describes it.
struct Package {
    name: String,
    dependencies: Vec<Dependency>,
}

/// What a package depends on.
struct Dependency {
    name: String,
    /// True when a feature or the package's own tests ask for it.
    is_optional: bool,
}

fn packages() -> Vec<Package> {
    let arguments = ["metadata", "--format-version=1", "--no-deps", "--offline", "--manifest-path"];
    let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
    let output = Command::new(env!("CARGO")).args(arguments).arg(manifest).output().expect("cargo starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo writes JSON");
    let text = |value: &Value| value.as_str().expect("a text").to_owned();
    let list = |value: &Value| value.as_array().expect("a list").clone();
    let dependency = |value: &Value| Dependency {
        name: text(&value["name"]),
        is_optional: value["optional"] == true || value["kind"] == "dev",
    };
    let package = |value: &Value| Package {
        name: text(&value["name"]),
        dependencies: list(&value["dependencies"]).iter().map(dependency).collect(),
    };
    list(&metadata["packages"]).iter().map(package).collect()
}

/// Uses of a crate on the same row or above.
fn upward(rows: &BTreeMap<&str, u32>) -> Vec<String> {
    let mut found = Vec::new();
    for package in packages() {
        let Some(row) = rows.get(package.name.as_str()) else { continue };
        for dependency in &package.dependencies {
            if rows.get(dependency.name.as_str()).is_some_and(|used| used >= row) {
                found.push(format!("{} uses {}", package.name, dependency.name));
            }
        }
    }
    found
}

#[test]
fn crates_use_only_lower_rows() {
    let wrong = upward(&BTreeMap::from(ROWS));
    assert!(wrong.is_empty(), "against the rows of crates/README.md: {}", wrong.join(", "));
}

#[test]
fn an_upward_dependency_would_be_found() {
    // The same check with the rows turned over must object.
    let top = ROWS.iter().map(|(_, row)| *row).max().unwrap_or(0);
    let rows = ROWS.into_iter().map(|(name, row)| (name, top - row)).collect();
    let wrong = upward(&rows);
    assert!(wrong.contains(&"cif-field uses cif-geometry".to_owned()), "{wrong:?}");
}

#[test]
fn every_package_has_a_row() {
    let rows = BTreeMap::from(ROWS);
    for Package { name, .. } in packages() {
        let is_placed = rows.contains_key(name.as_str()) || OUTSIDE.contains(&name.as_str());
        assert!(is_placed, "{name} needs a row in crates/README.md");
    }
}

#[test]
fn python_stays_in_two_crates() {
    let mut uses = 0;
    for Package { name, dependencies } in packages() {
        for dependency in dependencies.iter().filter(|d| ["pyo3", "numpy"].contains(&d.name.as_str())) {
            uses += 1;
            assert!(["cif-usd", "cif-python"].contains(&name.as_str()), "{name} uses {}", dependency.name);
            let is_allowed = name == "cif-python" || dependency.is_optional;
            assert!(is_allowed, "cif-usd needs Python only with its feature");
        }
    }
    assert_eq!(uses, 4, "two crates use both");
}
