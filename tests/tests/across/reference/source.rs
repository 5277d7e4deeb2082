//! Types that are serialised, from the source of the crates: fields, doc comments, and the attributes of serde.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use syn::punctuated::Punctuated;
use syn::{Attribute, Expr, GenericArgument, ImplItem, Lit, Meta, PathArguments, Token, Type, UseTree};

/// A struct or an enum.
pub(super) struct Item {
    pub(super) name: String,
    /// File from the root of the repository.
    pub(super) file: String,
    pub(super) doc: String,
    /// Field that names the variant.
    pub(super) tag: Option<String>,
    pub(super) kind: Kind,
    is_serialised: bool,
}

/// Its content.
pub(super) enum Kind {
    /// A struct with named fields.
    Fields(Vec<Field>),
    /// A struct that is serialised as its only field.
    Same(Type),
    /// An enum.
    Variants(Vec<Variant>),
}

/// A field as it is serialised.
pub(super) struct Field {
    pub(super) name: String,
    pub(super) doc: String,
    pub(super) kind: Type,
    /// True where its own fields stand in its place.
    pub(super) is_flat: bool,
}

/// A variant as it is serialised.
pub(super) struct Variant {
    pub(super) name: String,
    pub(super) doc: String,
    pub(super) fields: Vec<Field>,
}

/// Attributes of serde.
#[derive(Default)]
struct Serde {
    values: BTreeMap<String, String>,
}

/// All sources of the crates.
pub(super) struct Sources {
    items: Vec<Item>,
    /// Commands, name of the type and file of every `impl JsonReport`.
    reports: Vec<(Vec<String>, String, String)>,
    /// By file: for each imported name the name where it is defined, and the path of its module.
    imports: BTreeMap<String, BTreeMap<String, (String, String)>>,
}

impl Sources {
    /// Reads every source file of the crates.
    pub(super) fn read() -> Self {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let mut files = Vec::new();
        super::environment::files(&root.join("crates"), "rs", &mut files);
        files.sort();
        let mut sources = Self { items: Vec::new(), reports: Vec::new(), imports: BTreeMap::new() };
        for path in files.iter().filter(|path| path.components().any(|part| part.as_os_str() == "src")) {
            sources.add(&root, path);
        }
        sources
    }

    fn add(&mut self, root: &Path, path: &PathBuf) {
        let file = path.strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/");
        let text = std::fs::read_to_string(path).unwrap();
        if !text.contains("Serialize") && !text.contains("JsonReport") {
            return;
        }
        let parsed = syn::parse_file(&text).unwrap_or_else(|error| panic!("{file}: {error}"));
        self.add_items(&file, &parsed.items);
    }

    fn add_items(&mut self, file: &str, items: &[syn::Item]) {
        for item in items {
            match item {
                syn::Item::Struct(item) => {
                    let serde = Serde::of(&item.attrs);
                    let kind = match &item.fields {
                        syn::Fields::Named(_) if serde.has("transparent") => {
                            let field = item.fields.iter().next().expect("a field");
                            Kind::Same(field.ty.clone())
                        }
                        syn::Fields::Named(_) => Kind::Fields(fields(&item.fields, &serde, "rename_all")),
                        syn::Fields::Unnamed(all) if all.unnamed.len() == 1 => {
                            Kind::Same(all.unnamed[0].ty.clone())
                        }
                        _ => continue,
                    };
                    self.push(file, &item.ident, &item.attrs, None, kind);
                }
                syn::Item::Enum(item) => {
                    let serde = Serde::of(&item.attrs);
                    let variant = |variant: &syn::Variant| Variant {
                        name: serde.renamed(
                            &variant.ident.to_string(),
                            &Serde::of(&variant.attrs),
                            "rename_all",
                        ),
                        doc: doc(&variant.attrs),
                        fields: fields(&variant.fields, &serde, "rename_all_fields"),
                    };
                    let variants = item.variants.iter().map(variant).collect();
                    let tag = serde.values.get("tag").cloned();
                    self.push(file, &item.ident, &item.attrs, tag, Kind::Variants(variants));
                }
                // Declarations that a macro completes.
                syn::Item::Macro(item) => {
                    let items = item.mac.parse_body::<syn::File>().map(|file| file.items).unwrap_or_default();
                    let before = self.items.len();
                    self.add_items(file, &items);
                    self.items[before..].iter_mut().for_each(|item| item.is_serialised = true);
                }
                syn::Item::Impl(item) => self.add_impl(file, item),
                syn::Item::Use(item) => {
                    let imports = self.imports.entry(file.to_owned()).or_default();
                    import(&item.tree, "", imports);
                }
                _ => {}
            }
        }
    }

