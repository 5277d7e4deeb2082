//! The file that a training run saves into: locked while the run lasts, and never written over what others put there.

use std::fs::{self, File};
use std::hash::{DefaultHasher, Hasher};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use cif_field::Checkpoint;
use cif_train::TrainConfig;

use crate::error::Error;
use crate::lock::Lock;
use crate::output;

/// Bytes by which the contents of a file are recognised. The header of a scene comes first, with the times of its
/// run, so that no two states are alike.
const RECOGNISED_BYTES: u64 = 8 << 20;

/// Treatment of a scene that is there when a run begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// It is refused.
    Keep,
    /// It is replaced, by a run that begins anew or goes on with it.
    Replace,
}

/// Reasons why a state was not saved.
#[derive(Debug)]
pub enum Unsaved {
    /// Something else has appeared in the place of the file since the run began or saved last. The state was saved
    /// next to it, as the error says; the run has no file any more.
    Taken(Error),
    /// The file system refuses, perhaps for the moment.
    Refused(Error),
}

/// Where a run saves.
#[derive(Debug)]
pub struct Destination {
    path: PathBuf,
    /// Where the settings go that the run had.
    settings_path: PathBuf,
    existing: Existing,
    /// Contents of the file as this run knows them; `None` for no file.
    known: Option<Contents>,
    /// Settings that are in their file.
    written: Option<String>,
    _lock: Lock,
}

