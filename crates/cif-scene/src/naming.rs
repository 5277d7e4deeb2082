//! Names that every format accepts: `[A-Za-z0-9_]`, not starting with a digit.

use std::collections::{BTreeMap, BTreeSet};

/// Name of the node that holds everything outside the instances.
pub const BACKGROUND: &str = "background";
/// Name of what moves of the background, where the rest stands still.
pub const MOVING_BACKGROUND: &str = "background_moving";
/// Label of it.
pub const MOVING_BACKGROUND_LABEL: &str = "moving background";

/// Name made from a label and an id: `red mug` and 1 give `red_mug_001`.
///
/// Characters other than ASCII letters and digits become single underscores; a label without any usable
/// character becomes `instance`.
#[must_use]
pub fn instance_name(label: &str, id: u16) -> String {
    format!("{}_{id:03}", identifier(label, "instance"))
}

/// `text` as an identifier; `fallback` where nothing usable is left.
#[must_use]
pub fn identifier(text: &str, fallback: &str) -> String {
    let mut name = String::with_capacity(text.len());
    for character in text.chars() {
        if character.is_ascii_alphanumeric() {
            name.push(character);
        } else if !name.is_empty() && !name.ends_with('_') {
            name.push('_');
        }
    }
    let name = name.trim_end_matches('_');
    if name.is_empty() {
        return fallback.to_owned();
    }
    if name.starts_with(|first: char| first.is_ascii_digit()) { format!("_{name}") } else { name.to_owned() }
}

/// Label for a name that a person gave: without the id at its end, underscores as blanks. `blue_mug_001` and 1
/// give `blue mug`.
#[must_use]
pub fn label_of_name(name: &str, id: u16) -> String {
    let bare = name.strip_suffix(&format!("_{id:03}")).unwrap_or(name);
    let label = bare.replace('_', " ").trim().to_owned();
    if label.is_empty() { name.to_owned() } else { label }
}

/// Names that were given, so that none is given twice.
#[derive(Clone, Debug, Default)]
pub struct Names {
    taken: BTreeSet<String>,
    /// Last number given to a name that was asked for again.
    numbers: BTreeMap<String, u64>,
}

impl Names {
    /// Gives `name`, or `name_2`, `name_3`, ... where it is taken.
    pub fn take(&mut self, name: String) -> String {
        if self.taken.insert(name.clone()) {
            return name;
        }
        // Names are never free again, so that the search goes on where it ended.
        let number = self.numbers.entry(name.clone()).or_insert(1);
        loop {
            *number += 1;
            let candidate = format!("{name}_{number}");
            if self.taken.insert(candidate.clone()) {
                return candidate;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_become_identifiers() {
        let cases = [
            ("red mug", 1, "red_mug_001"),
            ("  Tasse (blau) ", 12, "Tasse_blau_012"),
            ("3rd box", 7, "_3rd_box_007"),
            ("杯子", 4, "instance_004"),
            ("", 65_535, "instance_65535"),
            ("__a--b__", 2, "a_b_002"),
        ];
        for (label, id, name) in cases {
            assert_eq!(instance_name(label, id), name, "{label}");
        }
    }

    #[test]
    fn names_become_labels() {
        for (name, label) in
            [("blue_mug_007", "blue mug"), ("blue_mug", "blue mug"), ("_007", "_007"), ("a_008", "a 008")]
        {
            assert_eq!(label_of_name(name, 7), label);
        }
    }

    #[test]
    fn taken_names_are_numbered() {
        let mut names = Names::default();
        let mut take = |name: &str| names.take(name.to_owned());
        assert_eq!(
            ["a_2", "a", "a", "a", "b", "a_2"].map(&mut take),
            ["a_2", "a", "a_3", "a_4", "b", "a_2_2"]
        );
    }
}
