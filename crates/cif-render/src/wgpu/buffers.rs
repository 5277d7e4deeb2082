//! Typed storage buffers that grow by need, uploads, and read-backs that may wait or not.

use std::marker::PhantomData;
use std::sync::mpsc::{Receiver, TryRecvError, channel};

use bytemuck::Pod;

use super::device::Gpu;
use super::error::GpuError;

/// Smallest allocation, bytes: bindings may not be empty.
const SMALLEST: u64 = 64;

/// An array on the device. Growing drops its contents unless said otherwise, and makes bind groups of the old
/// allocation stale: [`Self::generation`] changes.
#[derive(Debug)]
pub struct GpuVec<T> {
    label: &'static str,
    buffer: wgpu::Buffer,
    len: usize,
    generation: u64,
    marker: PhantomData<T>,
}

/// Usages of every array: kernels, copies both ways, indirect dispatch.
const USAGES: wgpu::BufferUsages = wgpu::BufferUsages::STORAGE
    .union(wgpu::BufferUsages::COPY_SRC)
    .union(wgpu::BufferUsages::COPY_DST)
    .union(wgpu::BufferUsages::INDIRECT);

impl<T: Pod> GpuVec<T> {
    /// Zeros.
    ///
    /// # Errors
    /// When the array exceeds what the device binds, with the arithmetic.
    pub fn zeros(gpu: &Gpu, label: &'static str, len: usize) -> Result<Self, GpuError> {
        let bytes = checked_bytes::<T>(gpu, label, len as u64)?;
        Ok(Self { label, buffer: allocate(gpu, label, bytes), len, generation: 0, marker: PhantomData })
    }

    /// Zeros of the same kind and name.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn like(&self, gpu: &Gpu, len: usize) -> Result<Self, GpuError> {
        Self::zeros(gpu, self.label, len)
    }

    /// A copy of values.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn from_slice(gpu: &Gpu, label: &'static str, values: &[T]) -> Result<Self, GpuError> {
        let array = Self::zeros(gpu, label, values.len())?;
        array.write(gpu, 0, values);
        Ok(array)
    }

    /// Elements.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// True when there are no elements.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Elements that fit without a new allocation.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.buffer.size() as usize / size_of::<T>()
    }

    /// Changes whenever the allocation does.
    #[must_use]
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// The allocation.
    #[must_use]
    pub fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    /// The whole allocation as a binding.
    #[must_use]
    pub fn binding(&self) -> wgpu::BindingResource<'_> {
        self.buffer.as_entire_binding()
    }

    /// Sets the length; a longer array than ever before is allocated anew with half as much room on top, and its
    /// contents are zeros. Says whether that happened.
    ///
    /// # Errors
    /// As [`Self::zeros`]; the array stays as it was.
    pub fn resize(&mut self, gpu: &Gpu, len: usize) -> Result<bool, GpuError> {
        let needed = checked_bytes::<T>(gpu, self.label, len as u64)?;
        self.len = len;
        if needed <= self.buffer.size() {
            return Ok(false);
        }
        let roomy = (needed + needed / 2).min(gpu.largest_binding()).max(needed);
        self.buffer = allocate(gpu, self.label, roomy);
        self.generation += 1;
        Ok(true)
    }

    /// As [`Self::resize`], keeping what was there.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn resize_keeping(&mut self, gpu: &Gpu, len: usize) -> Result<bool, GpuError> {
        let (old, kept) = (self.buffer.clone(), (self.len.min(len) * size_of::<T>()) as u64);
        let anew = self.resize(gpu, len)?;
        if anew && kept > 0 {
            let mut encoder = gpu.device().create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(&old, 0, &self.buffer, 0, kept.next_multiple_of(4));
            gpu.queue().submit([encoder.finish()]);
        }
        Ok(anew)
    }

    /// Overwrites elements from `first` on.
    ///
    /// # Panics
    /// When they reach past the end.
    pub fn write(&self, gpu: &Gpu, first: usize, values: &[T]) {
        assert!(
            first + values.len() <= self.len,
            "{}: {} + {} > {}",
            self.label,
            first,
            values.len(),
            self.len
        );
        if !values.is_empty() {
            gpu.queue().write_buffer(
                &self.buffer,
                (first * size_of::<T>()) as u64,
                bytemuck::cast_slice(values),
            );
        }
    }

    /// Replaces the contents, growing by need; says whether the allocation is new.
    ///
    /// # Errors
    /// As [`Self::zeros`].
    pub fn replace(&mut self, gpu: &Gpu, values: &[T]) -> Result<bool, GpuError> {
        let anew = self.resize(gpu, values.len())?;
        self.write(gpu, 0, values);
        Ok(anew)
    }

    /// Reads everything, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<T>, GpuError> {
        self.read_range(gpu, 0, self.len)
    }

    /// Reads elements, waiting for the device.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_range(&self, gpu: &Gpu, first: usize, count: usize) -> Result<Vec<T>, GpuError> {
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        let pending = self.read_later(gpu, &mut encoder, first, count);
        gpu.queue().submit([encoder.finish()]);
        pending.start().wait(gpu)
    }

    /// Records a copy for a read-back; nothing waits until [`Arriving::wait`].
    ///
    /// # Panics
    /// When the elements reach past the end.
    pub fn read_later(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        first: usize,
        count: usize,
    ) -> Recorded<T> {
        assert!(first + count <= self.len, "{}: {first} + {count} > {}", self.label, self.len);
        let size = (count * size_of::<T>()) as u64;
        let staging = gpu.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some(self.label),
            size: size.next_multiple_of(4).max(SMALLEST),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        if size > 0 {
            let from = (first * size_of::<T>()) as u64;
            encoder.copy_buffer_to_buffer(&self.buffer, from, &staging, 0, size.next_multiple_of(4));
        }
        Recorded { staging, count, marker: PhantomData }
    }
}

