//! The report of a command as JSON: `--json` prints it, `--json FILE` writes it.
//!
//! A report is one JSON document. Without a file it is all that goes to stdout; with one the command prints its
//! tables as ever. The word after `--json` is its file where it ends in `.json` or is a stream (`-`, `/dev/stdout`, a
//! named pipe), and an argument of its own otherwise, so that `cif info --json captures/table` is what it looks like.

use std::ffi::{OsStr, OsString};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use cif_output::Place;
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use crate::endings;
use crate::error::Error;
use crate::output::{self, Outputs};

/// The flag.
const FLAG: &str = "--json";

/// Its name in `cif export` before there was one for all commands.
const OLD_FLAG: &str = "--report-json";

/// The flag of `cif query` whose file, a table of paths, may be left out too.
const PATHS_FLAG: &str = "--trajectory";

/// A type whose values are reports. `docs/reference/json.md` describes every type that implements this, from its doc
/// comments; no other value can be given.
pub(crate) trait JsonReport: Serialize {
    /// Commands whose report it is, with the options that make it.
    const COMMANDS: &'static [&'static str];
}

/// A report of a command that has `--force` for other files as well.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Report {
    /// Print the report as JSON and nothing else, or write it to FILE (.json)
    #[arg(
        long,
        value_name = "FILE",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "-",
        value_parser = endings::report()
    )]
    json: Option<PathBuf>,
}

/// A report of a command that writes nothing else.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct OnlyReport {
    #[command(flatten)]
    report: Report,
    /// Replace an existing file of --json
    #[arg(long)]
    force: bool,
}

impl Report {
    /// True where the report is all that goes to stdout.
    pub(crate) fn to_stdout(&self) -> bool {
        self.json.as_deref().is_some_and(output::is_stdout)
    }

    /// True where there is a report to make.
    pub(crate) fn is_asked(&self) -> bool {
        self.json.is_some()
    }

    /// Checks that the file can be written, before the work starts.
    ///
    /// # Errors
    /// When it exists and is to be kept, is an input or another output, or its folder refuses it.
    pub(crate) fn check(&self, outputs: &mut Outputs) -> Result<(), Error> {
        self.file().map_or(Ok(()), |path| outputs.text(path))
    }

    /// Prints or writes the report; unless it is all that goes to stdout, `print` prints tables there.
    ///
    /// # Errors
    /// When the file cannot be written, or a path in the report is not UTF-8.
    pub(crate) fn give<R: JsonReport>(
        &self,
        report: impl FnOnce() -> R,
        print: impl FnOnce(),
    ) -> Result<(), Error> {
        if self.to_stdout() {
            println!("{:#}", json(&report())?);
            return Ok(());
        }
        // First the file: the reader of the tables may have left.
        let written = self
            .file()
            .map_or(Ok(()), |path| output::write_file(path, format!("{:#}\n", json(&report())?).as_bytes()));
        print();
        written
    }

    /// The file that is written; `None` where there is none, or it is stdout.
    pub(crate) fn file(&self) -> Option<&Path> {
        self.json.as_deref().filter(|path| !output::is_stdout(path))
    }
}

impl OnlyReport {
    /// The report alone.
    pub(crate) fn report(&self) -> &Report {
        &self.report
    }

    /// Checks that the file can be written, and that it is none of those that the command reads.
    ///
    /// # Errors
    /// As [`Report::check`], and when `--force` has no file to replace.
    pub(crate) fn check<'a>(&self, inputs: impl IntoIterator<Item = &'a Path>) -> Result<(), Error> {
        if self.force && !self.report.is_asked() {
            return Err(Error::usage(
                "--force replaces the file of --json alone, and there is none",
                "leave --force out; a folder of an earlier run is never replaced: remove it, or name a new one",
            ));
        }
        let mut outputs = Outputs::new(self.force);
        inputs.into_iter().try_for_each(|input| outputs.reads(input))?;
        self.report.check(&mut outputs)
    }

    /// As [`Report::give`].
    ///
    /// # Errors
    /// As [`Report::give`].
    pub(crate) fn give<R: JsonReport>(
        &self,
        report: impl FnOnce() -> R,
        print: impl FnOnce(),
    ) -> Result<(), Error> {
        self.report.give(report, print)
    }

    /// As [`Report::to_stdout`].
    pub(crate) fn to_stdout(&self) -> bool {
        self.report.to_stdout()
    }
}

/// A report as JSON; keys are sorted.
fn json<R: JsonReport>(report: &R) -> Result<Value, Error> {
    let failed = |error| format!("the report of {} cannot be JSON: {error}", R::COMMANDS.join(", "));
    serde_json::to_value(report).map_err(|error| Error::plain(failed(error)))
}