    fn push(
        &mut self,
        file: &str,
        name: &syn::Ident,
        attributes: &[Attribute],
        tag: Option<String>,
        kind: Kind,
    ) {
        let is_serialised = attributes.iter().any(|attribute| {
            let Meta::List(list) = &attribute.meta else { return false };
            list.path.is_ident("derive")
                && list.parse_args_with(Punctuated::<syn::Path, Token![,]>::parse_terminated).is_ok_and(
                    |derived| {
                        derived
                            .iter()
                            .any(|path| path.segments.last().is_some_and(|last| last.ident == "Serialize"))
                    },
                )
        });
        let (name, file) = (name.to_string(), file.to_owned());
        self.items.push(Item { name, file, doc: doc(attributes), tag, kind, is_serialised });
    }

    /// Reports, and types whose serialisation is written by hand.
    fn add_impl(&mut self, file: &str, item: &syn::ItemImpl) {
        let Some((_, path, _)) = &item.trait_ else { return };
        let Some(last) = path.segments.last() else { return };
        let Some(name) = name_of(&item.self_ty) else { return };
        if last.ident == "Serialize" {
            let own = self.items.iter_mut().find(|own| own.file == file && own.name == name);
            if let Some(own) = own {
                // In words, as it is shown.
                own.kind = Kind::Same(syn::parse_str("String").expect("a type"));
                own.is_serialised = true;
            }
        }
        if last.ident != "JsonReport" {
            return;
        }
        let commands = item.items.iter().find_map(|item| {
            let ImplItem::Const(item) = item else { return None };
            let Expr::Reference(list) = &item.expr else { return None };
            let Expr::Array(list) = &*list.expr else { return None };
            Some(list.elems.iter().map(text_of).collect())
        });
        self.reports.push((commands.expect("a list of commands"), name, file.to_owned()));
    }

    /// Commands, type and file of every report.
    pub(super) fn reports(&self) -> impl Iterator<Item = (&[String], &str, &str)> {
        self.reports.iter().map(|(commands, name, file)| (commands.as_slice(), name.as_str(), file.as_str()))
    }

    /// The serialised type that a name means in a file: of the file itself, else of the module or the crate that it is
    /// imported from, else the only one of its crate, else the only one of all.
    pub(super) fn find(&self, name: &str, file: &str) -> Option<&Item> {
        let (name, origin) = match self.imports.get(file).and_then(|imports| imports.get(name)) {
            Some((name, origin)) => (name.as_str(), origin.as_str()),
            None => (name, ""),
        };
        let own = folder_of(file);
        let of_crate = origin.split("::").next().unwrap_or_default();
        let from = if of_crate.starts_with("cif_") { of_crate.replace('_', "-") } else { own.to_owned() };
        let module = origin.rsplit("::").next().unwrap_or_default();
        let called: Vec<&Item> =
            self.items.iter().filter(|item| item.is_serialised && item.name == name).collect();
        let is_of_module = |item: &Item| {
            let file = item.file.trim_end_matches("/mod.rs").trim_end_matches(".rs");
            !module.is_empty() && file.ends_with(&format!("/{module}"))
        };
        let only = |is_meant: &dyn Fn(&Item) -> bool| {
            let mut found = called.iter().copied().filter(|item| is_meant(item));
            found.next().filter(|_| found.next().is_none())
        };
        // Of `super::record`, the file in the same folder.
        let folder = file.rsplit_once('/').map_or("", |(folder, _)| folder);
        let is_next_to_it =
            |item: &Item| origin.starts_with("super::") && item.file == format!("{folder}/{module}.rs");
        only(&|item| item.file == file)
            .or_else(|| only(&is_next_to_it))
            .or_else(|| only(&|item| folder_of(&item.file) == from && is_of_module(item)))
            .or_else(|| only(&|item| folder_of(&item.file) == from))
            .or_else(|| only(&|_| true))
    }

