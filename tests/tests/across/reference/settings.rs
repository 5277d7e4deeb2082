//! Training settings: doc comments from the source, values and limits from the types themselves.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use cif_dataset::Layout;
use cif_train::TrainConfig;
use cif_train::config::Preset;
use toml::{Table, Value};

use super::escape;

const SOURCES: [&str; 2] = [
    include_str!("../../../../crates/cif-train/src/config/mod.rs"),
    include_str!("../../../../crates/cif-field/src/deformation/mod.rs"),
];

const HEAD: &str = "\
# Training settings

Generated from the code by `make docs`; do not edit.

Each setting can be given as `cif train --set KEY=VALUE`, or in the TOML file of `--config`. \"Default\" is the value of
the preset `standard`. Values that a preset has for captures of some layouts only are listed apart. Codes such as A7
number questions that the publication of the method leaves open.
";

/// The layout whose presets are those of all.
const COMMON: Layout = Layout::Colmap;

/// A struct of the source: its doc comment and public fields.
#[derive(Default)]
struct Struct {
    doc: String,
    fields: Vec<Field>,
}

struct Field {
    name: String,
    kind: String,
    doc: String,
}

/// The page.
pub(super) fn page() -> String {
    let structs: BTreeMap<String, Struct> = SOURCES.iter().flat_map(|source| structs(source)).collect();
    let mut page = HEAD.to_owned();
    let mut keys = Vec::new();
    write_table(&mut page, &structs, "TrainConfig", "", &mut keys);
    for key in leaves(&values(Preset::Standard, COMMON), "") {
        assert!(keys.contains(&key), "no doc comment was found for the setting {key}");
    }
    page
}

/// The settings of a table, then those of the tables in it.
fn write_table(
    page: &mut String,
    structs: &BTreeMap<String, Struct>,
    name: &str,
    prefix: &str,
    keys: &mut Vec<String>,
) {
    let table = &structs[name];
    let (inner, plain): (Vec<_>, Vec<_>) =
        table.fields.iter().partition(|field| structs.contains_key(&field.kind));
    for field in plain {
        let key = format!("{prefix}{}", field.name);
        write!(page, "\n### `{key}`\n\n{}\n\n", escape(&field.doc)).unwrap();
        write_values(page, &key);
        keys.push(key);
    }
    for field in inner {
        let key = format!("{prefix}{}", field.name);
        let doc = if prefix.is_empty() { &structs[&field.kind].doc } else { &field.doc };
        write!(page, "\n## `{key}`\n\n{}\n", escape(doc)).unwrap();
        write_table(page, structs, &field.kind, &format!("{key}."), keys);
    }
}

/// Type, limits and values of a setting.
fn write_values(page: &mut String, key: &str) {
    let limit = limit_of(key).map(|limit| format!("; {limit}")).unwrap_or_default();
    writeln!(page, "- Takes: {}{limit}", type_of(key)).unwrap();
    let value = |preset, layout| match at(&values(preset, layout), key) {
        Some(value) => format!("`{value}`"),
        None => "none".to_owned(),
    };
    let common = Preset::ALL.map(|preset| value(preset, COMMON));
    if common.iter().all(|value| *value == common[0]) {
        writeln!(page, "- Value in every preset: {}", common[0]).unwrap();
    } else {
        let named: Vec<String> = Preset::ALL
            .iter()
            .zip(&common)
            .map(|(preset, value)| format!("{} in `{}`", value, name_of(*preset)))
            .collect();
        writeln!(page, "- Value: {}", named.join(", ")).unwrap();
    }
    for (preset, common) in Preset::ALL.iter().zip(&common) {
        let mut layouts: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for layout in Layout::ALL {
            let own = value(*preset, layout);
            if own != *common {
                layouts.entry(own).or_default().push(format!("`{}`", layout.name()));
            }
        }
        for (value, layouts) in layouts {
            writeln!(page, "- In `{}` for {}: {value}", name_of(*preset), layouts.join(", ")).unwrap();
        }
    }
}

/// Name of a preset as it is typed.
fn name_of(preset: Preset) -> String {
    let value = Value::try_from(preset).unwrap();
    value.as_str().unwrap().to_owned()
}

/// Every setting of a preset. By way of text, which has the shortest digits of each number.
fn values(preset: Preset, layout: Layout) -> Table {
    toml::to_string(&TrainConfig::preset(preset, layout)).unwrap().parse().unwrap()
}

/// The value of a dotted key.
fn at<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    match key.split_once('.') {
        Some((head, rest)) => at(table.get(head)?.as_table()?, rest),
        None => table.get(key),
    }
}

