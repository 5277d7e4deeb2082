//! Folders of measurements, one JSON file each with its pictures, so that a bench goes on where it was interrupted.

use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use cif_dataset::MadeFrom;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::{Error, write_file};

/// One measurement.
pub trait Measurement: Serialize + DeserializeOwned {
    /// Folder of such measurements inside that of their report.
    const FOLDER: &'static str;

    /// Everything that the measurement depends on: another value makes it void.
    fn fingerprint(&self) -> &MadeFrom;

    /// Files that must lie next to the record of this name, without folder.
    fn files(&self, id: &str) -> Vec<String>;
}

/// State of a measurement.
#[derive(Clone, Debug, PartialEq)]
pub enum Kept<M> {
    /// It is there, and nothing that it depends on has changed.
    Good(M),
    /// It is there and void, for a reason: a sentence without a full stop.
    Void(String),
    /// There is none, or not with all of its files.
    Missing,
}

impl<M> Kept<M> {
    /// The measurement, where it is good.
    #[must_use]
    pub fn good(self) -> Option<M> {
        match self {
            Self::Good(record) => Some(record),
            Self::Void(_) | Self::Missing => None,
        }
    }
}

/// The folder of the measurements of a report.
#[derive(Debug)]
pub struct Records<M>(PathBuf, PhantomData<M>);

impl<M: Measurement> Records<M> {
    /// Inside the folder of a report; created when missing.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn inside(report: &Path) -> Result<Self, Error> {
        let path = report.join(M::FOLDER);
        std::fs::create_dir_all(&path).map_err(Error::io("create the folder", &path))?;
        Ok(Self(path, PhantomData))
    }

    /// A file of the folder.
    #[must_use]
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// The measurement of what is there `now`; unreadable ones, and those without their files, count as missing.
    #[must_use]
    pub fn find(&self, id: &str, now: &MadeFrom) -> Kept<M> {
        let Ok(text) = std::fs::read_to_string(self.file(&format!("{id}.json"))) else {
            return Kept::Missing;
        };
        let Ok(record) = serde_json::from_str::<M>(&text) else {
            return match serde_json::from_str::<serde::de::IgnoredAny>(&text) {
                Ok(_) => Kept::Void("it does not record the content of what it was made from".to_owned()),
                Err(_) => Kept::Missing,
            };
        };
        if !record.files(id).iter().all(|name| self.file(name).is_file()) {
            return Kept::Missing;
        }
        match record.fingerprint().difference(now) {
            None => Kept::Good(record),
            Some(difference) => Kept::Void(difference),
        }
    }

    /// Inputs that the measurement of this name was made from: known stamps of files spare reading them.
    #[must_use]
    pub fn known(&self, id: &str) -> Option<MadeFrom> {
        let text = std::fs::read_to_string(self.file(&format!("{id}.json"))).ok()?;
        serde_json::from_str::<M>(&text).ok().map(|record| record.fingerprint().clone())
    }

    /// Keeps a measurement.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn keep(&self, id: &str, record: &M) -> Result<(), Error> {
        let text = serde_json::to_string_pretty(record).expect("records are plain data");
        write_file(&self.file(&format!("{id}.json")), text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    struct Scored {
        fingerprint: MadeFrom,
        pictures: Vec<String>,
    }

    impl Measurement for Scored {
        const FOLDER: &'static str = "scored";

        fn fingerprint(&self) -> &MadeFrom {
            &self.fingerprint
        }

        fn files(&self, _: &str) -> Vec<String> {
            self.pictures.clone()
        }
    }

    #[test]
    fn records_are_found_only_for_what_they_measured() {
        let folder = tempfile::tempdir().unwrap();
        let records = Records::inside(folder.path()).unwrap();
        let of = |seed: u32| MadeFrom::new().value("seed", seed).clone();
        let fingerprint = of(1);
        let record = Scored { fingerprint: fingerprint.clone(), pictures: Vec::new() };
        assert_eq!(records.find("a", &fingerprint), Kept::Missing);
        records.keep("a", &record).unwrap();
        assert_eq!(records.find("a", &fingerprint), Kept::Good(record.clone()));
        assert_eq!(records.find("a", &of(2)), Kept::Void("seed was 1 and is 2".to_owned()));
        records.keep("b", &Scored { pictures: vec!["b.png".into()], ..record }).unwrap();
        assert_eq!(records.find("b", &fingerprint), Kept::Missing, "its picture is missing");
        std::fs::write(records.file("a.json"), "{").unwrap();
        assert_eq!(records.find("a", &fingerprint), Kept::Missing);
        // Of versions that knew files by their names.
        std::fs::write(records.file("a.json"), r#"{"fingerprint": {"seed": 1}, "pictures": []}"#).unwrap();
        assert!(matches!(records.find("a", &fingerprint), Kept::Void(_)));
    }
}
