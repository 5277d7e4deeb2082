//! `--simd`: which vector instructions are used.

use cif_render::cpu::SimdLevel;
use clap::ValueEnum;
use clap::builder::{EnumValueParser, TypedValueParser};

/// Vector instructions of the renderer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::commands) enum Simd {
    /// The widest that the processor has
    Auto,
    /// AVX-512, as of Ice Lake
    Avx512,
    /// AVX2 with FMA
    Avx2,
    /// Baseline instructions of this kind of processor
    Portable,
}

impl Simd {
    /// Parses a level and refuses those that this processor lacks.
    pub(in crate::commands) fn parser() -> impl TypedValueParser<Value = Self> {
        EnumValueParser::<Self>::new().try_map(|simd| {
            if SimdLevel::from(simd).is_available() {
                return Ok(simd);
            }
            let available =
                Self::value_variants().iter().filter(|simd| SimdLevel::from(**simd).is_available());
            let names: Vec<&str> = available.map(|simd| simd.name()).collect();
            Err(format!("this processor does not have these instructions; it has {}", names.join(", ")))
        })
    }

    /// As it is typed.
    pub(in crate::commands) fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Avx512 => "avx512",
            Self::Avx2 => "avx2",
            Self::Portable => "portable",
        }
    }
}

impl From<Simd> for SimdLevel {
    fn from(simd: Simd) -> Self {
        match simd {
            Simd::Auto => Self::Auto,
            Simd::Avx512 => Self::Avx512,
            Simd::Avx2 => Self::Avx2,
            Simd::Portable => Self::Portable,
        }
    }
}