/// Dotted keys of all values; an empty table is one.
fn leaves(table: &Table, prefix: &str) -> Vec<String> {
    let leaf = |(key, value): (&String, &Value)| match value {
        Value::Table(inner) if !inner.is_empty() => leaves(inner, &format!("{prefix}{key}.")),
        _ => vec![format!("{prefix}{key}")],
    };
    table.iter().flat_map(leaf).collect()
}

/// The settings of `standard` with one of them changed, or the reason why it cannot have this value.
fn with(key: &str, value: Value) -> Result<TrainConfig, String> {
    let mut table = values(Preset::Standard, COMMON);
    let mut inner = &mut table;
    let mut rest = key;
    while let Some((head, tail)) = rest.split_once('.') {
        inner = inner.get_mut(head).and_then(Value::as_table_mut).unwrap();
        rest = tail;
    }
    inner.insert(rest.to_owned(), value);
    Value::Table(table).try_into().map_err(|error: toml::de::Error| error.message().trim().to_owned())
}

/// Type of a setting, by the messages with which others are refused.
fn type_of(key: &str) -> String {
    let word = || Value::String("?".to_owned());
    match with(key, word()) {
        Ok(_) => "text".to_owned(),
        Err(message) => match expected(&message) {
            "a map" => {
                let inner =
                    with(key, Value::Table(Table::from_iter([("name".to_owned(), word())]))).unwrap_err();
                format!("a table of names, each with one of {}", kind(expected(&inner)))
            }
            "a sequence" => {
                let inner = with(key, Value::Array(vec![word()])).unwrap_err();
                format!("a list, each {}", kind(expected(&inner)))
            }
            array if array.starts_with("an array of length ") => {
                let length = array.trim_start_matches("an array of length ");
                let inner = with(key, Value::Array(vec![word()])).unwrap_err();
                format!("a list of {length}, each {}", kind(expected(&inner)))
            }
            other => kind(other),
        },
    }
}

/// The part of a message of serde that says what it takes.
fn expected(message: &str) -> &str {
    let (_, expected) = message.split_once(", expected ").expect("a message that names what is expected");
    expected.lines().next().unwrap_or_default().trim_start_matches("one of ")
}

/// A type of Rust in words; names stay.
fn kind(expected: &str) -> String {
    match expected {
        "u8" | "u32" | "u64" => "a whole number".to_owned(),
        "f32" => "a number".to_owned(),
        "a boolean" => "`true` or `false`".to_owned(),
        names => names.to_owned(),
    }
}

/// Limits of a setting, by the words with which checks refuse values outside of them.
fn limit_of(key: &str) -> Option<String> {
    let whole = [0, i64::from(u8::MAX), i64::from(u32::MAX)].map(Value::Integer);
    let real = [-1.0, 0.0, 1e9].map(Value::Float);
    let now = at(&values(Preset::Standard, COMMON), key).cloned().unwrap_or(Value::Integer(1));
    let candidates: Vec<Value> = match now {
        Value::Integer(_) => whole.into(),
        Value::Float(_) => real.into(),
        Value::Array(items) => {
            let filled = |value: Value| Value::Array(vec![value; items.len()]);
            whole.into_iter().chain(real).map(filled).collect()
        }
        _ => Vec::new(),
    };
    let refused = |value| with(key, value).ok()?.validate().err();
    let of_key = |error: &cif_train::config::ConfigError| error.key.split('[').next() == Some(key);
    let error = candidates.into_iter().filter_map(refused).find(of_key)?;
    Some(error.expected.trim_start_matches("expected ").to_owned())
}

/// The structs of a source file with their doc comments, by name.
fn structs(source: &str) -> Vec<(String, Struct)> {
    let mut found: Vec<(String, Struct)> = Vec::new();
    let mut doc: Vec<&str> = Vec::new();
    let mut is_inside = false;
    for line in source.lines() {
        let text = line.trim();
        if let Some(words) = text.strip_prefix("///") {
            doc.push(words.trim());
            continue;
        }
        if text.starts_with("#[") {
            continue;
        }
        let words = doc.join(" ").replace("[`", "`").replace("`]", "`");
        if let Some(name) = line.strip_prefix("pub struct ").and_then(|rest| rest.strip_suffix(" {")) {
            found.push((name.to_owned(), Struct { doc: words, fields: Vec::new() }));
            is_inside = true;
        } else if let Some((name, kind)) = text
            .strip_prefix("pub ")
            .and_then(|rest| rest.strip_suffix(','))
            .and_then(|rest| rest.split_once(": "))
            .filter(|_| is_inside)
        {
            let (_, last) = found.last_mut().unwrap();
            last.fields.push(Field { name: name.to_owned(), kind: kind.to_owned(), doc: words });
        } else if line == "}" {
            is_inside = false;
        }
        doc.clear();
    }
    found
}