/// A `T` that is read from a file, or from the record of a scene, and passed on unchanged.
#[derive(Serialize)]
#[serde(transparent)]
pub(crate) struct Stored<T> {
    json: Value,
    #[serde(skip)]
    kind: PhantomData<T>,
}

impl<T> Stored<T> {
    /// Reads the file.
    ///
    /// # Errors
    /// When it cannot be read again.
    pub(crate) fn read(path: &Path) -> Result<Self, Error> {
        let text = std::fs::read(path).map_err(Error::io("read", path))?;
        let json: Value = serde_json::from_slice(&text)
            .map_err(|error| Error::plain(format!("{}: {error}", path.display())))?;
        Ok(Self::from(json))
    }
}

impl<T> From<Value> for Stored<T> {
    fn from(json: Value) -> Self {
        Self { json, kind: PhantomData }
    }
}

/// True where a word can be the file of a flag whose files have an ending.
pub(crate) fn is_file(word: &OsStr, ending: &str) -> bool {
    let path = Path::new(word);
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending))
        || output::is_stdout(path)
        || matches!(cif_output::place(path), Ok(Place::Stream(_)))
}

/// Joins a flag whose file may be left out to it, `--json FILE` to `--json=FILE`: so a file is distinguished from the
/// argument after the flag.
#[must_use]
pub(crate) fn join_files(arguments: Vec<OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::with_capacity(arguments.len());
    let mut words = arguments.into_iter().peekable();
    while let Some(word) = words.next() {
        if word == "--" {
            joined.push(word);
            joined.extend(words);
            break;
        }
        let (flag, file) = match word.to_str() {
            Some(FLAG) => (FLAG, words.next_if(|next| is_file(next, "json"))),
            Some(OLD_FLAG) => (FLAG, words.next()),
            Some(PATHS_FLAG) => (PATHS_FLAG, words.next_if(|next| is_file(next, "csv"))),
            _ => ("", None),
        };
        joined.push(match file {
            Some(file) => {
                let mut word = OsString::from(flag);
                word.push("=");
                word.push(file);
                word
            }
            None => word,
        });
    }
    joined
}

/// Advice where a word after a flag was meant as its file and is none by its name.
#[must_use]
pub(crate) fn advice(arguments: &[OsString], unexpected: &str) -> Option<String> {
    [(FLAG, "json"), (PATHS_FLAG, "csv")].into_iter().find_map(|(flag, ending)| {
        let follows = arguments.windows(2).any(|pair| pair[0] == flag && pair[1] == unexpected);
        follows.then(|| {
            let name = Path::new(unexpected).with_extension(ending);
            format!("the file of {flag} ends in .{ending}: {flag} {}", name.display())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn joined(line: &str) -> String {
        let words = join_files(line.split_whitespace().map(OsString::from).collect());
        words.iter().map(|word| word.to_str().unwrap()).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn files_of_reports_are_distinguished_from_other_arguments() {
        for (line, expected) in [
            ("cif info --json table", "cif info --json table"),
            ("cif info table --json", "cif info table --json"),
            ("cif eval --json out.json a.cif table", "cif eval --json=out.json a.cif table"),
            ("cif eval a.cif table --json A/B.JSON --force", "cif eval a.cif table --json=A/B.JSON --force"),
            ("cif eval a.cif table --json -", "cif eval a.cif table --json=-"),
            ("cif eval --json /dev/stdout a.cif table", "cif eval --json=/dev/stdout a.cif table"),
            ("cif eval --json=x.json a.cif", "cif eval --json=x.json a.cif"),
            ("cif info --json --quiet table", "cif info --json --quiet table"),
            ("cif export a.cif --report-json t.json", "cif export a.cif --json=t.json"),
            ("cif label a.cif -- --json x.json", "cif label a.cif -- --json x.json"),
            ("cif query --trajectory a.cif --label mug", "cif query --trajectory a.cif --label mug"),
            ("cif query a.cif --trajectory p.csv", "cif query a.cif --trajectory=p.csv"),
            ("cif query --trajectory - a.cif", "cif query --trajectory=- a.cif"),
        ] {
            assert_eq!(joined(line), expected);
        }
    }

    #[test]
    fn a_file_of_another_ending_is_explained() {
        let words: Vec<OsString> = ["eval", "--json", "scores.txt"].map(OsString::from).to_vec();
        assert_eq!(
            advice(&words, "scores.txt").unwrap(),
            "the file of --json ends in .json: --json scores.json"
        );
        assert!(advice(&words, "eval").is_none());
    }
}
