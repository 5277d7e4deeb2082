//! The modules of a crate use one another in one direction: of the files and folders of a folder, none uses what uses it.
//! The code of a `mod.rs`, `lib.rs` or `main.rs` counts as a file of its folder.
//!
//! Read from the source: `use` declarations and paths in code (`crate::`, `super::`, `self::`, child modules and imported
//! modules), followed through re-exports to the file that defines the item. Tests (`#[cfg(test)]`) and comments do not
//! count, a re-export (`pub use`) counts only where the code of its own file names it, and methods do not count.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Files and folders of every crate that use one another in circles, at most. A crate that has fewer gets the lower number;
/// none may rise.
const MOST: [(&str, usize); 21] = [
    ("cif-geometry", 0),
    ("cif-output", 0),
    ("cif-input", 0),
    ("cif-system", 0),
    ("cif-dataset", 0),
    ("cif-field", 0),
    ("cif-vision", 0),
    ("cif-web", 0),
    ("cif-render", 0),
    ("cif-masks", 0),
    ("cif-batch", 0),
    ("cif-capture", 0),
    ("cif-train", 0),
    ("cif-scene", 0),
    ("cif-usd", 0),
    ("cif-gltf", 0),
    ("cif-ply", 0),
    ("cif-exr", 0),
    ("cif-bench", 0),
    ("cif", 0),
    ("cif-python", 0),
];

/// A piece of Rust source.
#[derive(Clone, Debug, PartialEq)]
enum Token {
    /// A word: identifier, keyword or number.
    Word(String),
    /// `::`.
    Colons,
    /// Any other character that is not white space.
    Other(char),
}

/// Words and punctuation of a source text, without comments and literals of text.
fn tokens(text: &str) -> Vec<Token> {
    let characters: Vec<char> = text.chars().collect();
    let at = |k: usize| characters.get(k).copied().unwrap_or('\0');
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let (mut found, mut k) = (Vec::new(), 0);
    while k < characters.len() {
        let c = at(k);
        if c == '/' && at(k + 1) == '/' {
            while k < characters.len() && at(k) != '\n' {
                k += 1;
            }
        } else if c == '/' && at(k + 1) == '*' {
            while k < characters.len() && !(at(k) == '*' && at(k + 1) == '/') {
                k += 1;
            }
            k += 2;
        } else if c == '"' {
            k += 1;
            while k < characters.len() && at(k) != '"' {
                k += if at(k) == '\\' { 2 } else { 1 };
            }
            k += 1;
        } else if c == '\'' {
            // A lifetime has no quote after its first letter.
            if at(k + 1) == '\\' {
                k += 3;
                while k < characters.len() && at(k) != '\'' {
                    k += 1;
                }
                k += 1;
            } else {
                k += if at(k + 2) == '\'' { 3 } else { 1 };
            }
        } else if is_word(c) {
            let start = k;
            while is_word(at(k)) {
                k += 1;
            }
            let word: String = characters[start..k].iter().collect();
            let hashes = (k..).take_while(|&place| at(place) == '#').count();
            if ["r", "br", "cr"].contains(&word.as_str()) && at(k + hashes) == '"' {
                k += hashes + 1;
                let closes = |k: usize| at(k) == '"' && (1..=hashes).all(|offset| at(k + offset) == '#');
                while k < characters.len() && !closes(k) {
                    k += 1;
                }
                k += hashes + 1;
            } else {
                found.push(Token::Word(word));
            }
        } else if c == ':' && at(k + 1) == ':' {
            found.push(Token::Colons);
            k += 2;
        } else {
            if !c.is_whitespace() {
                found.push(Token::Other(c));
            }
            k += 1;
        }
    }
    found
}

/// Segments of a path.
type Segments = Vec<String>;

/// A module: a file, or a block `mod name { .. }` in one.
#[derive(Debug, Default)]
struct Module {
    /// Its file, from the source folder of the crate.
    file: String,
    /// Modules declared in it, tests left out.
    children: BTreeSet<String>,
    /// Items that it defines.
    items: BTreeSet<String>,
    /// Imported names and their full paths.
    imports: BTreeMap<String, Segments>,
    /// Modules of which all names are imported.
    globs: Vec<Segments>,
    /// Paths that its code names, as written.
    paths: Vec<Segments>,
    /// Names imported for others to use, until the code names them too.
    exported: BTreeSet<String>,
    /// Words of its code outside of `use`.
    words: BTreeSet<String>,
}

