//! Recordings that the images of a capture were made of.

use serde::{Deserialize, Serialize};

/// Image of a recording that a frame was made of, as `cif capture` writes it into `transforms.json` (`cif` of a frame).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameSource {
    /// File name of the video or photograph.
    pub file: String,
    /// Width and height there, pixels.
    pub size: [u32; 2],
    /// Place in the video; `None` for photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub video: Option<VideoFrame>,
}

/// Place of a frame in its video.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct VideoFrame {
    /// Number of the frame in the stream, from 0.
    pub frame: u64,
    /// Frames that the stream has.
    pub of: u64,
    /// Time of the frame in the stream, seconds.
    pub time: f64,
}

impl FrameSource {
    /// True where the numbers fit each other.
    pub(crate) fn is_sound(&self) -> bool {
        self.video.is_none_or(|video| video.frame < video.of && video.time.is_finite())
    }
}
