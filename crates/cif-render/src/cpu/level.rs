//! Which vector instructions the renderer runs on.

use fearless_simd::Level;

/// Which vector instructions to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SimdLevel {
    /// The widest the processor has.
    #[default]
    Auto,
    /// AVX-512 as of Ice Lake.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// Baseline instructions of the target only.
    Portable,
}

impl SimdLevel {
    /// The levels that this processor has, widest first; [`SimdLevel::Auto`] is the first of them.
    #[must_use]
    pub fn available() -> Vec<Self> {
        [Self::Avx512, Self::Avx2, Self::Portable].into_iter().filter(|level| level.is_available()).collect()
    }

    /// True when this processor has the instructions.
    #[must_use]
    pub fn is_available(self) -> bool {
        self.level().is_some()
    }

    /// All levels that this processor has, to dispatch to.
    #[cfg(test)]
    pub(super) fn levels() -> Vec<Level> {
        Self::available().into_iter().filter_map(Self::level).collect()
    }

    /// The level to dispatch to; `None` where the processor lacks it.
    pub(super) fn level(self) -> Option<Level> {
        match self {
            Self::Auto => Some(Level::new()),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Avx512 => Level::new().as_avx512().map(Level::Avx512),
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            Self::Avx2 => Level::new().as_avx2().map(Level::Avx2),
            #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
            Self::Avx512 | Self::Avx2 => None,
            Self::Portable => Some(Level::baseline()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_what_they_are_called() {
        let available = SimdLevel::available();
        assert_eq!(available.last(), Some(&SimdLevel::Portable), "every processor has its baseline");
        assert!(SimdLevel::Auto.is_available());
        let name = |level: SimdLevel| level.level().map(|level| format!("{level:?}"));
        assert_eq!(name(available[0]), name(SimdLevel::Auto));
        for (level, start) in [(SimdLevel::Avx512, "Avx512"), (SimdLevel::Avx2, "Avx2")] {
            if let Some(name) = name(level) {
                assert!(name.starts_with(start), "{name}");
            }
        }
    }
}
