//! Layers of settings: a preset, a TOML file, then what the user typed.
//!
//! Works on any configuration type: keys are those the type serialises, values are checked by deserialising
//! it after every single change, so that an error always points at the one key that caused it.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use cif_train::TrainConfig;
use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use crate::error::Error;

/// A configuration under construction.
#[derive(Clone, Debug)]
pub struct Layers<T> {
    table: Table,
    value: T,
    /// Keys that were set, in the order of time.
    origins: Vec<(String, Origin)>,
}

/// Where a value came from.
#[derive(Clone, Debug)]
enum Origin {
    Flag(String),
    File { path: PathBuf, text: Rc<str>, span: Range<usize> },
}

impl<T: Serialize + DeserializeOwned> Layers<T> {
    /// Starts from a preset.
    ///
    /// # Panics
    /// When the type does not survive a round trip through TOML, a defect of the type.
    #[must_use]
    pub fn new(preset: T) -> Self {
        let table = Table::try_from(&preset).expect("configurations serialise to TOML tables");
        Self { table, value: preset, origins: Vec::new() }
    }

    /// Lays the keys of a TOML file over the present values.
    ///
    /// # Errors
    /// At the first key that is unknown or has an impossible value, with its line.
    pub fn file(&mut self, path: &Path) -> Result<(), Error> {
        let text = cif_input::read_to_string(path).map_err(Error::io("read the settings", path))?;
        let parsed = DeTable::parse(&text).map_err(|error| {
            Error::in_text(path, &text, error.span().unwrap_or(0..0), error.message().trim(), None)
        })?;
        let shared: Rc<str> = text.as_str().into();
        for leaf in leaves(parsed.get_ref(), "") {
            self.assign(&leaf.key, leaf.value).map_err(|rejected| {
                let span = if rejected.unknown { leaf.key_span } else { leaf.value_span.clone() };
                Error::in_text(path, &text, span, rejected.message, rejected.help)
            })?;
            let origin =
                Origin::File { path: path.to_owned(), text: Rc::clone(&shared), span: leaf.value_span };
            self.origins.push((leaf.key, origin));
        }
        Ok(())
    }

    /// Applies one `table.key=value`; the value is TOML, bare words are taken as text.
    ///
    /// # Errors
    /// For an unknown key or an impossible value.
    pub fn assignment(&mut self, assignment: &str) -> Result<(), Error> {
        let (key, text) = assignment.split_once('=').ok_or_else(|| {
            Error::usage(
                format!("--set {assignment}: expected KEY=VALUE"),
                "for example --set fine.iterations=5000",
            )
        })?;
        let (key, text) = (key.trim(), text.trim());
        let value = format!("value = {text}")
            .parse::<Table>()
            .ok()
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| Value::String(text.to_owned()));
        self.typed(&format!("--set {key}"), key, value)
    }

    /// Applies a value that came from the flag `flag`.
    ///
    /// # Errors
    /// For an unknown key or an impossible value.
    pub fn typed(&mut self, flag: &str, key: &str, value: impl Into<Value>) -> Result<(), Error> {
        self.assign(key, value.into()).map_err(|rejected| Error::Failed {
            message: format!("{flag}: {}", rejected.message),
            help: rejected.help,
        })?;
        self.origins.push((key.to_owned(), Origin::Flag(flag.to_owned())));
        Ok(())
    }

    /// The error for a value that cannot work, with the line of the file or the flag that it came from. A key that
    /// nobody set was made impossible by another of its table: the last one that was set is pointed at.
    #[must_use]
    pub fn refused(&self, key: &str, message: String) -> Error {
        let name = key.split('[').next().unwrap_or(key);
        let table = |key: &str| key.rsplit_once('.').map(|(table, _)| table.to_owned());
        let last = |fits: &dyn Fn(&str) -> bool| self.origins.iter().rev().find(|(key, _)| fits(key));
        let found = last(&|key| key == name).or_else(|| last(&|key| table(key) == table(name)));
        match found.map(|(_, origin)| origin) {
            Some(Origin::File { path, text, span }) => {
                Error::in_text(path, text, span.clone(), message, None)
            }
            Some(Origin::Flag(flag)) => Error::plain(format!("{flag}: {message}")),
            None => Error::plain(message),
        }
    }

    /// The result.
    #[must_use]
    pub fn finish(self) -> T {
        self.value
    }

    fn assign(&mut self, key: &str, value: Value) -> Result<(), Rejected> {
        let known = keys(&self.table, "");
        let unknown = !known.iter().any(|name| name == key);
        if let Some(number) = not_finite(&value).filter(|_| !unknown) {
            return Err(Rejected {
                unknown: false,
                message: format!("`{key}` is {number}; a finite number is expected"),
                help: None,
            });
        }
        let mut table = self.table.clone();
        let changed = insert(&mut table, key, value)
            .then(|| Value::Table(table.clone()).try_into::<T>().map_err(|error| error.message().to_owned()));
        match changed {
            Some(Ok(changed)) => {
                self.table = table;
                self.value = changed;
                Ok(())
            }
            _ if unknown => Err(Rejected {
                unknown: true,
                message: format!("unknown key `{key}`"),
                help: Some(suggestion(key, &known)),
            }),
            Some(Err(message)) => Err(Rejected {
                unknown: false,
                message: format!("`{key}`: {}", message.trim()),
                help: present(&self.table, key).map(|now| format!("without it, {key} = {now}")),
            }),
            None => Err(Rejected { unknown: false, message: format!("`{key}` is no table"), help: None }),
        }
    }
}

