//! Limits of a deformation's shape, within which layout arithmetic cannot overflow.

use super::DeformationConfig;
use crate::error::ConfigError;

/// Most nodes along a spatial axis at multiplier 1.
pub const MAX_SPATIAL_RESOLUTION: u32 = 4096;
/// Most nodes along time.
pub const MAX_TIME_RESOLUTION: u32 = 65_536;
/// Most levels.
pub const MAX_LEVELS: usize = 8;
/// Largest resolution factor of a level.
pub const MAX_MULTIPLIER: u32 = 64;
/// Most channels per plane.
pub const MAX_CHANNELS: u32 = 256;
/// Largest MLP width.
pub const MAX_WIDTH: u32 = 1024;
/// Most floats in all planes: 8 GiB.
pub const MAX_PLANE_FLOATS: u64 = 1 << 31;

impl DeformationConfig {
    /// Checks that every setting is in range; the layouts may be asked for only then.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let within = |name, value: u32, low: u32, high: u32| {
            if (low..=high).contains(&value) {
                Ok(())
            } else {
                Err(ConfigError { name, value: value.to_string(), expected: format!("{low} to {high}") })
            }
        };
        for resolution in self.spatial_resolution {
            within("spatial_resolution", resolution, 2, MAX_SPATIAL_RESOLUTION)?;
        }
        within("time_resolution", self.time_resolution, 2, MAX_TIME_RESOLUTION)?;
        if self.multipliers.is_empty() || self.multipliers.len() > MAX_LEVELS {
            return Err(ConfigError {
                name: "multipliers",
                value: format!("a list of {}", self.multipliers.len()),
                expected: format!("1 to {MAX_LEVELS} factors"),
            });
        }
        for multiplier in &self.multipliers {
            within("multipliers", *multiplier, 1, MAX_MULTIPLIER)?;
        }
        within("channels", self.channels, 1, MAX_CHANNELS)?;
        within("width", self.width, 1, MAX_WIDTH)?;
        // At most 8 levels x 6 planes x 2^18 x 2^18 nodes x 2^8 channels < 2^50 floats.
        let floats = self.plane_layout().1 as u64;
        if floats > MAX_PLANE_FLOATS {
            return Err(ConfigError {
                name: "spatial_resolution, multipliers, channels",
                value: format!("{floats} floats together"),
                expected: format!("at most {MAX_PLANE_FLOATS}"),
            });
        }
        Ok(())
    }
}