impl Destination {
    /// Locks a file and checks that it can be written and that nothing there would be lost.
    ///
    /// # Errors
    /// When another process writes it, the folder is missing or refuses files, or the file or its settings exist and
    /// are to be kept.
    pub fn open(path: &Path, existing: Existing) -> Result<Self, Error> {
        output::check_file(path, true)?;
        let lock = Lock::take(path)?;
        if existing == Existing::Keep && path.exists() && is_unfinished(path) {
            return Err(Error::failed(
                format!("{} exists and holds a run that was interrupted", path.display()),
                "give --resume to continue it, --force to replace it, or choose another name",
            ));
        }
        output::check_file(path, existing == Existing::Replace)?;
        let known = Contents::of(path).map_err(Error::io("read", path))?;
        let settings_path = path.with_extension("train.toml");
        let destination =
            Self { path: path.to_owned(), settings_path, existing, known, written: None, _lock: lock };
        if destination.settings_are_kept()? && !destination.holds_canonical_settings() {
            output::check_file(&destination.settings_path, false)?;
        }
        Ok(destination)
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that the settings of a run may be written: a file with other ones is kept.
    ///
    /// # Errors
    /// When there is one.
    pub fn check_settings(&self, config: &TrainConfig) -> Result<(), Error> {
        if self.settings_are_kept()? && fs::read_to_string(&self.settings_path).ok() != Some(text_of(config))
        {
            output::check_file(&self.settings_path, false)?;
        }
        Ok(())
    }

    /// The run goes on with what the file holds; its settings are in their file already, where that exists.
    pub fn resumes(&mut self, config: &TrainConfig) {
        self.written = self.settings_path.exists().then(|| text_of(config));
    }

    /// Saves a state of the run, and its settings next to it.
    ///
    /// # Errors
    /// When something else has taken the place of the file, or it cannot be written.
    pub fn save(&mut self, checkpoint: &Checkpoint, config: &TrainConfig) -> Result<(), Unsaved> {
        let is_saved = self.try_to_save(checkpoint).map_err(Unsaved::Refused)?;
        if !is_saved {
            return Err(Unsaved::Taken(self.save_beside(checkpoint)));
        }
        self.write_settings(config).map_err(Unsaved::Refused)
    }

    /// As [`Self::save`] for the last state of a run: what its place refuses is saved in the folder for temporary
    /// files, because hours of training may be in it.
    ///
    /// # Errors
    /// Whenever the state is not in its file; the error says where it is.
    pub fn save_or_rescue(&mut self, checkpoint: &Checkpoint, config: &TrainConfig) -> Result<(), Error> {
        self.save(checkpoint, config).map_err(|unsaved| match unsaved {
            Unsaved::Taken(error) => error,
            Unsaved::Refused(error) => rescued(checkpoint, &self.path, &error),
        })
    }

    /// Saves where the file is this run's own, or not there; false where it is something else's.
    fn try_to_save(&mut self, checkpoint: &Checkpoint) -> Result<bool, Error> {
        let contents = || Contents::of(&self.path).map_err(Error::io("read", &self.path));
        let is_saved = match contents()? {
            None => save_anew(checkpoint, &self.path)?,
            found if found == self.known => {
                checkpoint.save(&self.path).map(|()| true).map_err(Error::plain)?
            }
            Some(_) => false,
        };
        if is_saved {
            self.known = contents()?;
        }
        Ok(is_saved)
    }

    fn write_settings(&mut self, config: &TrainConfig) -> Result<(), Error> {
        let text = text_of(config);
        if self.written.as_ref() != Some(&text) {
            output::write_file(&self.settings_path, text.as_bytes())?;
            self.written = Some(text);
        }
        Ok(())
    }

    /// Saves a state under a free name next to the file, which something else has written.
    fn save_beside(&self, checkpoint: &Checkpoint) -> Error {
        let name = self.path.display();
        let message = format!("{name} was written by something else while this run went on, and is kept");
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        let candidates = (2..1_000).map(|k| self.path.with_file_name(format!("{stem}-{k}.cif")));
        for path in candidates {
            match save_anew(checkpoint, &path) {
                Ok(true) => {
                    let help = if checkpoint.training.is_some() {
                        format!("this run was saved as {0}; continue it with --resume -o {0}", path.display())
                    } else {
                        format!("this run was saved as {}", path.display())
                    };
                    return Error::failed(message, help);
                }
                Ok(false) => {}
                Err(error) => return Error::plain(format!("{message}; {error}")),
            }
        }
        Error::failed(message, "this run could not be saved: a thousand names next to it are taken")
    }

    /// True where there are settings that are not to be replaced.
    fn settings_are_kept(&self) -> Result<bool, Error> {
        let exists = self.settings_path.try_exists().map_err(Error::io("look for", &self.settings_path))?;
        Ok(exists && self.existing == Existing::Keep)
    }

    /// True where the settings are as a run writes them, so that they may turn out to be its own.
    fn holds_canonical_settings(&self) -> bool {
        fs::read_to_string(&self.settings_path)
            .is_ok_and(|text| toml::from_str(&text).is_ok_and(|config: TrainConfig| text_of(&config) == text))
    }
}

fn text_of(config: &TrainConfig) -> String {
    toml::to_string_pretty(config).expect("settings serialise to TOML")
}

/// True where a file is a scene that a run can go on with.
pub(crate) fn is_unfinished(path: &Path) -> bool {
    Checkpoint::load(path).is_ok_and(|checkpoint| checkpoint.training.is_some())
}

/// Length and hash of the first bytes of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Contents {
    length: u64,
    hash: u64,
}

