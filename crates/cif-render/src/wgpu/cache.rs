//! Bind groups and small uniforms that are kept between submissions, and made anew when what they name has changed.

use std::collections::BTreeMap;

use bytemuck::Pod;

use super::buffers::Uniform;
use super::device::Gpu;
use super::kernel::Kernel;

/// Where a bind group is used: a name, and a number for repeated uses.
pub type Place = (&'static str, u32);

/// Bind groups by place.
#[derive(Debug, Default)]
pub struct BindCache {
    groups: BTreeMap<Place, (Vec<wgpu::Buffer>, wgpu::BindGroup)>,
}

impl BindCache {
    /// The bind group of a place, of these buffers in binding order.
    pub fn get(
        &mut self,
        gpu: &Gpu,
        place: Place,
        kernel: &Kernel,
        buffers: &[&wgpu::Buffer],
    ) -> wgpu::BindGroup {
        if let Some((known, group)) = self.groups.get(&place)
            && known.iter().eq(buffers.iter().copied())
        {
            return group.clone();
        }
        let resources: Vec<_> = buffers.iter().map(|buffer| buffer.as_entire_binding()).collect();
        let group = kernel.bind(gpu, &resources);
        self.groups.insert(place, (buffers.iter().copied().cloned().collect(), group.clone()));
        group
    }
}

/// Uniforms by place, written when their value changes.
#[derive(Debug)]
pub struct UniformCache<T> {
    uniforms: BTreeMap<Place, (T, Uniform<T>)>,
}

impl<T> Default for UniformCache<T> {
    fn default() -> Self {
        Self { uniforms: BTreeMap::new() }
    }
}

impl<T: Pod + PartialEq> UniformCache<T> {
    /// The uniform of a place with this value. One value per place and submission: a later write would reach the
    /// dispatches recorded before.
    pub fn get(&mut self, gpu: &Gpu, place: Place, value: T) -> &wgpu::Buffer {
        let (known, uniform) =
            self.uniforms.entry(place).or_insert_with(|| (value, Uniform::new(gpu, place.0, &value)));
        if *known != value {
            *known = value;
            uniform.write(gpu, &value);
        }
        uniform.buffer()
    }
}
