//! The GPU that tests run on: `CIF_TEST_GPU=off|auto|require`.

use super::device::Gpu;

/// The GPU for a test, or `None` with the reason on stderr. `off` skips, `auto` (the default) takes what is there,
/// software rasterisers too, and `require` insists.
///
/// # Panics
/// Under `require` without a GPU, and for other values.
#[must_use]
pub fn gpu() -> Option<Gpu> {
    let wish = std::env::var("CIF_TEST_GPU").unwrap_or_else(|_| "auto".to_owned());
    match wish.as_str() {
        "off" => {
            eprintln!("skipped: CIF_TEST_GPU=off");
            None
        }
        "auto" | "require" => match Gpu::open() {
            Ok(gpu) => {
                eprintln!("GPU: {} ({}, {})", gpu.facts().name, gpu.facts().interface, gpu.facts().driver);
                Some(gpu)
            }
            Err(error) => {
                assert!(wish == "auto", "CIF_TEST_GPU=require: {error}");
                eprintln!("skipped: {error}");
                None
            }
        },
        _ => panic!("CIF_TEST_GPU is {wish}; it may be off, auto or require"),
    }
}
