//! The plan as a person writes it, in TOML.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use cif_system::Error;
use serde::Deserialize;

/// Largest plan that is read, bytes.
const LARGEST: u64 = 4 << 20;

/// Most windows of time: their numbers have three digits.
const MOST_WINDOWS: u32 = 999;

/// A plan. Paths are relative to the folder of its file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Folder of all results.
    #[serde(default = "results")]
    pub output: PathBuf,
    /// Folders of captures, with wildcards.
    #[serde(default)]
    pub captures: Vec<String>,
    /// Options of every command that reads a capture, such as `--masks masks_tracker`.
    #[serde(default)]
    pub capture_options: Words,
    /// Training.
    #[serde(default)]
    pub train: Train,
    /// Named options of `cif train`; every scene is trained with each.
    #[serde(default)]
    pub variants: BTreeMap<String, Words>,
    /// Scores of every scene.
    #[serde(default)]
    pub eval: Toggle<Eval>,
    /// Files that every scene is exported as.
    #[serde(default)]
    pub export: Option<Export>,
    /// Further commands.
    #[serde(default)]
    pub step: Vec<OwnStep>,
    /// Benches, each taken apart into jobs.
    #[serde(default)]
    pub bench: Vec<Bench>,
    /// Share of a machine that a job takes.
    #[serde(default)]
    pub resources: Resources,
    /// Options of the engines of farms.
    #[serde(default)]
    pub engines: EngineOptions,
    /// The file.
    #[serde(skip)]
    pub file: PathBuf,
}

fn results() -> PathBuf {
    PathBuf::from("results")
}

/// Words of a command line: a list, or a text as a shell would split it.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(try_from = "WordsText")]
pub struct Words(pub Vec<String>);

#[derive(Deserialize)]
#[serde(untagged)]
enum WordsText {
    List(Vec<String>),
    Text(String),
}

impl TryFrom<WordsText> for Words {
    type Error = String;

    fn try_from(words: WordsText) -> Result<Self, String> {
        match words {
            WordsText::List(words) => Ok(Self(words)),
            WordsText::Text(text) => {
                shlex::split(&text).map(Self).ok_or_else(|| format!("a quote is not closed in: {text}"))
            }
        }
    }
}

/// A part that is there unless the plan says `false`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Toggle<T> {
    /// On or off.
    Is(bool),
    /// On, with options.
    With(T),
}

impl<T> Default for Toggle<T> {
    fn default() -> Self {
        Self::Is(true)
    }
}

/// How scenes are trained; every combination of the lists is a run.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Train {
    /// Named settings.
    #[serde(default)]
    pub preset: Vec<String>,
    /// Heads.
    #[serde(default)]
    pub head: Vec<String>,
    /// Seeds.
    #[serde(default)]
    pub seed: Vec<u32>,
    /// Windows of time that captures are divided into, each trained by itself; 0 for none.
    #[serde(default)]
    pub windows: u32,
    /// Options of every run.
    #[serde(default)]
    pub options: Words,
    /// Steps that come first.
    #[serde(default)]
    pub needs: Vec<String>,
}

/// How scenes are scored.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Eval {
    /// Options of `cif eval`.
    #[serde(default)]
    pub options: Words,
    /// Pictures of the held-out frames.
    #[serde(default = "yes")]
    pub pictures: bool,
}

fn yes() -> bool {
    true
}

/// How scenes are exported.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Export {
    /// Names of files; the ending says the format.
    pub files: Vec<String>,
    /// Options of `cif export`.
    #[serde(default)]
    pub options: Words,
}

/// Subjects of a step, of which each has a job.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Each {
    /// Every trained scene; of a capture that is divided into windows of time, each of them.
    #[default]
    Run,
    /// All windows of a scene together; every trained scene where there are none.
    Whole,
    /// Every capture.
    Capture,
    /// Once.
    Batch,
}

/// A command of one's own.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnStep {
    /// Name.
    pub name: String,
    /// Subjects, of which each has a job.
    #[serde(default)]
    pub each: Each,
    /// Steps that come first; a step of every scene needs the training anyway.
    #[serde(default)]
    pub needs: Vec<String>,
    /// The command of cif without its first word, with placeholders.
    pub command: Words,
    /// Files and folders that it makes, with placeholders.
    #[serde(default)]
    pub makes: Vec<String>,
    /// Share of a machine that its jobs take, where that differs.
    #[serde(flatten)]
    pub resources: Resources,
}

/// A bench.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bench {
    /// Name.
    pub name: String,
    /// `accuracy CAPTURE -o DIR ...` or `compare CAPTURE... -o DIR ...`, with the placeholder `{output}`.
    pub command: Words,
}

/// Share of a machine that a job takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Resources {
    /// Threads.
    pub threads: Option<u32>,
    /// Memory, GiB.
    pub memory_gib: Option<f64>,
    /// Longest time, which farms end a job after.
    #[serde(default, deserialize_with = "duration")]
    pub time: Option<Duration>,
}

impl Resources {
    /// These, and others where these say nothing.
    #[must_use]
    pub fn or(self, others: Self) -> Self {
        Self {
            threads: self.threads.or(others.threads),
            memory_gib: self.memory_gib.or(others.memory_gib),
            time: self.time.or(others.time),
        }
    }
}

