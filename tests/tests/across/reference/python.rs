//! The Python package, from its stub and its public files.

use std::fmt::Write as _;

use super::escape;

const PACKAGE: &str = include_str!("../../../../crates/cif-python/python/cif/__init__.py");
const STUB: &str = include_str!("../../../../crates/cif-python/python/cif/_native.pyi");
const VIEW: &str = include_str!("../../../../crates/cif-python/python/cif/_view.py");
const USD: &str = include_str!("../../../../crates/cif-python/python/cif/usd.py");

const HEAD: &str = "\
# Python

Generated from the docstrings of the package by `make docs`; do not edit.
";

/// A class, function or attribute.
struct Item {
    name: String,
    /// As it is written, with its decorators, without the colon at its end.
    signature: String,
    doc: String,
    members: Vec<Item>,
}

impl Item {
    fn is_class(&self) -> bool {
        self.signature.starts_with("class ")
    }

    fn is_options(&self) -> bool {
        self.signature.contains("(TypedDict")
    }

    fn is_property(&self) -> bool {
        self.signature.starts_with("@property")
    }
}

/// The page.
pub(super) fn page() -> String {
    let mut page = HEAD.to_owned();
    let own: Vec<Item> = [PACKAGE, VIEW].into_iter().flat_map(items).collect();
    let native = items(STUB);
    let names = public_names(PACKAGE);
    write!(page, "\n## Module `cif`\n\n{}\n", prose(&module_doc(PACKAGE))).unwrap();
    if let Some((_, conventions)) = module_doc(STUB).split_once("\n\n") {
        write!(page, "\n{}\n", prose(conventions)).unwrap();
    }
    for name in &names {
        // What the package defines itself hides what it is made of.
        let item = own.iter().chain(&native).find(|item| item.name == *name);
        write_item(&mut page, "cif", item.unwrap_or_else(|| panic!("cif.{name} is in no file")));
    }
    page.push_str("\n## Options\n\nDictionaries of keyword arguments; every key may be left out.\n");
    for item in native.iter().filter(|item| item.is_options()) {
        write!(page, "\n### {}\n\n{}\n\n", item.name, prose(&item.doc)).unwrap();
        item.members.iter().for_each(|member| write_entry(&mut page, member));
    }
    let usd = items(USD);
    write!(page, "\n## Module `cif.usd`\n\n{}\n", prose(&module_doc(USD))).unwrap();
    for name in public_names(USD) {
        let item = usd.iter().find(|item| item.name == name);
        write_item(&mut page, "cif.usd", item.unwrap_or_else(|| panic!("cif.usd.{name} is in no file")));
    }
    page
}

/// A class with its members, a function or an attribute.
fn write_item(page: &mut String, module: &str, item: &Item) {
    write!(page, "\n### {module}.{}\n\n```python\n{}\n```\n", item.name, item.signature).unwrap();
    if !item.doc.is_empty() {
        write!(page, "\n{}\n", prose(&item.doc)).unwrap();
    }
    if !item.is_class() {
        return;
    }
    let shown = |member: &&Item| member.name == "__init__" || !member.name.starts_with('_');
    let (properties, methods): (Vec<&Item>, Vec<&Item>) =
        item.members.iter().filter(shown).partition(|member| member.is_property());
    if !properties.is_empty() {
        page.push_str("\nProperties:\n\n");
        properties.into_iter().for_each(|property| write_entry(page, property));
    }
    for method in methods {
        let name = if method.name == "__init__" { "constructor" } else { &method.name };
        write!(page, "\n#### {}.{name}\n\n```python\n{}\n```\n", item.name, method.signature).unwrap();
        if !method.doc.is_empty() {
            write!(page, "\n{}\n", prose(&method.doc)).unwrap();
        }
    }
}

/// A property or option as an entry of a list.
fn write_entry(page: &mut String, item: &Item) {
    let typed = match item.signature.split_once(" -> ") {
        Some((_, kind)) => format!("{}: {kind}", item.name),
        None => item.signature.clone(),
    };
    let doc = item.doc.split('\n').collect::<Vec<_>>().join("\n  ");
    let doc = if doc.is_empty() { String::new() } else { format!("  \n  {}", prose(&doc)) };
    writeln!(page, "- `{typed}`{doc}").unwrap();
}

/// A docstring as Markdown: reStructuredText's code and blocks of code.
fn prose(doc: &str) -> String {
    escape(&doc.replace("``", "`").replace("::\n", ":\n"))
}

/// The docstring of a file.
fn module_doc(source: &str) -> String {
    let lines: Vec<&str> = source.lines().collect();
    docstring(&lines).unwrap_or_default()
}

/// The names in `__all__`.
fn public_names(source: &str) -> Vec<String> {
    let (_, list) = source.split_once("__all__ = [").expect("a list of what is public");
    let (list, _) = list.split_once(']').expect("the end of the list");
    list.split('"').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Classes, functions and attributes of a file.
fn items(source: &str) -> Vec<Item> {
    // Without the docstring of the file, which may hold code.
    let body = source.splitn(3, "\"\"\"").nth(2).unwrap_or_default();
    block(&body.lines().collect::<Vec<_>>())
}

/// What stands at the outermost level of some lines. Files are formatted by ruff: definitions begin and end with their lines.
fn block(lines: &[&str]) -> Vec<Item> {
    let mut found = Vec::new();
    let mut signature: Vec<&str> = Vec::new();
    let mut position = 0;
    while position < lines.len() {
        let line = lines[position];
        position += 1;
        if line.starts_with('@') {
            signature.push(line);
            continue;
        }
        let is_definition = line.starts_with("class ") || line.starts_with("def ");
        if !is_definition {
            if let Some((name, _)) = line.split_once(": ").filter(|(name, _)| is_name(name)) {
                let doc = docstring(&lines[position..]).unwrap_or_default();
                found.push(Item {
                    name: name.to_owned(),
                    signature: line.to_owned(),
                    doc,
                    members: Vec::new(),
                });
            }
            continue;
        }
        let mut last = line;
        signature.push(last);
        while !last.ends_with(':') && !last.ends_with(": ...") {
            last = lines[position];
            signature.push(last);
            position += 1;
        }
        let start = position;
        while position < lines.len() && (lines[position].is_empty() || lines[position].starts_with("    ")) {
            position += 1;
        }
        let body: Vec<&str> =
            lines[start..position].iter().map(|line| line.strip_prefix("    ").unwrap_or(line)).collect();
        let words = line.split_once(' ').map_or("", |(_, rest)| rest);
        let name = words.split(|character: char| !character.is_alphanumeric() && character != '_').next();
        found.push(Item {
            name: name.unwrap_or_default().to_owned(),
            signature: signature.join("\n").trim_end_matches(" ...").trim_end_matches(':').to_owned(),
            doc: docstring(&body).unwrap_or_default(),
            members: if line.starts_with("class ") { block(&body) } else { Vec::new() },
        });
        signature.clear();
    }
    found
}

fn is_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|character| character.is_alphanumeric() || character == '_')
}

/// The docstring that these lines begin with.
fn docstring(lines: &[&str]) -> Option<String> {
    let text = lines.join("\n");
    let (doc, _) = text.strip_prefix("\"\"\"")?.split_once("\"\"\"")?;
    Some(doc.trim_end().to_owned())
}
