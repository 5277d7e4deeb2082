//! Backends: whether the processor or a GPU does the work.

use cif_render::wgpu::{Gpu, SubgroupUse};
use cif_train::{TrainError, Trainer};
use clap::ValueEnum;

use crate::error::Error;

/// Backend that does the work.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Backend {
    /// A GPU where there is one that supports everything that is asked and is faster, which is measured for a
    /// second, else the processor
    Auto,
    /// The processor
    #[default]
    Cpu,
    /// A GPU, through Vulkan, Metal or Direct3D 12
    Wgpu,
}

impl Backend {
    /// As it is typed.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Wgpu => "wgpu",
        }
    }

    /// The GPU to use, if any; `auto` takes no software rasteriser for one. Notes go to stderr.
    ///
    /// # Errors
    /// When a GPU is asked for and there is none.
    pub fn open(self) -> Result<Option<Gpu>, Error> {
        let gpu = match self {
            Self::Cpu => Ok(None),
            Self::Wgpu => Gpu::open().map(Some).map_err(Error::plain),
            Self::Auto => Ok(match Gpu::open() {
                Ok(gpu) if !gpu.facts().software => Some(gpu),
                Ok(gpu) => {
                    crate::messages::note!(
                        "{} is no GPU but software on the processor; using --backend cpu",
                        gpu.facts().name
                    );
                    None
                }
                Err(error) => {
                    crate::messages::note!("{error}");
                    None
                }
            }),
        }?;
        if let Some(gpu) = &gpu
            && let SubgroupUse::Wrong(_) = gpu.subgroups()
        {
            crate::messages::note!("subgroups of {} are {}", gpu.facts().name, gpu.subgroups());
        }
        Ok(gpu)
    }

    /// Makes a trainer's steps run on the GPU, and says so; `auto` tries steps on both for a second, takes what is
    /// faster, and stays on the processor where the GPU cannot hold the scene or fails.
    ///
    /// # Errors
    /// When a GPU is asked for and cannot hold the scene.
    pub fn apply(self, gpu: Option<&Gpu>, trainer: &mut Trainer) -> Result<(), Error> {
        let Some(gpu) = gpu else { return Ok(()) };
        let name = format!("{} ({})", gpu.facts().name, gpu.facts().interface);
        if self != Self::Auto {
            trainer.use_gpu(gpu).map_err(Error::plain)?;
            crate::messages::outcome!("training on {name}");
            return Ok(());
        }
        match trainer.use_faster(gpu) {
            Ok(probe) if probe.gpu_is_faster() => crate::messages::outcome!("training on {name}: {probe}"),
            Ok(probe) => crate::messages::outcome!("training on the processor, not on {name}: {probe}"),
            Err(error @ TrainError::Device(_)) => {
                crate::messages::note!("{error}; using --backend cpu");
            }
            Err(error) => return Err(Error::plain(error)),
        }
        Ok(())
    }
}
