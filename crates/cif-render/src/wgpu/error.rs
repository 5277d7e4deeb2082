//! Errors of the GPU backend, in words for the person at the keyboard.

/// Error of the wgpu backend.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum GpuError {
    /// No adapter at all.
    #[error(
        "no GPU was found through {backends}: {found}. Install the driver of your GPU (on Linux its Vulkan driver; \
         `vulkaninfo --summary` shows what is there), or use the CPU with --backend cpu"
    )]
    NoAdapter {
        /// Interfaces that were asked.
        backends: String,
        /// Adapters that were found, in words.
        found: String,
    },
    /// An adapter below what every kernel needs.
    #[error(
        "the GPU {adapter} is too small: {missing}. These are the core limits of WebGPU; use another GPU \
         (WGPU_ADAPTER_NAME selects by name), or the CPU with --backend cpu"
    )]
    TooSmall {
        /// Name of the adapter.
        adapter: String,
        /// Each limit that is too low, with what was found.
        missing: String,
    },
    /// The driver refused a device.
    #[error("the driver of the GPU {adapter} gives no device: {message}")]
    NoDevice {
        /// Name of the adapter.
        adapter: String,
        /// Message of the driver.
        message: String,
    },
    /// A feature that is to be held back or not, and is none.
    #[error(
        "CIF_GPU_FEATURES names \"{name}\", which is no optional feature; it may be all, none, or some of subgroups, \
         timestamps, separated by commas"
    )]
    UnknownFeature {
        /// The unknown name.
        name: String,
    },
    /// Something does not fit the limits of the device.
    #[error(
        "{what}: {count} x {item_bytes} bytes = {bytes} bytes, but this GPU binds at most {limit} bytes at a time; \
         use {advice}, or the CPU with --backend cpu"
    )]
    TooLarge {
        /// Data that does not fit.
        what: String,
        /// Elements.
        count: u64,
        /// Bytes of an element.
        item_bytes: u64,
        /// Their product.
        bytes: u128,
        /// Largest binding, bytes.
        limit: u64,
        /// Change that would need less memory.
        advice: String,
    },
    /// A deformation network whose activations do not fit the memory of a workgroup.
    #[error(
        "the deformation network is too wide for the wgpu backend: {rows} Gaussians x ({features} features + 3 x \
         width {width}) x 4 bytes = {bytes} bytes of activations, and a workgroup has {limit}; use a smaller \
         `width` or fewer `channels`, or the CPU with --backend cpu"
    )]
    NetworkTooWide {
        /// Gaussians that a workgroup takes at least.
        rows: u32,
        /// Features, levels times channels, padded to 4.
        features: u32,
        /// Width, padded to 4.
        width: u32,
        /// Their product.
        bytes: u64,
        /// Bytes there are.
        limit: u32,
    },
    /// Memory of the device is used up.
    #[error(
        "the GPU is out of memory: {0}; close other programs that use it, or use the CPU with --backend cpu"
    )]
    OutOfMemory(String),
    /// The device is gone: driver reset, unplugged, hung.
    #[error("the GPU was lost: {0}; what was computed on it since the last save is gone")]
    Lost(String),
    /// A kernel or a command that the device rejects; a fault of this program or of the driver.
    #[error("the GPU rejected a command, which is a fault of this program or of the driver: {0}")]
    Rejected(String),
}