fn duration<'de, D: serde::Deserializer<'de>>(source: D) -> Result<Option<Duration>, D::Error> {
    let text = Option::<String>::deserialize(source)?;
    text.map(|text| humantime::parse_duration(&text).map_err(serde::de::Error::custom)).transpose()
}

/// Options of the engines of farms, as each takes them.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EngineOptions {
    /// Command that starts cif on a worker, such as `/opt/cif/bin/cif` or `apptainer run cif.sif`.
    #[serde(default)]
    pub command: Words,
    /// Options of `sbatch`, such as `--partition=cpu`.
    #[serde(default)]
    pub slurm: Words,
    /// Options of `hq submit`.
    #[serde(default)]
    pub hyperqueue: Words,
}

impl Plan {
    /// Reads a plan.
    ///
    /// # Errors
    /// When the file cannot be read, or says something that no plan may say.
    pub fn read(file: &Path) -> Result<Self, Error> {
        let about = |problem: String| {
            Error::refused(
                format!("{}: {problem}", file.display()),
                "see cif batch --help for what a plan may say",
            )
        };
        let size = std::fs::metadata(file).map_err(Error::io("read", file))?.len();
        if size > LARGEST {
            return Err(about(format!("it has {size} bytes, too many for a plan")));
        }
        let text = cif_input::read_to_string(file).map_err(Error::io("read", file))?;
        let mut plan: Self = toml::from_str(&text).map_err(|error| about(error.to_string()))?;
        plan.file = file.to_owned();
        plan.check().map_err(about)?;
        Ok(plan)
    }

    /// Folder that paths are relative to.
    #[must_use]
    pub fn folder(&self) -> &Path {
        match self.file.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        }
    }

    fn check(&self) -> Result<(), String> {
        let mut seeds = self.train.seed.clone();
        seeds.sort_unstable();
        if seeds.windows(2).any(|pair| pair[0] == pair[1]) {
            return Err("a seed is listed twice".to_owned());
        }
        let named = self.variants.keys().map(String::as_str);
        let named = named.chain(self.train.preset.iter().chain(&self.train.head).map(String::as_str));
        let named = named.chain(self.step.iter().map(|step| step.name.as_str()));
        for name in named.chain(self.bench.iter().map(|bench| bench.name.as_str())) {
            check_name(name)?;
        }
        if self.train.windows == 1 || self.train.windows > MOST_WINDOWS {
            return Err(format!("windows must be 2 to {MOST_WINDOWS}"));
        }
        let own = self.step.iter().map(|step| &step.resources);
        for resources in own.chain([&self.resources]) {
            if resources.threads == Some(0) {
                return Err("threads must be 1 or more".to_owned());
            }
            if resources.memory_gib.is_some_and(|memory| !(memory > 0.0 && memory < 1e6)) {
                return Err("memory_gib must be above 0".to_owned());
            }
        }
        if self.captures.is_empty()
            && self.bench.is_empty()
            && self.step.iter().all(|step| step.each != Each::Batch)
        {
            return Err("it names no captures and no benches, so there is nothing to do".to_owned());
        }
        Ok(())
    }
}

/// Names become parts of paths and of the names of jobs.
pub(crate) fn check_name(name: &str) -> Result<(), String> {
    let is_plain = |letter: char| letter.is_alphanumeric() || "-_+.= ".contains(letter);
    if name.is_empty() || name.starts_with('.') || name.trim() != name || !name.chars().all(is_plain) {
        return Err(format!(
            "`{name}` cannot be a name: letters, digits and the signs -_+.= alone, no dot in front"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Plan, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("plan.toml");
        std::fs::write(&file, text).unwrap();
        Plan::read(&file).map_err(|error| error.to_string())
    }

    #[test]
    fn options_are_lists_or_texts_as_for_a_shell() {
        let plan = read(
            "captures = ['a']\ncapture_options = \"--masks 'my masks'\"\n[train]\noptions = ['--set', 'a=b c']\n[resources]\ntime = '4h'",
        )
        .unwrap();
        assert_eq!(plan.capture_options.0, ["--masks", "my masks"]);
        assert_eq!(plan.train.options.0, ["--set", "a=b c"]);
        assert_eq!(plan.resources.time, Some(Duration::from_secs(14_400)));
        assert_eq!(plan.eval, Toggle::Is(true));
    }

    #[test]
    fn what_no_plan_may_say_is_refused_with_its_place() {
        for (text, said) in [
            ("captures = ['a']\nseeds = 3", "unknown field `seeds`"),
            ("captures = ['a']\n[train]\npresets = ['draft']", "unknown field `presets`"),
            ("captures = ['a']\n[train]\nseed = [1, 1]", "listed twice"),
            ("captures = ['a']\n[variants]\n'../up' = []", "cannot be a name"),
            ("captures = ['a']\n[resources]\nthreads = 0", "1 or more"),
            ("captures = ['a']\n[train]\nwindows = 1", "2 to 999"),
            ("captures = ['a']\n[resources]\nmemory_gib = -1.0", "above 0"),
            ("captures = ['a']\n[train]\noptions = \"--set 'x\"", "not closed"),
            ("output = 'x'", "nothing to do"),
            ("captures = [", "plan.toml"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(said), "{text}: {error}");
        }
    }
}
