//! Time codes of a scene.

/// Captured frame numbers: frame `f` of the field's timeline is time code `f`.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeCodes {
    /// Sampled time codes, ascending, at least one.
    pub samples: Vec<f64>,
    /// Normalised time of every sample.
    pub times: Vec<f64>,
    /// Time codes per second.
    pub frames_per_second: f64,
}

impl TimeCodes {
    /// First time code.
    #[must_use]
    pub fn start(&self) -> f64 {
        self.samples.first().copied().unwrap_or(0.0)
    }

    /// Last time code.
    #[must_use]
    pub fn end(&self) -> f64 {
        self.samples.last().copied().unwrap_or(0.0)
    }

    /// The range of the time codes.
    #[must_use]
    pub fn range(&self) -> CodeRange {
        CodeRange { ends: Some((self.start(), self.end())), per_second: self.frames_per_second }
    }
}

/// Range of the time codes of a file, by which it is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodeRange {
    /// First and last time code; `None` where the file does not say.
    pub ends: Option<(f64, f64)>,
    /// Time codes per second.
    pub per_second: f64,
}
