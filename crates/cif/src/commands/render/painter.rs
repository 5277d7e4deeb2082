//! Pictures of a scene by the processor or by a GPU.

#[cfg(feature = "wgpu")]
use cif_field::Field;
#[cfg(feature = "wgpu")]
use cif_geometry::PinholeCamera;
#[cfg(feature = "wgpu")]
use cif_render::cpu::BandRequest;
use cif_render::cpu::{Renderer, SimdLevel};
#[cfg(feature = "wgpu")]
use cif_render::wgpu::{Gpu, GpuError, GpuRenderer};
#[cfg(feature = "wgpu")]
use cif_render::{Channels, RenderSettings};

#[cfg(feature = "wgpu")]
use crate::backend::Backend;
#[cfg(feature = "wgpu")]
use crate::error::Error;

/// Backend that renders.
pub(super) enum Painter {
    /// The processor.
    Cpu(Box<Renderer>),
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(Box<GpuRenderer>),
}

/// View that is rendered first, to find the faster backend.
#[cfg(feature = "wgpu")]
pub(super) struct Sample<'a> {
    pub(super) field: &'a Field,
    pub(super) camera: &'a PinholeCamera,
    pub(super) time: f64,
    pub(super) settings: &'a RenderSettings,
    pub(super) channels: Channels,
    /// True when a GPU keeps spherical harmonics in 16-bit floats.
    pub(super) compact: bool,
}

#[cfg(feature = "wgpu")]
impl Sample<'_> {
    fn renderer(&self, gpu: &Gpu) -> Result<GpuRenderer, GpuError> {
        if self.compact { GpuRenderer::compact(gpu, self.field) } else { GpuRenderer::new(gpu, self.field) }
    }
}

impl Painter {
    /// The processor.
    pub(super) fn cpu(simd: SimdLevel) -> Self {
        Self::Cpu(Box::new(Renderer::new(simd)))
    }

    /// Opens the backend; `auto` renders `sample` on both where there is a GPU, and takes the faster.
    #[cfg(feature = "wgpu")]
    pub(super) fn choose(backend: Backend, simd: SimdLevel, sample: &Sample<'_>) -> Result<Self, Error> {
        let Some(gpu) = backend.open()? else { return Ok(Self::cpu(simd)) };
        let facts = gpu.facts();
        let name = format!("{} ({})", facts.name, facts.interface);
        if backend == Backend::Wgpu {
            crate::messages::outcome!("rendering on {name}");
            return sample.renderer(&gpu).map(|renderer| Self::Gpu(Box::new(renderer))).map_err(Error::plain);
        }
        let mut processor = Renderer::new(simd);
        let start = std::time::Instant::now();
        let request = BandRequest { channels: sample.channels, ..BandRequest::default() };
        let Ok(()) = processor.render_bands(
            sample.field,
            sample.camera,
            sample.time,
            sample.settings,
            &request,
            |_| Ok::<(), std::convert::Infallible>(()),
        );
        let on_processor = start.elapsed();
        match probe(&gpu, sample) {
            Ok((renderer, on_gpu)) if on_gpu < on_processor => {
                crate::messages::outcome!(
                    "rendering on {name}: {on_gpu:.1?} a view, {on_processor:.1?} on the processor"
                );
                Ok(Self::Gpu(Box::new(renderer)))
            }
            Ok((_, on_gpu)) => {
                crate::messages::outcome!(
                    "rendering on the processor: {on_processor:.1?} a view, {on_gpu:.1?} on {name}"
                );
                Ok(Self::Cpu(Box::new(processor)))
            }
            Err(error) => {
                crate::messages::note!("rendering on the processor, because {name} does not do it: {error}");
                Ok(Self::Cpu(Box::new(processor)))
            }
        }
    }
}

/// A renderer on the GPU, and the time of a view once everything is warm.
#[cfg(feature = "wgpu")]
fn probe(gpu: &Gpu, sample: &Sample<'_>) -> Result<(GpuRenderer, std::time::Duration), GpuError> {
    let mut renderer = sample.renderer(gpu)?;
    let view = |renderer: &mut GpuRenderer| {
        let Sample { field, camera, time, settings, channels, .. } = *sample;
        renderer.render_bands(field, camera, time, settings, channels, |_, _| Ok::<(), GpuError>(()))
    };
    view(&mut renderer)?;
    let start = std::time::Instant::now();
    view(&mut renderer)?;
    Ok((renderer, start.elapsed()))
}