/// The modules of a crate by their paths; the root has the empty path.
type Modules = BTreeMap<Segments, Module>;

/// Reads one file and the files of its modules.
fn read_file(source: &Path, file: &Path, path: Segments, modules: &mut Modules) {
    let text = std::fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let name = file.strip_prefix(source).expect("below the source").display().to_string();
    let tokens = tokens(&text);
    let outside = read_module(&tokens, &name, path, modules);
    for child in outside {
        let folder =
            child[..child.len() - 1].iter().fold(source.to_owned(), |folder, part| folder.join(part));
        let last = child.last().expect("modules have names");
        let candidates = [folder.join(format!("{last}.rs")), folder.join(last).join("mod.rs")];
        let found: Option<&PathBuf> = candidates.iter().find(|candidate| candidate.is_file());
        read_file(
            source,
            found.unwrap_or_else(|| panic!("no file of module {child:?} in {name}")),
            child,
            modules,
        );
    }
}

/// Reads the tokens of one module; gives the modules that lie in files of their own.
fn read_module(tokens: &[Token], file: &str, path: Segments, modules: &mut Modules) -> Vec<Segments> {
    let mut module = Module { file: file.to_owned(), ..Module::default() };
    let mut outside = Vec::new();
    let word = |k: usize| match tokens.get(k) {
        Some(Token::Word(word)) => word.as_str(),
        _ => "",
    };
    let is = |k: usize, c: char| tokens.get(k) == Some(&Token::Other(c));
    let mut depth = 0_usize;
    let mut k = 0;
    while k < tokens.len() {
        if is(k, '#') && is(k + 1, '[') {
            let end = closing(tokens, k + 1);
            let words: Vec<&str> = (k..end).map(word).filter(|word| !word.is_empty()).collect();
            let is_test = words.first() == Some(&"cfg") && words.contains(&"test") && !words.contains(&"not");
            k = end + 1;
            if is_test {
                // The item that follows, with its other attributes.
                while is(k, '#') {
                    k = closing(tokens, k + 1) + 1;
                }
                while k < tokens.len() && !is(k, ';') && !is(k, '{') {
                    k = if is(k, '(') || is(k, '[') { closing(tokens, k) + 1 } else { k + 1 };
                }
                let is_list = is(k, '{');
                k = if is_list { closing(tokens, k) + 1 } else { k + 1 };
                if is_list && is(k, ';') {
                    k += 1;
                }
            }
            continue;
        }
        match word(k) {
            "mod" if !word(k + 1).is_empty() => {
                let child: Segments = path.iter().cloned().chain([word(k + 1).to_owned()]).collect();
                module.children.insert(word(k + 1).to_owned());
                if is(k + 2, '{') {
                    let end = closing(tokens, k + 2);
                    outside.extend(read_module(&tokens[k + 3..end], file, child, modules));
                    k = end + 1;
                } else {
                    outside.push(child);
                    k += 3;
                }
                continue;
            }
            "use" if k == 0 || tokens[k - 1] != Token::Other('<') && !is(k + 1, '<') => {
                let is_export = k > 0 && (word(k - 1) == "pub" || is(k - 1, ')'));
                let end = (k..tokens.len()).find(|&end| is(end, ';')).unwrap_or(tokens.len());
                let mut leaves = Vec::new();
                use_tree(&tokens[k + 1..end], &mut Vec::new(), &mut leaves);
                for (leaf, name) in leaves {
                    if name == "*" {
                        module.globs.push(leaf);
                    } else {
                        if is_export {
                            module.exported.insert(name.clone());
                        }
                        module.imports.insert(name, leaf);
                    }
                }
                k = end + 1;
                continue;
            }
            "fn" | "struct" | "enum" | "trait" | "type" | "const" | "static" | "union" if depth == 0 => {
                module.items.insert(word(k + 1).to_owned());
            }
            "macro_rules" => {
                module.items.insert(word(k + 2).to_owned());
            }
            _ => {}
        }
        match &tokens[k] {
            Token::Other('{') => depth += 1,
            Token::Other('}') => depth = depth.saturating_sub(1),
            Token::Word(first) if k == 0 || tokens[k - 1] != Token::Colons => {
                let mut segments = vec![first.clone()];
                while tokens.get(k + 1) == Some(&Token::Colons) && !word(k + 2).is_empty() {
                    segments.push(word(k + 2).to_owned());
                    k += 2;
                }
                module.words.insert(first.clone());
                if segments.len() > 1 {
                    module.paths.push(segments);
                }
            }
            _ => {}
        }
        k += 1;
    }
    modules.insert(path, module);
    outside
}

