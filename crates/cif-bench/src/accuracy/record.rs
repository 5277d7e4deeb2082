//! Record of a rung: one JSON file and its pictures, so that a report goes on where it was interrupted.

use std::path::{Path, PathBuf};

use cif_train::Curve;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::{Error, write_file};

/// A measured rung.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Everything that the measurement depends on: another value makes the record void.
    pub fingerprint: Value,
    /// Processor time of training, all threads together, measuring not counted; of a frame or a file where
    /// nothing is trained; seconds.
    pub cpu_s: f64,
    /// Wall time of the same.
    pub wall_s: f64,
    /// Mean PSNR of the held-out frames, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM of the held-out frames.
    pub ssim: Option<f64>,
    /// mIoU of the held-out frames, percent.
    pub miou: Option<f64>,
    /// Gaussians.
    pub gaussians: Option<usize>,
    /// Bytes of the parameters or of the file.
    pub bytes: Option<u64>,
    /// Largest difference from what is exact, in the unit of the ladder.
    pub residual: Option<f64>,
    /// PSNR against the exact picture, dB.
    pub psnr_to_exact: Option<f64>,
    /// Time of a render, milliseconds.
    pub render_ms: Option<f64>,
    /// Largest resident memory of the process so far, MB.
    pub peak_rss_mb: Option<f64>,
    /// Settings over the base, as `--set` takes them.
    pub settings: Vec<String>,
    /// The run's own curve.
    pub curve: Option<Curve>,
    /// Pictures beside the record, without folder.
    pub pictures: Vec<String>,
}

/// The folder of the rungs of a report.
#[derive(Clone, Debug)]
pub struct Folder(PathBuf);

impl Folder {
    /// Inside the folder of a report; created when missing.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn inside(report: &Path) -> Result<Self, Error> {
        let path = report.join("rungs");
        std::fs::create_dir_all(&path).map_err(Error::io("create the folder", &path))?;
        Ok(Self(path))
    }

    /// A file of the folder.
    #[must_use]
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// The record of a rung that was measured with this fingerprint; unreadable ones count as missing.
    #[must_use]
    pub fn find(&self, id: &str, fingerprint: &Value) -> Option<Record> {
        let text = std::fs::read_to_string(self.file(&format!("{id}.json"))).ok()?;
        let record: Record = serde_json::from_str(&text).ok()?;
        let whole = record.pictures.iter().all(|picture| self.file(picture).is_file());
        (record.fingerprint == *fingerprint && whole).then_some(record)
    }

    /// Keeps a record.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn keep(&self, id: &str, record: &Record) -> Result<(), Error> {
        let text = serde_json::to_string_pretty(record).expect("records are plain data");
        write_file(&self.file(&format!("{id}.json")), text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_found_only_for_what_they_measured() {
        let folder = tempfile::tempdir().unwrap();
        let rungs = Folder::inside(folder.path()).unwrap();
        let fingerprint = serde_json::json!({ "seed": 1 });
        let record = Record { fingerprint: fingerprint.clone(), psnr: Some(30.5), ..Record::default() };
        assert_eq!(rungs.find("a", &fingerprint), None);
        rungs.keep("a", &record).unwrap();
        assert_eq!(rungs.find("a", &fingerprint), Some(record.clone()));
        assert_eq!(rungs.find("a", &serde_json::json!({ "seed": 2 })), None);
        rungs.keep("b", &Record { pictures: vec!["b.png".into()], ..record }).unwrap();
        assert_eq!(rungs.find("b", &fingerprint), None, "its picture is missing");
        std::fs::write(rungs.file("a.json"), "{").unwrap();
        assert_eq!(rungs.find("a", &fingerprint), None);
    }
}