/// A read-back that is recorded but not submitted.
#[derive(Debug)]
#[must_use = "start it after the submission"]
pub struct Recorded<T> {
    staging: wgpu::Buffer,
    count: usize,
    marker: PhantomData<T>,
}

impl<T: Pod> Recorded<T> {
    /// To be called after the commands were submitted.
    pub fn start(self) -> Arriving<T> {
        let (sender, receiver) = channel();
        self.staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // Nobody listening any more is fine.
            let _ = sender.send(result.is_ok());
        });
        Arriving { staging: self.staging, count: self.count, receiver, marker: PhantomData }
    }
}

/// A read-back under way.
#[derive(Debug)]
#[must_use = "take or wait for what arrives"]
pub struct Arriving<T> {
    staging: wgpu::Buffer,
    count: usize,
    receiver: Receiver<bool>,
    marker: PhantomData<T>,
}

impl<T: Pod> Arriving<T> {
    /// The values once they have arrived, else the read-back itself, still under way; never waits.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn take(self, gpu: &Gpu) -> Result<Result<Vec<T>, Self>, GpuError> {
        gpu.poll()?;
        match self.receiver.try_recv() {
            Ok(mapped) => self.finish(gpu, mapped).map(Ok),
            Err(TryRecvError::Empty) => Ok(Err(self)),
            Err(TryRecvError::Disconnected) => self.finish(gpu, false).map(Ok),
        }
    }

    /// Waits for it.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub fn wait(self, gpu: &Gpu) -> Result<Vec<T>, GpuError> {
        gpu.wait()?;
        let mapped = self.receiver.recv().unwrap_or(false);
        self.finish(gpu, mapped)
    }

    fn finish(self, gpu: &Gpu, mapped: bool) -> Result<Vec<T>, GpuError> {
        gpu.check()?;
        let view = if mapped { self.staging.get_mapped_range(..).ok() } else { None };
        let Some(view) = view else {
            return Err(GpuError::Lost("a result cannot be read back".to_owned()));
        };
        let bytes = self.count * size_of::<T>();
        Ok(bytemuck::pod_collect_to_vec(&view[..bytes]))
    }
}

/// Small read-backs of equal size, again and again: their memory is used anew once they have been read.
#[derive(Debug)]
pub struct Readback {
    words: usize,
    free: Vec<wgpu::Buffer>,
}

/// A read-back that has been submitted.
#[derive(Debug)]
#[must_use = "open it, or wait for its submission"]
pub struct PendingWords(Arriving<u32>);

impl Readback {
    /// Read-backs of at most so many `words` of 4 bytes.
    #[must_use]
    pub fn new(words: usize) -> Self {
        Self { words, free: Vec::new() }
    }

    /// Records copies of words, (array, first byte, words) each, into one read-back, in their order.
    ///
    /// # Panics
    /// When they are more words than a read-back has.
    pub fn record(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        parts: &[(&wgpu::Buffer, u64, usize)],
    ) -> Recorded<u32> {
        let staging = self.free.pop().unwrap_or_else(|| {
            gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("read-back"),
                size: 4 * self.words as u64,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        });
        let mut at = 0;
        for (array, first_byte, words) in parts {
            assert!(at + words <= self.words, "a read-back has {} words", self.words);
            encoder.copy_buffer_to_buffer(array, *first_byte, &staging, 4 * at as u64, 4 * *words as u64);
            at += words;
        }
        Recorded { staging, count: at, marker: PhantomData }
    }

    /// The words that have arrived, or `pending` again while they are under way; never waits.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn open(
        &mut self,
        gpu: &Gpu,
        pending: PendingWords,
    ) -> Result<Result<Vec<u32>, PendingWords>, GpuError> {
        let staging = pending.0.staging.clone();
        Ok(match pending.0.take(gpu)? {
            Ok(words) => {
                staging.unmap();
                self.free.push(staging);
                Ok(words)
            }
            Err(arriving) => Err(PendingWords(arriving)),
        })
    }
}

