//! Peak throughput of a device or a processor: the lower bounds of the times of stages are derived from it.

/// Peak throughput.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speed {
    /// Bytes read and written per second by a copy.
    pub bytes_per_second: f64,
    /// Single-precision operations per second; a fused multiplication and addition counts as two.
    pub flops_per_second: f64,
}