impl Layers<TrainConfig> {
    /// The result, where every setting can work.
    ///
    /// # Errors
    /// At the first setting that cannot, see [`Layers::refused`].
    pub fn validated(mut self) -> Result<TrainConfig, Error> {
        // A number that was asked for is the number.
        let is_set = |name: &str| self.origins.iter().any(|(key, _)| key == name);
        if is_set("densify.max_gaussians") && !is_set("densify.detail") {
            self.value.densify.detail = 0.0;
        }
        match self.value.validate() {
            Ok(()) => Ok(self.value),
            Err(error) => Err(self.refused(error.key, error.to_string())),
        }
    }
}

struct Rejected {
    unknown: bool,
    message: String,
    help: Option<String>,
}

struct Leaf {
    key: String,
    key_span: Range<usize>,
    value: Value,
    value_span: Range<usize>,
}

/// Values of a parsed file in the order of the text, tables opened.
fn leaves(table: &DeTable<'_>, prefix: &str) -> Vec<Leaf> {
    let mut found = Vec::new();
    for (key, value) in table {
        let name = format!("{prefix}{}", key.get_ref());
        match value.get_ref() {
            DeValue::Table(inner) => found.extend(leaves(inner, &format!("{name}."))),
            _ => found.push(Leaf {
                key: name,
                key_span: key.span(),
                value: plain(value),
                value_span: value.span(),
            }),
        }
    }
    found.sort_by_key(|leaf| leaf.key_span.start);
    found
}

fn plain(value: &Spanned<DeValue<'_>>) -> Value {
    match value.get_ref() {
        DeValue::String(text) => Value::String(text.to_string()),
        DeValue::Boolean(value) => Value::Boolean(*value),
        DeValue::Datetime(value) => Value::Datetime(*value),
        DeValue::Array(items) => Value::Array(items.iter().map(plain).collect()),
        DeValue::Table(table) => {
            Value::Table(table.iter().map(|(key, value)| (key.get_ref().to_string(), plain(value))).collect())
        }
        // The parser has validated the digits; separators are removed, a radix is honoured.
        DeValue::Integer(number) => i64::from_str_radix(&number.as_str().replace('_', ""), number.radix())
            .map_or_else(|_| Value::String(number.as_str().to_owned()), Value::Integer),
        DeValue::Float(number) => number
            .as_str()
            .replace('_', "")
            .parse()
            .map_or_else(|_| Value::String(number.as_str().to_owned()), Value::Float),
    }
}

/// A number in a value that is none, or infinite.
fn not_finite(value: &Value) -> Option<f64> {
    match value {
        Value::Float(number) => (!number.is_finite()).then_some(*number),
        Value::Array(values) => values.iter().find_map(not_finite),
        Value::Table(table) => table.values().find_map(not_finite),
        _ => None,
    }
}

/// Dotted names of all values.
fn keys(table: &Table, prefix: &str) -> Vec<String> {
    table
        .iter()
        .flat_map(|(key, value)| match value {
            // What users name, as objects, is not known before.
            Value::Table(inner) if inner.is_empty() => vec![format!("{prefix}{key}")],
            Value::Table(inner) => keys(inner, &format!("{prefix}{key}.")),
            _ => vec![format!("{prefix}{key}")],
        })
        .collect()
}

fn present<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    match key.split_once('.') {
        Some((head, rest)) => present(table.get(head)?.as_table()?, rest),
        None => table.get(key),
    }
}

/// Sets a dotted key; false when a part of the path is a plain value.
fn insert(table: &mut Table, key: &str, value: Value) -> bool {
    match key.split_once('.') {
        None => {
            table.insert(key.to_owned(), value);
            true
        }
        Some((head, rest)) => table
            .entry(head.to_owned())
            .or_insert_with(|| Value::Table(Table::new()))
            .as_table_mut()
            .is_some_and(|inner| insert(inner, rest, value)),
    }
}

