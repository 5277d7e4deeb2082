//! `--backend`: whether the processor or a GPU does the work.

use cif_render::wgpu::Gpu;
use clap::ValueEnum;

use crate::error::Error;

/// What does the work.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum Backend {
    /// A GPU where there is one that supports everything that is asked, else the processor
    Auto,
    /// The processor
    #[default]
    Cpu,
    /// A GPU, through Vulkan, Metal or Direct3D 12
    Wgpu,
}

impl Backend {
    /// The GPU to use, if any; `auto` takes no software rasteriser for one.
    pub(super) fn open(self) -> Result<Option<Gpu>, Error> {
        match self {
            Self::Cpu => Ok(None),
            Self::Wgpu => Gpu::open().map(Some).map_err(Error::plain),
            Self::Auto => Ok(match Gpu::open() {
                Ok(gpu) if !gpu.facts().software => Some(gpu),
                Ok(gpu) => {
                    eprintln!(
                        "note: {} is no GPU but software on the processor; using --backend cpu",
                        gpu.facts().name
                    );
                    None
                }
                Err(error) => {
                    eprintln!("note: {error}");
                    None
                }
            }),
        }
    }
}
