//! Peak throughput of a device, measured.

use std::time::{Duration, Instant};

use super::buffers::GpuVec;
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{
    Commands, Constant, Kernel, MAX_WORKGROUPS, Module, Snippet, Timestamps, constants, workgroups,
};
use super::stages::entries;
use crate::speed::Speed;

/// Rounds of a chain in an invocation.
const ROUNDS: u32 = 256;
/// Floating-point operations of an invocation: eight chains of four lanes, two operations a round.
const OPERATIONS: u64 = 8 * 4 * 2 * ROUNDS as u64;
/// Bytes of a copy: far more than caches hold, on GPUs and on processors that stand in for them.
const COPIED: [u64; 2] = [256 << 20, 64 << 20];
/// A run is long enough to be timed from here on.
const LONG: Duration = Duration::from_millis(4);
/// Most invocations of a run.
const MOST_INVOCATIONS: usize = 1 << 24;
/// Runs, of which the best counts.
const RUNS: usize = 5;

/// Copies, and multiplies and adds.
pub const SPEED: Module = Module {
    name: "speed",
    text: include_str!("speed.wgsl"),
    imports: &[Snippet {
        name: "constants",
        text: || {
            constants(&[
                ("ROUNDS", Constant::Unsigned(ROUNDS)),
                ("MAX_WORKGROUPS", Constant::Unsigned(MAX_WORKGROUPS)),
            ])
        },
    }],
    entries: &["copy_values", "multiply_add"],
};

impl Speed {
    /// Measures a device, in well under a second.
    ///
    /// # Errors
    /// When the device is lost, or rejects the kernels.
    pub fn of_device(gpu: &Gpu) -> Result<Self, GpuError> {
        let [copy, multiply] = entries(gpu, &SPEED)?;
        let most = COPIED[usize::from(gpu.facts().software)].min(gpu.largest_binding());
        let values = (most / 16) as usize;
        let source = GpuVec::<[f32; 4]>::zeros(gpu, "numbers to copy", values)?;
        let target = GpuVec::<[f32; 4]>::zeros(gpu, "copied numbers", values)?;
        let bindings = [source.binding(), target.binding()];
        let groups = [copy.bind(gpu, &bindings), multiply.bind(gpu, &bindings)];
        let mut copied = Duration::MAX;
        // The first run makes the memory.
        for _ in 0..=RUNS {
            copied = copied.min(timed(gpu, &copy, &groups[0], values)?);
        }
        let mut invocations = 1 << 12;
        while invocations < MOST_INVOCATIONS && timed(gpu, &multiply, &groups[1], invocations)? < LONG {
            invocations *= 4;
        }
        let mut multiplied = Duration::MAX;
        for _ in 0..RUNS {
            multiplied = multiplied.min(timed(gpu, &multiply, &groups[1], invocations)?);
        }
        Ok(Self {
            bytes_per_second: 2.0 * 16.0 * values as f64 / copied.as_secs_f64().max(1e-9),
            flops_per_second: (OPERATIONS * invocations as u64) as f64 / multiplied.as_secs_f64().max(1e-9),
        })
    }
}

/// Time of a dispatch: of the device where it has timestamps, else until it is done.
fn timed(
    gpu: &Gpu,
    kernel: &Kernel,
    group: &wgpu::BindGroup,
    invocations: usize,
) -> Result<Duration, GpuError> {
    let mut timestamps = Timestamps::new(gpu);
    let start = Instant::now();
    let mut commands = Commands::new(gpu, timestamps.as_mut());
    commands.stage("speed", |stage| stage.dispatch(kernel, group, workgroups(invocations, 256)));
    commands.submit();
    gpu.wait()?;
    let waited = start.elapsed();
    let on_device = match &timestamps {
        Some(timestamps) => timestamps.read(gpu)?.first().map(|(_, time)| *time),
        None => None,
    };
    Ok(on_device.filter(|time| !time.is_zero()).unwrap_or(waited))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wgpu::testing;

    #[test]
    fn speeds_are_those_of_a_machine() {
        for gpu in testing::gpus() {
            let Speed { bytes_per_second, flops_per_second } = Speed::of_device(&gpu).unwrap();
            println!("{:.1} GB/s, {:.1} GFLOP/s", bytes_per_second / 1e9, flops_per_second / 1e9);
            // From a busy processor to more than any GPU: finite, and no nonsense.
            assert!((1e7..1e15).contains(&bytes_per_second), "{bytes_per_second}");
            assert!((1e7..1e17).contains(&flops_per_second), "{flops_per_second}");
        }
    }
}
