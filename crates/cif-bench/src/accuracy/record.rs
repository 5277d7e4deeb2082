//! Record of a rung.

use cif_dataset::MadeFrom;
use cif_train::Curve;
use serde::{Deserialize, Serialize};

use crate::records::Measurement;

/// A measured rung.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Everything that the measurement depends on: another value makes the record void.
    pub fingerprint: MadeFrom,
    /// Processor time of training, all threads together, measuring not counted; of a frame or a file where
    /// nothing is trained; seconds.
    pub cpu_s: f64,
    /// Wall time of the same.
    pub wall_s: f64,
    /// Mean PSNR of the held-out frames, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM of the held-out frames.
    pub ssim: Option<f64>,
    /// Panoptic quality of the held-out frames, percent.
    pub panoptic: Option<f64>,
    /// Mean IoU of the held-out frames over the whole image, percent: what spills onto the background counts.
    pub iou: Option<f64>,
    /// mIoU of the held-out frames over labelled pixels, percent.
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
    /// Pictures next to the record, without folder.
    pub pictures: Vec<String>,
}

impl Measurement for Record {
    const FOLDER: &'static str = "rungs";

    fn fingerprint(&self) -> &MadeFrom {
        &self.fingerprint
    }

    fn files(&self, _: &str) -> Vec<String> {
        self.pictures.clone()
    }
}
