//! Where the time of a training step goes.

use std::time::{Duration, Instant};

/// Wall time per stage, summed over views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes {
    /// Deformation forward.
    pub deform: Duration,
    /// Projection and spherical harmonics.
    pub project: Duration,
    /// Depth sort and tile lists.
    pub bin: Duration,
    /// Raster forward, with the instance pass when it is on.
    pub rasterize: Duration,
    /// Raster backward, likewise.
    pub rasterize_backward: Duration,
    /// Projection backward, with the sums over tiles.
    pub project_backward: Duration,
    /// Deformation backward.
    pub deform_backward: Duration,
}

impl StageTimes {
    /// Stage names and times, in the order of a step.
    #[must_use]
    pub fn rows(&self) -> [(&'static str, Duration); 7] {
        [
            ("deform", self.deform),
            ("project", self.project),
            ("bin and sort", self.bin),
            ("rasterize", self.rasterize),
            ("rasterize backward", self.rasterize_backward),
            ("project backward", self.project_backward),
            ("deform backward", self.deform_backward),
        ]
    }
}

/// Runs `work` and adds its wall time to `total`.
pub(super) fn timed<T>(total: &mut Duration, work: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = work();
    *total += start.elapsed();
    result
}
