//! Record of a run, next to its pictures and its scene.

use cif_dataset::MadeFrom;
use serde::{Deserialize, Serialize};

use crate::records::Measurement;

/// Scores of a run on the held-out frames of its capture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Name of the capture.
    pub capture: String,
    /// The head, or the ablation.
    pub head: String,
    /// Seed.
    pub seed: u64,
    /// Panoptic quality over the whole image, percent.
    pub panoptic: Option<f64>,
    /// Mean IoU over the whole image, percent: what spills onto the background counts.
    pub iou: Option<f64>,
    /// Accuracy of labelled pixels, percent.
    pub macc_pix: Option<f64>,
    /// Accuracy of instances, percent.
    pub macc_inst: Option<f64>,
    /// Mean IoU over labelled pixels, percent.
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
    pub fingerprint: MadeFrom,
    /// Scores.
    pub row: Row,
    /// Steps of the instance stage.
    pub steps: u64,
    /// Pictures next to the record, without folder: colours, labels and true labels of a frame.
    pub pictures: Vec<String>,
}

impl Measurement for Record {
    const FOLDER: &'static str = "runs";

    fn fingerprint(&self) -> &MadeFrom {
        &self.fingerprint
    }

    fn files(&self, id: &str) -> Vec<String> {
        self.pictures.iter().cloned().chain([format!("{id}.cif")]).collect()
    }
}