    /// The serialised type behind references, boxes and options.
    pub(super) fn named(&self, kind: &Type, file: &str) -> Option<&Item> {
        match kind {
            Type::Reference(inner) => self.named(&inner.elem, file),
            _ => self.find(&name_of(kind)?, file),
        }
    }

    /// A type of Rust in the words of JSON; named types are added to `open`.
    pub(super) fn words<'a>(&'a self, kind: &Type, file: &str, open: &mut Vec<&'a Item>) -> String {
        let list = |inner: &str| format!("list of {}", plural(inner));
        match kind {
            Type::Reference(inner) => self.words(&inner.elem, file, open),
            Type::Slice(inner) => list(&self.words(&inner.elem, file, open)),
            Type::Array(inner) => {
                let length = match &inner.len {
                    Expr::Lit(length) => text_of(&Expr::Lit(length.clone())),
                    _ => "fixed length, each".to_owned(),
                };
                format!("list of {length} {}", plural(&self.words(&inner.elem, file, open)))
            }
            Type::Tuple(all) if all.elems.is_empty() => "null".to_owned(),
            Type::Tuple(all) => {
                let all: Vec<String> = all.elems.iter().map(|inner| self.words(inner, file, open)).collect();
                format!("list: {}", all.join(", "))
            }
            Type::Path(path) => {
                let last = path.path.segments.last().expect("a name");
                let inner: Vec<&Type> = match &last.arguments {
                    PathArguments::AngleBracketed(all) => all
                        .args
                        .iter()
                        .filter_map(|argument| match argument {
                            GenericArgument::Type(inner) => Some(inner),
                            _ => None,
                        })
                        .collect(),
                    _ => Vec::new(),
                };
                let name = last.ident.to_string();
                match (name.as_str(), inner.as_slice()) {
                    ("Option", [inner]) => format!("{} or null", self.words(inner, file, open)),
                    ("Box" | "Stored" | "Cow" | "Arc", [.., inner]) => self.words(inner, file, open),
                    ("Vec" | "BTreeSet", [inner]) => list(&self.words(inner, file, open)),
                    ("BTreeMap" | "Map", [.., value]) => {
                        format!("object whose values are each {}", self.words(value, file, open))
                    }
                    ("String" | "str" | "PathBuf" | "Path" | "Cow", _) => "text".to_owned(),
                    ("bool", _) => "true or false".to_owned(),
                    ("f32" | "f64", _) => "number".to_owned(),
                    ("u8" | "u16" | "u32" | "u64" | "usize" | "i32" | "i64", _) => "integer".to_owned(),
                    ("DVec3" | "Vec3", _) => "list of 3 numbers".to_owned(),
                    ("DVec2" | "Vec2", _) => "list of 2 numbers".to_owned(),
                    ("DQuat", _) => "list of 4 numbers".to_owned(),
                    ("DMat3", _) => "list of 9 numbers".to_owned(),
                    ("Value" | "Map", _) => "any JSON".to_owned(),
                    ("TrainConfig", _) => "object of [settings](settings.md)".to_owned(),
                    _ => self.word_of_named(&name, file, open),
                }
            }
            _ => panic!("{file}: a type that is not known"),
        }
    }

    fn word_of_named<'a>(&'a self, name: &str, file: &str, open: &mut Vec<&'a Item>) -> String {
        let item = self.find(name, file).unwrap_or_else(|| panic!("{file}: {name} is not known"));
        if let Kind::Same(inner) = &item.kind {
            return self.words(inner, &item.file, open);
        }
        open.push(item);
        format!("[{}](#{})", item.name, item.name.to_lowercase())
    }
}