/// Place of the bracket that closes the one at `open`.
fn closing(tokens: &[Token], open: usize) -> usize {
    let mut depth = 0_usize;
    for (k, token) in tokens.iter().enumerate().skip(open) {
        match token {
            Token::Other('(' | '[' | '{') => depth += 1,
            Token::Other(')' | ']' | '}') => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return k;
        }
    }
    tokens.len()
}

/// Leaves of the tree of a `use` declaration: the path and the name that it gets here.
fn use_tree(tokens: &[Token], prefix: &mut Segments, leaves: &mut Vec<(Segments, String)>) {
    let length = prefix.len();
    let mut k = 0;
    let mut alias = None;
    while k < tokens.len() {
        match &tokens[k] {
            Token::Word(word) if word == "as" => {
                if let Some(Token::Word(name)) = tokens.get(k + 1) {
                    alias = Some(name.clone());
                }
                k += 1;
            }
            Token::Word(word) => prefix.push(word.clone()),
            Token::Other('*') => {
                leaves.push((prefix.clone(), "*".to_owned()));
                prefix.truncate(length);
                return;
            }
            Token::Other('{') => {
                let end = closing(tokens, k);
                let (mut start, mut place) = (k + 1, k + 1);
                while place <= end {
                    if place == end || tokens[place] == Token::Other(',') {
                        if place > start {
                            use_tree(&tokens[start..place], prefix, leaves);
                        }
                        start = place + 1;
                    } else if tokens[place] == Token::Other('{') {
                        place = closing(tokens, place);
                    }
                    place += 1;
                }
                prefix.truncate(length);
                return;
            }
            _ => {}
        }
        k += 1;
    }
    let mut path = prefix.clone();
    // `{self, ..}` names the module before it.
    if path.len() > 1 && path.last().is_some_and(|last| last == "self") {
        path.pop();
    }
    let name = alias.or_else(|| path.last().cloned()).unwrap_or_default();
    leaves.push((path, name));
    prefix.truncate(length);
}

/// Full path of a path in a module; `None` for paths to other crates, local items and types.
fn full(modules: &Modules, at: &Segments, path: &[String]) -> Option<Segments> {
    let module = &modules[at];
    let mut base = match path.first()?.as_str() {
        "crate" => return Some(path[1..].to_vec()),
        "self" => at.clone(),
        "super" => {
            let ups = path.iter().take_while(|part| *part == "super").count();
            let kept = at.len().checked_sub(ups)?;
            return Some(at[..kept].iter().chain(&path[ups..]).cloned().collect());
        }
        first if module.children.contains(first) => {
            return Some(at.iter().chain(path).cloned().collect());
        }
        first => {
            let imported = module.imports.get(first).filter(|target| target.as_slice() != path)?;
            full(modules, at, imported)?
        }
    };
    base.extend_from_slice(&path[1..]);
    Some(base)
}

/// The module that defines what a full path names, and true where the path names the module itself.
fn defined(modules: &Modules, path: &[String], depth: usize) -> Option<(Segments, bool)> {
    let mut at: Segments = Vec::new();
    for (k, part) in path.iter().enumerate() {
        let module = &modules[&at];
        if module.children.contains(part) {
            at.push(part.clone());
            continue;
        }
        if depth == 0 || module.items.contains(part) {
            return Some((at, false));
        }
        if let Some(target) = module.imports.get(part) {
            let target = full(modules, &at, target)?;
            return defined(modules, &[&target, &path[k + 1..]].concat(), depth - 1);
        }
        for glob in &module.globs {
            let Some((target, true)) =
                full(modules, &at, glob).and_then(|target| defined(modules, &target, depth - 1))
            else {
                continue;
            };
            let below = &modules[&target];
            if below.items.contains(part) || below.children.contains(part) || below.imports.contains_key(part)
            {
                return defined(modules, &[&target, &path[k..]].concat(), depth - 1);
            }
        }
        return Some((at, false));
    }
    Some((at, true))
}