impl Recorded<u32> {
    /// As [`Self::start`], for [`Readback::open`].
    pub fn send(self) -> PendingWords {
        PendingWords(self.start())
    }
}

/// A small block of constants that kernels read as a uniform, or from storage, see [`Gpu::constants_in_storage`].
#[derive(Debug)]
pub struct Uniform<T> {
    buffer: wgpu::Buffer,
    marker: PhantomData<T>,
}

impl<T: Pod> Uniform<T> {
    /// A block with a value.
    #[must_use]
    pub fn new(gpu: &Gpu, label: &'static str, value: &T) -> Self {
        let buffer = gpu.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: (size_of::<T>() as u64).next_multiple_of(16),
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let uniform = Self { buffer, marker: PhantomData };
        uniform.write(gpu, value);
        uniform
    }

    /// Replaces the value for the commands that are submitted next.
    pub fn write(&self, gpu: &Gpu, value: &T) {
        gpu.queue().write_buffer(&self.buffer, 0, bytemuck::bytes_of(value));
    }

    /// The allocation.
    #[must_use]
    pub fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    /// The block as a binding.
    #[must_use]
    pub fn binding(&self) -> wgpu::BindingResource<'_> {
        self.buffer.as_entire_binding()
    }
}

/// Bytes of an array, refused when the device cannot bind them.
fn checked_bytes<T>(gpu: &Gpu, label: &str, count: u64) -> Result<u64, GpuError> {
    checked_product(label, count, size_of::<T>() as u64, gpu.largest_binding())
}

/// The product in 128 bits, so that no count overflows.
pub(crate) fn checked_product(label: &str, count: u64, item_bytes: u64, limit: u64) -> Result<u64, GpuError> {
    let bytes = u128::from(count) * u128::from(item_bytes);
    if bytes > u128::from(limit) {
        return Err(GpuError::TooLarge {
            what: label.to_owned(),
            count,
            item_bytes,
            bytes,
            limit,
            advice: "fewer Gaussians or a smaller image".to_owned(),
        });
    }
    Ok((bytes as u64).next_multiple_of(16).max(SMALLEST))
}

fn allocate(gpu: &Gpu, label: &str, bytes: u64) -> wgpu::Buffer {
    gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: bytes,
        usage: USAGES,
        mapped_at_creation: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_beyond_the_device_are_refused_with_the_arithmetic() {
        assert_eq!(checked_product("x", 3, 4, 1024), Ok(64));
        assert_eq!(checked_product("x", 100, 4, 1024), Ok(400));
        let error = checked_product("tile pairs", 1 << 33, 8, 134_217_728).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("tile pairs: 8589934592 x 8 bytes = 68719476736 bytes"), "{text}");
        assert!(text.contains("134217728"), "{text}");
        assert!(checked_product("x", u64::MAX, u64::MAX, u64::MAX).is_err());
    }

    #[test]
    fn letters_arrive_in_order_and_their_memory_is_used_again() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        let a = GpuVec::from_slice(&gpu, "a", &[1_u32, 2, 3]).unwrap();
        let b = GpuVec::from_slice(&gpu, "b", &[[4.0_f32; 4]; 2]).unwrap();
        let mut readback = Readback::new(6);
        for round in 0..3_u32 {
            a.write(&gpu, 0, &[round]);
            let mut encoder = gpu.device().create_command_encoder(&Default::default());
            let parts = [(a.buffer(), 0, 2), (b.buffer(), 16, 4)];
            let recorded = readback.record(&gpu, &mut encoder, &parts);
            let submission = gpu.queue().submit([encoder.finish()]);
            let pending = recorded.send();
            gpu.wait_for(submission).unwrap();
            let words = readback.open(&gpu, pending).unwrap().unwrap();
            assert_eq!(
                words,
                [round, 2, 4.0_f32.to_bits(), 4.0_f32.to_bits(), 4.0_f32.to_bits(), 4.0_f32.to_bits()]
            );
            assert_eq!(readback.free.len(), 1, "one after the other needs one");
        }
    }

    #[test]
    fn the_first_fault_that_is_reported_stays() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        gpu.tell(GpuError::OutOfMemory("no room".to_owned()));
        gpu.tell(GpuError::Lost("later".to_owned()));
        assert_eq!(gpu.check(), Err(GpuError::OutOfMemory("no room".to_owned())));
    }

    #[test]
    fn a_lost_device_is_an_error_and_nothing_hangs() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        let values = GpuVec::from_slice(&gpu, "values", &[1_u32, 2, 3]).unwrap();
        assert_eq!(values.read(&gpu).unwrap(), [1, 2, 3]);
        gpu.device().destroy();
        let _ = gpu.wait();
        let error = values.read(&gpu).unwrap_err();
        assert!(error.to_string().contains("GPU"), "{error}");
        assert!(gpu.check().is_err(), "the fault stays");
    }
}
