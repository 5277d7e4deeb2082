//! The GPU that tests run on: `CIF_TEST_GPU=off|auto|require`.

use cif_system::environment::TEST_GPU;

use super::device::Gpu;
use super::features::GpuFeatures;
use super::form::Form;

/// The GPU for a test, or `None` with the reason on stderr. `off` skips, `auto` (the default) takes what is there,
/// software rasterisers too, and `require` insists.
///
/// # Panics
/// Under `require` without a GPU, and for other values.
#[must_use]
pub fn gpu() -> Option<Gpu> {
    let wish = TEST_GPU.text().unwrap_or_else(|| "auto".to_owned());
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

/// The GPU for a test of kernels that exist in two forms: in the form that it works in, then in the other, where it
/// has subgroups; that one with constants in uniform blocks, in software too. Empty where [`gpu`] is `None`.
///
/// # Panics
/// As [`gpu`].
#[must_use]
pub fn gpus() -> Vec<Gpu> {
    let Some(gpu) = gpu() else { return Vec::new() };
    let other = match gpu.form() {
        Form::Portable => {
            gpu.facts().subgroups.map(|_| GpuFeatures { software_storage: false, ..GpuFeatures::ALL })
        }
        Form::Subgroups => Some(GpuFeatures::NONE),
    };
    let other = other.map(|features| match Gpu::open_with(features) {
        Ok(other) => {
            assert_ne!(other.form(), gpu.form(), "{}", other.subgroups());
            assert!(!other.constants_in_storage());
            other
        }
        Err(error) => panic!("the same GPU with other features: {error}"),
    });
    std::iter::once(gpu).chain(other).collect()
}
