//! The file of questions in words, and the instances that are their answers.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use cif_dataset::InstanceLabel;
use cif_dataset::meant::known_names;
use cif_train::heads::lang_splat::relevance::Question as Codes;
use serde::{Deserialize, Serialize};

use super::capture::Capture;
use crate::error::Error;
use crate::words::words;

/// A file of questions, explained.
pub(super) const EXAMPLE: &str = include_str!("questions.toml");

/// Longest file, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// A file of questions.
#[derive(Debug)]
pub(super) struct File {
    path: PathBuf,
    content: Content,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    capture: Vec<OfCapture>,
    /// Codes of texts of anything.
    #[serde(default)]
    anything: Vec<[f32; 3]>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OfCapture {
    name: String,
    /// Folder of feature maps.
    maps: Option<PathBuf>,
    question: Vec<OfQuestion>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OfQuestion {
    text: String,
    answer: Vec<Named>,
    /// Its code in the space of the maps.
    code: Option<[f32; 3]>,
}

/// An instance by its id, or instances by their label or class.
#[derive(Debug, Deserialize)]
#[serde(untagged, expecting = "expected ids of instances (3) and labels or classes (\"blue mug\")")]
enum Named {
    Id(u16),
    Label(String),
}

/// Questions about a capture.
#[derive(Clone, Debug)]
pub(super) struct OfOneCapture {
    /// Its name.
    pub(super) capture: String,
    pub(super) questions: Vec<Question>,
    /// Folder of feature maps, which 4D LangSplat learns.
    pub(super) maps: Option<PathBuf>,
}

/// A question, and the ids of the instances that are its answer.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Question {
    pub(super) text: String,
    pub(super) answer: BTreeSet<u16>,
    /// Codes of the question and of texts of anything, where the capture has maps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) codes: Option<Codes>,
}

impl OfOneCapture {
    /// Its name, and the texts of its questions.
    pub(super) fn titles(&self) -> (String, Vec<String>) {
        (self.capture.clone(), self.questions.iter().map(|question| question.text.clone()).collect())
    }
}

impl File {
    /// Reads a file: JSON where its name ends so, else TOML.
    ///
    /// # Errors
    /// When it cannot be read or does not say what it has to; the message has the line.
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let size = cif_input::check(path).map_err(Error::io("read the questions", path))?;
        if size > MAX_BYTES {
            return Err(Error::failed(
                format!("{} has {size} bytes, too many for a list of questions", path.display()),
                format!("write one of at most {MAX_BYTES}"),
            ));
        }
        let text = cif_input::read_to_string(path).map_err(Error::io("read the questions", path))?;
        let help = || Some("cif bench compare --help shows such a file".to_owned());
        let is_json = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
        let content: Content = if is_json {
            serde_json::from_str(&text).map_err(|error| {
                let at = place(&text, error.line(), error.column());
                let message = error.to_string();
                let end = message.rfind(" at line").unwrap_or(message.len());
                Error::in_text(path, &text, at..at, &message[..end], help())
            })?
        } else {
            toml::from_str(&text).map_err(|error| {
                Error::in_text(path, &text, error.span().unwrap_or(0..0), error.message().trim(), help())
            })?
        };
        let file = Self { path: path.to_owned(), content };
        file.check()?;
        Ok(file)
    }

    fn refused(&self, problem: impl std::fmt::Display, help: impl Into<String>) -> Error {
        Error::failed(format!("{}: {problem}", self.path.display()), help)
    }

    /// Refuses what no capture could answer.
    fn check(&self) -> Result<(), Error> {
        if self.content.capture.is_empty() {
            return Err(self.refused("it has no captures", "cif bench compare --help shows such a file"));
        }
        for (k, of) in self.content.capture.iter().enumerate() {
            let name = &of.name;
            if self.content.capture[..k].iter().any(|other| other.name == *name) {
                return Err(self.refused(
                    format!("capture {name} is listed twice"),
                    "put all of its questions under one [[capture]]",
                ));
            }
            if of.question.is_empty() {
                return Err(self.refused(
                    format!("capture {name} has no questions"),
                    "add a [[capture.question]] with text and answer, or leave the capture out",
                ));
            }
            for (j, question) in of.question.iter().enumerate() {
                let text = &question.text;
                if words(text).is_empty() {
                    return Err(self.refused(
                        format!("question {} of capture {name}, '{text}', has no words", j + 1),
                        "for example text = \"steel jug\"",
                    ));
                }
                if of.question[..j].iter().any(|other| other.text == *text) {
                    return Err(self.refused(
                        format!("capture {name} is asked '{text}' twice"),
                        "leave one of them out: tables name questions by their text",
                    ));
                }
                if question.answer.is_empty() {
                    return Err(self.refused(
                        format!("question '{text}' of capture {name} has no answer"),
                        "name ids, labels or classes of its instances: answer = [3, \"blue mug\"]",
                    ));
                }
            }
            self.check_codes(of)?;
        }
        Ok(())
    }

