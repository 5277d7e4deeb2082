//! Peak throughput of the processor, measured on all threads.

use std::hint::black_box;
use std::time::{Duration, Instant};

use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x16};
use fearless_simd_macros::simd;
use rayon::prelude::*;

use super::SimdLevel;
use crate::speed::Speed;

/// Vectors that are multiplied and added at a time, so that no operation waits for the one before.
const CHAINS: usize = 12;

/// Rounds of the chains in a run.
const ROUNDS: u32 = 1 << 16;

/// Runs, of which the best counts.
const RUNS: usize = 5;

impl Speed {
    /// Measures the processor in some milliseconds: a copy between arrays of `bytes` together, which caches may hold, and
    /// chains of multiplications and additions with vector instructions of a level.
    ///
    /// # Panics
    /// When the processor lacks the level.
    #[must_use]
    pub fn of_processor(simd: SimdLevel, bytes: usize) -> Self {
        let level = simd.level().expect("a level that the processor has");
        let threads = rayon::current_num_threads();
        let values = (bytes / 8).max(threads);
        let source = vec![1.0_f32; values];
        let mut target = vec![0.0_f32; values];
        let chunk = values.div_ceil(threads);
        let copied = best(|| {
            let chunks = target.par_chunks_mut(chunk).zip(source.par_chunks(chunk));
            chunks.for_each(|(target, source)| target.copy_from_slice(source));
            black_box(&mut target);
        });
        let multiplied = best(|| {
            let sums = (0..threads).into_par_iter().map(|thread| multiply_add(level, thread as f32));
            black_box(sums.sum::<f32>());
        });
        let operations = threads * CHAINS * 16 * 2 * ROUNDS as usize;
        Self {
            bytes_per_second: 8.0 * values as f64 / copied.as_secs_f64().max(1e-9),
            flops_per_second: operations as f64 / multiplied.as_secs_f64().max(1e-9),
        }
    }
}

fn best(mut run: impl FnMut()) -> Duration {
    let timed = |_| {
        let start = Instant::now();
        run();
        start.elapsed()
    };
    // The first run makes the memory.
    (0..=RUNS).map(timed).min().unwrap_or_default()
}

fn multiply_add(level: Level, from: f32) -> f32 {
    dispatch!(level, simd => chains(simd, from))
}

#[simd]
fn chains<S: Simd>(simd: S, from: f32) -> f32 {
    let mut values: [f32x16<S>; CHAINS] = [f32x16::splat(simd, from); CHAINS];
    let (factor, term) = (f32x16::splat(simd, black_box(0.999)), f32x16::splat(simd, black_box(0.001)));
    for _ in 0..ROUNDS {
        for value in &mut values {
            *value = value.mul_add(factor, term);
        }
    }
    let mut lanes = [0.0; 16];
    values.into_iter().reduce(|a, b| a + b).expect("some chains").store_array(&mut lanes);
    lanes.into_iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_has_a_speed() {
        for level in SimdLevel::available() {
            let speed = Speed::of_processor(level, 1 << 20);
            assert!(speed.bytes_per_second > 1e6 && speed.flops_per_second > 1e6, "{level:?}: {speed:?}");
            assert!(speed.bytes_per_second.is_finite() && speed.flops_per_second.is_finite());
        }
        // x = 0.999 x + 0.001 stays at 1 where it begins there.
        let lanes = (16 * CHAINS) as f32;
        assert!((multiply_add(Level::new(), 1.0) / lanes - 1.0).abs() < 1e-4);
    }
}
