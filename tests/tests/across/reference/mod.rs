//! The pages of `docs/reference/` are generated from the code: compared with what it gives, or written with
//! `CIF_WRITE_DOCS=1`, which `make docs` sets.

mod commands;
mod environment;
mod json;
mod python;
mod settings;
mod source;

use std::path::Path;

use cif_system::environment::WRITE_DOCS;

#[test]
fn commands_are_as_in_the_reference() {
    check("commands.md", &commands::page());
}

#[test]
fn environment_variables_are_as_in_the_reference() {
    check("environment.md", &environment::page());
}

#[test]
fn json_outputs_are_as_in_the_reference() {
    check("json.md", &json::page(&source::Sources::read()));
}

#[test]
fn settings_are_as_in_the_reference() {
    check("settings.md", &settings::page());
}

#[test]
fn python_is_as_in_the_reference() {
    check("python.md", &python::page());
}

/// Compares a stored page with what the code gives, or writes it.
fn check(name: &str, page: &str) {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/reference"));
    let path = folder.join(name);
    if WRITE_DOCS.text().is_some_and(|value| value == "1") {
        std::fs::create_dir_all(folder).unwrap();
        cif::output::write_file(&path, page.as_bytes()).unwrap();
        return;
    }
    let stored = std::fs::read_to_string(&path).unwrap_or_default().replace("\r\n", "\n");
    let differs = page.lines().zip(stored.lines()).find(|(new, old)| new != old);
    assert!(stored == page, "docs/reference/{name} is stale: run make docs (first difference: {differs:?})");
}

/// Plain text as Markdown: characters that would format it are escaped, except in code (in backticks, or indented by
/// four spaces).
fn escape(text: &str) -> String {
    let mut escaped = String::new();
    let mut in_code = false;
    for line in text.split_inclusive('\n') {
        let is_block = line.starts_with("    ");
        for character in line.chars() {
            in_code ^= character == '`' && !is_block;
            if matches!(character, '*' | '<') && !in_code && !is_block {
                escaped.push('\\');
            }
            escaped.push(character);
        }
    }
    escaped
}

#[test]
fn only_text_outside_of_code_is_escaped() {
    assert_eq!(escape("a * b `a * b` <c>\n    a * b\n"), "a \\* b `a * b` \\<c>\n    a * b\n");
}