/// The crate of a file.
fn folder_of(file: &str) -> &str {
    file.split('/').nth(1).unwrap_or_default()
}

/// Several of a type in words.
fn plural(words: &str) -> String {
    match words {
        "integer" | "number" => format!("{words}s"),
        "text" => "texts".to_owned(),
        _ => words.to_owned(),
    }
}

/// Names that a `use` brings in, with the path that they come from.
fn import(tree: &UseTree, origin: &str, imports: &mut BTreeMap<String, (String, String)>) {
    let from = |name: &syn::Ident| format!("{origin}{}{name}", if origin.is_empty() { "" } else { "::" });
    match tree {
        UseTree::Path(path) => import(&path.tree, &from(&path.ident), imports),
        UseTree::Name(name) => {
            imports.insert(name.ident.to_string(), (name.ident.to_string(), origin.to_owned()));
        }
        UseTree::Rename(name) => {
            imports.insert(name.rename.to_string(), (name.ident.to_string(), origin.to_owned()));
        }
        UseTree::Group(group) => group.items.iter().for_each(|tree| import(tree, origin, imports)),
        UseTree::Glob(_) => {}
    }
}

/// The last name of a type, or that of what it stores.
fn name_of(kind: &Type) -> Option<String> {
    match kind {
        Type::Reference(inner) => name_of(&inner.elem),
        Type::Path(path) => {
            let last = path.path.segments.last()?;
            let PathArguments::AngleBracketed(inner) = &last.arguments else {
                return Some(last.ident.to_string());
            };
            let stored = inner.args.iter().find_map(|argument| match argument {
                GenericArgument::Type(inner) if last.ident == "Stored" => name_of(inner),
                _ => None,
            });
            stored.or_else(|| Some(last.ident.to_string()))
        }
        _ => None,
    }
}

fn fields(fields: &syn::Fields, of_type: &Serde, rename_all: &str) -> Vec<Field> {
    let shown = |field: &&syn::Field| !Serde::of(&field.attrs).has("skip");
    let read = |field: &syn::Field| {
        let serde = Serde::of(&field.attrs);
        let name = field.ident.as_ref().map(ToString::to_string).unwrap_or_default();
        Field {
            name: of_type.renamed(name.trim_start_matches("r#"), &serde, rename_all),
            doc: doc(&field.attrs),
            kind: field.ty.clone(),
            is_flat: serde.has("flatten"),
        }
    };
    // Not on a build without its feature, which has `null` in its place.
    let is_left_out = |field: &syn::Field| {
        field.attrs.iter().any(|attribute| {
            let Meta::List(list) = &attribute.meta else { return false };
            list.path.is_ident("cfg") && list.tokens.to_string().starts_with("not")
        })
    };
    fields.iter().filter(shown).filter(|field| !is_left_out(field)).map(read).collect()
}

impl Serde {
    fn of(attributes: &[Attribute]) -> Self {
        let mut found = Self::default();
        for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("serde")) {
            let Meta::List(list) = &attribute.meta else { continue };
            let all = list
                .parse_args_with(Punctuated::<Meta, Token![,]>::parse_terminated)
                .expect("serde's own form");
            for meta in all {
                let name = meta.path().get_ident().map(ToString::to_string).unwrap_or_default();
                let value = match &meta {
                    Meta::NameValue(pair) => text_of(&pair.value),
                    _ => String::new(),
                };
                found.values.insert(name, value);
            }
        }
        found
    }

    fn has(&self, name: &str) -> bool {
        self.values.contains_key(name)
    }

    /// Name of a field or variant with attributes of its own.
    fn renamed(&self, name: &str, own: &Self, rename_all: &str) -> String {
        if let Some(name) = own.values.get("rename") {
            return name.clone();
        }
        let split = |separator: char| {
            let mut text = String::new();
            for character in name.chars() {
                if character.is_uppercase() && !text.is_empty() {
                    text.push(separator);
                }
                text.extend(character.to_lowercase());
            }
            text
        };
        match self.values.get(rename_all).map(String::as_str) {
            None => name.to_owned(),
            Some("lowercase") => name.to_lowercase(),
            Some("snake_case") => split('_'),
            Some("kebab-case") => split('-').replace('_', "-"),
            // Of formats of others, whose types are in no report.
            Some(_) => name.to_owned(),
        }
    }
}

