//! Prefix sums and radix sorts of arrays on the device.

use super::buffers::GpuVec;
use super::cache::{BindCache, Place, UniformCache};
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{Kernel, Stage, workgroups};
use super::stages::{SCAN, SORT, entries};
use super::view::{NONE, SCAN_BLOCK, SORT_BLOCK, ScanParameters, SortParameters, work};

/// Number of elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Count {
    /// Known here.
    Host(usize),
    /// The pairs of the work counts.
    Pairs,
}

/// Exclusive prefix sums in place, saturating.
#[derive(Debug)]
pub struct Scan {
    reduce: Kernel,
    spine: Kernel,
    spread: Kernel,
    sums: GpuVec<u32>,
    uniforms: UniformCache<ScanParameters>,
}

impl Scan {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the driver rejects them.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [reduce, spine, spread] = entries(gpu, &SCAN)?;
        let sums = GpuVec::zeros(gpu, "sums of blocks", 0)?;
        Ok(Self { reduce, spine, spread, sums, uniforms: UniformCache::default() })
    }

    /// Records the sum over the first elements of `values`. `work` are the counts that [`Count::Pairs`] reads: then
    /// the elements are the digit counts of the sort of pairs, at most `capacity`.
    ///
    /// # Errors
    /// When scratch memory exceeds what the device binds.
    pub fn record(
        &mut self,
        gpu: &Gpu,
        cache: &mut BindCache,
        stage: &mut Stage<'_>,
        place: Place,
        values: &GpuVec<u32>,
        count: Count,
        capacity: usize,
        counts: &GpuVec<u32>,
    ) -> Result<(), GpuError> {
        let blocks = capacity.div_ceil(SCAN_BLOCK);
        if self.sums.len() < blocks {
            self.sums.resize(gpu, blocks)?;
        }
        let parameters = match count {
            Count::Host(count) => ScanParameters { count: count as u32, work_element: NONE, unused: [0; 2] },
            Count::Pairs => ScanParameters { count: 0, work_element: work::DIGITS as u32, unused: [0; 2] },
        };
        let uniform = self.uniforms.get(gpu, place, parameters);
        let buffers = [uniform, counts.buffer(), values.buffer(), self.sums.buffer()];
        let group = cache.get(gpu, place, &self.reduce, &buffers);
        for kernel in [&self.reduce, &self.spine, &self.spread] {
            if std::ptr::eq(kernel, &self.spine) {
                stage.dispatch(kernel, &group, [1, 1, 1]);
            } else if let Count::Host(count) = count {
                stage.dispatch(kernel, &group, workgroups(count, SCAN_BLOCK));
            } else {
                stage.dispatch_indirect(kernel, &group, counts, work::BY_DIGIT_BLOCK);
            }
        }
        Ok(())
    }
}

/// Keys with a value each, twice: a pass reads one and writes the other.
#[derive(Debug)]
pub struct SortArrays {
    /// Keys.
    pub keys: [GpuVec<u32>; 2],
    /// Values.
    pub values: [GpuVec<u32>; 2],
    digits: GpuVec<u32>,
}

impl SortArrays {
    /// Arrays without elements.
    ///
    /// # Errors
    /// Never for empty arrays.
    pub fn new(gpu: &Gpu, label: &'static str) -> Result<Self, GpuError> {
        let array = || GpuVec::zeros(gpu, label, 0);
        Ok(Self { keys: [array()?, array()?], values: [array()?, array()?], digits: array()? })
    }

    /// Sets the number of elements; contents are lost when it grows.
    ///
    /// # Errors
    /// When the arrays exceed what the device binds.
    pub fn resize(&mut self, gpu: &Gpu, len: usize) -> Result<(), GpuError> {
        for array in self.keys.iter_mut().chain(&mut self.values) {
            array.resize(gpu, len)?;
        }
        self.digits.resize(gpu, 16 * self.keys[0].capacity().div_ceil(SORT_BLOCK))?;
        Ok(())
    }
}

/// Blocks up to which each of them adds up the counts of those before it, which saves the three dispatches of a prefix sum
/// in every pass. Together they read `16 blocks^2` counts, 16 MB at this many, about what three dispatches take.
const FEW_BLOCKS: usize = 512;

/// Stable radix sorts by 32-bit keys, 4 bits a pass.
#[derive(Debug)]
pub struct RadixSort {
    histogram: Kernel,
    scatter: Kernel,
    uniforms: UniformCache<SortParameters>,
}