    /// Refuses feature maps without the codes that they are asked by, and codes without maps.
    fn check_codes(&self, of: &OfCapture) -> Result<(), Error> {
        let name = &of.name;
        let is_direction =
            |code: &[f32; 3]| code.iter().all(|v| v.is_finite()) && code.iter().any(|v| *v != 0.0);
        let codes = of.question.iter().filter_map(|question| question.code.as_ref());
        if let Some(code) = self.content.anything.iter().chain(codes).find(|code| !is_direction(code)) {
            return Err(self.refused(
                format!("code {code:?} has no direction"),
                "give three numbers, not all 0, by the encoder that the maps were made with",
            ));
        }
        for OfQuestion { text, code, .. } in &of.question {
            match (&of.maps, code) {
                (Some(_), None) => {
                    return Err(self.refused(
                        format!("capture {name} has maps, and its question '{text}' has no code to be asked by"),
                        "add code = [0.1, 0.7, 0.2], its text as the encoder of the maps has it, or leave the maps out",
                    ));
                }
                (None, Some(_)) => {
                    return Err(self.refused(
                        format!("question '{text}' has a code, and its capture {name} no maps"),
                        "add maps = \"DIR\", the folder of feature maps, to the capture, or leave the code out",
                    ));
                }
                _ => {}
            }
        }
        if of.maps.is_some() && self.content.anything.is_empty() {
            return Err(self.refused(
                format!("capture {name} has maps, and the file no codes of texts of anything"),
                "add anything = [[0.5, 0.5, 0.1]] at the top: codes of \"object\", \"things\", \"stuff\" and \
                 \"texture\"",
            ));
        }
        Ok(())
    }

    /// The questions of every capture that has some, in the order of captures.
    ///
    /// # Errors
    /// When no capture has any, or an answer names none of its instances.
    pub(super) fn of(&self, captures: &[Capture]) -> Result<Vec<OfOneCapture>, Error> {
        let names: Vec<&str> = captures.iter().map(|capture| &capture.name[..]).collect();
        let known = |of: &&OfCapture| names.contains(&&of.name[..]);
        let others: Vec<&str> =
            self.content.capture.iter().filter(|of| !known(of)).map(|of| &of.name[..]).collect();
        if others.len() == self.content.capture.len() {
            return Err(self.refused(
                format!("{} is not compared here, but {}", others.join(", "), names.join(", ")),
                "captures are called as their folders",
            ));
        }
        if !others.is_empty() {
            let path = self.path.display();
            crate::messages::note!(
                "{path}: {} is not compared here, so nothing is asked of it",
                others.join(", ")
            );
        }
        let mut found = Vec::new();
        for capture in captures {
            let Some(of) = self.content.capture.iter().find(|of| of.name == capture.name) else { continue };
            let questions = of.question.iter().map(|question| {
                let answer = ids(&question.answer, &capture.scored().instances).map_err(|problem| {
                    self.refused(
                        format!("question '{}' of capture {}: {problem}", question.text, capture.name),
                        "name ids, labels or classes of instances; cif info CAPTURE lists them",
                    )
                })?;
                let anything = self.content.anything.clone();
                let codes = question.code.map(|code| Codes { code, anything });
                Ok(Question { text: question.text.clone(), answer, codes })
            });
            let questions = questions.collect::<Result<_, Error>>()?;
            let folder = self.path.parent().unwrap_or(Path::new(""));
            let maps = of.maps.as_ref().map(|maps| folder.join(maps));
            found.push(OfOneCapture { capture: capture.name.clone(), questions, maps });
        }
        Ok(found)
    }
}

/// Byte of a line and a column, both from 1.
fn place(text: &str, line: usize, column: usize) -> usize {
    let start: usize = text.split_inclusive('\n').take(line.saturating_sub(1)).map(str::len).sum();
    let at = (start + column.saturating_sub(1)).min(text.len());
    (0..=at).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0)
}

