//! The table of numerically hard cases in `tests/README.md` names tests that exist, for every row.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Rows of the methods reference, section 7.
const ROWS: u32 = 44;

/// Tests named in a row, as path and function.
fn tests_of(row: &str) -> Vec<(&str, &str)> {
    row.split('`')
        .filter_map(|span| span.split_once(".rs::").map(|_| span))
        .filter_map(|span| span.rsplit_once("::"))
        .collect()
}

#[test]
fn every_row_names_tests_that_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let table = fs::read_to_string(root.join("tests/README.md")).unwrap();
    let mut rows = BTreeMap::new();
    for line in table.lines().filter(|line| line.starts_with("| ")) {
        let Some(number) = line.split('|').nth(1).and_then(|cell| cell.trim().parse::<u32>().ok()) else {
            continue;
        };
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        assert_eq!(cells.len(), 8, "row {number} has eight columns: {line}");
        assert!(rows.insert(number, tests_of(line)).is_none(), "row {number} is there twice");
        for worst in &cells[4..] {
            let is_stated = !worst.is_empty() && *worst != "?";
            assert!(is_stated, "row {number} states no worst error; see how the table is made");
        }
    }
    assert_eq!(rows.keys().copied().collect::<Vec<_>>(), (1..=ROWS).collect::<Vec<_>>());
    for (number, tests) in rows {
        assert!(!tests.is_empty(), "row {number} names no test");
        for (path, name) in tests {
            let source =
                fs::read_to_string(root.join(path)).unwrap_or_else(|e| panic!("row {number}: {path}: {e}"));
            // A function of a suite, which is a test of every renderer.
            let suite = source.split_once("tests_of!(").map_or("", |(_, list)| list);
            if suite.lines().any(|line| line.trim() == format!("{name},")) {
                continue;
            }
            let declared =
                source.lines().map(str::trim).position(|line| line.starts_with(&format!("fn {name}(")));
            let declared = declared.unwrap_or_else(|| panic!("row {number}: {path} has no test {name}"));
            let attributes: Vec<&str> = source.lines().take(declared).collect();
            let is_test = attributes.iter().rev().take(3).any(|line| line.trim() == "#[test]");
            assert!(is_test, "row {number}: {path}: {name} is no test");
        }
    }
}

#[test]
fn names_are_read_from_rows() {
    let row = "| 1 | a | b | `x/y.rs::first` `z.rs::second` and `no_test` | exact |";
    assert_eq!(tests_of(row), [("x/y.rs", "first"), ("z.rs", "second")]);
}