impl RadixSort {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the driver rejects them.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [histogram, scatter] = entries(gpu, &SORT)?;
        Ok(Self { histogram, scatter, uniforms: UniformCache::default() })
    }

    /// Records the sort of `arrays.keys[0]` by the lowest `bits`; says in which of the two the result lies.
    ///
    /// # Errors
    /// When scratch memory exceeds what the device binds.
    #[expect(clippy::too_many_arguments, reason = "the recorder's place, its scratch and its operands")]
    pub fn record(
        &mut self,
        gpu: &Gpu,
        cache: &mut BindCache,
        stage: &mut Stage<'_>,
        scan: &mut Scan,
        name: &'static str,
        arrays: &SortArrays,
        count: Count,
        bits: u32,
        counts: &GpuVec<u32>,
    ) -> Result<usize, GpuError> {
        let passes = bits.div_ceil(4);
        let is_summed = match count {
            Count::Host(count) => count,
            Count::Pairs => arrays.keys[0].len(),
        } > FEW_BLOCKS * SORT_BLOCK;
        for pass in 0..passes {
            let (from, to) = (pass as usize % 2, 1 - pass as usize % 2);
            let (host_count, work_element) = match count {
                Count::Host(count) => (count as u32, NONE),
                Count::Pairs => (0, work::PAIRS as u32),
            };
            let is_summed_word = u32::from(is_summed);
            let parameters = SortParameters {
                count: host_count,
                work_element,
                shift: 4 * pass,
                is_summed: is_summed_word,
            };
            let uniform = self.uniforms.get(gpu, (name, pass), parameters);
            let buffers = [
                uniform,
                counts.buffer(),
                arrays.keys[from].buffer(),
                arrays.values[from].buffer(),
                arrays.digits.buffer(),
                arrays.keys[to].buffer(),
                arrays.values[to].buffer(),
            ];
            let group = cache.get(gpu, (name, pass), &self.histogram, &buffers);
            let run = |stage: &mut Stage<'_>, kernel: &Kernel| match count {
                Count::Host(count) => stage.dispatch(kernel, &group, workgroups(count, SORT_BLOCK)),
                Count::Pairs => stage.dispatch_indirect(kernel, &group, counts, work::BY_SORT_BLOCK),
            };
            run(stage, &self.histogram);
            if is_summed {
                let digits = match count {
                    Count::Host(count) => Count::Host(16 * count.div_ceil(SORT_BLOCK)),
                    Count::Pairs => Count::Pairs,
                };
                // A place of its own, apart from those of the sort.
                let place = (name, pass + 100);
                scan.record(gpu, cache, stage, place, &arrays.digits, digits, arrays.digits.len(), counts)?;
            }
            run(stage, &self.scatter);
        }
        Ok(passes as usize % 2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wgpu::kernel::Commands;
    use crate::wgpu::testing;

    fn number(k: usize) -> u32 {
        (k as u32 ^ 0x5bd1).wrapping_mul(0x9e37_79b1)
    }

    #[test]
    fn prefix_sums_saturate_and_are_those_of_the_host_in_both_forms() {
        for gpu in testing::gpus() {
            let mut scan = Scan::new(&gpu).unwrap();
            let none = GpuVec::<u32>::zeros(&gpu, "work", work::LEN).unwrap();
            // Within a workgroup, over several, over several rounds of the spine; small, and overflowing half way.
            for (count, largest) in
                [(1, 9), (255, 9), (1024, 9), (1025, 9), (5000, 1000), (300_000, 13_000), (300_000, 29_000)]
            {
                let values: Vec<u32> = (0..count).map(|k| number(k) % largest).collect();
                let array = GpuVec::from_slice(&gpu, "values", &values).unwrap();
                let mut commands = Commands::new(&gpu, None);
                commands.stage("scan", |stage| {
                    let place = ("test", count as u32);
                    let mut cache = BindCache::default();
                    scan.record(&gpu, &mut cache, stage, place, &array, Count::Host(count), count, &none)
                        .unwrap();
                });
                commands.submit();
                let mut sum = 0_u32;
                for (k, (found, value)) in array.read(&gpu).unwrap().into_iter().zip(values).enumerate() {
                    assert_eq!(found, sum, "{:?}: {k} of {count} below {largest}", gpu.form());
                    sum = sum.saturating_add(value);
                }
                assert_eq!(sum == u32::MAX, largest == 29_000, "{sum}");
            }
        }
    }

    #[test]
    fn sorts_are_stable_in_both_forms() {
        for gpu in testing::gpus() {
            let (mut scan, mut sort) = (Scan::new(&gpu).unwrap(), RadixSort::new(&gpu).unwrap());
            let none = GpuVec::<u32>::zeros(&gpu, "work", work::LEN).unwrap();
            for count in [1, 2047, 2049, 70_000, FEW_BLOCKS * SORT_BLOCK + 1] {
                // Many equal keys, and the largest.
                let keys: Vec<u32> =
                    (0..count).map(|k| if k % 11 == 0 { u32::MAX } else { number(k / 3) }).collect();
                let mut expected: Vec<u32> = (0..count as u32).collect();
                expected.sort_by_key(|k| keys[*k as usize]);
                let mut arrays = SortArrays::new(&gpu, "test").unwrap();
                arrays.resize(&gpu, count).unwrap();
                arrays.keys[0].write(&gpu, 0, &keys);
                arrays.values[0].write(&gpu, 0, &(0..count as u32).collect::<Vec<u32>>());
                let mut commands = Commands::new(&gpu, None);
                let mut result = 0;
                commands.stage("sort", |stage| {
                    let mut cache = BindCache::default();
                    let count = Count::Host(count);
                    result = sort
                        .record(&gpu, &mut cache, stage, &mut scan, "test", &arrays, count, 32, &none)
                        .unwrap();
                });
                commands.submit();
                let found = arrays.values[result].read_range(&gpu, 0, count).unwrap();
                assert!(found == expected, "{:?}: {count} keys", gpu.form());
            }
        }
    }
}