/// Files that every file of a crate uses.
fn uses(source: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let mut modules = Modules::new();
    let root = ["lib.rs", "main.rs"].map(|name| source.join(name));
    let root = root.iter().find(|file| file.is_file()).expect("a crate has lib.rs or main.rs");
    read_file(source, root, Vec::new(), &mut modules);
    let mut uses: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (at, module) in &modules {
        let used = uses.entry(module.file.clone()).or_default();
        let is_used = |name: &String| !module.exported.contains(name) || module.words.contains(name);
        let imports = module.imports.iter().filter(|(name, _)| is_used(name)).map(|(_, path)| path);
        for path in imports.chain(&module.paths) {
            let Some(path) = full(&modules, at, path) else { continue };
            if let Some((target, false)) = defined(&modules, &path, 8) {
                used.insert(modules[&target].file.clone());
            }
        }
        // Names that came with a glob: items of that module among the words of this one.
        for glob in &module.globs {
            let Some((target, true)) = full(&modules, at, glob).and_then(|path| defined(&modules, &path, 8))
            else {
                continue;
            };
            for name in module.words.iter().filter(|word| !module.items.contains(*word)) {
                let below = &modules[&target];
                if below.items.contains(name) || below.imports.contains_key(name) {
                    let path: Segments = target.iter().chain([name]).cloned().collect();
                    if let Some((target, false)) = defined(&modules, &path, 8) {
                        used.insert(modules[&target].file.clone());
                    }
                }
            }
        }
        let file = module.file.clone();
        used.remove(&file);
    }
    uses
}

/// Groups of more than one member that all reach one another (Kosaraju's algorithm).
fn circles(uses: &BTreeMap<String, BTreeSet<String>>) -> Vec<Vec<String>> {
    fn reach<'a>(
        from: &'a str,
        edges: &BTreeMap<&'a str, Vec<&'a str>>,
        seen: &mut BTreeSet<&'a str>,
        order: &mut Vec<&'a str>,
    ) {
        if !seen.insert(from) {
            return;
        }
        for &next in edges.get(from).into_iter().flatten() {
            reach(next, edges, seen, order);
        }
        order.push(from);
    }
    let (mut forward, mut backward) = (BTreeMap::new(), BTreeMap::new());
    for (from, targets) in uses {
        for to in targets {
            forward.entry(from.as_str()).or_insert_with(Vec::new).push(to.as_str());
            backward.entry(to.as_str()).or_insert_with(Vec::new).push(from.as_str());
        }
    }
    let (mut seen, mut order) = (BTreeSet::new(), Vec::new());
    for from in uses.keys() {
        reach(from, &forward, &mut seen, &mut order);
    }
    let mut seen = BTreeSet::new();
    let mut found = Vec::new();
    for &from in order.iter().rev() {
        let mut members = Vec::new();
        reach(from, &backward, &mut seen, &mut members);
        if members.len() > 1 {
            members.sort_unstable();
            found.push(members.into_iter().map(str::to_owned).collect());
        }
    }
    found
}

/// The circles of every folder of a crate, described with one use for every pair of members.
fn circles_of_folders(uses: &BTreeMap<String, BTreeSet<String>>) -> Vec<Circle> {
    /// Of a folder: what each member uses, with a pair of files that shows it.
    type Members = BTreeMap<String, BTreeMap<String, String>>;
    let mut folders: BTreeMap<String, Members> = BTreeMap::new();
    for (file, targets) in uses {
        for target in targets {
            let (from, to): (Vec<&str>, Vec<&str>) = (file.split('/').collect(), target.split('/').collect());
            let shared = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
            // `name.rs` and the folder `name/` are one member.
            let member = |parts: &[&str]| parts[shared].trim_end_matches(".rs").to_owned();
            let (from, to) = (member(&from), member(&to));
            if from != to {
                let folder = file.split('/').take(shared).collect::<Vec<_>>().join("/");
                let example = format!("{file} uses {target}");
                folders.entry(folder).or_default().entry(from).or_default().entry(to).or_insert(example);
            }
        }
    }
    let mut found = Vec::new();
    for (folder, members) in &folders {
        let edges = members.iter().map(|(from, to)| (from.clone(), to.keys().cloned().collect())).collect();
        for circle in circles(&edges) {
            let mut examples = Vec::new();
            for from in &circle {
                let to = members[from].iter().filter(|(to, _)| circle.contains(to));
                examples.extend(to.map(|(_, example)| example.clone()));
            }
            found.push(Circle { folder: folder.clone(), members: circle, examples });
        }
    }
    found
}

/// Members of a folder that all use one another, directly or through others.
#[derive(Debug)]
struct Circle {
    /// From the source folder of the crate.
    folder: String,
    /// Names of files and folders, without endings.
    members: Vec<String>,
    /// For each pair of members that use one another a pair of files.
    examples: Vec<String>,
}

fn source_of(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates").join(name).join("src")
}