/// Ids of the instances that are named, by id, or by label or class in any case; the error is the problem.
fn ids(named: &[Named], instances: &[InstanceLabel]) -> Result<BTreeSet<u16>, String> {
    let mut found = BTreeSet::new();
    for name in named {
        let is_it = |instance: &&InstanceLabel| match name {
            Named::Id(id) => instance.id == *id,
            Named::Label(label) => [&instance.label, &instance.category]
                .iter()
                .any(|own| own.to_lowercase() == label.to_lowercase()),
        };
        let before = found.len();
        found.extend(instances.iter().filter(is_it).map(|instance| instance.id));
        let is_known = found.len() > before || instances.iter().any(|instance| is_it(&instance));
        if !is_known {
            let known: Vec<String> =
                instances.iter().map(|instance| format!("{} {}", instance.id, instance.label)).collect();
            return Err(match name {
                Named::Id(id) => format!("no instance is {id}; there are {}", known.join(", ")),
                Named::Label(label) => {
                    format!("no instance is '{label}'; {}", known_names(label, "there are", &known))
                }
            });
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn read(name: &str, text: &str) -> Result<File, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        File::read(&path).map_err(|error| error.to_string())
    }

    fn instance(id: u16, label: &str, category: &str) -> InstanceLabel {
        let (label, category) = (label.to_owned(), category.to_owned());
        InstanceLabel { id, label, category, taxonomies: BTreeMap::new() }
    }

    #[test]
    fn the_example_and_the_same_in_json_are_read() {
        let toml = read("questions.toml", EXAMPLE).unwrap().content;
        let json = "{ \"capture\": [{ \"name\": \"table\", \"question\": [\
                    { \"text\": \"steel jug\", \"answer\": [3, \"jug\"] }] }] }";
        let json = read("questions.JSON", json).unwrap().content;
        assert_eq!((toml.capture.len(), toml.capture[0].question.len()), (1, 2));
        assert!(
            matches!(&json.capture[0].question[0].answer[..], [Named::Id(3), Named::Label(l)] if l == "jug")
        );
    }

    #[test]
    fn mistakes_are_reported_with_their_place() {
        let question = |text: &str, answer: &str| {
            format!("[[capture]]\nname = \"a\"\n[[capture.question]]\ntext = \"{text}\"\nanswer = {answer}\n")
        };
        for (text, message) in [
            (question("jug", "[3.5]"), ["questions.toml:5", "ids of instances"]),
            (question("jug", "[70000]"), ["questions.toml:5", "ids of instances"]),
            (question("jug", "[]"), ["capture a", "has no answer"]),
            (question("12 --", "[3]"), ["question 1 of capture a", "no words"]),
            (question("jug", "[3]").replace("answer", "anwser"), ["questions.toml:5", "anwser"]),
            (question("jug", "[3]").repeat(2), ["capture a", "twice"]),
            (
                format!("{0}[[capture.question]]\ntext = \"jug\"\nanswer = [1]\n", question("jug", "[3]")),
                ["'jug'", "twice"],
            ),
            ("capture = []".to_owned(), ["questions.toml", "no captures"]),
            ("[[capture]]\nname = \"a\"\nquestion = []\n".to_owned(), ["capture a", "no questions"]),
        ] {
            let error = read("questions.toml", &text).unwrap_err();
            assert!(message.iter().all(|part| error.contains(part)), "{error}");
        }
        let error = read("q.json", "{\n \"capture\": [{ \"nam\": 1 }]\n}").unwrap_err();
        assert!(error.contains("q.json:2") && error.contains("nam"), "{error}");
    }

    #[test]
    fn answers_are_named_by_id_label_or_class() {
        let instances =
            [instance(3, "red mug", "mug"), instance(5, "blue mug", "mug"), instance(9, "box", "box")];
        let of = |named: &[Named]| ids(named, &instances).map(|found| found.into_iter().collect::<Vec<_>>());
        assert_eq!(of(&[Named::Label("MUG".into())]), Ok(vec![3, 5]));
        assert_eq!(
            of(&[Named::Id(9), Named::Label("red mug".into()), Named::Label("mug".into())]),
            Ok(vec![3, 5, 9])
        );
        assert_eq!(of(&[Named::Label("mug".into()), Named::Id(3)]), Ok(vec![3, 5]), "named twice");
        let message = of(&[Named::Id(4)]).unwrap_err();
        assert!(
            message.contains("no instance is 4") && message.contains("3 red mug, 5 blue mug"),
            "{message}"
        );
    }
}
