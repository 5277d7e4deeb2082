//! The check of subgroups. Drivers are not taken at their word: a device uses subgroups only after known numbers have
//! come out right.

use super::buffers::GpuVec;
use super::device::Gpu;
use super::error::GpuError;
use super::features::GpuFeatures;
use super::form::Form;
use super::kernel::{Commands, Kernel, Module};

impl Gpu {
    /// Opens the best adapter: discrete before integrated before virtual before software. The environment variable
    /// `WGPU_ADAPTER_NAME` restricts the choice to adapters whose name contains it, and `CIF_GPU_FEATURES` what is
    /// used of them, see [`GpuFeatures::from_environment`].
    ///
    /// # Errors
    /// When there is none, when it is below the core limits of WebGPU, or when the driver refuses.
    pub fn open() -> Result<Self, GpuError> {
        Self::open_with(GpuFeatures::from_environment()?)
    }

    /// As [`Self::open`], using what `features` allow and the adapter has.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_with(features: GpuFeatures) -> Result<Self, GpuError> {
        Self::unchecked(features)?.checked()
    }

    /// Itself with subgroups that are used only where they compute known numbers right.
    fn checked(self) -> Result<Self, GpuError> {
        if self.form() == Form::Portable {
            return Ok(self);
        }
        let wrong = match self_check(&self) {
            Ok(wrong) => wrong,
            Err(error @ (GpuError::OutOfMemory(_) | GpuError::Lost(_))) => return Err(error),
            Err(error) => Some(error.to_string()),
        };
        Ok(match wrong {
            None => self,
            Some(what) => self.without_subgroups(what),
        })
    }
}

/// Compares what the device computes of known numbers.
pub const SELF_CHECK: Module = Module {
    name: "self_check",
    text: include_str!("self_check.wgsl"),
    imports: &[],
    entries: &["self_check"],
};

const INVOCATIONS: usize = 256;

/// Runs [`SELF_CHECK`] in the form of the device, which may be any; says what came out wrong, if anything did.
///
/// # Errors
/// When the device is lost, or rejects the kernel.
pub fn self_check(gpu: &Gpu) -> Result<Option<String>, GpuError> {
    let kernel = Kernel::compile(gpu, &SELF_CHECK)?.remove(0);
    let found = GpuVec::<[u32; 4]>::zeros(gpu, "known numbers", 3 * INVOCATIONS)?;
    let group = kernel.bind(gpu, &[found.binding()]);
    let mut commands = Commands::new(gpu, None);
    commands.stage("self-check", |stage| stage.dispatch(&kernel, &group, [1, 1, 1]));
    commands.submit();
    Ok(differences(&found.read(gpu)?))
}

/// The first difference from the known numbers.
fn differences(found: &[[u32; 4]]) -> Option<String> {
    let locals = 0..INVOCATIONS as u32;
    let sum = |of: fn(u32) -> f32| locals.clone().map(of).sum::<f32>();
    let sums = [sum(|i| i as f32), sum(|_| 1.0), sum(|i| 0.25 * (i % 7) as f32), sum(|i| -((i * i) as f32))];
    let before = |rank: u32, of: fn(u32) -> u32| (0..rank).map(of).fold(0_u32, u32::saturating_add);
    let small: fn(u32) -> u32 = |rank| 3 * rank + 1;
    let large: fn(u32) -> u32 = |rank| 0x0101_0101 + rank;
    let all = INVOCATIONS as u32;
    let mut ranks = [false; INVOCATIONS];
    for (local, rows) in found.chunks_exact(3).enumerate() {
        let of_sums = rows[0].map(f32::from_bits);
        if of_sums != sums {
            return Some(format!("sums of a workgroup are {of_sums:?} for invocation {local}, not {sums:?}"));
        }
        let [rank, ..] = rows[1];
        match ranks.get_mut(rank as usize) {
            Some(taken) if !*taken => *taken = true,
            _ => return Some(format!("invocation {local} has rank {rank}, which is taken or too large")),
        }
        let expected = [before(rank, small), before(all, small), before(rank, large), before(all, large)];
        let place = rows[2][1];
        // Eight places from a multiple of eight on.
        let (of_neighbours, sum) = (f32::from_bits(rows[2][2]), (8 * (place & !7) + 28) as f32);
        if of_neighbours != sum {
            return Some(format!("the sum of the neighbours of place {place} is {of_neighbours}, not {sum}"));
        }
        let of_counts = [rows[1][1], rows[1][2], rows[1][3], rows[2][0]];
        if of_counts != expected {
            return Some(format!("prefix sums at rank {rank} are {of_counts:?}, not {expected:?}"));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wgpu::testing;

    #[test]
    fn known_numbers_come_out_right_in_both_forms() {
        for gpu in testing::gpus() {
            assert_eq!(self_check(&gpu), Ok(None), "{:?}", gpu.form());
        }
    }

    #[test]
    fn wrong_numbers_are_reported() {
        let locals = 0..INVOCATIONS as u32;
        let sum = |of: fn(u32) -> f32| locals.clone().map(of).sum::<f32>().to_bits();
        let sums =
            [sum(|i| i as f32), sum(|_| 1.0), sum(|i| 0.25 * (i % 7) as f32), sum(|i| -((i * i) as f32))];
        let below = |rank: u32| (0..rank).map(|k| 0x0101_0101 + k).fold(0_u32, u32::saturating_add);
        // Ranks in an order of their own.
        let right: Vec<[u32; 4]> = locals
            .flat_map(|local| {
                let rank = (local * 37 + 11) % INVOCATIONS as u32;
                let small = |rank: u32| 3 * (rank * rank.saturating_sub(1) / 2) + rank;
                let counts = [rank, small(rank), small(INVOCATIONS as u32), below(rank)];
                let of_neighbours = (8 * (local & !7) + 28) as f32;
                [sums, counts, [below(INVOCATIONS as u32), local, of_neighbours.to_bits(), 0]]
            })
            .collect();
        assert_eq!(differences(&right), None);
        assert_eq!(below(INVOCATIONS as u32), u32::MAX, "the large numbers overflow");
        let fails = |at: usize, value: [u32; 4], expected: &str| {
            let mut wrong = right.clone();
            wrong[at] = value;
            let message = differences(&wrong).unwrap_or_default();
            assert!(message.contains(expected), "{expected} not in: {message}");
        };
        fails(0, [sums[0], sums[1], sums[2], sums[3] + 1], "sums of a workgroup");
        fails(3 * 9 + 1, right[3 * 8 + 1], "taken");
        fails(3 * 9 + 1, [900, 0, 0, 0], "too large");
        let [rank, small, all, large] = right[3 * 200 + 1];
        fails(3 * 200 + 1, [rank, small + 1, all, large], "prefix sums");
        fails(3 * 200 + 2, [0; 4], "neighbours");
        let [_, place, of_neighbours, _] = right[3 * 200 + 2];
        fails(3 * 200 + 2, [0, place, of_neighbours, 0], "prefix sums");
    }

    #[test]
    fn modules_get_the_form_they_are_asked_for() {
        let portable = SELF_CHECK.source_in(Form::Portable);
        assert!(!portable.contains("subgroupAdd") && !portable.contains("@builtin(subgroup"), "{portable}");
        let by_subgroups = SELF_CHECK.source_in(Form::Subgroups);
        assert!(
            by_subgroups.contains("subgroupAdd(value)") && by_subgroups.contains("@builtin(subgroup_id)")
        );
        assert_eq!(SELF_CHECK.source(), portable);
    }
}