#[test]
fn modules_do_not_use_one_another_in_circles() {
    let mut wrong = String::new();
    for (name, most) in MOST {
        let circles = circles_of_folders(&uses(&source_of(name)));
        let found: usize = circles.iter().map(|circle| circle.members.len()).sum();
        if found > most {
            wrong += &format!("{name}: {found} files and folders in circles, at most {most} are allowed\n");
            for Circle { folder, members, examples } in circles {
                wrong +=
                    &format!("  src/{folder}: {}\n    {}\n", members.join(", "), examples.join("\n    "));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn every_crate_is_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates");
    let mut crates = BTreeSet::new();
    for entry in folder.read_dir().expect("the folder of crates").map(|entry| entry.expect("an entry")) {
        if entry.path().is_dir() {
            crates.insert(entry.file_name().into_string().expect("a name in UTF-8"));
        }
    }
    assert_eq!(crates, MOST.map(|(name, _)| name.to_owned()).into());
}

/// Uses between the files of a crate made of these texts.
fn uses_of(files: &[(&str, &str)]) -> BTreeMap<String, BTreeSet<String>> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for (name, text) in files {
        let file = folder.path().join(name);
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("a folder");
        std::fs::write(file, text).expect("a file");
    }
    uses(folder.path())
}

#[test]
fn uses_are_followed_to_the_files_that_define_them() {
    let found = uses_of(&[
        ("lib.rs", "pub mod graph;\nmod shape;\nmod text;\npub use graph::{Node, names as words};\n"),
        ("graph/mod.rs", "mod node;\npub mod names;\npub use node::*;\n"),
        ("graph/node.rs", "pub struct Node;\nimpl Node { fn f() { super::names::take() } }"),
        ("graph/names.rs", "pub fn take() {}"),
        ("shape.rs", "use crate::{words, Node};\nfn f(_: &Node) { words::take() }"),
        (
            "text.rs",
            "// use crate::shape::f;\nconst A: (&str, char) = (\"crate::shape::f\", '\"');\n\
             const B: &str = r#\"crate::shape::f\"#;\npub use crate::graph::names::take;\n\
             #[cfg(test)]\nmod tests { use crate::shape::f; }\nfn f<'a>(_: &'a dyn std::fmt::Debug) {}",
        ),
    ]);
    let listed: Vec<String> = found
        .iter()
        .filter(|(_, targets)| !targets.is_empty())
        .map(|(file, targets)| format!("{file}: {}", targets.iter().cloned().collect::<Vec<_>>().join(" ")))
        .collect();
    assert_eq!(listed, ["graph/node.rs: graph/names.rs", "shape.rs: graph/names.rs graph/node.rs"]);
    assert!(circles_of_folders(&found).is_empty());
}

#[test]
fn circles_between_files_and_between_folders_are_found() {
    // No two files use each other, but their folders do.
    let folders = uses_of(&[
        ("lib.rs", "mod a;\nmod b;\n"),
        ("a/mod.rs", "pub mod one;\nmod two;\n"),
        ("a/one.rs", "pub fn f() {}"),
        ("a/two.rs", "fn f() { crate::b::f() }"),
        ("b.rs", "use super::a::one;\npub fn f() { one::f() }"),
    ]);
    let [circle] = &circles_of_folders(&folders)[..] else { panic!("{folders:?}") };
    assert_eq!(
        (circle.folder.as_str(), circle.members.as_slice()),
        ("", &["a".to_owned(), "b".to_owned()][..])
    );
    assert_eq!(circle.examples, ["a/two.rs uses b.rs", "b.rs uses a/one.rs"]);
    // A file and the code of the folder that it lies in.
    let parent = uses_of(&[
        ("main.rs", "mod a;\n"),
        ("a/mod.rs", "mod one;\npub struct All { one: one::One }\n"),
        ("a/one.rs", "use super::All;\npub struct One(Box<All>);"),
    ]);
    let [circle] = &circles_of_folders(&parent)[..] else { panic!("{parent:?}") };
    assert_eq!((circle.folder.as_str(), circle.members.len()), ("a", 2));
}

#[test]
fn the_graph_uses_nothing_else_of_its_crate() {
    for (file, targets) in uses(&source_of("cif-scene")) {
        if file.starts_with("graph/") {
            let outside: Vec<&String> =
                targets.iter().filter(|target| !target.starts_with("graph/")).collect();
            assert!(outside.is_empty(), "{file} uses {outside:?}");
        }
    }
}