/// The nearest known keys, in words.
fn suggestion(key: &str, known: &[String]) -> String {
    let last = |name: &str| name.rsplit('.').next().unwrap_or(name).to_owned();
    let distance = |name: &String| {
        // A key may be right but in the wrong table.
        let whole = strsim::damerau_levenshtein(key, name);
        whole.min(strsim::damerau_levenshtein(&last(key), &last(name)) + 1)
    };
    let nearest = known.iter().min_by_key(|name| distance(name));
    match nearest {
        Some(nearest) if distance(nearest) <= 2 + key.len() / 4 => format!("did you mean `{nearest}`?"),
        _ => format!("known keys: {}", known.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Config {
        seed: u64,
        rate: f64,
        limit: Option<u32>,
        fine: Stage,
    }

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Stage {
        iterations: u32,
        mode: Mode,
    }

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum Mode {
        Own,
        OpacityOnly,
    }

    fn layers() -> Layers<Config> {
        Layers::new(Config {
            seed: 1,
            rate: 0.5,
            limit: None,
            fine: Stage { iterations: 10, mode: Mode::Own },
        })
    }

    fn file(text: &str) -> Result<Config, Error> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("settings.toml");
        std::fs::write(&path, text).unwrap();
        let mut layers = layers();
        layers.file(&path)?;
        Ok(layers.finish())
    }

    #[test]
    fn files_override_presets_and_leave_the_rest() {
        let config = file("rate = 2\nlimit = 1_000\n[fine]\nmode = \"opacity-only\"\n").unwrap();
        assert_eq!((config.seed, config.rate, config.limit), (1, 2.0, Some(1000)));
        assert_eq!(config.fine, Stage { iterations: 10, mode: Mode::OpacityOnly });
    }

    #[test]
    fn typos_are_found_with_their_line_and_the_nearest_key() {
        let error = file("seed = 3\n\n[fine]\niteratons = 5\n").unwrap_err();
        let text = error.to_string();
        assert!(text.contains("settings.toml:4") && text.contains("fine.iteratons"), "{text}");
        let help = miette::Diagnostic::help(&error).unwrap().to_string();
        assert_eq!(help, "did you mean `fine.iterations`?");
    }

    #[test]
    fn a_key_in_the_wrong_table_is_recognised() {
        let error = file("iterations = 5\n").unwrap_err();
        assert!(miette::Diagnostic::help(&error).unwrap().to_string().contains("fine.iterations"));
    }

    #[test]
    fn impossible_values_point_at_the_value() {
        let error = file("seed = 3\n[fine]\niterations = \"many\"\n").unwrap_err();
        assert!(error.to_string().contains("settings.toml:3: `fine.iterations`"), "{error}");
        let error = file("fine.mode = \"none\"\n").unwrap_err();
        assert!(error.to_string().contains("opacity-only"), "{error}");
        assert!(file("fine = 3\n").is_err());
        assert!(file("seed.deep = 3\n").is_err());
    }

    #[test]
    fn broken_toml_names_the_line() {
        let error = file("seed = 3\nrate = \n").unwrap_err();
        assert!(error.to_string().contains("settings.toml:2"), "{error}");
    }

    #[test]
    fn a_number_of_gaussians_that_is_asked_for_is_the_number() {
        let detail = |set: &[&str]| {
            let mut layers = Layers::new(TrainConfig::default());
            set.iter().for_each(|assignment| layers.assignment(assignment).unwrap());
            layers.validated().unwrap().densify.detail
        };
        assert!(detail(&["densify.every=50"]) > 0.0);
        assert_eq!(detail(&["densify.max_gaussians=30000"]), 0.0);
        assert_eq!(detail(&["densify.max_gaussians=30000", "densify.detail=3"]), 3.0);
    }

    #[test]
    fn values_out_of_range_name_the_line_or_the_flag_that_they_came_from() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        std::fs::write(&path, "seed = 3\n[model]\nspatial_resolution = [0, 8, 8]\n").unwrap();
        let refused = |set: &[&str], file: bool| {
            let mut preset = TrainConfig::default();
            preset.stages.fine_includes_coarse = true;
            let mut layers = Layers::new(preset);
            if file {
                layers.file(&path).unwrap();
            }
            set.iter().for_each(|assignment| layers.assignment(assignment).unwrap());
            layers.validated().unwrap_err().to_string()
        };
        let text = refused(&[], true);
        assert!(text.contains("mine.toml:3: setting `model.spatial_resolution[0]` is 0"), "{text}");
        let text = refused(&["rates.opacity=-1"], false);
        assert!(text.starts_with("--set rates.opacity: setting `rates.opacity` is -1"), "{text}");
        // Nobody set stages.fine_includes_coarse; what is incompatible with it is pointed at.
        let text = refused(&["stages.fine=1", "seed=4"], false);
        assert!(text.starts_with("--set stages.fine: "), "{text}");
    }

    #[test]
    fn assignments_take_numbers_words_and_lists() {
        let mut layers = layers();
        layers.assignment("fine.iterations=77").unwrap();
        layers.assignment("fine.mode = opacity-only").unwrap();
        layers.assignment("limit=4").unwrap();
        let error = layers.assignment("fine.itertions=1").unwrap_err();
        assert!(error.to_string().starts_with("--set fine.itertions: unknown key"), "{error}");
        assert!(layers.assignment("fine.iterations").is_err());
        for value in ["nan", "-inf"] {
            let error = layers.assignment(&format!("rate={value}")).unwrap_err().to_string();
            assert!(error.starts_with("--set rate: ") && error.contains("finite"), "{error}");
        }
        let config = layers.finish();
        assert_eq!(
            (config.fine.iterations, config.fine.mode, config.limit),
            (77, Mode::OpacityOnly, Some(4))
        );
    }
}