impl Contents {
    fn of(path: &Path) -> io::Result<Option<Self>> {
        let file = match File::open(path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let length = file.metadata()?.len();
        let mut first = Vec::new();
        file.take(RECOGNISED_BYTES).read_to_end(&mut first)?;
        let mut hasher = DefaultHasher::new();
        hasher.write(&first);
        Ok(Some(Self { length, hash: hasher.finish() }))
    }
}

/// Saves a file where there is none; false when there is one after all.
fn save_anew(checkpoint: &Checkpoint, path: &Path) -> Result<bool, Error> {
    let new = cif_output::NewFile::create(path).map_err(Error::io("write to the folder of", path))?;
    let mut sink = BufWriter::with_capacity(1 << 20, new.file());
    checkpoint.write(&mut sink, path).map_err(Error::plain)?;
    sink.flush().map_err(Error::io("write", path))?;
    drop(sink);
    new.finish_new().map_err(Error::io("write", path))
}

/// Saves what its place refuses in the folder for temporary files.
fn rescued(checkpoint: &Checkpoint, path: &Path, refused: &Error) -> Error {
    match output::rescue(path, |file| checkpoint.save(file).map_err(Error::plain)) {
        Ok(rescue) => Error::failed(
            refused.to_string(),
            format!("the scene was saved as {} instead; move it where there is space", rescue.display()),
        ),
        Err(error) => Error::failed(
            format!(
                "{refused}; nothing of this run could be saved in the folder for temporary files either: {error}"
            ),
            "make space, or set TMPDIR to a folder that has some, then train again",
        ),
    }
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic::{SyntheticConfig, generate};

    use super::*;

    fn checkpoint(iterations: u32) -> Checkpoint {
        let mut field = generate(&SyntheticConfig::default()).field;
        field.record.notes.insert("iterations".to_owned(), serde_json::json!(iterations));
        Checkpoint { field, training: None, head: None }
    }

    fn listing(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_appears_meanwhile_is_kept_and_the_run_saved_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        let config = TrainConfig::default();
        for existing in [Existing::Keep, Existing::Replace] {
            let mut destination = Destination::open(&path, existing).unwrap();
            checkpoint(1).save(&path).unwrap();
            let Err(Unsaved::Taken(error)) = destination.save(&checkpoint(2), &config) else {
                panic!("it was there")
            };
            assert!(error.to_string().contains("written by something else"), "{error}");
            let help = miette::Diagnostic::help(&error).unwrap().to_string();
            assert!(help.contains("a-2.cif"), "{help}");
            assert_eq!(Checkpoint::load(&path).unwrap(), checkpoint(1));
            assert_eq!(Checkpoint::load(folder.path().join("a-2.cif")).unwrap(), checkpoint(2));
            drop(destination);
            assert_eq!(listing(folder.path()), ["a-2.cif", "a.cif"]);
            for name in ["a-2.cif", "a.cif"] {
                fs::remove_file(folder.path().join(name)).unwrap();
            }
        }
    }

    #[test]
    fn a_run_replaces_what_it_saved_itself_and_nobody_elses() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        let config = TrainConfig::default();
        let mut destination = Destination::open(&path, Existing::Keep).unwrap();
        for iterations in [1, 2, 3] {
            destination.save(&checkpoint(iterations), &config).unwrap();
        }
        assert_eq!(Checkpoint::load(&path).unwrap(), checkpoint(3));
        assert_eq!(listing(folder.path()), [".a.cif.lock", "a.cif", "a.train.toml"]);
        // Moved away, it may be written again.
        fs::rename(&path, folder.path().join("kept.cif")).unwrap();
        destination.save(&checkpoint(4), &config).unwrap();
        checkpoint(5).save(&path).unwrap();
        assert!(matches!(destination.save(&checkpoint(6), &config), Err(Unsaved::Taken(_))));
        assert_eq!(Checkpoint::load(&path).unwrap(), checkpoint(5));
    }

    #[test]
    fn settings_of_others_are_kept_and_equal_ones_are_no_obstacle() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        let settings = folder.path().join("a.train.toml");
        let config = TrainConfig::default();
        fs::write(&settings, "# mine\n").unwrap();
        let error = Destination::open(&path, Existing::Keep).unwrap_err();
        assert!(error.to_string().contains("a.train.toml exists"), "{error}");
        fs::write(&settings, text_of(&config)).unwrap();
        let destination = Destination::open(&path, Existing::Keep).unwrap();
        destination.check_settings(&config).unwrap();
        let other = TrainConfig { seed: 5, ..config.clone() };
        assert!(destination.check_settings(&other).is_err());
        drop(destination);
        Destination::open(&path, Existing::Replace).unwrap().check_settings(&other).unwrap();
    }
}
