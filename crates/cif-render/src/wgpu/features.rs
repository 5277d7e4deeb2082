//! Optional features: used where an adapter has them, never required, and held back where that is asked.

use cif_system::environment::GPU_FEATURES;

use super::error::GpuError;

/// Which optional features devices may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpuFeatures {
    /// Sums over workgroups by subgroups.
    pub subgroups: bool,
    /// The same where software stands in for a GPU: it loops over subgroups, which is slower than memory.
    pub software_subgroups: bool,
    /// Constants of kernels in storage where software stands in for a GPU, see [`super::Gpu::constants_in_storage`]:
    /// more storage buffers than the core has.
    pub software_storage: bool,
    /// Times of stages from the device.
    pub timestamps: bool,
}

impl GpuFeatures {
    /// All that the adapter has.
    pub const ALL: Self =
        Self { subgroups: true, software_subgroups: true, software_storage: true, timestamps: true };
    /// All that make the adapter faster.
    pub const DEFAULT: Self = Self { software_subgroups: false, ..Self::ALL };
    /// The core of WebGPU alone.
    pub const NONE: Self =
        Self { subgroups: false, software_subgroups: false, software_storage: false, timestamps: false };
    /// The environment variable that holds features back.
    pub const VARIABLE: &str = GPU_FEATURES.name();

    /// Features that [`Self::VARIABLE`] allows; [`Self::DEFAULT`] where it is not set.
    ///
    /// # Errors
    /// When it names a feature that is not there.
    pub fn from_environment() -> Result<Self, GpuError> {
        GPU_FEATURES.text().map_or(Ok(Self::DEFAULT), |text| Self::parse(&text))
    }

    /// From `all`, `none`, or names separated by commas.
    ///
    /// # Errors
    /// When a name is not there.
    pub fn parse(text: &str) -> Result<Self, GpuError> {
        let mut features = Self { software_storage: true, ..Self::NONE };
        for name in text.split(',').map(str::trim) {
            match name {
                "all" if text.trim() == "all" => features = Self::ALL,
                "none" if text.trim() == "none" => features = Self::NONE,
                "subgroups" => (features.subgroups, features.software_subgroups) = (true, true),
                "timestamps" => features.timestamps = true,
                _ => return Err(GpuError::UnknownFeature { name: name.to_owned() }),
            }
        }
        Ok(features)
    }

    /// As wgpu has them.
    pub(super) fn welcome(self, in_software: bool) -> wgpu::Features {
        let mut features = wgpu::Features::empty();
        let subgroups = if in_software { self.software_subgroups } else { self.subgroups };
        features.set(wgpu::Features::SUBGROUP, subgroups);
        features.set(wgpu::Features::TIMESTAMP_QUERY, self.timestamps);
        features
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_are_named_and_others_refused() {
        let parse = GpuFeatures::parse;
        assert_eq!(parse("all"), Ok(GpuFeatures::ALL));
        assert_eq!(parse(" none "), Ok(GpuFeatures::NONE));
        let timestamps = GpuFeatures { subgroups: false, software_subgroups: false, ..GpuFeatures::ALL };
        assert_eq!(parse("timestamps"), Ok(timestamps));
        assert_eq!(parse("subgroups, timestamps"), Ok(GpuFeatures::ALL));
        for wrong in ["", "f64", "none,subgroups", "all,timestamps", "subgroups,"] {
            let error = parse(wrong).unwrap_err().to_string();
            assert!(error.contains("CIF_GPU_FEATURES") && error.contains("subgroups, timestamps"), "{error}");
        }
    }
}