/// The doc comment as Markdown, on one line.
fn doc(attributes: &[Attribute]) -> String {
    let lines = attributes.iter().filter_map(|attribute| match &attribute.meta {
        Meta::NameValue(pair) if pair.path.is_ident("doc") => Some(text_of(&pair.value).trim().to_owned()),
        _ => None,
    });
    let text = lines.collect::<Vec<_>>().join(" ");
    plain_links(text.trim()).replace("`None`", "`null`")
}

/// Links of rustdoc as plain code: [`a::B`](c) as `B`.
fn plain_links(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("[`") {
        let Some((path, after)) = after.split_once("`]") else { break };
        let name = path.rsplit("::").next().unwrap_or(path);
        plain += &format!("{before}`{name}`");
        rest = after;
        if let Some(target) = after.strip_prefix('(')
            && let Some((_, after)) = target.split_once(')')
        {
            rest = after;
        }
    }
    plain + rest
}

fn text_of(expression: &Expr) -> String {
    match expression {
        Expr::Lit(literal) => match &literal.lit {
            Lit::Str(text) => text.value(),
            Lit::Int(number) => number.base10_digits().to_owned(),
            other => panic!("another literal: {}", matches!(other, Lit::Bool(_))),
        },
        _ => String::new(),
    }
}

#[test]
fn attributes_of_serde_are_followed() {
    let text = "
        /// A [`super::Thing`](link).
        #[derive(Serialize)]
        struct A<'a> {
            /// Number, `None` without one.
            #[serde(rename = \"x\")]
            one: Option<&'a f32>,
            #[serde(skip)]
            two: u8,
            #[serde(flatten)]
            b: B,
            list: [Vec<C>; 3],
        }
        #[derive(Serialize)]
        struct B { three: BTreeMap<String, (u8, String)> }
        #[derive(Serialize)]
        #[serde(tag = \"kind\", rename_all = \"snake_case\")]
        enum C { FirstOne, Second { four: bool } }";
    let mut sources = Sources { items: Vec::new(), reports: Vec::new(), imports: BTreeMap::new() };
    sources.add_items("crates/x/src/lib.rs", &syn::parse_file(text).unwrap().items);
    let file = "crates/x/src/lib.rs";
    let Kind::Fields(fields) = &sources.find("A", file).unwrap().kind else { panic!("fields") };
    let shown: Vec<(&str, bool)> = fields.iter().map(|field| (field.name.as_str(), field.is_flat)).collect();
    assert_eq!(shown, [("x", false), ("b", true), ("list", false)]);
    assert_eq!(
        (sources.find("A", file).unwrap().doc.as_str(), fields[0].doc.as_str()),
        ("A `Thing`.", "Number, `null` without one.")
    );
    let mut open = Vec::new();
    assert_eq!(sources.words(&fields[0].kind, file, &mut open), "number or null");
    assert_eq!(sources.words(&fields[2].kind, file, &mut open), "list of 3 list of [C](#c)");
    let Kind::Fields(inner) = &sources.named(&fields[1].kind, file).unwrap().kind else { panic!("fields") };
    assert_eq!(
        sources.words(&inner[0].kind, file, &mut open),
        "object whose values are each list: integer, text"
    );
    let [c] = open.as_slice() else { panic!("one type") };
    let Kind::Variants(variants) = &c.kind else { panic!("variants") };
    assert_eq!(
        (c.tag.as_deref(), variants[0].name.as_str(), variants[1].fields.len()),
        (Some("kind"), "first_one", 1)
    );
}
