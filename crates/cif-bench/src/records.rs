//! Folders of measurements, one JSON file each with its pictures, so that a bench goes on where it was interrupted.

use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::error::{Error, write_file};

/// One measurement.
pub trait Measurement: Serialize + DeserializeOwned {
    /// Folder of such measurements inside that of their report.
    const FOLDER: &'static str;

    /// Everything that the measurement depends on: another value makes it void.
    fn fingerprint(&self) -> &Value;

    /// Files that must lie beside the record of this name, without folder.
    fn files(&self, id: &str) -> Vec<String>;
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

    /// The measurement with this fingerprint; unreadable ones, and those without their files, count as missing.
    #[must_use]
    pub fn find(&self, id: &str, fingerprint: &Value) -> Option<M> {
        let text = std::fs::read_to_string(self.file(&format!("{id}.json"))).ok()?;
        let record: M = serde_json::from_str(&text).ok()?;
        let whole = record.files(id).iter().all(|name| self.file(name).is_file());
        (record.fingerprint() == fingerprint && whole).then_some(record)
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
        fingerprint: Value,
        pictures: Vec<String>,
    }

    impl Measurement for Scored {
        const FOLDER: &'static str = "scored";

        fn fingerprint(&self) -> &Value {
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
        let fingerprint = serde_json::json!({ "seed": 1 });
        let record = Scored { fingerprint: fingerprint.clone(), pictures: Vec::new() };
        assert_eq!(records.find("a", &fingerprint), None);
        records.keep("a", &record).unwrap();
        assert_eq!(records.find("a", &fingerprint), Some(record.clone()));
        assert_eq!(records.find("a", &serde_json::json!({ "seed": 2 })), None);
        records.keep("b", &Scored { pictures: vec!["b.png".into()], ..record }).unwrap();
        assert_eq!(records.find("b", &fingerprint), None, "its picture is missing");
        std::fs::write(records.file("a.json"), "{").unwrap();
        assert_eq!(records.find("a", &fingerprint), None);
    }
}
