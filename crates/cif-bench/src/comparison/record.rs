//! Record of a run: one JSON file, its pictures and its scene, so that a comparison goes on where it was interrupted.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::{Error, write_file};

/// Scores of a run on the held-out frames of its capture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Name of the capture.
    pub capture: String,
    /// The head, or the ablation.
    pub head: String,
    /// Seed.
    pub seed: u64,
    /// Accuracy of pixels, percent.
    pub macc_pix: Option<f64>,
    /// Accuracy of instances, percent.
    pub macc_inst: Option<f64>,
    /// Mean IoU, percent.
    pub miou: Option<f64>,
    /// Mean PSNR, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM.
    pub ssim: Option<f64>,
    /// Gaussians in the end.
    pub gaussians: usize,
    /// Processor time on top of the reconstruction, all threads together, seconds.
    pub seconds: f64,
}

/// A run that is done.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Everything that the run depends on: another value makes the record void.
    pub fingerprint: Value,
    /// Scores.
    pub row: Row,
    /// Steps of the instance stage.
    pub steps: u64,
    /// Pictures beside the record, without folder: colours, labels and true labels of a frame.
    pub pictures: Vec<String>,
}

/// The folder of the runs of a comparison.
#[derive(Clone, Debug)]
pub struct Runs(PathBuf);

impl Runs {
    /// Inside the folder of a comparison; created when missing.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn inside(comparison: &Path) -> Result<Self, Error> {
        let path = comparison.join("runs");
        std::fs::create_dir_all(&path).map_err(Error::io("create the folder", &path))?;
        Ok(Self(path))
    }

    /// A file of the folder.
    #[must_use]
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// The record of a run with this fingerprint; unreadable ones, and those without their files, count as missing.
    #[must_use]
    pub fn find(&self, id: &str, fingerprint: &Value) -> Option<Record> {
        let text = std::fs::read_to_string(self.file(&format!("{id}.json"))).ok()?;
        let record: Record = serde_json::from_str(&text).ok()?;
        let files = record.pictures.iter().cloned().chain([format!("{id}.cif")]);
        let whole = files.into_iter().all(|name| self.file(&name).is_file());
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
