//! Reports of commands as JSON, and the log of a training: fields, types and doc comments of the types that are
//! serialised, read from the source.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use super::escape;
use super::source::{Field, Item, Kind, Sources};

const HEAD: &str = "\
# JSON outputs

Generated from the code by `make docs`; do not edit.

`--json` prints the report of a command as one JSON document and nothing else; `--json FILE.json` writes it into a file.
`cif train --log FILE` writes one JSON object per line and event. Fields may be added, so readers should leave those
alone that they do not know. Numbers that are not finite, and whatever there is none of, are `null`. Ids of instances are the values
of the pixels of masks.
";

/// The page.
pub(super) fn page(sources: &Sources) -> String {
    let mut page = HEAD.to_owned();
    let mut reports: Vec<(String, &Item)> = Vec::new();
    for (commands, kind, file) in sources.reports() {
        let item = sources.find(kind, file).unwrap_or_else(|| panic!("{kind} of {file} is in no source"));
        reports
            .push((commands.iter().map(|words| format!("`{words}`")).collect::<Vec<_>>().join(", "), item));
    }
    reports.sort_by(|a, b| a.0.cmp(&b.0));
    let log = sources.find("LogLine", "crates/cif/src/progress.rs").expect("the lines of the log");
    reports.push(("`cif train --log`".to_owned(), log));
    let mut open: Vec<&Item> = Vec::new();
    for (commands, item) in &reports {
        write!(page, "\n## {commands}\n\n{}\n", escape(&item.doc)).unwrap();
        write_item(&mut page, sources, item, &mut open);
    }
    page.push_str("\n# Types\n");
    let mut written: BTreeSet<(&str, &str)> = BTreeSet::new();
    let mut types: BTreeMap<(&str, &str), String> = BTreeMap::new();
    while let Some(item) = open.pop() {
        if written.insert((&item.name, &item.file)) {
            let mut text = format!("\n## {}\n\n{}\n", item.name, escape(&item.doc));
            write_item(&mut text, sources, item, &mut open);
            types.insert((&item.name, &item.file), text);
        }
    }
    let names: Vec<&str> = types.keys().map(|(name, _)| *name).collect();
    let twice = names.windows(2).find(|pair| pair[0] == pair[1]);
    assert!(twice.is_none(), "two types of reports are called {twice:?}, which readers cannot keep apart");
    page.extend(types.into_values());
    page
}

/// The fields or variants of a type; types that they name are added to `open`.
fn write_item<'a>(page: &mut String, sources: &'a Sources, item: &'a Item, open: &mut Vec<&'a Item>) {
    match &item.kind {
        Kind::Fields(fields) => {
            page.push('\n');
            write_fields(page, sources, item, fields, open);
        }
        Kind::Same(inner) => {
            writeln!(page, "\n{}.", capital(&sources.words(inner, &item.file, open))).unwrap()
        }
        Kind::Variants(variants) => {
            page.push('\n');
            if let Some(tag) = &item.tag {
                let names: Vec<String> =
                    variants.iter().map(|variant| format!("`\"{}\"`", variant.name)).collect();
                writeln!(page, "- `{tag}`, one of {}", names.join(", ")).unwrap();
            }
            for variant in variants {
                let name = match &item.tag {
                    Some(tag) => format!("`{tag}`: `\"{}\"`", variant.name),
                    None => format!("`\"{}\"`", variant.name),
                };
                writeln!(page, "- {name}: {}", escape(&variant.doc)).unwrap();
                let mut fields = String::new();
                write_fields(&mut fields, sources, item, &variant.fields, open);
                fields.lines().for_each(|line| writeln!(page, "  {line}").unwrap());
            }
        }
    }
}

/// Fields as entries of a list, those of flattened types among them.
fn write_fields<'a>(
    page: &mut String,
    sources: &'a Sources,
    item: &'a Item,
    fields: &'a [Field],
    open: &mut Vec<&'a Item>,
) {
    for field in fields {
        // The value of a variant, which has no name.
        if field.name.is_empty() {
            writeln!(page, "- {}", sources.words(&field.kind, &item.file, open)).unwrap();
            continue;
        }
        if field.is_flat {
            if let Some(inner) = sources.named(&field.kind, &item.file) {
                if let Kind::Fields(fields) = &inner.kind {
                    write_fields(page, sources, inner, fields, open);
                } else {
                    writeln!(page, "- the fields of {}", sources.words(&field.kind, &item.file, open))
                        .unwrap();
                }
                continue;
            }
            writeln!(
                page,
                "- further fields ({}): {}",
                sources.words(&field.kind, &item.file, open),
                escape(&field.doc)
            )
            .unwrap();
            continue;
        }
        // Left out of the report, see `without_bookkeeping`.
        let is_bookkeeping =
            item.name == "Record" && ["fingerprint", "pictures"].contains(&field.name.as_str());
        if is_bookkeeping {
            continue;
        }
        let words = sources.words(&field.kind, &item.file, open);
        writeln!(page, "- `{}` ({words}): {}", field.name, escape(&field.doc)).unwrap();
    }
}

fn capital(text: &str) -> String {
    let mut characters = text.chars();
    characters.next().map_or_else(String::new, |first| first.to_uppercase().chain(characters).collect())
}

/// Keys of a JSON value, at any depth.
fn keys<'a>(value: &'a serde_json::Value, found: &mut BTreeSet<&'a str>) {
    match value {
        serde_json::Value::Object(members) => {
            for (key, value) in members {
                found.insert(key);
                keys(value, found);
            }
        }
        serde_json::Value::Array(items) => items.iter().for_each(|item| keys(item, found)),
        _ => {}
    }
}

#[test]
fn reports_have_the_fields_of_the_page() {
    let folder = tempfile::tempdir().unwrap();
    let capture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/tabletop-mini");
    let page = page(&Sources::read());
    for line in ["info CAPTURE --json", "plan CAPTURE --json", "info --gpu --json"] {
        let words =
            line.split(' ').map(|word| if word == "CAPTURE" { capture.to_str().unwrap() } else { word });
        let run =
            cif_test::command::run(env!("CARGO_BIN_EXE_cif-under-test"), folder.path(), words).succeeds();
        let report: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
        let mut found = BTreeSet::new();
        keys(&report, &mut found);
        assert!(found.len() > 3, "{line}: {report}");
        // Keys that are names of the capture, or of limits of a GPU.
        let names = ["groups", "limits", "taxonomies"].iter().filter_map(|key| {
            let place = report
                .pointer(&format!("/{key}"))
                .or_else(|| report.pointer(&format!("/adapters/0/{key}")))?;
            place.as_object()
        });
        let names: BTreeSet<&str> = names.flat_map(|map| map.keys().map(String::as_str)).collect();
        for key in found.difference(&names) {
            assert!(page.contains(&format!("- `{key}` (")), "{line}: `{key}` is not on the page");
        }
    }
}
